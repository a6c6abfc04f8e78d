"""A 2.5D map of the last metres: columns of evidence cells, out of which planar scans are cut.

A cell with a return is hit, the cells along its ray are free (Hornung et al., "OctoMap", 2013). A column is
classified by its cells between the floor and 1.8 m. A wall is occupied over most of the height that was
observed; a table, a chair or a lintel only in a part of it, while rays pass over it. The planar scan of a
place consists of the walls that are visible from there and of the free floor before them. So one view of a
tilted camera shows the wall above it together with the floor that other views have observed.

Memory is that of the window, however long the recording is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.planar_scan import BEARINGS, PlanarScan, mean_per_cell, planar_normals
from pc2grid.geometry import F32, F64, I64, SE2, BoolGrid
from pc2grid.libraries import compiled
from pc2grid.model import SENSOR_MODELS, SLICE_BORDERS_M, SLICES, SensorKind
from pc2grid.settings import ProjectionConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnParameters:
    """Numbers of the columns. Chosen by hand, unless noted.

    layer_m : height of a cell; a ray ends so far before its point. layers : of the window, half of them below
        the sensor.
    hit, miss : evidence of a scan for a surface in a cell, and against. limits : of the evidence, so that
        what has gone is forgotten after a few scans.
    margin_sigmas : a ray ends this many standard deviations of its point earlier.
    wall_share, wall_layers : a wall is occupied in so large a share of the observed cells between
        `band_min_m` and `band_max_m`, and in so many at least.
    over : what rays pass over in so many layers is no wall but a thing. Walls reach up as far as they are
        observed: of the columns of a real room, walls have 0 or 1 such layers, chairs and persons 2 to 6.
    gap_m : unknown ground that free ground continues behind.
    """

    layer_m: float = 0.1
    layers: int = 56
    hit: int = 2
    miss: int = 1
    limits: tuple[int, int] = (-6, 12)
    margin_sigmas: float = 2.0
    wall_share: float = 0.5
    wall_layers: int = 3
    over: int = 2
    gap_m: float = 0.3


COLUMNS = ColumnParameters()
UNKNOWN, FREE, LOW, WALL = 0, 1, 2, 3
"""What a column is."""


class ColumnMap:
    """The columns around a sensor, in the session frame (z up).

    reach_m : from the sensor; what lies beyond is forgotten.
    """

    def __init__(
        self,
        reach_m: float,
        sensor: SensorKind,
        config: ProjectionConfig,
    ) -> None:
        self._reach_m, self._config = reach_m, config
        self._noise_per_m2 = SENSOR_MODELS[sensor].noise_per_m2
        size = 2 * math.ceil(1.25 * reach_m / config.resolution_m)
        self._evidence = np.zeros((size, size, COLUMNS.layers), np.int8)
        self._seen = np.zeros((size, size, COLUMNS.layers), np.uint8)
        self._touched = np.zeros((size, size), np.uint8)
        self._columns = np.zeros((2, size, size), np.uint8)  # what each is, and its heights (`SLICES`)
        self._sums = np.zeros((size, size, 3), np.float32)
        self._low: I64 = np.zeros(3, np.int64)  # lowest cell of the window
        self._stamp = 0
        self._floor_m = math.nan  # z of the floor that the states are for

    def add(self, points_m: F64, rays_m: F64, sensor_m: F64, floor_m: float, doubt_m: float = 0.0) -> None:
        """Enter a scan at its place in the session frame.

        points_m : (N, 3) returns. rays_m : (M, 3) of these, those whose rays clear what is before them.
        sensor_m : (3,) origin of the rays. floor_m : z of the floor. doubt_m : the floor may lie higher or
        lower by so much: points there are no obstacles.
        """
        p, edge_m = COLUMNS, self._config.resolution_m
        self._center(sensor_m)
        self._stamp += 1
        if self._stamp > np.iinfo(self._seen.dtype).max:
            self._stamp = 1
            self._seen[:] = 0
            self._touched[:] = 0
        cell, margin = (edge_m, p.layer_m), (p.layer_m, p.margin_sigmas * self._noise_per_m2)
        observe(
            self._evidence, self._seen, self._touched, self._sums, self._low, points_m, rays_m, sensor_m,
            cell, self._band_m(floor_m), margin, self._stamp, p.hit, p.miss, p.limits,
        )  # fmt: skip
        same_floor = abs(floor_m - self._floor_m) < 0.5 * p.layer_m
        if not same_floor:
            self._floor_m = floor_m
        low, high = (round(z / p.layer_m) for z in self._band_m(self._floor_m))
        floor, doubt = math.floor(self._floor_m / p.layer_m), round(doubt_m / p.layer_m)
        first, second = (round((self._floor_m + border_m) / p.layer_m) for border_m in SLICE_BORDERS_M)
        changed = self._stamp if same_floor else 0
        classify(
            self._evidence, self._columns[0], self._columns[1], self._touched, self._sums, self._low, changed,
            (floor - 1 - doubt, floor + 2 + doubt), (low + doubt, high), (first, second), p.wall_share,
            p.wall_layers, p.over,
        )  # fmt: skip

    def cut(self, T_session_base: SE2, sensor_m: F64, stamp_ns: int) -> PlanarScan:
        """Return the planar scan at a place: the walls and the floor that are visible from `sensor_m` (3,),
        session frame.

        T_session_base : planar pose of the base, in whose frame the planar scan is.
        """
        p, to_base, edge_m = COLUMNS, T_session_base.inverse(), self._config.resolution_m
        origin = to_base.apply(sensor_m[None, :2])[0]
        # A wall on the border of two cells is in both.
        free_m, sums, low_m = view(
            self._columns[0], self._sums, self._low, sensor_m[:2], T_session_base.yaw, self._reach_m, edge_m,
            p.gap_m, (2.0 * edge_m, 4.0 * self._noise_per_m2), BEARINGS,
        )  # fmt: skip
        walls_m = mean_per_cell(sums, edge_m) if len(sums) else low_m[:0]
        hits: F32 = to_base.apply(walls_m).astype(np.float32)
        obstacles_m: F64 = np.concatenate((walls_m, low_m))
        column, row = (np.floor(obstacles_m / edge_m).astype(np.int64) % self._columns.shape[1]).T
        return PlanarScan(
            stamp_ns=stamp_ns,
            hits_m=hits,
            normal_rad=planar_normals(hits, origin),
            origin_m=origin,
            free_m=free_m.astype(np.float32),
            low_m=to_base.apply(low_m).astype(np.float32),
            heights=self._columns[1, column, row],
        )

    def agreement(self, points_m: F64) -> tuple[float, float]:
        """Return how well points (N, 3), session frame, agree with surfaces and observed free space, -1..1.

        It is the share of points on surfaces minus the share in free space: among the points in observed
        cells, and among all points in the window.
        """
        cell = self._config.resolution_m, COLUMNS.layer_m
        met, against, inside = agreement_counts(self._evidence, self._low, points_m, cell)
        return (met - against) / max(met + against, 1), (met - against) / max(inside, 1)

    def obstacles(self) -> tuple[BoolGrid, F64]:
        """Return a mask (H, W) of all obstacles, rows along y, and its corner (2,)."""
        shift = (-self._low[:2] % self._columns.shape[1]).tolist()
        corner_m = self._config.resolution_m * self._low[:2].astype(np.float64)
        return np.roll(self._columns[0] >= LOW, shift, (0, 1)).T, corner_m

    def _band_m(self, floor_m: float) -> tuple[float, float]:
        return floor_m + self._config.band_min_m, floor_m + self._config.band_max_m

    def _center(self, sensor_m: F64) -> None:
        """Move the window if the sensor is no longer near its middle."""
        p, edge_m = COLUMNS, self._config.resolution_m
        size = self._columns.shape[1]
        cell = np.array([edge_m, edge_m, p.layer_m])
        half = np.array([size // 2, size // 2, p.layers // 2])
        low = np.floor(sensor_m / cell).astype(np.int64) - half
        if not self._stamp:
            self._low = low
        slack = np.array([size // 10, size // 10, p.layers // 10])
        if not (np.abs(low - self._low) > slack).any():
            return
        for axis, count in enumerate(self._evidence.shape):  # cells that leave the window are forgotten
            cells = np.arange(low[axis], low[axis] + count)
            leaves = cells[np.abs(cells - self._low[axis] - 0.5 * (count - 1)) > 0.5 * count] % count
            np.moveaxis(self._evidence, axis, 0)[leaves] = 0
            if axis < 2:
                np.moveaxis(self._sums, axis, 0)[leaves] = 0.0
        self._low, self._floor_m = low, math.nan  # states are made again


# --- compiled functions -------------------------------------------------------------------------------


@compiled()
def observe(
    evidence: NDArray[np.int8],
    seen: NDArray[np.uint8],
    touched: NDArray[np.uint8],
    sums: F32,
    low: I64,
    points: F64,
    rays: F64,
    sensor: F64,
    cell: tuple[float, float],
    band: tuple[float, float],
    margin: tuple[float, float],
    stamp: int,
    hit: int,
    miss: int,
    limits: tuple[int, int],
) -> None:
    """Enter a hit where the points (N, 3) of a scan lie, one a cell and scan, and then a miss along its rays
    to points (M, 3) where it has no hit.

    evidence, seen : (W, W, L), `seen` is the stamp of the last scan that entered a cell. touched : (W, W) the
    same of columns. sums : (W, W, 3) sums of x and y, relative to the column's corner, of the points in the
    band, and their number. sensor : (3,) origin of the rays. cell : edge and height of a cell. band : lowest
    and highest z of an obstacle. margin : (a, b), a ray ends a + b * range^2 before its point. limits : of
    the evidence.
    """
    size, layers = evidence.shape[0], evidence.shape[2]
    edge, height = cell
    for n in range(len(points)):
        i, j = math.floor(points[n, 0] / edge), math.floor(points[n, 1] / edge)
        k = math.floor(points[n, 2] / height)
        if not (
            low[0] <= i < low[0] + size and low[1] <= j < low[1] + size and low[2] <= k < low[2] + layers
        ):
            continue
        a, b, c = i % size, j % size, k % layers
        if seen[a, b, c] != stamp:
            seen[a, b, c] = stamp
            evidence[a, b, c] = min(evidence[a, b, c] + hit, limits[1])
            touched[a, b] = stamp
        if band[0] <= points[n, 2] <= band[1]:
            if sums[a, b, 2] >= 200.0:
                sums[a, b] *= 0.5
            sums[a, b, 0] += points[n, 0] - i * edge
            sums[a, b, 1] += points[n, 1] - j * edge
            sums[a, b, 2] += 1.0

    x, y, z = sensor[0] / edge - low[0], sensor[1] / edge - low[1], sensor[2] / height - low[2]
    first_a, first_b, first_c = low[0] % size, low[1] % size, low[2] % layers
    for n in range(len(rays)):
        dx, dy, dz = rays[n, 0] - sensor[0], rays[n, 1] - sensor[1], rays[n, 2] - sensor[2]
        away = math.sqrt(dx * dx + dy * dy + dz * dz)
        steps = int((away - margin[0] - margin[1] * away * away) / edge)
        dx, dy, dz = dx / away, dy / away, dz / away * edge / height
        for step in range(steps):
            i, j, k = math.floor(x + step * dx), math.floor(y + step * dy), math.floor(z + step * dz)
            if not (0 <= i < size and 0 <= j < size):
                break
            if not 0 <= k < layers:
                continue
            a, b, c = first_a + i, first_b + j, first_c + k
            a -= size * (a >= size)
            b -= size * (b >= size)
            c -= layers * (c >= layers)
            if seen[a, b, c] != stamp:
                seen[a, b, c] = stamp
                evidence[a, b, c] = max(evidence[a, b, c] - miss, limits[0])
                touched[a, b] = stamp


@compiled()
def classify(
    evidence: NDArray[np.int8],
    state: NDArray[np.uint8],
    heights: NDArray[np.uint8],
    touched: NDArray[np.uint8],
    sums: F32,
    low: I64,
    stamp: int,
    ground: tuple[int, int],
    band: tuple[int, int],
    borders: tuple[int, int],
    share: float,
    least: int,
    over: int,
) -> None:
    """Write the state (W, W) of the columns with a stamp (0: of all), and the heights (W, W) of those with an
    obstacle.

    ground, band : first layer, and the layer behind the last one, of the floor and of obstacles.
    borders : first layer of each slice but the lowest, see `pc2grid.model.SLICES`. A wall is occupied in at
    least `least` layers and in at least `share` of the observed ones, and fewer than `over` layers above it
    were observed to be free.
    """
    size, layers = evidence.shape[0], evidence.shape[2]
    band = max(band[0], low[2]), min(band[1], low[2] + layers)
    ground = max(ground[0], low[2]), min(ground[1], low[2] + layers)
    for a in range(size):
        for b in range(size):
            if stamp != 0 and touched[a, b] != stamp:
                continue
            occupied, free, passed_over, filled, empty = 0, 0, 0, 0, 0
            for k in range(band[0], band[1]):
                value = evidence[a, b, k % layers]
                slice_bit = 1 << ((k >= borders[0]) + (k >= borders[1]))
                filled |= slice_bit * (value > 0)
                empty |= slice_bit * (value < 0)
                occupied += value > 0
                free += value < 0
                passed_over = 0 if value > 0 else passed_over + (value < 0)
            heights[a, b] = 0
            if occupied:
                tall = occupied >= least and passed_over < over
                # Points in the band locate a wall.
                is_wall = tall and sums[a, b, 2] > 0 and occupied >= share * (occupied + free)
                state[a, b], heights[a, b] = WALL if is_wall else LOW, filled | (empty & ~filled) << SLICES
                continue
            for k in range(ground[0], ground[1]):
                free += evidence[a, b, k % layers] > 0
            state[a, b] = FREE if free else UNKNOWN


@compiled()
def view(
    state: NDArray[np.uint8],
    sums: F32,
    low: I64,
    origin: F64,
    turn: float,
    reach: float,
    edge: float,
    gap: float,
    depth: tuple[float, float],
    bearings: int,
) -> tuple[F64, F64, F64]:
    """Cast a ray along each bearing from a place (2,): find the first wall and the floor before it.

    turn : direction of the first bearing, radians. gap : unknown ground wider than this ends what is free.
    depth : (d, q), walls behind the first one are part of it up to d + q * range^2.

    Returns the free range of each bearing (0: none), for each wall the sums of x, y and 1 of its points (S,
    3), by increasing bearing, and the middles (K, 2) of the low columns that were passed, each once.
    """
    size = state.shape[0]
    free_m, walls, lows = np.zeros(bearings), np.empty((bearings, 3)), np.empty((size * size, 2))
    passed = np.zeros((size, size), np.uint8)  # low columns
    found, count = 0, 0
    x, y = origin[0] / edge - low[0], origin[1] / edge - low[1]
    for bearing in range(bearings):
        angle = turn + bearing * (2.0 * math.pi / bearings)
        along_x, along_y = math.cos(angle), math.sin(angle)
        dx, dy = along_x / edge, along_y / edge
        free, known, is_wall, last_i, last_j, r = 0.0, False, False, -1, -1, 0.0
        while r < reach and not is_wall:
            r += 0.5 * edge
            i, j = math.floor(x + r * dx), math.floor(y + r * dy)
            if i == last_i and j == last_j:
                continue
            last_i, last_j = i, j
            if not (0 <= i < size and 0 <= j < size):
                break
            a, b = (i + low[0]) % size, (j + low[1]) % size
            is_wall = state[a, b] == WALL
            if state[a, b] == UNKNOWN:
                if known and r - free > gap:
                    break
            elif not is_wall:
                known, free = True, r
                if state[a, b] == LOW and not passed[a, b]:
                    passed[a, b] = 1
                    lows[count, 0], lows[count, 1] = (low[0] + i + 0.5) * edge, (low[1] + j + 0.5) * edge
                    count += 1
        free_m[bearing] = free
        if not is_wall:
            continue
        if r - free <= gap:
            free_m[bearing] = max(r - 0.5 * edge, free)
        first, thick = r, depth[0] + depth[1] * r * r
        sx = sy = total = 0.0
        last_i, last_j = -1, -1  # of a column in the window, as its state is looked up
        while True:
            i, j = math.floor((origin[0] + r * along_x) / edge), math.floor((origin[1] + r * along_y) / edge)
            a, b = i % size, j % size
            new = a != last_i or b != last_j
            last_i, last_j = a, b
            outside = i < low[0] or i >= low[0] + size or j < low[1] or j >= low[1] + size
            if outside or (new and r - first > thick):
                break
            if new and state[a, b] == WALL:
                total += sums[a, b, 2]
                sx += sums[a, b, 0] + i * edge * sums[a, b, 2]
                sy += sums[a, b, 1] + j * edge * sums[a, b, 2]
            if r >= reach:
                break
            r += 0.5 * edge
        walls[found, 0], walls[found, 1], walls[found, 2] = sx, sy, total
        found += 1
    return free_m, walls[:found].copy(), lows[:count].copy()


@compiled()
def agreement_counts(
    evidence: NDArray[np.int8], low: I64, points: F64, cell: tuple[float, float]
) -> tuple[int, int, int]:
    """Count the points (N, 3) in or beside a cell with a surface, those in free cells, and those in the
    window.
    """
    size, layers = evidence.shape[0], evidence.shape[2]
    met, against, inside = 0, 0, 0
    for n in range(len(points)):
        i, j = math.floor(points[n, 0] / cell[0]), math.floor(points[n, 1] / cell[0])
        k = math.floor(points[n, 2] / cell[1])
        if not (
            low[0] < i < low[0] + size - 1
            and low[1] < j < low[1] + size - 1
            and low[2] < k < low[2] + layers - 1
        ):
            continue
        inside += 1
        here = evidence[i % size, j % size, k % layers]
        best = here
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    best = max(best, evidence[(i + a) % size, (j + b) % size, (k + c) % layers])
        if best > 0:
            met += 1
        elif here < 0:
            against += 1
    return met, against, inside
