"""Compiled steps of this folder. The tests compare them with plain forms in numpy."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, U8
from pc2grid.model import SLICES


@njit(cache=True)
def planar_normals(
    away: F64,
    order: NDArray[np.intp],
    bearings: F64,
    reach_m: float,
    reach_per_m: float,
    sparse_factor: float,
    max_flatness: float,
) -> F32:
    """The angle of the normal of the surface at each hit, as `normals.planar_normals` defines it.

    away : (N, 2) hits from the sensor. order : sorts them by their `bearings`.

    Measured: 0.06 ms instead of 16 ms a scan of a planar laser, 0.11 instead of 86 ms of a lidar; all of the
    tracking of a scan takes 2 ms and 6 ms.
    """
    count = len(order)
    angles = np.empty(count, dtype=np.float32)
    for place in range(count):
        i = order[place]
        x, y = away[i, 0], away[i, 1]
        distance = math.hypot(x, y)
        towards = math.atan2(-y, -x)
        angles[i] = towards
        for factor in (1.0, sparse_factor):
            reach = factor * (reach_m + reach_per_m * distance)
            window = reach / max(distance, reach)
            n = 1.0
            sx = sy = sxx = sxy = syy = 0.0
            # Half of the hits on either side at most, so that each neighbour is counted once.
            for step, farthest in ((-1, (count - 1) // 2), (1, count // 2)):
                for k in range(1, farthest + 1):
                    j = order[(place + step * k) % count]
                    turn = abs(bearings[j] - bearings[i])
                    if min(turn, 2.0 * math.pi - turn) > window:
                        break
                    dx, dy = away[j, 0] - x, away[j, 1] - y
                    if dx * dx + dy * dy < reach * reach:
                        n += 1.0
                        sx += dx
                        sy += dy
                        sxx += dx * dx
                        sxy += dx * dy
                        syy += dy * dy
            if n < 3.0:
                continue
            mx, my = sx / n, sy / n
            a, b, d = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
            spread = math.sqrt(0.25 * (a - d) * (a - d) + b * b)
            if 0.5 * (a + d) - spread < max_flatness * (0.5 * (a + d) + spread):
                normal = 0.5 * math.atan2(2.0 * b, a - d) + 0.5 * math.pi
                if math.cos(normal - towards) < 0.0:
                    normal += math.pi
                angles[i] = normal
            break
    return angles


@njit(cache=True)
def scan_bearings(
    points: F32,
    sensor: F64,
    plane: F64,
    band: tuple[float, float],
    limit: float,
    depths: tuple[float, float],
    bearings: int,
) -> tuple[F64, F64, F64]:
    """Sort points (N, 3) by bearing.

    sensor : (3,). plane : (4,) with height = plane[:3] . p + plane[3]. band : lowest and highest height of
    an obstacle. limit : farthest range of an obstacle point. depths : (d, q), obstacle points of one
    bearing belong to one surface up to a range difference of d + q * range**2.

    Returns for each bearing the range of the nearest obstacle (inf: none) and how far floor and ceiling
    show it to be free (0: not at all), and for each surface (S, 3) the sums of x and y of its points and
    their number, by increasing bearing and range.

    Measured: 0.6 ms instead of 23 ms a scan of a lidar, 0.015 instead of 0.7 ms of a planar laser.
    """
    nearest, reach = np.empty(bearings), np.empty(bearings)
    for b in range(bearings):
        nearest[b], reach[b] = math.inf, 0.0
    count = points.shape[0]
    bearing_of, ranges = np.empty(count, dtype=np.int32), np.empty(count)
    sensor_height = plane[0] * sensor[0] + plane[1] * sensor[1] + plane[2] * sensor[2] + plane[3]
    for k in range(count):
        px, py = float(points[k, 0]), float(points[k, 1])
        x, y = px - sensor[0], py - sensor[1]
        ranges[k] = distance = math.hypot(x, y)
        bearing = round(math.atan2(y, x) * (bearings / (2.0 * math.pi))) % bearings
        height = plane[0] * px + plane[1] * py + plane[2] * points[k, 2] + plane[3]
        bearing_of[k] = -1
        if height < band[0]:
            reach[bearing] = max(reach[bearing], distance)
        elif height > band[1]:
            if sensor_height < band[1]:
                part = (band[1] - sensor_height) / (height - sensor_height)
                reach[bearing] = max(reach[bearing], distance * part)
        else:
            nearest[bearing] = min(nearest[bearing], distance)
            if distance <= limit:
                bearing_of[k] = bearing
    order, starts = _by_bearing(bearing_of, ranges, bearings)
    return nearest, reach, _surfaces(points, ranges, order, starts, depths)


@njit(cache=True)
def _by_bearing(
    bearing_of: NDArray[np.int32], ranges: F64, bearings: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The points with a bearing (not -1) by bearing and range, and where those of each bearing start."""
    starts = np.zeros(bearings + 1, dtype=np.int64)
    for bearing in bearing_of:
        if bearing >= 0:
            starts[bearing + 1] += 1
    filled = np.empty(bearings + 1, dtype=np.int64)
    filled[0] = 0
    for b in range(bearings):
        starts[b + 1] += starts[b]
        filled[b + 1] = starts[b + 1]
    order = np.empty(starts[bearings], dtype=np.int64)
    for k in range(len(bearing_of)):
        bearing = bearing_of[k]
        if bearing >= 0:
            place = filled[bearing]  # insertion sort by range: one bearing has a few dozen points
            while place > starts[bearing] and ranges[order[place - 1]] > ranges[k]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = k
            filled[bearing] += 1
    return order, starts


@njit(cache=True)
def _surfaces(
    points: F32,
    ranges: F64,
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    depths: tuple[float, float],
) -> F64:
    """For each surface (S, 3) the sums of x and y of its points, and their number."""
    surfaces = np.empty((len(order), 3))
    found = 0
    for bearing in range(len(starts) - 1):
        first = 0.0
        for place in range(starts[bearing], starts[bearing + 1]):
            k = order[place]
            if place == starts[bearing] or ranges[k] - first > depths[0] + depths[1] * ranges[k] * ranges[k]:
                first = ranges[k]
                surfaces[found, 0] = surfaces[found, 1] = surfaces[found, 2] = 0.0
                found += 1
            surfaces[found - 1, 0] += points[k, 0]
            surfaces[found - 1, 1] += points[k, 1]
            surfaces[found - 1, 2] += 1.0
    return surfaces[:found].copy()


@njit(cache=True)
def heights_seen(
    at: F32,
    points: F32,
    sensor: F64,
    plane: F64,
    band: tuple[float, float],
    depths: tuple[float, float],
    borders: F64,
    bearings: int,
) -> U8:
    """As `heights.heights_seen`; of each obstacle, only the points of the `bearings` that matter are looked
    at."""
    per_rad = bearings / (2.0 * math.pi)
    bearing_of, ranges = np.empty(len(points), dtype=np.int32), np.empty(len(points))
    for n in range(len(points)):
        dx, dy = points[n, 0] - sensor[0], points[n, 1] - sensor[1]
        bearing_of[n] = math.floor(math.atan2(dy, dx) * per_rad) % bearings
        ranges[n] = math.hypot(dx, dy)
    order, starts = _sorted(bearing_of, bearings)
    heights = np.zeros(len(at), dtype=np.uint8)
    for k in range(len(at)):
        x, y = at[k, 0] - sensor[0], at[k, 1] - sensor[1]
        r = math.hypot(x, y)
        reach = 0.5 * math.pi if r <= 0.5 * depths[0] else math.asin(0.5 * depths[0] / r)
        first = math.floor((math.atan2(y, x) - reach) * per_rad)
        filled, empty = 0, 0
        for bearing in range(first, first + min(math.ceil(2.0 * reach * per_rad) + 1, bearings)):
            here = order[starts[bearing % bearings] : starts[bearing % bearings + 1]]
            more = _heights_along(here, points, ranges, (x, y, r), sensor, plane, band, depths, borders)
            filled, empty = filled | more[0], empty | more[1]
        heights[k] = filled | (empty & ~filled) << SLICES
    return heights


@njit(cache=True)
def _sorted(bearing_of: NDArray[np.int32], bearings: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The points by bearing, and where those of each bearing start."""
    starts = np.zeros(bearings + 1, dtype=np.int64)
    for bearing in bearing_of:
        starts[bearing + 1] += 1
    order, filled = np.empty(len(bearing_of), dtype=np.int64), np.empty(bearings + 1, dtype=np.int64)
    filled[0] = 0
    for b in range(bearings):
        starts[b + 1] += starts[b]
        filled[b + 1] = starts[b + 1]
    for n in range(len(bearing_of)):
        order[filled[bearing_of[n]]] = n
        filled[bearing_of[n]] += 1
    return order, starts


@njit(cache=True)
def _heights_along(
    order: NDArray[np.int64],
    points: F32,
    ranges: F64,
    at: tuple[float, float, float],
    sensor: F64,
    plane: F64,
    band: tuple[float, float],
    depths: tuple[float, float],
    borders: F64,
) -> tuple[int, int]:
    """The slices that the points in `order` fill and leave empty at x, y and the range `at`."""
    x, y, r = at
    deep = depths[0] + depths[1] * r * r
    sensor_height = plane[0] * sensor[0] + plane[1] * sensor[1] + plane[2] * sensor[2] + plane[3]
    filled, empty = 0, 0
    for n in order:
        dx, dy, away = points[n, 0] - sensor[0], points[n, 1] - sensor[1], max(ranges[n], 1e-9)
        aside = abs(x * dy - y * dx) / away
        behind = away > r + deep
        if away < r - deep or aside > (0.25 if behind else 0.5) * depths[0] or dx * x + dy * y <= 0.0:
            continue
        height = plane[0] * points[n, 0] + plane[1] * points[n, 1] + plane[2] * points[n, 2] + plane[3]
        if behind:
            height = sensor_height + (height - sensor_height) * r / away
        if band[0] <= height <= band[1]:
            bit = 1
            for border in borders:
                bit <<= height >= border
            filled, empty = filled | bit * (not behind), empty | bit * behind
    return filled, empty
