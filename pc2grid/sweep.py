"""A scan reduced to the plane: the one thing that every later stage sees, whatever the sensor.

A beam of a laser, a ring of a lidar and a pixel of a camera say the same two things about the floor
plan: there is something here, and there is nothing up to here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.config import ProjectionConfig
from pc2grid.floor import Ground
from pc2grid.geometry import F64
from pc2grid.model import F32, SensorKind

BEARINGS = 1440  # a wall seen along itself needs them fine: a quarter of a degree is a cell at 12 m
_CAMERA_NOISE_PER_M2 = 0.0015  # of a depth, as in stereo and structured light; standard deviation
_GAP_BINS = 5  # beams up to 1.5 degrees apart count as looking in between


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """What one scan says about the plane.

    All coordinates are in the levelled base frame: the base's origin and heading, z up.

    stamp_ns : stamp of the scan.
    hits_m : (M, 2) float32, obstacle points within the height band, about one per grid cell.
    origin_m : (2,) float64, where the sensor is.
    free_m : (B,) float32, how far from `origin_m` the plane is known to be free, for B equal bearings
        around it (entry 0 looks along +x, counter-clockwise); 0 where nothing was learned.
    """

    stamp_ns: int
    hits_m: F32
    origin_m: F64
    free_m: F32

    def free_polygon(self, limit_m: float = np.inf) -> F64:
        """(B, 2) outline in the levelled base frame of the free space no farther than `limit_m`, metres."""
        free_m = np.minimum(self.free_m, limit_m)
        outline: F64 = self.origin_m + free_m[:, None] * _directions(len(self.free_m))
        return outline


@lru_cache(maxsize=4)
def _directions(count: int) -> F64:
    """(count, 2) unit vectors, equally spaced around, the first along +x."""
    bearings = np.arange(count) * (2.0 * np.pi / count)
    directions: F64 = np.column_stack((np.cos(bearings), np.sin(bearings)))
    directions.flags.writeable = False
    return directions


def flatten(
    points_m: NDArray[np.floating],
    *,
    stamp_ns: int,
    sensor_m: F64,
    ground: Ground | None,
    config: ProjectionConfig,
    sensor: SensorKind = "lidar",
) -> Sweep:
    """Reduce points to the plane.

    points_m : (N, 3) in the levelled base frame. sensor_m : (3,) the sensor in that frame.
    ground : the floor in that frame, or None for a planar laser, whose every return is an obstacle.

    A bearing is free up to its nearest obstacle; without an obstacle, as far as the farthest return on
    the floor or, for a ray that climbs to a ceiling or an overhang, to where it leaves the height band.
    Obstacle points above each other, as far apart as the noise of a `sensor` makes them, are one hit in
    their middle: thirty pixels on a wall say where it is five times as well as each of them.
    """
    origin = np.asarray(sensor_m, dtype=np.float64)
    if ground is None:
        plane, sensor_height = np.zeros(4), 0.0
        band = (-np.inf, np.inf)
        cell_m = 0.5 * config.resolution_m  # a laser's beams are few: keep nearly all of them
    else:
        plane = np.array([*ground.normal, ground.offset_m])
        sensor_height = float(ground.heights(origin[None, :])[0])
        band = (config.band_min_m, config.band_max_m)
        cell_m = config.resolution_m
    points = np.asarray(points_m, dtype=np.float32)
    noise = _CAMERA_NOISE_PER_M2 if sensor == "depth" else 0.0
    free, hits = _scatter(points, origin, sensor_height, plane, *band, config.max_range_m, cell_m, noise)
    return Sweep(stamp_ns=stamp_ns, hits_m=hits, origin_m=origin[:2].copy(), free_m=free)


@njit(cache=True)
def _scatter(
    points: F32,
    sensor: F64,
    sensor_height: float,
    plane: F64,
    band_min: float,
    band_max: float,
    limit: float,
    cell_m: float,
    noise: float,
) -> tuple[F32, F32]:
    """How far each bearing is free, and the obstacle points, about one a cell."""
    nearest = np.full(BEARINGS, np.inf)
    reach = np.zeros(BEARINGS)
    count = points.shape[0]
    bearings = np.empty(count, dtype=np.int32)
    ranges = np.empty(count)
    starts = np.zeros(BEARINGS + 1, dtype=np.int64)
    for k in range(count):
        px, py = float(points[k, 0]), float(points[k, 1])
        x, y = px - sensor[0], py - sensor[1]
        ranges[k] = distance = math.hypot(x, y)
        bearing = round(math.atan2(y, x) * (BEARINGS / (2.0 * math.pi))) % BEARINGS
        height = plane[0] * px + plane[1] * py + plane[2] * points[k, 2] + plane[3]
        bearings[k] = -1
        if height < band_min:
            reach[bearing] = max(reach[bearing], distance)
        elif height > band_max:
            if sensor_height < band_max:
                part = (band_max - sensor_height) / (height - sensor_height)
                reach[bearing] = max(reach[bearing], distance * part)
        else:
            nearest[bearing] = min(nearest[bearing], distance)
            if distance <= limit:
                bearings[k] = bearing
                starts[bearing + 1] += 1
    starts = np.cumsum(starts)
    column = np.empty(starts[-1], dtype=np.int64)
    filled = starts.copy()
    for k in range(count):
        if bearings[k] >= 0:
            column[filled[bearings[k]]] = k
            filled[bearings[k]] += 1
    surfaces = np.empty((len(column), 3))
    found = 0
    for bearing in range(BEARINGS):
        first = 0.0
        for place in range(starts[bearing], starts[bearing + 1]):
            k = column[place]
            before = place  # sorting by insertion: a bearing holds a few dozen
            while before > starts[bearing] and ranges[column[before - 1]] > ranges[k]:
                column[before] = column[before - 1]
                before -= 1
            column[before] = k
        for place in range(starts[bearing], starts[bearing + 1]):
            k = column[place]
            depth = cell_m + 4.0 * noise * ranges[k] * ranges[k]
            if place == starts[bearing] or ranges[k] - first > depth:
                first = ranges[k]
                surfaces[found] = 0.0
                found += 1
            surfaces[found - 1, 0] += points[k, 0]
            surfaces[found - 1, 1] += points[k, 1]
            surfaces[found - 1, 2] += 1.0
    free = np.where(np.isfinite(nearest), nearest, reach)
    _fill_gaps(free)
    return np.minimum(free, limit).astype(np.float32), _one_per_cell(surfaces[:found], cell_m)


@njit(cache=True)
def _one_per_cell(sums: F64, cell_m: float) -> F32:
    """The means (M, 2) of all that falls into each cell, first seen first; sums (N, 3) of x, y and number."""
    mask = 1
    while mask < 2 * len(sums) + 2:
        mask *= 2
    slots = np.full(mask, -1, dtype=np.int32)  # a hash table of cells
    mask -= 1
    keys = np.empty(len(sums), dtype=np.int64)
    total = np.zeros((len(sums), 3))
    used = 0
    for x, y, n in sums:
        key = math.floor(x / n / cell_m) * (1 << 32) + math.floor(y / n / cell_m)
        slot = (key * -7046029254386353131 >> 20) & mask
        while slots[slot] >= 0 and keys[slots[slot]] != key:
            slot = (slot + 1) & mask
        if slots[slot] < 0:
            slots[slot], keys[used] = used, key
            used += 1
        total[slots[slot], 0] += x
        total[slots[slot], 1] += y
        total[slots[slot], 2] += n
    hits = np.empty((used, 2), dtype=np.float32)
    for k in range(used):
        hits[k, 0] = total[k, 0] / total[k, 2]
        hits[k, 1] = total[k, 1] / total[k, 2]
    return hits


@njit(cache=True)
def _fill_gaps(free: F64) -> None:
    """Bearings between two that looked, at most `_GAP_BINS` wide, take the shorter of the two."""
    looked = np.flatnonzero(free > 0.0)
    for k in range(len(looked)):
        left, right = looked[k - 1], looked[k]
        between = (right - left - 1) % BEARINGS
        if between <= _GAP_BINS:
            for step in range(1, between + 1):
                free[(left + step) % BEARINGS] = min(free[left], free[right])
