"""One point cloud of a building, a terrestrial scan or the map of another program, becomes a grid.

1. The floor is found and levelled (`level_cloud`).
2. Viewpoints are spread over the floor where it was seen and nothing stands on it.
3. From each of them the cloud around it is reduced to the plane and drawn, exactly as a scan of a recording
   is (`project_to_plane`, `GridBuilder`). So the ground between seen floor and a wall is free even if
   furniture hid the floor there, as it is in the map of a robot.

Steps 2 and 3 need the memory of a tile beside the voxels and the grid.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, U8, BoolGrid
from pc2grid.clouds.ground import Ground, find_ground
from pc2grid.clouds.parameters import CLOUD_PARAMETERS
from pc2grid.clouds.planar_scan import project_to_plane
from pc2grid.clouds.sampling import random_subset
from pc2grid.clouds.voxel_cloud import VoxelCloud
from pc2grid.config import ProjectionConfig
from pc2grid.errors import MapFileError
from pc2grid.geometry import SE2
from pc2grid.io.building_file import UPRIGHT, axis_of_file
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudMapParameters:
    """How a cloud becomes a grid. Chosen by hand; tried on a 3D scan of an office floor with 5 cm voxels.

    resolution_m : edge of a cell, and of the voxels in which points are counted, so that a dense cloud
        gives the same grid as a thin one.
    floor_m : points this near to the floor plane are floor. A floor is uneven by some centimetres over a
        whole storey.
    refine_m, refine_points : RANSAC tolerance when the plane is fitted to the points near the floor, and of
        how many of them.
    passage_m : lowest and highest height above the floor at which an obstacle blocks a robot.
    obstacle_voxels : a cell is occupied if at least this many voxels above it are; one alone may be noise.
    gap_m : gaps of the seen floor, and holes of walls, up to this wide are closed.
    margin_m : width of the unknown border around the cloud.
    max_cells : larger grids are refused, since a few stray points would make them.

    Viewpoints:

    tile_m : edge of the tiles in which the cloud is drawn.
    spacing_m : at most one viewpoint in a square of this edge.
    clearance_m : least distance of a viewpoint to what is not seen floor.
    height_m : of the viewpoints above the floor.
    sight_m : what is farther away is not drawn from a viewpoint. Up to 11 m a voxel of 5 cm is wider than a
        bearing of a planar scan (0.25 degrees), so that no bearing looks through a wall.
    hidden_m : ground farther than this from seen floor is not free, even if it lies before a wall.
    ceiling_m : what is higher above the floor is not used: it belongs to the storey above.
    tall_m : the largest height of a building. What is higher is not in metres.
    small_m : the least width and depth of a building.
    """

    resolution_m: float = 0.05
    floor_m: float = 0.15
    refine_m: float = 0.05
    refine_points: int = 20_000
    passage_m: tuple[float, float] = (0.2, 1.6)
    obstacle_voxels: int = 2
    gap_m: float = 0.2
    margin_m: float = 0.5
    max_cells: int = 100_000_000

    tile_m: float = 16.0
    spacing_m: float = 1.0
    clearance_m: float = 0.15
    height_m: float = 1.0
    sight_m: float = 8.0
    hidden_m: float = 0.5
    ceiling_m: float = 4.0
    tall_m: float = 60.0
    small_m: float = 1.0


CLOUD_MAP = CloudMapParameters()
PROJECTION = ProjectionConfig()
_LEAST_UP = 0.99 / math.sqrt(3.0)
"""Of a floor's normal along the axis that points up. The farthest direction from all axes has 1 / sqrt(3)."""
_TILTED = dataclasses.replace(CLOUD_PARAMETERS, max_tilt_rad=math.acos(_LEAST_UP))
_NEARLY_DEG = 10.0
"""A plane that is tilted by less is level, and one that is nearer to upright may be a wall."""
_SCANS_OF_A_VIEW = 2
"""Scans of the same that make a cell free in a `GridBuilder`."""


def level_cloud(
    points_m: NDArray[np.floating],
    parameters: CloudMapParameters = CLOUD_MAP,
    *,
    floor_z: float | None = None,
    up: str = "z",
) -> F64:
    """Return T_level_cloud (4, 4): it makes the floor of a cloud (N, 3) level and puts it at z = 0.

    x and y stay as they are but for the tilt. The z axis of the cloud must point up within 55 degrees. Of
    several storeys the lowest is taken.

    floor_z : height of the floor in the cloud, metres, where that is known: nothing is looked for, and the
        cloud is not turned.
    up : axis of the file that became z, for the words of an error.

    Raises MapFileError if the cloud shows no floor, or one that is tilted by more.
    """
    points = np.asarray(points_m, np.float64)
    check_plausible(points, parameters)
    if floor_z is not None:
        lowered = np.eye(4)
        lowered[2, 3] = -floor_z
        return lowered
    # A cloud may lie far from its origin, in coordinates of a country: it is turned about its middle.
    middle = np.median(points, axis=0)
    points = points - middle
    ground = _refined(points, _lowest_floor(points, up), parameters)
    T_level_cloud = ground.leveling()
    T_level_cloud[:3, 3] = middle - T_level_cloud[:3, :3] @ middle
    T_level_cloud[2, 3] += ground.offset_m - middle[2]
    return T_level_cloud


def _lowest_floor(points: F64, up: str) -> Ground:
    """The floor of a cloud (N, 3) about its middle.

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
    """What could be the floor of a cloud (N, 3) about its middle, with each of the six axes taken as up.

    z comes first. A wall is a floor of a cloud that lies on its side; but a floor is larger, and all of the
    building is near to it: with each comes its share of the points over the height of the building above it.
    """
    sample = points[random_subset(len(points), _TILTED.ground_sample)]
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
    """The angle of a normal (3,) with the z axis."""
    return math.degrees(math.acos(min(float(normal[2]), 1.0)))


def _no_floor(normal: F64 | None, up: str) -> MapFileError:
    """The error for a cloud whose floor is not below it. normal : (3,) of the most likely floor, if any."""
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


def check_plausible(points_m: NDArray[np.floating], parameters: CloudMapParameters = CLOUD_MAP) -> None:
    """Raise MapFileError for points (N, 3) that cannot be a building in metres, z up."""
    p = parameters
    if not len(points_m):
        raise MapFileError("it holds neither points nor triangles")
    low, high = np.quantile(points_m, (0.01, 0.99), axis=0)
    extent = high - low
    size = " x ".join(f"{v:.0f}" if v >= 10.0 else f"{v:.2g}" for v in extent)
    if extent[2] > p.tall_m:
        raise MapFileError(
            f"the cloud is {size} large, too high for a building in metres",
            hint="--set read.unit_m=0.001 says millimetres, 0.01 centimetres; read.up=y another axis",
        )
    if max(extent) < p.small_m:
        raise MapFileError(
            f"the cloud is {size} large, too small for a building in metres",
            hint="--set read.unit_m=1000 says that one unit is a kilometre",
        )


def _refined(points: F64, ground: Ground, p: CloudMapParameters) -> Ground:
    """The ground fitted to all points near it; `find_ground` uses a small sample."""
    from pc2grid.open3d_core import o3d

    near = points[np.abs(ground.heights(points)) < p.floor_m]
    near = near[random_subset(len(near), p.refine_points)]
    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(near))
    model, _ = cloud.segment_plane(p.refine_m, 3, 1000, probability=1.0)
    plane: F64 = np.asarray(model) / np.linalg.norm(model[:3])
    if plane[:3] @ ground.normal < 0.0:
        plane = -plane
    return Ground(plane[:3], float(plane[3]), ground.ceiling_m)


def drivable_plan(
    level_points_m: NDArray[np.floating], parameters: CloudMapParameters = CLOUD_MAP
) -> OccupancyGrid:
    """Draw where a robot can drive in a levelled cloud (N, 3), whose floor is at z = 0.

    A cell is free where the floor was seen and nothing stands on it at the heights that a robot passes
    through, and occupied where something does. The grid has the x and y axes of the cloud.

    Raises MapFileError if the cloud is too large for a grid.

    >>> import numpy as np
    >>> floor = np.mgrid[0:4:0.05, 0:3:0.05, 0:1].reshape(3, -1).T
    >>> wall = np.mgrid[0:4:0.05, 3:3.05:0.05, 0:2:0.05].reshape(3, -1).T
    >>> grid = drivable_plan(np.concatenate((floor, wall)))
    >>> bool(grid.free.any()), bool(grid.occupied.any())
    (True, True)
    """
    p = parameters
    voxels = _voxels(np.asarray(level_points_m, np.float64), p)
    if not len(voxels):
        raise MapFileError("the cloud has no points near its floor")
    low = voxels[:, :2].min(axis=0)
    columns, rows = (int(v) for v in voxels[:, :2].max(axis=0) - low + 1)
    margin = round(p.margin_m / p.resolution_m)
    shape = (rows + 2 * margin, columns + 2 * margin)
    if shape[0] * shape[1] > p.max_cells:
        raise MapFileError(
            f"the cloud is {columns * p.resolution_m:.0f} x {rows * p.resolution_m:.0f} m large",
            hint="remove stray points from it",
        )
    cell = (voxels[:, 1] - low[1] + margin) * shape[1] + voxels[:, 0] - low[0] + margin
    height_m = (voxels[:, 2] + 0.5) * p.resolution_m

    def counts(chosen: NDArray[np.bool_]) -> I64:
        return np.bincount(cell[chosen], minlength=shape[0] * shape[1]).reshape(shape)

    floor = _without_gaps(counts(np.abs(height_m) < p.floor_m) > 0, p.gap_m / p.resolution_m)
    obstacles = counts((height_m > p.passage_m[0]) & (height_m < p.passage_m[1]))
    cells = np.full(shape, UNKNOWN, np.int8)
    cells[floor > 0] = FREE
    cells[obstacles >= p.obstacle_voxels] = OCCUPIED
    corner = (low - margin) * p.resolution_m
    return OccupancyGrid(
        cells=cells, resolution_m=p.resolution_m, origin_m=(float(corner[0]), float(corner[1]))
    )


def voxel_cloud(
    blocks: Iterable[NDArray[np.floating]],
    projection: ProjectionConfig = PROJECTION,
    parameters: CloudMapParameters = CLOUD_MAP,
) -> F64:
    """The points of blocks (N, 3), one for each voxel of the size of a cell, (V, 3).

    Raises MapFileError if they cannot be a building in metres.
    """
    cloud = VoxelCloud(projection.resolution_m)
    for block in blocks:
        if len(block) and not len(cloud):
            check_plausible(block, parameters)
        cloud.add(block)
    return cloud.points_m()


def map_cloud(
    level_points_m: NDArray[np.floating],
    projection: ProjectionConfig = PROJECTION,
    *,
    origin_m: F64 | None = None,
    parameters: CloudMapParameters = CLOUD_MAP,
) -> OccupancyGrid:
    """Draw the occupancy grid of a levelled cloud (N, 3), whose floor is at z = 0.

    The cloud has one point a voxel (`voxel_cloud`). The grid has its x and y axes.

    origin_m : (3,) where the cloud was taken from, if it may be a single scan. Such a scan shows only rings
        of the floor, on which no viewpoint fits.

    Raises MapFileError if no viewpoint is found, LimitExceeded if the map needs more than `max_cells`.

    >>> import numpy as np
    >>> floor = np.mgrid[0:4:0.05, 0:3:0.05, 0:1].reshape(3, -1).T
    >>> wall = np.mgrid[0:4:0.05, 3:3.05:0.05, 0:2:0.05].reshape(3, -1).T
    >>> grid = map_cloud(np.concatenate((floor, wall)))
    >>> bool(grid.free.any()), bool(grid.occupied.any())
    (True, True)
    """
    p = parameters
    points = np.asarray(level_points_m, np.float64)
    tiles = _Tiles(_without_noise(points, projection, p), p.tile_m)
    builder = GridBuilder(projection)
    drawn = 0
    for tile in tiles:
        near = tiles.around(tile, p.sight_m)
        for view_m in _viewpoints(near, tiles.corner_m(tile), projection, p):
            _draw(builder, near, view_m, projection, p)
            drawn += 1
    if drawn:
        return _near_seen_floor(builder.grid(), points, p)
    if origin_m is None or not p.floor_m < origin_m[2] < p.ceiling_m:
        raise MapFileError(
            "the floor of the cloud is seen nowhere without something on it",
            hint=f"obstacles are what is {projection.band_min_m:g} to {projection.band_max_m:g} m above the"
            " floor (settings projection.band_min_m and band_max_m)",
        )
    _draw(builder, points, origin_m, projection, p)
    return builder.grid()


class _Tiles:
    """Points (N, 3) by the square of `edge_m` that they lie in; iterates over the squares with points."""

    def __init__(self, points: F64, edge_m: float) -> None:
        self._edge_m = edge_m
        square = np.floor(points[:, :2] / edge_m).astype(np.int64)
        order = np.lexsort((square[:, 1], square[:, 0]))
        self._points = points[order]
        square = square[order]
        starts = np.flatnonzero(np.any(np.diff(square, axis=0, prepend=square[:1] - 1), axis=1))
        ends = np.append(starts[1:], len(square))
        self._rows = {
            (int(square[a, 0]), int(square[a, 1])): slice(int(a), int(b))
            for a, b in zip(starts, ends, strict=True)
        }

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._rows)

    def corner_m(self, tile: tuple[int, int]) -> F64:
        """The lower left corner (2,) of a square."""
        return np.array(tile) * self._edge_m

    def around(self, tile: tuple[int, int], margin_m: float) -> F64:
        """The points (M, 3) of a square and up to `margin_m`, at most an edge, around it."""
        steps = (-1, 0, 1)
        rows = (self._rows.get((tile[0] + i, tile[1] + j)) for i in steps for j in steps)
        points = np.concatenate([self._points[found] for found in rows if found is not None])
        low_m = self.corner_m(tile) - margin_m
        inside = (points[:, :2] >= low_m) & (points[:, :2] < low_m + self._edge_m + 2.0 * margin_m)
        chosen: F64 = points[inside.all(axis=1)]
        return chosen


def _without_noise(points: F64, projection: ProjectionConfig, p: CloudMapParameters) -> F64:
    """The points up to the ceiling, without obstacles of fewer than `obstacle_voxels` in a cell."""
    points = points[(points[:, 2] > -p.floor_m) & (points[:, 2] < p.ceiling_m)]
    cell = np.floor(points[:, :2] / projection.resolution_m).astype(np.int64)
    _, column = np.unique((cell[:, 0] << 32) + cell[:, 1], return_inverse=True)
    band = (points[:, 2] > projection.band_min_m) & (points[:, 2] < projection.band_max_m)
    obstacles = np.bincount(column, band)
    kept: F64 = points[~band | (obstacles[column] >= p.obstacle_voxels)]
    return kept


def _viewpoints(near: F64, corner_m: F64, projection: ProjectionConfig, p: CloudMapParameters) -> F64:
    """Viewpoints (K, 3) in a tile, one in each square of `spacing_m` that has room on seen floor for it.

    near : the points of the tile and around it. corner_m : (2,) of the tile.
    """
    cell_m = projection.resolution_m
    side = round((p.tile_m + 2.0 * p.spacing_m) / cell_m)
    low_m = corner_m - p.spacing_m
    cell = np.floor((near[:, :2] - low_m) / cell_m).astype(np.int64)
    inside = ((cell >= 0) & (cell < side)).all(axis=1)

    def seen(chosen: NDArray[np.bool_]) -> BoolGrid:
        mask = np.zeros((side, side), np.bool_)
        mask[tuple(cell[chosen & inside, ::-1].T)] = True
        return mask

    floor = _without_gaps(seen(np.abs(near[:, 2]) < p.floor_m), p.gap_m / cell_m)
    obstacle = (near[:, 2] > projection.band_min_m) & (near[:, 2] < projection.band_max_m)
    room_m = cv2.distanceTransform(floor * ~seen(obstacle), cv2.DIST_L2, 5) * cell_m
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


def _without_gaps(floor: BoolGrid, gap_cells: float) -> U8:
    """The seen floor (H, W), 0 or 1, with its narrow gaps closed."""
    side = 2 * round(gap_cells / 2) + 1
    kernel = np.ones((side, side), np.uint8)
    return cv2.morphologyEx(floor.astype(np.uint8), cv2.MORPH_CLOSE, kernel).astype(np.uint8)


def _draw(
    builder: GridBuilder, near: F64, view_m: F64, projection: ProjectionConfig, p: CloudMapParameters
) -> None:
    """Draw what lies around a viewpoint (3,), as if a scan from there had returned it."""
    away = near - (view_m[0], view_m[1], 0.0)
    away = away[np.einsum("ij,ij->i", away[:, :2], away[:, :2]) < p.sight_m**2]
    planar_scan = project_to_plane(
        away.astype(np.float32),
        stamp_ns=0,
        sensor_m=np.array([0.0, 0.0, view_m[2]]),
        ground=Ground(np.array([0.0, 0.0, 1.0]), 0.0),
        config=projection,
    )
    closed = dataclasses.replace(planar_scan, free_m=_without_slits(planar_scan.free_m, p.gap_m))
    for _ in range(_SCANS_OF_A_VIEW):
        builder.add(closed, SE2(float(view_m[0]), float(view_m[1]), 0.0))


def _near_seen_floor(grid: OccupancyGrid, points: F64, p: CloudMapParameters) -> OccupancyGrid:
    """The grid without the free cells that are far from all floor that was seen.

    A view through a wall that was not scanned ends on some obstacle of another room.
    """
    floor = points[np.abs(points[:, 2]) < p.floor_m, :2]
    row, column = grid.to_cell(floor).T
    inside = (row >= 0) & (row < grid.cells.shape[0]) & (column >= 0) & (column < grid.cells.shape[1])
    unseen = np.ones(grid.cells.shape, np.uint8)
    unseen[row[inside], column[inside]] = 0
    away_m = cv2.distanceTransform(unseen, cv2.DIST_L2, 5) * grid.resolution_m
    cells = np.where(grid.free & (away_m > p.hidden_m), np.int8(UNKNOWN), grid.cells)
    return dataclasses.replace(grid, cells=cells)


def _without_slits(free_m: F32, gap_m: float) -> F32:
    """Free ranges (B,) that do not pass between obstacles which are less than `gap_m` apart.

    Scanned walls have holes, behind which a view would show the next room in stripes.
    """
    bearing_rad = 2.0 * np.pi / len(free_m)
    known_m = np.where(free_m > 0.0, free_m, np.inf)
    shortest_m = known_m.copy()
    widest = int(0.5 * gap_m / bearing_rad / max(known_m.min(), gap_m))
    for step in range(1, widest + 1):
        wide = np.where(known_m * (step * bearing_rad) < 0.5 * gap_m, known_m, np.inf)
        for side in (step, -step):
            np.minimum(shortest_m, np.roll(wide, side), out=shortest_m)
    return np.where(free_m > 0.0, shortest_m, 0.0).astype(np.float32)


def _voxels(points: F64, p: CloudMapParameters) -> I64:
    """Indices (V, 3) of the voxels that hold points and matter to a robot, each once."""
    chosen = points[(points[:, 2] > -p.floor_m) & (points[:, 2] < p.passage_m[1])]
    voxels: I64 = np.unique(np.floor(chosen / p.resolution_m).astype(np.int64), axis=0)
    return voxels
