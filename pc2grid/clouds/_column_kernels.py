"""Compiled parts of `column_map`: evidence in a window that moves with the sensor, and what a view of it
shows.

The window is a torus: the cell with the indices (i, j, k) of the map is at their remainders, so nothing is
copied when the window moves.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64
from pc2grid.model import SLICES

UNKNOWN, FREE, LOW, WALL = 0, 1, 2, 3
"""What a column is."""


@njit(cache=True)
def clear(evidence: NDArray[np.int8], sums: F32, low: I64, new: I64) -> None:
    """Forget the cells that leave the window when its lowest indices (3,) change from `low` to `new`."""
    size, layers = evidence.shape[0], evidence.shape[2]
    for i in range(new[0], new[0] + size):
        for j in range(new[1], new[1] + size):
            if not (low[0] <= i < low[0] + size and low[1] <= j < low[1] + size):
                evidence[i % size, j % size] = 0
                sums[i % size, j % size] = 0.0
    for k in range(new[2], new[2] + layers):
        if not low[2] <= k < low[2] + layers:
            evidence[:, :, k % layers] = 0


@njit(cache=True)
def observe_points(
    evidence: NDArray[np.int8],
    seen: NDArray[np.uint8],
    touched: NDArray[np.uint8],
    sums: F32,
    low: I64,
    points: F64,
    cell: tuple[float, float],
    band: tuple[float, float],
    stamp: int,
    hit: int,
    most: int,
) -> None:
    """Enter a hit where the points (N, 3) of a scan lie, one a cell and scan.

    evidence, seen : (W, W, L), `seen` is the stamp of the last scan that entered a cell. touched : (W, W) the
    same of columns. sums : (W, W, 3) sums of x and y, relative to the column's corner, of the points in the
    band, and their number. cell : edge and height of a cell. band : lowest and highest z of an obstacle.
    """
    size, layers = evidence.shape[0], evidence.shape[2]
    edge, height = cell
    for n in range(len(points)):
        i, j = math.floor(points[n, 0] / edge), math.floor(points[n, 1] / edge)
        k = math.floor(points[n, 2] / height)
        if not (_within(low, size, i, j) and low[2] <= k < low[2] + layers):
            continue
        a, b, c = i % size, j % size, k % layers
        if seen[a, b, c] != stamp:
            seen[a, b, c] = stamp
            evidence[a, b, c] = min(evidence[a, b, c] + hit, most)
            touched[a, b] = stamp
        if band[0] <= points[n, 2] <= band[1]:
            if sums[a, b, 2] >= 200.0:
                for m in range(3):
                    sums[a, b, m] *= 0.5
            sums[a, b, 0] += points[n, 0] - i * edge
            sums[a, b, 1] += points[n, 1] - j * edge
            sums[a, b, 2] += 1.0


@njit(cache=True)
def observe_rays(
    evidence: NDArray[np.int8],
    seen: NDArray[np.uint8],
    touched: NDArray[np.uint8],
    low: I64,
    rays: F64,
    sensor: F64,
    cell: tuple[float, float],
    margin: tuple[float, float],
    stamp: int,
    miss: int,
    least: int,
) -> None:
    """Enter a miss along the rays of a scan to points (M, 3) where it has no hit, one a cell and scan.

    The others as for `observe_points`. margin : (a, b), a ray ends a + b * range^2 before its point.
    """
    size, layers = evidence.shape[0], evidence.shape[2]
    edge, height = cell
    for n in range(len(rays)):
        dx, dy, dz = rays[n, 0] - sensor[0], rays[n, 1] - sensor[1], rays[n, 2] - sensor[2]
        away = math.sqrt(dx * dx + dy * dy + dz * dz)
        steps = int((away - margin[0] - margin[1] * away * away) / edge)
        dx, dy, dz = dx / away * edge, dy / away * edge, dz / away * edge
        for step in range(steps):
            i = math.floor((sensor[0] + step * dx) / edge)
            j = math.floor((sensor[1] + step * dy) / edge)
            k = math.floor((sensor[2] + step * dz) / height)
            if not _within(low, size, i, j):
                break
            if not low[2] <= k < low[2] + layers:
                continue
            a, b, c = i % size, j % size, k % layers
            if seen[a, b, c] != stamp:
                seen[a, b, c] = stamp
                evidence[a, b, c] = max(evidence[a, b, c] - miss, least)
                touched[a, b] = stamp


@njit(cache=True)
def _within(low: I64, size: int, i: int, j: int) -> bool:
    """Whether the column (i, j) of the map is one of the window."""
    inside: bool = low[0] <= i < low[0] + size and low[1] <= j < low[1] + size
    return inside


@njit(cache=True)
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
    """Write the state (W, W) of the columns that carry a stamp; 0: of all. And of those with an obstacle the
    heights (W, W), see `pc2grid.model.SLICES`.

    ground, band : of the first and behind the last layer of the floor, and of an obstacle.
    borders : of the first layer of each slice but the lowest. A wall is occupied in at least `least` layers,
    and in so large a `share` of those that were observed, and less than `over` layers above it were observed
    to be free.
    """
    size, layers = evidence.shape[0], evidence.shape[2]
    band = max(band[0], low[2]), min(band[1], low[2] + layers)
    ground = max(ground[0], low[2]), min(ground[1], low[2] + layers)
    for a in range(size):
        for b in range(size):
            if stamp == 0 or touched[a, b] == stamp:
                measured = sums[a, b, 2] > 0
                state[a, b], heights[a, b] = _column(
                    evidence[a, b], ground, band, borders, share, least, over, measured
                )


@njit(cache=True)
def _column(
    evidence: NDArray[np.int8],
    ground: tuple[int, int],
    band: tuple[int, int],
    borders: tuple[int, int],
    share: float,
    least: int,
    over: int,
    measured: bool,
) -> tuple[int, int]:
    """State and heights of a column by the evidence (L,) in its cells.

    ground, band : the first and behind the last layer of the floor, and of an obstacle. measured : whether
    points tell where a wall is.
    """
    layers = len(evidence)
    occupied, free, passed_over = 0, 0, 0
    filled, empty = 0, 0
    for k in range(band[0], band[1]):
        value = evidence[k % layers]
        slice_bit = 1 << ((k >= borders[0]) + (k >= borders[1]))
        filled |= slice_bit * (value > 0)
        empty |= slice_bit * (value < 0)
        occupied += value > 0
        free += value < 0
        passed_over = 0 if value > 0 else passed_over + (value < 0)
    if occupied:
        tall = occupied >= least and passed_over < over
        is_wall = tall and measured and occupied >= share * (occupied + free)
        return WALL if is_wall else LOW, filled | (empty & ~filled) << SLICES
    for k in range(ground[0], ground[1]):
        free += evidence[k % layers] > 0
    return FREE if free else UNKNOWN, 0


@njit(cache=True)
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
    """What a place (2,) sees of the columns: the first wall along each bearing, and the floor before it.

    turn : direction of the first bearing, radians. gap : unknown ground wider than this ends what is free.
    depth : (d, q), walls behind the first one are part of it up to d + q * range^2.

    Returns how far each bearing is free (0: not at all), for each wall the sums of x, y and 1 of its points
    (S, 3), by increasing bearing, and the low columns passed (K, 2), each once, as their middles.
    """
    size = state.shape[0]
    free_m = np.zeros(bearings)
    walls = np.empty((bearings, 3))
    passed = np.zeros((size, size), np.uint8)
    found = 0
    lows = np.empty((size * size, 2))
    count = 0
    for bearing in range(bearings):
        angle = turn + bearing * (2.0 * math.pi / bearings)
        along = (math.cos(angle), math.sin(angle))
        free, first, count = _first_wall(state, low, origin, along, reach, edge, gap, passed, lows, count)
        if first >= 0.0:
            if first - free <= gap:
                free = max(first - 0.5 * edge, free)
            thick = depth[0] + depth[1] * first * first
            sx, sy, total = _wall(state, sums, low, origin, along, first, thick, reach, edge)
            walls[found, 0], walls[found, 1], walls[found, 2] = sx, sy, total
            found += 1
        free_m[bearing] = free
    return free_m, walls[:found].copy(), lows[:count].copy()


@njit(cache=True)
def _first_wall(
    state: NDArray[np.uint8],
    low: I64,
    origin: F64,
    along: tuple[float, float],
    reach: float,
    edge: float,
    gap: float,
    passed: NDArray[np.uint8],
    lows: F64,
    count: int,
) -> tuple[float, float, int]:
    """How far a bearing is free, the range of its first wall (-1: none), and how many low columns are passed.

    passed : (W, W), whether a low column was passed before. lows : gets the middles of those that were not.
    """
    size = state.shape[0]
    free, known = 0.0, False
    last_a, last_b = -1, -1
    r = 0.0
    while r < reach:
        r += 0.5 * edge
        i, j = math.floor((origin[0] + r * along[0]) / edge), math.floor((origin[1] + r * along[1]) / edge)
        if not _within(low, size, i, j):
            break
        a, b = i % size, j % size
        if a == last_a and b == last_b:
            continue
        last_a, last_b = a, b
        if state[a, b] == WALL:
            return free, r, count
        if state[a, b] == UNKNOWN:
            if known and r - free > gap:
                break
            continue
        known, free = True, r
        if state[a, b] == LOW and not passed[a, b]:
            passed[a, b] = 1
            lows[count, 0], lows[count, 1] = (i + 0.5) * edge, (j + 0.5) * edge
            count += 1
    return free, -1.0, count


@njit(cache=True)
def _wall(
    state: NDArray[np.uint8],
    sums: F32,
    low: I64,
    origin: F64,
    along: tuple[float, float],
    first: float,
    thick: float,
    reach: float,
    edge: float,
) -> tuple[float, float, float]:
    """The sums of x, y and 1 of the points of a wall that begins at the range `first` and is so thick."""
    size = state.shape[0]
    sx = sy = total = 0.0
    last_a, last_b = -1, -1
    r = first
    while True:
        i, j = math.floor((origin[0] + r * along[0]) / edge), math.floor((origin[1] + r * along[1]) / edge)
        a, b = i % size, j % size
        new = a != last_a or b != last_b
        last_a, last_b = a, b
        if not _within(low, size, i, j) or (new and r - first > thick):
            return sx, sy, total
        if new and state[a, b] == WALL:
            total += sums[a, b, 2]
            sx += sums[a, b, 0] + i * edge * sums[a, b, 2]
            sy += sums[a, b, 1] + j * edge * sums[a, b, 2]
        if r >= reach:
            return sx, sy, total
        r += 0.5 * edge


@njit(cache=True)
def agreement(
    evidence: NDArray[np.int8], low: I64, points: F64, cell: tuple[float, float]
) -> tuple[int, int, int]:
    """How many of points (N, 3) lie in or beside a cell with a surface, how many where rays have passed,
    and how many lie in the window."""
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
