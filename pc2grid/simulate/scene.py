"""The world of a simulated drive, and the rays that its sensor casts into it.

A building is a floor plan, extruded to walls of one height, or a real one as a point cloud or a mesh. Rays
hit the faces of the occupied voxels of a cloud, or the triangles of a mesh. For both the floor is found and
levelled, and the robot drives where it is visible and free of obstacles (`pc2grid.grids.drawn`). Clutter is
in other places in each session: chairs, boxes, tables, people. The three sensors have directions and times of
their rays, and noise and losses of their readings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pc2grid.geometry import F32, F64, SE2, BoolGrid, frozen_arrays, transform_points
from pc2grid.grids.drawn import CLOUD_MAP, check_plausible, drivable_plan, level_cloud, named, voxel_cloud
from pc2grid.io.building_file import (
    building_points,
    is_building_file,
    kind_of,
    load_mesh,
    neighbour_distances_m,
    sampled,
)
from pc2grid.io.maps import is_map_file, load_map
from pc2grid.model import OccupancyGrid, SensorKind
from pc2grid.settings import ReadConfig
from pc2grid.simulate.config import DepthConfig, LaserConfig, LidarConfig
from pc2grid.simulate.plan import Passages, outline_mask

# --- triangles and rays -------------------------------------------------------------------------------


def quads(corners_m: F64) -> F32:
    """Return faces with four corners (N, 4, 3), in order around each face, as triangles (2 N, 3, 3)."""
    return np.concatenate((corners_m[:, [0, 1, 2]], corners_m[:, [0, 2, 3]])).astype(np.float32)


def prism(outline_m: F64, bottom_m: float, top_m: float) -> F32:
    """Return triangles (T, 3, 3) of a convex outline (N, 2) between two heights, with lid and bottom."""
    n = len(outline_m)
    bottom, top = (np.column_stack((outline_m, np.full(n, z))) for z in (bottom_m, top_m))
    after = np.roll(np.arange(n), -1)
    sides = np.stack((bottom, bottom[after], top[after], top), axis=1)
    fan = np.column_stack((np.zeros(n - 2, np.intp), np.arange(1, n - 1), np.arange(2, n)))
    return np.concatenate((quads(sides), bottom[fan], top[fan])).astype(np.float32)


def _runs(mask: BoolGrid) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the maximal runs of True along the rows: row, first column, column after the last."""
    padded = np.pad(mask, ((0, 0), (1, 1)))
    rows, starts = np.nonzero(padded[:, 1:] & ~padded[:, :-1])
    _, ends = np.nonzero(~padded[:, 1:] & padded[:, :-1])
    return rows, starts, ends


def extrude(grid: OccupancyGrid, height_m: float) -> F32:
    """Make walls where the grid is occupied, and a floor (z = 0) and ceiling over its whole extent.

    Returns triangles (T, 3, 3).

    Faces are made only between an occupied and another cell, and faces in one line are joined: a building of
    a million cells has about ten thousand. Walls reach the ceiling, so they have no top. Unknown cells are
    empty.
    """
    solid = np.pad(grid.occupied, 1)
    along_x = _runs(solid[1:, 1:-1] != solid[:-1, 1:-1])
    along_y = _runs((solid[1:-1, 1:] != solid[1:-1, :-1]).T)
    lines = np.concatenate(
        (
            np.column_stack((along_x[1], along_x[0], along_x[2], along_x[0])),
            np.column_stack((along_y[0], along_y[1], along_y[0], along_y[2])),
        )
    )
    ends_m = lines.reshape(-1, 2, 2) * grid.resolution_m + np.array(grid.origin_m)
    walls = np.empty((len(lines), 4, 3))
    walls[:, :2, :2], walls[:, 2:, :2] = ends_m, ends_m[:, ::-1]
    walls[:, :2, 2], walls[:, 2:, 2] = 0.0, height_m
    (x0, y0), (h, w) = grid.origin_m, grid.cells.shape
    x1, y1 = x0 + w * grid.resolution_m, y0 + h * grid.resolution_m
    plates = np.array([[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)] for z in (0.0, height_m)])
    return quads(np.concatenate((walls, plates)))


class Scene:
    """Casts rays onto triangles (T, 3, 3), which are seen from both sides (Open3D RaycastingScene, Embree).

    The constructor loads Open3D.
    """

    def __init__(self, triangles_m: F32) -> None:
        from pc2grid.open3d_core import o3d

        tensor: Any = o3d.core.Tensor
        self._tensor = tensor
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        corners = np.arange(3 * len(triangles_m), dtype=np.uint32).reshape(-1, 3)
        # Open3D's tensors need writable memory.
        self._scene.add_triangles(tensor(triangles_m.reshape(-1, 3).copy()), tensor(corners))

    def cast(self, rays: F32) -> F32:
        """Cast rays (N, 6), origin in metres and direction.

        Returns (N,) multiples of the direction until the first hit, inf without one.
        """
        return np.asarray(self._scene.cast_rays(self._tensor.from_numpy(rays))["t_hit"].numpy())


# --- buildings ----------------------------------------------------------------------------------------

_VOXEL_M = CLOUD_MAP.resolution_m  # smallest voxel of a cloud that rays hit
# A voxel is at least this many median distances between neighbours wide, so that walls have few holes: if n
# random points lie on a square metre, this distance is 0.47 / sqrt(n) and 3 % of such voxels stay empty.
_SPACINGS = 4.0
_LATTICE = 1.01  # the points of a lattice are equally far from their neighbours, within 1 %


@dataclass(frozen=True, slots=True)
class Building:
    """A real building.

    plan : where the robot may drive, in the map frame. shell : (T, 3, 3) triangles for the rays, in the same
    frame, with the floor at z = 0. T_map_file : (4, 4), the frame of the file in the map frame.
    """

    plan: OccupancyGrid
    shell: F32
    T_map_file: F64

    @staticmethod
    def of(points_m: NDArray[np.floating], mesh: F32 | None = None) -> Building:
        """Make a building of points (N, 3) whose z axis points up, and of the triangles (T, 3, 3) that they
        lie on, if any.

        Raises MapFileError if they show no floor.
        """
        points = np.asarray(points_m, np.float64)
        T_map_file = level_cloud(points)
        # The voxels follow the axes of the cloud, in which they may have been a lattice before.
        shell = voxel_faces(points, voxel_m(points)) if mesh is None else mesh
        plan = drivable_plan(transform_points(T_map_file, points))
        return Building(plan, transform_points(T_map_file, shell).astype(np.float32), T_map_file)


def load_building(path: str | Path) -> OccupancyGrid | Building:
    """Read a nav2 map, a cloud or a mesh. A .ply with triangles is a mesh.

    Raises MapFileError if the file cannot be read, or shows no floor.
    """
    path = Path(path)
    if is_map_file(path):
        return load_map(path)
    with named(path):
        if is_building_file(path) and kind_of(path) == "mesh":
            vertices, triangles = load_mesh(path)
            check_plausible(vertices)
            rounded = vertices.astype(np.float32)
            points = voxel_cloud(sampled(rounded.astype(np.float64), triangles))
            return Building.of(points, rounded[triangles])
        return Building.of(np.concatenate([np.empty((0, 3)), *building_points(path, ReadConfig())]))


def voxel_m(points_m: F64) -> float:
    """Return the edge of the voxels in which a cloud (N, 3) is dense: 5 cm or more.

    The points of a lattice, such as the centres of the voxels of an octree, keep its spacing.
    """
    low, median, high = np.quantile(neighbour_distances_m(points_m), (0.1, 0.5, 0.9))
    lattice = low > 0.0 and high < _LATTICE * low
    return max(float(median) * (1.0 if lattice else _SPACINGS), _VOXEL_M)


def voxel_faces(points_m: F64, edge_m: float) -> F32:
    """Return the faces between occupied voxels and empty ones, as triangles (T, 3, 3).

    The first point's corner is on the lattice.
    """
    first = points_m.min(axis=0)
    voxels = np.rint((points_m - first) / edge_m).astype(np.int64) + 1
    occupied = np.zeros(voxels.max(axis=0) + 2, bool)
    occupied[tuple(voxels.T)] = True
    corners = []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        for side in (1, -1):
            faces = np.argwhere(occupied & ~np.roll(occupied, -side, axis=axis))
            corner = np.repeat(faces[:, None].astype(np.float64), 4, axis=1)
            corner[..., axis] += 0.5 * side
            corner[..., u] += (-0.5, 0.5, 0.5, -0.5)
            corner[..., v] += (-0.5, -0.5, 0.5, 0.5)
            corners.append(corner)
    return quads((np.concatenate(corners) - 1) * edge_m + first)


# --- sensors ------------------------------------------------------------------------------------------

OPTICAL = np.array([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
"""R_body_optical (REP-103): z forward, x right, y down, in body axes."""


# A neighbour whose depth differs by more than this share of the depth and this distance is a depth jump.
_JUMP_SHARE, _JUMP_M = 0.1, 0.1


@dataclass(frozen=True, slots=True)
@frozen_arrays(T_base_sensor=(np.float64, 4, 4), directions=(np.float64, "R", 3), offsets_s=(np.float64, "R"))
class SimulatedSensor:
    """A sensor as the rays that it casts in each scan.

    kind : of the sensor. frame : name of its frame.
    T_base_sensor : (4, 4) mounting.
    rate_hz : scans per second.
    directions : (R, 3) in the sensor frame; a reading times its direction is the point. Unit vectors for
        ranges; z = 1 for depths.
    offsets_s : (R,) when each ray is cast, relative to the scan's stamp; all zero for a camera.
    """

    kind: SensorKind
    frame: str
    T_base_sensor: F64
    rate_hz: float
    directions: F64
    offsets_s: F64
    config: LidarConfig | LaserConfig | DepthConfig

    def measure(self, true_m: F32, rng: np.random.Generator) -> F32:
        """Turn true distances (R,), inf for none, into readings (R,) float32, NaN without a return."""
        if isinstance(self.config, DepthConfig):
            return _measure_depth(true_m, self.config, rng)
        noise = rng.standard_normal(len(true_m), dtype=np.float32) * np.float32(self.config.noise_m)
        kept = rng.random(len(true_m), dtype=np.float32) >= self.config.dropout
        reading = true_m + noise
        kept &= (reading >= self.config.min_range_m) & (reading <= self.config.max_range_m)
        return np.where(kept, reading, np.float32(np.nan))


def lidar(config: LidarConfig) -> SimulatedSensor:
    """Make a lidar: columns of beams, fired one after another during one turn, stamped at the first
    column."""
    azimuth = np.arange(config.columns) * (2 * math.pi / config.columns) - math.pi
    top = math.radians(config.elevation_deg) if config.beams > 1 else 0.0
    elevation = np.linspace(-top, top, config.beams)
    a, e = (v.ravel() for v in np.meshgrid(azimuth, elevation, indexing="ij"))
    directions = np.column_stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)))
    offsets = np.repeat(np.arange(config.columns) / (config.columns * config.rate_hz), config.beams)
    return SimulatedSensor(
        "lidar", "lidar_link", _mount(config.mount_m), config.rate_hz, directions, offsets, config
    )


def laser(config: LaserConfig) -> SimulatedSensor:
    """Make a laser: one horizontal row of rays from right to left, one after another, stamped at the
    first."""
    count = round(config.field_deg / config.step_deg) + 1
    angle = laser_angle_min(config) + np.arange(count) * math.radians(config.step_deg)
    directions = np.column_stack((np.cos(angle), np.sin(angle), np.zeros(count)))
    offsets = np.arange(count, dtype=np.float64) * laser_time_increment(config)
    return SimulatedSensor(
        "laser", "laser_link", _mount(config.mount_m), config.rate_hz, directions, offsets, config
    )


def laser_angle_min(config: LaserConfig) -> float:
    """Return the bearing of the first ray, radians."""
    return -math.radians(round(config.field_deg / config.step_deg) * config.step_deg) / 2


def laser_time_increment(config: LaserConfig) -> float:
    """Return the seconds between two rays."""
    return config.step_deg / 360.0 / config.rate_hz


def depth(config: DepthConfig) -> SimulatedSensor:
    """Make a pinhole camera with a global shutter."""
    K = depth_intrinsics(config)
    u, v = (p.ravel() for p in np.meshgrid(np.arange(config.width), np.arange(config.height)))
    directions = np.column_stack(((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.size)))
    pose = _mount(config.mount_m)
    pose[:3, :3] = OPTICAL
    frame, at_once = "camera_depth_optical_frame", np.zeros(u.size)
    return SimulatedSensor("depth", frame, pose, config.rate_hz, directions, at_once, config)


def depth_intrinsics(config: DepthConfig) -> F64:
    """Return K (3, 3) in pixels, pixel centres at whole numbers."""
    fx = config.width / 2 / math.tan(math.radians(config.horizontal_deg) / 2)
    fy = config.height / 2 / math.tan(math.radians(config.vertical_deg) / 2)
    return np.array([(fx, 0, (config.width - 1) / 2), (0, fy, (config.height - 1) / 2), (0, 0, 1)])


SENSORS: dict[SensorKind, Callable[[Any], SimulatedSensor]] = {"lidar": lidar, "laser": laser, "depth": depth}
"""For each kind the function that makes one, of its section of the configuration."""


def _mount(xyz_m: tuple[float, float, float]) -> F64:
    pose = np.eye(4)
    pose[:3, 3] = xyz_m
    return pose


def _measure_depth(true_m: F32, config: DepthConfig, rng: np.random.Generator) -> F32:
    """Add noise that grows with the square of the depth, losses at depth jumps, and rounding to
    millimetres."""
    depth = np.where(np.isfinite(true_m), true_m, 0).astype(np.float32)
    spread = config.noise_m + config.noise_per_m * depth**2
    lost = np.full(len(depth), config.dropout, np.float32)
    image = depth.reshape(config.height, config.width)
    near, far = ndimage.minimum_filter(image, 3), ndimage.maximum_filter(image, 3)
    lost[((far - near) > _JUMP_SHARE * image + _JUMP_M).ravel()] = config.edge_dropout
    noise = rng.standard_normal(len(depth), dtype=np.float32) * spread
    reading = np.round((depth + noise) * 1000) / np.float32(1000)
    kept = rng.random(len(depth), dtype=np.float32) >= lost
    kept &= (reading >= config.min_range_m) & (reading <= config.max_range_m) & (depth > 0)
    return np.where(kept, reading, np.float32(np.nan)).astype(np.float32)


# --- clutter ------------------------------------------------------------------------------------------

_TRIES_PER_OBJECT = 40
_SQUARE_SHARE = 0.5  # of the objects are aligned with the axes of the map
_KEPT_FREE_M = 1.0  # around the start of the drive


Prism = tuple[F64, float, float]
"""A part of an object: its convex outline (N, 2) in the frame of the object, and its lowest and highest z."""


@dataclass(frozen=True, slots=True)
class Furniture:
    """One movable object; people who stand still count as such.

    pose : T_map_object. outline_m : (N, 2) convex hull on the floor, in its frame.
    """

    pose: SE2
    outline_m: F64
    parts: tuple[Prism, ...]

    def mesh(self) -> F32:
        """Return the triangles (T, 3, 3) in the map frame."""
        parts = [prism(self.pose.apply(outline_m), low, high) for outline_m, low, high in self.parts]
        return np.concatenate(parts)


def place_clutter(
    grid: OccupancyGrid,
    count: int,
    rng: np.random.Generator,
    *,
    robot_m: float,
    keep_free_m: tuple[tuple[float, float], ...] = (),
) -> tuple[Furniture, ...]:
    """Place up to `count` objects on free cells so that a robot of radius `robot_m` still gets everywhere.

    keep_free_m : points of the map frame; objects stay `_KEPT_FREE_M` away from them. Returns fewer objects
    if there is no room for all.
    """
    passages = Passages(grid.free, grid.resolution_m, robot_m)
    places = np.flatnonzero(grid.free)
    names = list(FURNITURE)
    shares = np.array([FURNITURE[name][1] for name in names])
    placed: list[Furniture] = []
    for _ in range(_TRIES_PER_OBJECT * count if len(places) else 0):
        if len(placed) == count:
            break
        name = names[rng.choice(len(names), p=shares / shares.sum())]
        outline, parts = FURNITURE[name][0](rng)
        cell = np.array([np.unravel_index(places[rng.integers(len(places))], grid.cells.shape)])
        x, y = (float(v) for v in grid.to_point(cell)[0])
        square = rng.random() < _SQUARE_SHARE
        yaw = rng.choice(4) * math.pi / 2 if square else rng.uniform(-math.pi, math.pi)
        candidate = Furniture(SE2(x, y, float(yaw)), outline, tuple(parts))
        reach = float(np.linalg.norm(outline, axis=1).max())
        if any(math.hypot(x - px, y - py) < _KEPT_FREE_M + reach for px, py in keep_free_m):
            continue
        footprint = (candidate.pose.apply(outline) - grid.origin_m) / grid.resolution_m
        if passages.put(footprint):
            placed.append(candidate)
    return tuple(placed)


def covered(grid: OccupancyGrid, clutter: tuple[Furniture, ...]) -> BoolGrid:
    """Return a mask (H, W) of the cells below any of the objects."""
    shape = (grid.cells.shape[0], grid.cells.shape[1])
    mask: BoolGrid = np.zeros(shape, bool)
    for furniture in clutter:
        footprint = (furniture.pose.apply(furniture.outline_m) - grid.origin_m) / grid.resolution_m
        mask |= outline_mask(footprint, shape)
    return mask


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> F64:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _legs(width: float, depth: float, thickness: float, top: float) -> list[Prism]:
    x, y, t = width / 2, depth / 2, thickness
    corners = ((-x, -y), (x - t, -y), (x - t, y - t), (-x, y - t))
    return [(_rectangle(a, b, a + t, b + t), 0.0, top) for a, b in corners]


def _box(rng: np.random.Generator) -> tuple[F64, list[Prism]]:
    width, depth, height = rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.6), rng.uniform(0.3, 1.2)
    outline = _rectangle(-width / 2, -depth / 2, width / 2, depth / 2)
    return outline, [(outline, 0.0, height)]


def _cylinder(
    radius_m: tuple[float, float], height_m: tuple[float, float], rng: np.random.Generator
) -> tuple[F64, list[Prism]]:
    angles = np.arange(16) * (2 * math.pi / 16)
    outline = rng.uniform(*radius_m) * np.column_stack((np.cos(angles), np.sin(angles)))
    return outline, [(outline, 0.0, rng.uniform(*height_m))]


def _chair(rng: np.random.Generator) -> tuple[F64, list[Prism]]:
    size, seat, back = rng.uniform(0.42, 0.5), rng.uniform(0.42, 0.48), rng.uniform(0.8, 1.0)
    half = size / 2
    outline = _rectangle(-half, -half, half, half)
    rest = (_rectangle(-half, -half, -half + 0.04, half), seat, back)
    return outline, [(outline, seat - 0.05, seat), rest, *_legs(size, size, 0.04, seat)]


def _table(rng: np.random.Generator) -> tuple[F64, list[Prism]]:
    width, depth, height = rng.uniform(1.0, 1.6), rng.uniform(0.6, 0.8), rng.uniform(0.7, 0.76)
    outline = _rectangle(-width / 2, -depth / 2, width / 2, depth / 2)
    return outline, [(outline, height - 0.03, height), *_legs(width, depth, 0.06, height)]


FURNITURE: dict[str, tuple[Callable[[np.random.Generator], tuple[F64, list[Prism]]], float]] = {
    "chair": (_chair, 0.35),
    "box": (_box, 0.25),
    "table": (_table, 0.15),
    "person": (partial(_cylinder, (0.18, 0.26), (1.55, 1.9)), 0.15),
    "bin": (partial(_cylinder, (0.14, 0.22), (0.3, 0.75)), 0.10),
}
"""For each kind the function that makes one, and its share of all objects (chosen by hand)."""
