"""Planar drives through small plans without any 3D simulation: planar scans from isovists, exact poses."""

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from pc2grid.clouds.planar_scan import BEARINGS, PlanarScan, planar_normals
from pc2grid.geometry import SE2
from pc2grid.model import FREE, OCCUPIED, OccupancyGrid, RegisteredScan, Scan
from pc2grid.submaps.submaps import WALL, isovist, partition
from signature.config import Config
from signature.database import Label
from signature.database.protocol import BuildingFrame
from signature.paper import Signature, SignatureTable, describe
from signature.places.map_index import MapIndex

RESOLUTION_M = 0.05


def plan(
    width_m: float, height_m: float, walls: Sequence[tuple[float, float, float, float]]
) -> OccupancyGrid:
    """A hall with its lower left corner at (0, 0), and walls in it from (x0, y0) to (x1, y1)."""
    cells = np.full((round(height_m / RESOLUTION_M), round(width_m / RESOLUTION_M)), FREE, np.int16)
    outline = [(0, 0, width_m, 0), (width_m, 0, width_m, height_m), (width_m, height_m, 0, height_m)]
    for x0, y0, x1, y1 in [*outline, (0, height_m, 0, 0), *walls]:
        ends = [
            tuple(int(min(v / RESOLUTION_M, n - 1)) for v, n in zip(p, cells.shape[::-1], strict=True))
            for p in ((x0, y0), (x1, y1))
        ]
        cv2.line(cells, *ends, OCCUPIED, thickness=2)
    return OccupancyGrid(cells=cells.astype(np.int8), resolution_m=RESOLUTION_M, origin_m=(0.0, 0.0))


def office() -> OccupancyGrid:
    """20 x 14 m: a corridor with rooms of different sizes, no two places alike."""
    walls = [
        (0, 6, 3, 6), (4, 6, 9, 6), (10, 6, 16, 6), (17, 6, 20, 6),  # of the corridor, with doors
        (0, 8, 6, 8), (7, 8, 13, 8), (14, 8, 20, 8),
        (5, 0, 5, 6), (12, 0, 12, 6), (8, 8, 8, 14), (14.5, 8, 14.5, 14),  # between rooms
        (2, 2, 3, 2), (3, 2, 3, 4), (7, 1, 7, 3), (15, 3, 18, 3), (16, 1, 16, 3),  # within them
        (2, 11, 5, 11), (10, 10, 10, 12), (17, 10, 17, 14),
    ]  # fmt: skip
    return plan(20, 14, walls)


OTHER = plan(16, 12, [(4, 0, 4, 7), (9, 5, 9, 12), (9, 5, 13, 5), (6, 9, 6, 12), (13, 2, 16, 2)])
"""Another building."""
BENT = [(0, 3, 3, 3), (4, 3, 6, 3), (2, 3, 2, 5)]
TWINS = plan(12, 6, [(6, 0, 6, 6), *BENT, *[(x0 + 6, y0, x1 + 6, y1) for x0, y0, x1, y1 in BENT]])
"""Two rooms side by side that are alike: (x, y) of the one is (x + 6, y) of the other."""


def changed_part() -> OccupancyGrid:
    """A part of the office, without the wall from (7, 1) to (7, 3), and with a box."""
    cells = cut(office(), 4.0, 0.0, 15.0, 12.0).cells.copy()
    cells[18:62, 58:63] = 0
    cells[140:148, 110:118] = 100
    return OccupancyGrid(cells=cells, resolution_m=RESOLUTION_M, origin_m=(0.0, 0.0))


def with_tables(grid: OccupancyGrid) -> OccupancyGrid:
    """The map by a lidar that has seen over and under tables of 0.6 x 1 m, which stand wherever the floor is
    free, 0.4 m apart and from walls."""
    cells, heights = grid.cells.copy(), np.zeros(grid.cells.shape, np.uint8)
    long, wide, gap = 20, 12, 8  # cells
    rows, columns = (
        range(gap, size, side + gap) for size, side in zip(cells.shape, (wide, long), strict=True)
    )
    for row, column in itertools.product(rows, columns):
        table, around = (
            np.s_[row - free : row + wide + free, column - free : column + long + free] for free in (0, gap)
        )
        if (grid.cells[around] == FREE).all():
            cells[table], heights[table] = OCCUPIED, 0b101_010
    return replace(grid, cells=cells, heights=heights)


def office_part(center_m: tuple[float, float], half_m: float = 3.0) -> OccupancyGrid:
    """Part of the office in a frame of its own, whose origin is at `center_m`."""
    crop = office().crop(center_m, half_m)
    origin_m = crop.origin_m[0] - center_m[0], crop.origin_m[1] - center_m[1]
    return OccupancyGrid(cells=crop.cells, resolution_m=crop.resolution_m, origin_m=origin_m)


def drive(
    grid: OccupancyGrid,
    corners_m: Sequence[tuple[float, float]],
    *,
    field_rad: float = 2 * math.pi,
    reach_m: float = 12.0,
) -> Iterator[tuple[RegisteredScan, PlanarScan, SE2]]:
    """Planar scans every 0.2 m along straight lines between corners, with the true pose of each.

    The registered pose is in the frame of the first one, as a robot that starts anywhere would have it.
    """
    first: SE2 | None = None
    stamp_ns = 0
    for (x0, y0), (x1, y1) in itertools.pairwise(corners_m):
        yaw = math.atan2(y1 - y0, x1 - x0)
        steps = max(1, round(math.hypot(x1 - x0, y1 - y0) / 0.2))
        for k in range(steps):
            truth = SE2(x0 + (x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps, yaw)
            first = first or truth
            stamp_ns += 100_000_000
            planar_scan = look(grid, truth, stamp_ns, field_rad, reach_m)
            yield register(first.inverse() @ truth, stamp_ns), planar_scan, truth


def register(T_odom_base: SE2, stamp_ns: int) -> RegisteredScan:
    scan = Scan(stamp_ns=stamp_ns, points_m=np.zeros((0, 3)), T_base_sensor=np.eye(4), sensor="laser")
    return RegisteredScan(scan=scan, T_session_base=T_odom_base.lift())


def look(grid: OccupancyGrid, truth: SE2, stamp_ns: int, field_rad: float, reach_m: float) -> PlanarScan:
    view = isovist(grid, (truth.x, truth.y), reach_m, bearings=BEARINGS)
    bearings = 2 * np.pi * np.arange(BEARINGS) / BEARINGS
    relative = np.remainder(bearings - truth.yaw + np.pi, 2 * np.pi) - np.pi
    inside = np.abs(relative) <= field_rad / 2
    hit = inside & (view.ends == WALL)
    points = view.ranges_m[:, None] * np.column_stack((np.cos(relative), np.sin(relative)))
    free = np.zeros(BEARINGS, np.float32)
    bins = np.rint(relative * BEARINGS / (2 * np.pi)).astype(int) % BEARINGS
    free[bins[inside]] = view.ranges_m[inside]
    return flat_scan(points[hit], free, stamp_ns)


def flat_scan(hits_m: ArrayLike, free_m: ArrayLike, stamp_ns: int = 0) -> PlanarScan:
    """The planar scan of a sensor at the base. free_m : of each bearing, or the same for all."""
    free, hits = np.asarray(free_m, np.float32), np.asarray(hits_m, np.float32).reshape(-1, 2)
    return PlanarScan(
        stamp_ns=stamp_ns,
        hits_m=hits,
        normal_rad=planar_normals(hits, np.zeros(2)),
        origin_m=np.zeros(2),
        free_m=np.full(BEARINGS, free) if free.ndim == 0 else free,
    )


_DESCRIBED: dict[tuple[object, ...], list[tuple[Signature, tuple[float, float], int]]] = {}


def _described(grid: OccupancyGrid, config: Config) -> list[tuple[Signature, tuple[float, float], int]]:
    """The signatures of a map with centre and number; most tests ask the same office."""
    heights = None if grid.heights is None else grid.heights.tobytes()
    about = grid.cells.tobytes(), heights, grid.cells.shape, grid.resolution_m, grid.origin_m
    key = (*about, config.partition, config.signature)
    if key not in _DESCRIBED:
        submaps = partition(grid, config.partition)
        _DESCRIBED[key] = [(describe(s, config.signature), s.center_m, s.submap_id) for s in submaps]
    return _DESCRIBED[key]


def building(
    grids: dict[str, OccupancyGrid],
    config: Config | None = None,
    labels: dict[str, Label] | None = None,
    joined: dict[str, SE2] | None = None,
    drawn: Collection[str] = (),
) -> MapIndex:
    """A database in memory. joined : where sessions lie in their building. drawn : see `MapIndex`."""
    config = config or Config()
    rows = [(*row, index) for index, grid in enumerate(grids.values()) for row in _described(grid, config)]
    signatures, centers, ids, sessions = (
        (list(column) for column in zip(*rows, strict=True)) if rows else ([],) * 4
    )
    table = SignatureTable.of(signatures, centers, submap_id=ids, session_index=sessions)
    exact = ((0.0, 0.0, 0.0),) * 3
    frames = {
        name: BuildingFrame(name="building", T_building_session=T, covariance=exact)
        for name, T in (joined or {}).items()
    }
    return MapIndex(grids, grids.__getitem__, table, config, config, labels, frames=frames, drawn=drawn)


def cut(grid: OccupancyGrid, x0: float, y0: float, x1: float, y1: float) -> OccupancyGrid:
    """A part of a plan with its own frame at the plan's (x0, y0)."""
    a, b, c, d = (round(v / RESOLUTION_M) for v in (y0, y1, x0, x1))
    return OccupancyGrid(cells=grid.cells[a:b, c:d], resolution_m=RESOLUTION_M, origin_m=(0.0, 0.0))
