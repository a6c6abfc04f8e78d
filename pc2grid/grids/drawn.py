"""Maps that are no recordings, as occupancy grids: a nav2 map, or a point cloud or mesh of a building.

A cloud, such as a terrestrial scan or the map of another program, becomes a grid in three steps:

1. The floor is found and levelled (`level_cloud`).
2. Viewpoints are spread over the visible floor that is free of obstacles.
3. From each of them the cloud around it is reduced to the plane and drawn, as a scan of a recording is
(`project_to_plane`, `GridBuilder`). So the ground between visible floor and a wall is free even if furniture
hid the floor there, as in the map of a robot.

Steps 2 and 3 need the memory of a tile beside the voxels and the grid. At the end the levelled cloud is
checked: it may be upside down, on its side, or one floor of several.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.cloud import VoxelCloud, random_subset
from pc2grid.clouds.ground import CLOUD_PARAMETERS, LEVEL, Ground, find_ground
from pc2grid.clouds.planar_scan import project_to_plane
from pc2grid.errors import MapFileError
from pc2grid.geometry import (
    F32,
    F64,
    I64,
    SE2,
    U8,
    BoolGrid,
    frozen_arrays,
    invert_pose,
    leveling,
    transform_points,
)
from pc2grid.grids.occupancy import GridBuilder
from pc2grid.io.building_file import (
    UPRIGHT,
    axis_of_file,
    building_points,
    digest_of_building,
    is_building_file,
    kind_of,
    neighbour_distances_m,
)
from pc2grid.io.maps import MAX_CELLS, is_map_file, load_map
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from pc2grid.settings import Config, ProjectionConfig, ReadConfig

_SPACING_NEIGHBOUR = 3
"""On a surface the third neighbour is as far away as a voxel filter is wide; the first may be much nearer."""


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(T_map_file=(np.float64, 4, 4), level_points_m=(np.float64, "V", 3))
class DrawnMap:
    """A map that was read from a file.

    grid : in the map frame. kind : "nav2 map", "cloud" or "mesh".
    T_map_file : (4, 4), the frame of the file in the map frame, whose floor is level and at z = 0. Of a nav2
        map the two are the same.
    level_points_m : (V, 3) in the map frame, one a voxel of the size of a cell; empty for a nav2 map.
    digest : sha256 of what was read. warnings : sentences for the user.
    """

    grid: OccupancyGrid
    kind: str
    T_map_file: F64
    level_points_m: F64
    digest: str
    warnings: tuple[str, ...] = ()


def is_drawn_map(path: Path) -> bool:
    """Return True if an input is a map, not a recording."""
    return is_map_file(path) or is_building_file(path)


def load_drawn_map(path: str | Path, config: Config = Config()) -> DrawnMap:
    """Read a map. `config.read` has unit and axes of a cloud, `config.projection` how it is drawn.

    Raises MapFileError if it cannot be read, shows no floor or is not in metres; LimitExceeded if it is too
    large.

    >>> drawn = load_drawn_map("map.yaml")
    >>> drawn.kind, drawn.grid.resolution_m
    ('nav2 map', 0.05)
    """
    path = Path(path)
    if is_map_file(path):
        warnings: list[str] = []
        grid = load_map(path, warnings.append)
        return DrawnMap(
            grid=grid,
            kind="nav2 map",
            T_map_file=np.eye(4),
            level_points_m=np.empty((0, 3)),
            digest=_digest_of_nav2_map(path, grid),
            warnings=tuple(warnings),
        )
    kind = kind_of(path)
    with named(path):
        points = voxel_cloud(building_points(path, config.read, check_plausible), config.projection)
        T_map_file = level_cloud(points, floor_z=config.read.floor_z, up=config.read.up)
        level = transform_points(T_map_file, points)
        # Viewpoints, unlike `drivable_plan(level)`, also include the ground that furniture hides from above,
        # as the map of a robot does.
        sparse = _sparse(points)
        try:
            grid = map_cloud(level, config.projection, origin_m=T_map_file[:3, 3])
        except MapFileError as error:
            raise MapFileError("; ".join((error.message, *sparse)), hint=error.hint) from error
    return DrawnMap(
        grid=grid,
        kind=kind,
        T_map_file=T_map_file,
        level_points_m=level,
        digest=digest_of_building(path),
        warnings=tuple(
            f"{path.name}: {sentence}"
            for sentence in (*sparse, *_doubts(level, T_map_file, config.read, dense=not sparse))
        ),
    )


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Name the file in errors that do not."""
    try:
        yield
    except MapFileError as error:
        if str(path) in error.message:
            raise
        raise MapFileError(f"{path}: {error.message}", hint=error.hint) from error


def digest_of_map(path: Path) -> str:
    """Return the sha256 of `DrawnMap.digest`, without drawing the map."""
    return (
        _digest_of_nav2_map(path, load_map(path, warn=lambda sentence: None))
        if is_map_file(path)
        else digest_of_building(path)
    )


def _digest_of_nav2_map(path: Path, grid: OccupancyGrid) -> str:
    """Return the sha256 of the text and the cells, not of the image file: other formats can hold the same
    cells."""
    return hashlib.sha256(path.read_bytes() + grid.cells.tobytes()).hexdigest()


def _sparse(points: F64) -> tuple[str, ...]:
    """Return a warning if the points (V, 3) are too far from each other to draw walls without gaps."""
    spacing_m = float(np.median(neighbour_distances_m(points, _SPACING_NEIGHBOUR)))
    if spacing_m <= _SPARSE_M:
        return ()
    return (
        f"its points are {spacing_m:.2f} m apart, so walls have gaps and a lidar may not be found in it; less"
        f" than {_SPARSE_M:g} m is needed: a voxel filter of 0.1 m or finer",
    )


def _doubts(level: F64, T_map_file: F64, read: ReadConfig, *, dense: bool) -> Iterator[str]:
    """Yield warnings about the map of a levelled cloud (V, 3). dense : it is dense enough to show its
    doors."""
    if dense and is_upside_down(level):
        down = axis_of_file(np.array([0.0, 0.0, -1.0]), read.up)
        yield (
            "it looks upside down, as doors or furniture reach up to its highest plane, not down to its"
            f" lowest; if so, the map is mirrored: --set read.up={down} turns it"
        )
    if read.floor_z is not None:
        return
    side = side_that_is_up(level)
    if side is not None:
        side = T_map_file[:3, :3].T @ side
        axes = (axis_of_file(side, read.up), axis_of_file(-side, read.up))
        yield (
            "it looks as if it lay on its side, with a wall taken for the floor:"
            f" --set read.up={axes[0]} or {axes[1]} turns it"
        )
    others = other_floors(level)
    if others:
        middle_m = np.median(level[:, :2], axis=0)
        there = np.array([(*middle_m, height_m) for height_m, _ in others], np.float64)
        z_m = transform_points(invert_pose(T_map_file), there)[:, 2]
        floors = " and ".join(
            f"another floor lies at z = {z:.1f} with {area_m2:.0f} m2"
            for z, (_, area_m2) in zip(z_m, others, strict=True)
        )
        yield f"the lowest floor is mapped; {floors}: --set read.floor_z={z_m[0]:.1f} maps that one"


# --- from a cloud to a grid ---------------------------------------------------------------------------

PROJECTION = ProjectionConfig()


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudMapParameters:
    """How a cloud becomes a grid. Chosen by hand; tried on a 3D scan of an office floor with 5 cm voxels.

    resolution_m : edge of a cell, and of the voxels in which points are counted, so that a dense cloud
        gives the same grid as a thin one.
    floor_m : points this near to the floor plane are floor. A floor is uneven by some centimetres over a
        whole storey.
    refine_m : RANSAC tolerance when the plane is fitted to the points near the floor.
    passage_m : lowest and highest height above the floor at which an obstacle blocks a robot.
    obstacle_voxels : a cell is occupied if at least this many voxels above it are; one alone may be noise.
    gap_m : gaps of the seen floor, and holes of walls, up to this wide are closed.
    max_cells : larger grids are refused, since a few stray points would make them.

    Viewpoints:

    tile_m : edge of the tiles in which the cloud is drawn.
    spacing_m : at most one viewpoint in a square of this edge.
    clearance_m : least distance of a viewpoint to what is not seen floor.
    height_m : of the viewpoints above the floor.
    sight_m : range of the view from a viewpoint. Up to 11 m a voxel of 5 cm is wider than a bearing of a
        planar scan (0.25 degrees), so that no bearing passes through a wall.
    hidden_m : ground farther than this from visible floor is not free, even if it lies before a wall.
    ceiling_m : points higher above the floor are not used: they belong to the storey above.
    tall_m : the largest height of a building. A higher cloud is not in metres.
    small_m : the least width and depth of a building.
    """

    resolution_m: float = PROJECTION.resolution_m
    floor_m: float = 0.15
    refine_m: float = resolution_m
    passage_m: tuple[float, float] = (0.2, 1.6)
    obstacle_voxels: int = 2
    gap_m: float = 0.2
    max_cells: int = MAX_CELLS

    spacing_m: float = 1.0
    clearance_m: float = 0.15
    height_m: float = 1.0
    sight_m: float = 8.0
    tile_m: float = 2.0 * sight_m
    hidden_m: float = 0.5
    ceiling_m: float = 4.0
    tall_m: float = 60.0
    small_m: float = 1.0


CLOUD_MAP = CloudMapParameters()
_SPARSE_M = 3.0 * CLOUD_MAP.resolution_m
"""Spacing of points above which walls have gaps. Chosen by hand."""
_SCANS_OF_A_VIEW = 2
"""Scans of the same that make a cell free in a `GridBuilder`."""


def voxel_cloud(
    blocks: Iterable[NDArray[np.floating]],
    projection: ProjectionConfig = PROJECTION,
) -> F64:
    """Return the points of blocks (N, 3), one for each voxel of the size of a cell, (V, 3).

    Raises MapFileError if they cannot be a building in metres.
    """
    cloud = VoxelCloud(projection.resolution_m)
    for block in blocks:
        if len(block) and not len(cloud):
            check_plausible(block)
        cloud.add(block)
    return cloud.points_m()


def map_cloud(
    level_points_m: NDArray[np.floating],
    projection: ProjectionConfig = PROJECTION,
    *,
    origin_m: F64 | None = None,
) -> OccupancyGrid:
    """Draw the occupancy grid of a levelled cloud (N, 3), whose floor is at z = 0.

    The cloud has one point a voxel (`voxel_cloud`). The grid has its x and y axes.

    origin_m : (3,) position of the sensor, if the cloud may be a single scan. Such a scan shows only rings
        of the floor, on which no viewpoint fits.

    Raises MapFileError if no viewpoint is found, LimitExceeded if the map needs more than `max_cells`.

    >>> import numpy as np
    >>> floor = np.mgrid[0:4:0.05, 0:3:0.05, 0:1].reshape(3, -1).T
    >>> wall = np.mgrid[0:4:0.05, 3:3.05:0.05, 0:2:0.05].reshape(3, -1).T
    >>> grid = map_cloud(np.concatenate((floor, wall)))
    >>> bool(grid.free.any()), bool(grid.occupied.any())
    (True, True)
    """
    p = CLOUD_MAP
    points = np.asarray(level_points_m, np.float64)
    builder = GridBuilder(projection)
    for corner_m, near in _tiles(_without_noise(points, projection)):
        for view_m in _viewpoints(near, corner_m, projection):
            _draw(builder, near, view_m, projection)
    grid = builder.grid()
    if grid.cells.size:
        # A view through a wall that was not scanned ends on some obstacle of another room: free cells that
        # are far from all visible floor are removed.
        unseen = ~_mask(grid.to_cell(points[np.abs(points[:, 2]) < p.floor_m, :2]), grid.cells.shape)
        away_m = cv2.distanceTransform(unseen.astype(np.uint8), cv2.DIST_L2, 5) * grid.resolution_m
        cells = np.where(grid.free & (away_m > p.hidden_m), np.int8(UNKNOWN), grid.cells)
        return dataclasses.replace(grid, cells=cells)
    if origin_m is None or not p.floor_m < origin_m[2] < p.ceiling_m:
        raise MapFileError(
            "the floor of the cloud is seen nowhere without something on it",
            hint=f"obstacles are what is {projection.band_min_m:g} to {projection.band_max_m:g} m above the"
            " floor (settings projection.band_min_m and band_max_m)",
        )
    _draw(builder, points, origin_m, projection)
    return builder.grid()


def _tiles(points: F64) -> Iterator[tuple[F64, F64]]:
    """Yield the lower left corner (2,) of each tile with points (N, 3), and the points (M, 3) that are in
    sight of it."""
    edge_m, margin_m = CLOUD_MAP.tile_m, CLOUD_MAP.sight_m
    points = points[np.argsort(points[:, 0], kind="stable")]
    for corner_m in np.unique(np.floor(points[:, :2] / edge_m), axis=0) * edge_m:
        low_m, high_m = corner_m - margin_m, corner_m + edge_m + margin_m
        first, last = np.searchsorted(points[:, 0], (low_m[0], high_m[0]))
        strip = points[first:last]
        yield corner_m, strip[(strip[:, 1] >= low_m[1]) & (strip[:, 1] < high_m[1])]


def _without_noise(points: F64, projection: ProjectionConfig) -> F64:
    """Return the points up to the ceiling, without obstacles of fewer than `obstacle_voxels` in a cell."""
    p = CLOUD_MAP
    points = points[(points[:, 2] > -p.floor_m) & (points[:, 2] < p.ceiling_m)]
    cell = np.floor(points[:, :2] / projection.resolution_m).astype(np.int64)
    _, column = np.unique((cell[:, 0] << 32) + cell[:, 1], return_inverse=True)
    band = (points[:, 2] > projection.band_min_m) & (points[:, 2] < projection.band_max_m)
    obstacles = np.bincount(column, band)
    return np.asarray(points[~band | (obstacles[column] >= p.obstacle_voxels)])


def _viewpoints(near: F64, corner_m: F64, projection: ProjectionConfig) -> F64:
    """Return viewpoints (K, 3) in a tile, one in each square of `spacing_m` that has room for it on visible
    floor.

    near : the points of the tile and around it. corner_m : (2,) of the tile.
    """
    p, cell_m = CLOUD_MAP, projection.resolution_m
    side = round((p.tile_m + 2.0 * p.spacing_m) / cell_m)
    low_m = corner_m - p.spacing_m
    cell = np.floor((near[:, 1::-1] - low_m[::-1]) / cell_m).astype(np.int64)
    seen = _mask(cell[np.abs(near[:, 2]) < p.floor_m], (side, side))
    obstacle = _mask(cell[_between(near[:, 2], projection.band_min_m, projection.band_max_m)], (side, side))
    room_m = cv2.distanceTransform(_without_gaps(seen, cell_m) * ~obstacle, cv2.DIST_L2, 5) * cell_m
    step = round(p.spacing_m / cell_m)
    squares = room_m[step:-step, step:-step]
    count = len(squares) // step
    squares = squares[: count * step, : count * step].reshape(count, step, count, step).swapaxes(1, 2)
    best = squares.reshape(count, count, step * step).argmax(axis=2)
    row, column = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    at = np.column_stack([(column * step + best % step).ravel(), (row * step + best // step).ravel()])
    roomy = squares.reshape(count * count, step * step).max(axis=1) >= p.clearance_m
    xy_m = corner_m + (at[roomy] + 0.5) * cell_m
    return np.column_stack((xy_m, np.full(len(xy_m), p.height_m)))


def _without_gaps(floor: BoolGrid, cell_m: float) -> U8:
    """Close the narrow gaps of the visible floor (H, W); returns 0 or 1."""
    side = 2 * round(CLOUD_MAP.gap_m / cell_m / 2) + 1
    kernel = np.ones((side, side), np.uint8)
    return cv2.morphologyEx(floor.astype(np.uint8), cv2.MORPH_CLOSE, kernel).astype(np.uint8)


def _draw(builder: GridBuilder, near: F64, view_m: F64, projection: ProjectionConfig) -> None:
    """Draw the surroundings of a viewpoint (3,), as if a scan from there had returned them."""
    away = near - (view_m[0], view_m[1], 0.0)
    away = away[np.einsum("ij,ij->i", away[:, :2], away[:, :2]) < CLOUD_MAP.sight_m**2]
    planar_scan = project_to_plane(
        away.astype(np.float32),
        stamp_ns=0,
        sensor_m=np.array([0.0, 0.0, view_m[2]]),
        ground=Ground(np.array([0.0, 0.0, 1.0]), 0.0),
        config=projection,
    )
    closed = dataclasses.replace(planar_scan, free_m=_without_slits(planar_scan.free_m))
    for _ in range(_SCANS_OF_A_VIEW):
        builder.add(closed, SE2(float(view_m[0]), float(view_m[1]), 0.0))


def _without_slits(free_m: F32) -> F32:
    """Return free ranges (B,) that do not pass between obstacles which are less than `gap_m` apart.

    Scanned walls have holes, through which a view would show the next room in stripes.
    """
    gap_m, bearing_rad = CLOUD_MAP.gap_m, 2.0 * np.pi / len(free_m)
    known_m = np.where(free_m > 0.0, free_m, np.inf)
    shortest_m = known_m.copy()
    widest = int(0.5 * gap_m / bearing_rad / max(known_m.min(), gap_m))
    for step in range(1, widest + 1):
        wide = np.where(known_m * (step * bearing_rad) < 0.5 * gap_m, known_m, np.inf)
        for side in (step, -step):
            np.minimum(shortest_m, np.roll(wide, side), out=shortest_m)
    return np.where(free_m > 0.0, shortest_m, 0.0).astype(np.float32)


def drivable_plan(level_points_m: NDArray[np.floating]) -> OccupancyGrid:
    """Draw where a robot can drive in a levelled cloud (N, 3), whose floor is at z = 0.

    A cell is free if the floor is visible and nothing stands on it at the heights of a robot, and occupied if
    something does. The grid has the x and y axes of the cloud.

    Raises MapFileError if the cloud is too large for a grid.

    >>> import numpy as np
    >>> floor = np.mgrid[0:4:0.05, 0:3:0.05, 0:1].reshape(3, -1).T
    >>> wall = np.mgrid[0:4:0.05, 3:3.05:0.05, 0:2:0.05].reshape(3, -1).T
    >>> grid = drivable_plan(np.concatenate((floor, wall)))
    >>> bool(grid.free.any()), bool(grid.occupied.any())
    (True, True)
    """
    p, points = CLOUD_MAP, np.asarray(level_points_m, np.float64)
    near = points[_between(points[:, 2], -p.floor_m, p.passage_m[1])]
    voxels = np.unique(np.floor(near / p.resolution_m).astype(np.int64), axis=0)
    if not len(voxels):
        raise MapFileError("the cloud has no points near its floor")
    low = voxels[:, :2].min(axis=0)
    columns, rows = (int(v) for v in voxels[:, :2].max(axis=0) - low + 1)
    if rows * columns > p.max_cells:
        raise MapFileError(
            f"the cloud is {columns * p.resolution_m:.0f} x {rows * p.resolution_m:.0f} m large",
            hint="remove stray points from it",
        )
    shape = (rows, columns)
    cell = (voxels[:, 1] - low[1]) * columns + voxels[:, 0] - low[0]
    height_m = (voxels[:, 2] + 0.5) * p.resolution_m

    def counts(chosen: NDArray[np.bool_]) -> I64:
        return np.bincount(cell[chosen], minlength=rows * columns).reshape(shape)

    floor = _without_gaps(counts(np.abs(height_m) < p.floor_m) > 0, p.resolution_m)
    obstacles = counts(_between(height_m, *p.passage_m))
    cells = np.full(shape, UNKNOWN, np.int8)
    cells[floor > 0] = FREE
    cells[obstacles >= p.obstacle_voxels] = OCCUPIED
    corner = low * p.resolution_m
    return OccupancyGrid(
        cells=cells, resolution_m=p.resolution_m, origin_m=(float(corner[0]), float(corner[1]))
    )


def check_plausible(points_m: NDArray[np.floating]) -> None:
    """Raise MapFileError for points (N, 3) that cannot be a building in metres, z up."""
    if not len(points_m):
        raise MapFileError("it holds neither points nor triangles")
    low, high = np.quantile(points_m, (0.01, 0.99), axis=0)
    extent = high - low
    size = " x ".join(f"{v:.0f}" if v >= 10.0 else f"{v:.2g}" for v in extent)
    if extent[2] > CLOUD_MAP.tall_m:
        raise MapFileError(
            f"the cloud is {size} large, too high for a building in metres",
            hint="--set read.unit_m=0.001 says millimetres, 0.01 centimetres; read.up=y another axis",
        )
    if max(extent) < CLOUD_MAP.small_m:
        raise MapFileError(
            f"the cloud is {size} large, too small for a building in metres",
            hint="--set read.unit_m=1000 says that one unit is a kilometre",
        )


# --- the floor of a cloud -----------------------------------------------------------------------------

_LEAST_UP = 0.99 / math.sqrt(3.0)
"""Of a floor's normal along the axis that points up. The farthest direction from all axes has 1 / sqrt(3)."""
_TILTED = dataclasses.replace(CLOUD_PARAMETERS, max_tilt_rad=math.acos(_LEAST_UP))
_NEARLY_DEG = math.degrees(math.acos(LEVEL.level))
"""A plane that is tilted by less is level, and one that is nearer to upright may be a wall."""


def level_cloud(points_m: NDArray[np.floating], *, floor_z: float | None = None, up: str = "z") -> F64:
    """Return T_level_cloud (4, 4), which makes the floor of a cloud (N, 3) level, at z = 0.

    x and y stay as they are but for the tilt. The z axis of the cloud must point up within 55 degrees. Of
    several storeys the lowest is taken.

    floor_z : height of the floor in the cloud, metres, if it is known: nothing is searched for, and the cloud
        is not rotated.
    up : axis of the file that became z, for the words of an error.

    Raises MapFileError if the cloud shows no floor, or one that is tilted by more.
    """
    points = np.asarray(points_m, np.float64)
    check_plausible(points)
    if floor_z is not None:
        lowered = np.eye(4)
        lowered[2, 3] = -floor_z
        return lowered
    from pc2grid.open3d_core import o3d

    # A cloud may lie far from its origin, in coordinates of a country: it is turned about its middle.
    middle = np.median(points, axis=0)
    points = points - middle
    ground = _lowest_floor(points, up)
    # `find_ground` uses a small sample: the plane is fitted again, to all points near it.
    near = points[np.abs(ground.heights(points)) < CLOUD_MAP.floor_m]
    near = near[random_subset(len(near), CLOUD_PARAMETERS.sample)]
    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(near))
    model, _ = cloud.segment_plane(CLOUD_MAP.refine_m, 3, 1000, probability=1.0)
    plane: F64 = np.asarray(model) / np.linalg.norm(model[:3])
    if plane[:3] @ ground.normal < 0.0:
        plane = -plane
    T_level_cloud = leveling(plane[:3])
    T_level_cloud[:3, 3] = middle - T_level_cloud[:3, :3] @ middle
    T_level_cloud[2, 3] += float(plane[3]) - middle[2]
    return T_level_cloud


def _lowest_floor(points: F64, up: str) -> Ground:
    """Return the floor of a cloud (N, 3) about its middle.

    Raises MapFileError if there is none, or it is tilted by more than 55 degrees.
    """
    found = []
    for ground, size in possible_floors(points):
        if _tilt_deg(ground.normal) < _NEARLY_DEG:
            return ground
        found.append((ground, size))
    if not found:
        raise _no_floor(None, up)
    if any(ground.normal[2] > _LEAST_UP for ground, _ in found):
        # The less a plane is tilted, the more likely it is the floor.
        floor, _ = max(found, key=lambda one: one[1] * one[0].normal[2])
    else:
        # Upright walls are in every building.
        above = [one for one in found if one[0].normal[2] < -_LEAST_UP]
        floor, _ = max(above or found, key=lambda one: one[1])
    if floor.normal[2] < _LEAST_UP:
        raise _no_floor(floor.normal, up)
    return floor


def possible_floors(points: F64) -> Iterator[tuple[Ground, float]]:
    """Yield candidates for the floor of a cloud (N, 3) about its middle, with each of the six axes taken as
    up.

    z comes first. A wall is a floor of a cloud that lies on its side; but a floor is larger, and all of the
    building is near to it: with each candidate comes its share of the points over the height of the building
    above it.
    """
    sample = points[random_subset(len(points), _TILTED.sample)]
    for turn in UPRIGHT.values():
        turned = sample @ turn.T
        # Below half of the points, or, where more of them are floor, below all of them.
        for highest_m in (0.0, float(turned[:, 2].max()) + 1.0):
            ground = find_ground(turned, np.array([0.0, 0.0, highest_m]), parameters=_TILTED)
            if ground is not None:
                heights = ground.heights(turned)
                share = float((np.abs(heights) < _TILTED.plane_tolerance_m).mean())
                ground = dataclasses.replace(ground, normal=turn.T @ ground.normal)
                yield ground, share / float(np.quantile(heights, 0.99))
                break


def _tilt_deg(normal: F64) -> float:
    """Return the angle of a normal (3,) with the z axis."""
    return math.degrees(math.acos(min(float(normal[2]), 1.0)))


def _no_floor(normal: F64 | None, up: str) -> MapFileError:
    """Return the error for a cloud whose floor is not below it. normal : (3,) of the most likely floor, if
    any."""
    words = "the cloud shows no floor: no large level plane lies below its other points"
    uneven = (
        "if the floor is uneven, its height: --set read.floor_z=-0.4 (metres); else cut off what is below"
    )
    if normal is None:
        return MapFileError(words, hint=f"if another axis points up: --set read.up=y, or -y; {uneven}")
    turns, opposite = f"--set read.up={axis_of_file(normal, up)}", axis_of_file(-normal, up)
    tilt_deg = _tilt_deg(normal)
    if tilt_deg > 180.0 - _NEARLY_DEG:
        words += ", but one lies above them"
        return MapFileError(words, hint=f"if the cloud is upside down: {turns}; {uneven}")
    if abs(tilt_deg - 90.0) < _NEARLY_DEG:
        return MapFileError(words, hint=f"if another axis points up: {turns} or {opposite}; {uneven}")
    return MapFileError(
        f"the floor of the cloud, a large level plane, is tilted by {tilt_deg:.0f} degrees",
        hint=f"{turns} names the axis that is nearest to up; from there the floor is levelled",
    )


# --- is the right side up, and the right floor mapped? ------------------------------------------------

_CELL_M = CLOUD_MAP.gap_m
"""Edge of the cells and voxels in which a building is judged: a door is four of them wide."""
_SLICE_M = CLOUD_MAP.resolution_m  # of heights, in which level surfaces are searched for
_NEAR_M = CLOUD_MAP.floor_m  # points this near to a surface belong to it
_BAND_M = 0.5  # what stands within this from a floor separates its rooms
_PASSAGE_M = CLOUD_MAP.passage_m[1]  # free height above a floor on which nothing stands, below all others
_AROUND_SLICES = round(_BAND_M / _SLICE_M)  # a level surface has more points than the heights around it
_SURFACE_SHARE = 0.25  # of the points of the floor, at least, that a ceiling or another floor has
_OVERHEAD_SHARE = 0.02  # of the cells of a floor, at least, that have walls or a ceiling above head height
_CERTAIN = 0.2
"""Evidence above which a cloud is taken to be upside down. Chosen by hand; tried on 20 made clouds and a real
one: at most 0.18 for all that are upright, at least 0.3 for those turned with doors or much furniture."""
_LIES = 2.0
"""A plane so many times as likely to be the floor, by `possible_floors`, as that at z = 0 shows a cloud that
lies on its side. 3.4 in rooms of 5 m."""


def is_upside_down(level_points_m: NDArray[np.floating]) -> bool:
    """Return True if the floor of a levelled cloud (V, 3), at z = 0, is more likely a ceiling.

    Doors reach the floor, so the floor is connected where the ceiling is divided into rooms. And more stands
    on a floor than hangs from a ceiling. Without a ceiling the answer is False.
    """
    points = np.asarray(level_points_m, np.float64)
    ceiling_m = next((height_m for height_m in _surfaces(points) if height_m < CLOUD_MAP.ceiling_m), None)
    if ceiling_m is None:
        return False
    points = points[(points[:, 2] > -_NEAR_M) & (points[:, 2] < ceiling_m + _NEAR_M)]
    below, above = points[:, 2], ceiling_m - points[:, 2]
    cells, shape = _cells(points)
    floor, ceiling = (_free(cells, shape, heights) for heights in (below, above))
    if not floor.any() or not ceiling.any():
        return False
    doors = math.log2(_largest_share(ceiling) / _largest_share(floor))
    standing, hanging = _things(cells, shape, below, above)
    furniture = (hanging - standing) / (hanging + standing + 0.5 * float(floor.sum()))
    return doors + furniture > _CERTAIN


def side_that_is_up(level_points_m: NDArray[np.floating]) -> F64 | None:
    """Return the direction (3,) that is more likely up than z in a levelled cloud (V, 3) of one storey, if
    any.

    A wall may be taken for a floor. The cloud is then higher than a storey, and its floor stands upright.
    """
    points = np.asarray(level_points_m, np.float64)
    if np.quantile(points[:, 2], 0.99) < CLOUD_MAP.ceiling_m or other_floors(points):
        return None
    floors = list(possible_floors(points - np.median(points, axis=0)))
    upright = [size for ground, size in floors if axis_of_file(ground.normal, "z") == "z"]
    best, size = max(floors, key=lambda one: one[1])
    return best.normal if upright and size > _LIES * max(upright) else None


def other_floors(level_points_m: NDArray[np.floating]) -> list[tuple[float, float]]:
    """Return the floors above that of a levelled cloud (V, 3), from below: free to pass, with walls around.

    Each is its height above the mapped one, m, and its visible area, m2.
    """
    points = np.asarray(level_points_m, np.float64)
    cells, shape = _cells(points)
    found = []
    for height_m in _surfaces(points):
        heights = points[:, 2] - height_m
        on_it = np.abs(heights) < 0.5 * _NEAR_M
        seen = _mask(cells[on_it], shape)
        in_the_way = _mask(cells[_between(heights, _NEAR_M, _PASSAGE_M)], shape)
        overhead = _mask(cells[_between(heights, _PASSAGE_M, CLOUD_MAP.ceiling_m)], shape)
        area = int(seen.sum())
        if (seen & ~in_the_way).sum() > 0.5 * area and (seen & overhead).sum() > _OVERHEAD_SHARE * area:
            found.append((float(np.median(points[on_it, 2])), area * _CELL_M**2))
    return found


def _surfaces(points: F64) -> list[float]:
    """Return the heights of the large level surfaces above the floor, from below."""
    edges = np.arange(-_NEAR_M, max(points[:, 2].max(), _PASSAGE_M) + 1.0, _SLICE_M)
    counts, _ = np.histogram(points[:, 2], edges)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(counts, _AROUND_SLICES), 2 * _AROUND_SLICES + 1)
    level = np.convolve(counts, np.ones(3), "same") - 3.0 * np.median(around, axis=1)
    middle_m = edges[:-1] + 0.5 * _SLICE_M
    floor = level[np.abs(middle_m) < _NEAR_M].max()
    highest = np.lib.stride_tricks.sliding_window_view(np.pad(level, 2), 5).max(axis=1)
    chosen = (middle_m > _PASSAGE_M) & (level == highest) & (level > max(_SURFACE_SHARE * floor, 0.0))
    return [float(height_m) for height_m in middle_m[chosen]]


def _cells(points: F64) -> tuple[I64, tuple[int, int]]:
    """Return the cell (V, 2) of each point, from (0, 0), and the size of a grid that contains them."""
    cells = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    cells -= cells.min(axis=0)
    rows, columns = (cells.max(axis=0) + 1).tolist()
    return cells, (rows, columns)


def _mask(cells: I64, shape: tuple[int, ...]) -> BoolGrid:
    """Return a mask (H, W) of cells (N, 2), given as (row, column); those outside are left out."""
    mask = np.zeros(shape, np.bool_)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    mask[tuple(cells[inside].T)] = True
    return mask


def _between(heights: NDArray[np.floating], low_m: float, high_m: float) -> NDArray[np.bool_]:
    return (heights > low_m) & (heights < high_m)


def _free(cells: I64, shape: tuple[int, int], distances: F64) -> BoolGrid:
    """Return the free cells (R, C) of a floor or ceiling whose neighbours are free, too.

    distances : (V,) of the points from it.
    """
    seen = _mask(cells[np.abs(distances) < _NEAR_M], shape)
    free = seen & ~_mask(cells[_between(distances, _NEAR_M, _BAND_M)], shape)
    return cv2.erode(free.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _largest_share(free: BoolGrid) -> float:
    """Return the share of the free cells that lie in the largest connected component."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(free.astype(np.uint8), connectivity=4)
    return float(stats[1:, cv2.CC_STAT_AREA].max() / free.sum())


def _things(cells: I64, shape: tuple[int, int], below: F64, above: F64) -> tuple[int, int]:
    """Count the voxels of objects that stand on the floor, and of those that hang from the ceiling.

    Walls, which do both, are left out. below, above : (V,) distances of the points from the floor and from
    the ceiling.
    """
    from scipy import ndimage

    ends = [_between(distances, _NEAR_M, _BAND_M) for distances in (below, above)]
    low, high = (_mask(cells[end], shape) for end in ends)
    # A wall that leans by a hair may have its ends in neighbouring cells.
    near_low, near_high = (ndimage.binary_dilation(end, np.ones((3, 3), np.bool_)) for end in (low, high))
    wall = (low & near_high) | (high & near_low)
    kept = (below > _NEAR_M) & (above > _NEAR_M) & ~wall[tuple(cells.T)]
    at = (*cells[kept].T, (below[kept] / _CELL_M).astype(np.int64))
    voxels = np.zeros((*shape, int(below.max() / _CELL_M) + 1), np.bool_)
    voxels[at] = True
    labels, count = ndimage.label(voxels, np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    stands, hangs = (np.bincount(labels[at][end[kept]], minlength=count + 1) > 0 for end in ends)
    return int(sizes[stands & ~hangs].sum()), int(sizes[hangs & ~stands].sum())
