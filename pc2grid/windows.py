"""A point set at every place of a window, heading by heading: scan matching without a tree.

Where the headings are known to a few degrees, branch and bound (`pc2grid.alignment.search`) opens most of
its boxes anyway. Then it is faster to leave none out: at a fixed heading, a point that moves through a
window of the map reads rows of neighbouring cells, which a processor adds up dozens at a time.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.alignment import NEUTRAL, U8, LikelihoodField, levels_for
from pc2grid.geometry import F64
from pc2grid.model import F32, I64

MOST_POINTS = 256
"""So many of them add up in 16 bits."""
_LANES = 32


def search_windows(
    target: LikelihoodField,
    walls_m: F32,
    starts: F64,
    *,
    half_t_m: float,
    half_a_rad: float,
    step_rad: float = math.radians(1.7),
    floor: float = 0.45,
    keep: float = 0.8,
    most: int = 10,
    apart_m: float = 0.5,
    apart_rad: float = math.radians(10.0),
) -> F64:
    """The best distinct poses of a point set around some starts, best first; as `alignment.search`.

    walls_m : (M, 2) points, at most `MOST_POINTS`, centred on what they should rotate about.
    starts : (B, 3) x, y, yaw: boxes of poses with half widths `half_t_m` and `half_a_rad` to search.
    step_rad : headings this far apart are tried, on all cells of the map in the box.
    floor, keep : poses scoring below `floor`, or below `keep` times the best, are not reported.
    apart_m, apart_rad : two reported poses differ by more than one of these; of poses in the same quarter
        of a box only the best is looked at.

    Returns (H, 4): x, y, yaw, and the most (mean likelihood over the points, 0..1) that any pose within
    half a cell and half a step can score. ValueError for too many points.
    """
    if len(walls_m) > MOST_POINTS:
        raise ValueError(f"{len(walls_m)} points; at most {MOST_POINTS}")
    if not len(walls_m) or not len(starts):
        return np.empty((0, 4))
    res, origin = target.resolution_m, np.asarray(target.origin_m)
    x, y = np.ascontiguousarray(walls_m.T / res, np.float32)
    turns = max(1, math.ceil(2 * half_a_rad / step_rad))
    step_rad = 2 * half_a_rad / turns
    half = max(1, math.ceil(half_t_m / res))
    level = levels_for(np.hypot(x, y), 0.5, 0.5 * step_rad, np.asarray(target.reaches_m) / res)
    # The first maximum that covers what `level` does, from the middle of a quarter to all its cells.
    reach = np.array([math.ceil(reach_m / res) for reach_m in target.reaches_m])
    cover = np.searchsorted(reach, reach[level] + (half + 1) // 2)
    found = _best_of_quarters(
        target.levels,
        level,
        cover,
        x,
        y,
        np.column_stack(((starts[:, :2] - origin) / res, starts[:, 2])),
        half,
        np.asarray(step_rad * (np.arange(turns) - 0.5 * (turns - 1)), np.float64),
        int(255 * NEUTRAL),
        floor,
        keep,
    )
    found = found[np.argsort(-found[:, 3], kind="stable")]
    found = found[found[:, 3] >= max(floor, keep * float(found[0, 3]))]
    found[:, :2] = found[:, :2] * res + origin
    return _apart(found, most, apart_m, apart_rad)


def _apart(found: F64, most: int, apart_m: float, apart_rad: float) -> F64:
    """Up to `most` of the poses (N, 4), best first, no two alike."""
    kept: list[int] = []
    for k in range(len(found)):
        if len(kept) == most:
            break
        near = np.abs(found[kept, :2] - found[k, :2]).max(axis=1) < apart_m
        turn = np.abs((found[kept, 2] - found[k, 2] + math.pi) % (2 * math.pi) - math.pi)
        if not (near & (turn < apart_rad)).any():
            kept.append(k)
    return found[kept]


@numba.njit(cache=True, nogil=True)
def _add_windows(flat: U8, corners: I64, width: int, sums: NDArray[np.uint16]) -> None:
    """Add to `sums` the windows of images `width` cells wide, each from its first cell in `flat` on."""
    tall, wide = sums.shape
    for r in range(tall):
        total, below = sums[r], r * width
        p = 0
        while p + 4 <= len(corners):  # four at a time: the sums stay in registers meanwhile
            a, b = corners[p] + below, corners[p + 1] + below
            c, d = corners[p + 2] + below, corners[p + 3] + below
            row_a, row_b, row_c, row_d = (
                flat[a : a + wide],
                flat[b : b + wide],
                flat[c : c + wide],
                flat[d : d + wide],
            )
            for k in range(wide):
                total[k] += np.uint16(
                    np.uint16(row_a[k]) + np.uint16(row_b[k]) + np.uint16(row_c[k]) + np.uint16(row_d[k])
                )
            p += 4
        for q in range(p, len(corners)):
            a = corners[q] + below
            row_a = flat[a : a + wide]
            for k in range(wide):
                total[k] += row_a[k]


@numba.njit(cache=True, nogil=True)
def _add_hanging_window(level: U8, row: int, column: int, sums: NDArray[np.uint16], outside: int) -> None:
    """The same for one window that hangs over the map: every cell out there counts `outside`."""
    height, width = level.shape
    tall, wide = sums.shape
    begin, end = min(max(-column, 0), wide), min(max(width - column, 0), wide)
    out = np.uint16(outside)
    for r in range(tall):
        total = sums[r]
        if 0 <= row + r < height and begin < end:
            inside = level[row + r, column + begin : column + end]
            for k in range(begin):
                total[k] += out
            for k in range(end - begin):
                total[begin + k] += inside[k]
            for k in range(end, wide):
                total[k] += out
        else:
            for k in range(wide):
                total[k] += out


@numba.njit(cache=True, nogil=True)
def _most_around(levels: U8, cover: I64, rows: I64, columns: I64, down: int, right: int, outside: int) -> int:
    """What no sum of the points comes to that `cover` covers, from their cells moved `down` and `right`."""
    count, height, width = levels.shape
    total = 0
    for p in range(len(rows)):
        i, j = rows[p] + down, columns[p] + right
        if cover[p] < count and 0 <= i < height and 0 <= j < width:
            total += max(int(levels[cover[p], i, j]), outside)
        else:
            total += 255
    return total


@numba.njit(cache=True, nogil=True)
def _best_of_quarters(
    levels: U8,
    point_level: I64,
    cover: I64,
    x: F32,
    y: F32,
    starts: F64,
    half: int,
    turns: F64,
    outside: int,
    floor: float,
    keep: float,
) -> F64:
    """For each start the best pose in each quarter of its window (4 B, 4): x, y (cells), yaw, score.

    Left out is what would not be reported: the upper or lower half of a window at a heading at which neither
    of its quarters can come to `floor`, to `keep` times the best so far, and to more than at other headings.
    """
    _, height, width = levels.shape
    n, size = len(x), 2 * half + 1
    best = np.empty((4 * len(starts), 4))
    full, least = 255.0 * n, floor
    # Whole vectors: what lies beyond the window belongs to other cells and is not looked at.
    sums = np.empty((half + 1, -(-size // _LANES) * _LANES), np.uint16)
    flat, corners = levels.reshape(-1), np.empty(n, np.int64)
    rows, columns = np.empty(n, np.int64), np.empty(n, np.int64)
    middles = (-half // 2, (half + 1) // 2)
    for b in range(len(starts)):
        for q in range(4):
            best[4 * b + q] = starts[b, 0], starts[b, 1], starts[b, 2], -1.0
        for turn in turns:
            yaw = starts[b, 2] + turn
            c, s = math.cos(yaw), math.sin(yaw)
            for p in range(n):
                rows[p] = math.floor(s * x[p] + c * y[p] + starts[b, 1])
                columns[p] = math.floor(c * x[p] - s * y[p] + starts[b, 0])
            for upper in range(2):
                hope = False
                for right in range(2):
                    most = _most_around(levels, cover, rows, columns, middles[upper], middles[right], outside)
                    hope |= most / full >= least and most / full > best[4 * b + 2 * upper + right, 3]
                if not hope:
                    continue
                first, tall = (0, half + 1) if upper else (-half, half)
                sums[:] = 0
                whole = 0
                for p in range(n):
                    i, j = rows[p] + first, columns[p] - half
                    if i >= 0 and j >= 0 and i + tall < height and j + size <= width:
                        corners[whole] = (point_level[p] * height + i) * width + j
                        whole += 1
                    else:
                        _add_hanging_window(levels[point_level[p]], i, j, sums[:tall], outside)
                _add_windows(flat, corners[:whole], width, sums[:tall])
                for r in range(tall):
                    for right in range(2):
                        part = sums[r, half:size] if right else sums[r, :half]
                        top = np.uint16(0)
                        for k in range(len(part)):
                            top = max(top, part[k])
                        q = 4 * b + 2 * upper + right
                        if top / full > best[q, 3]:
                            at = np.argmax(part) + (half if right else 0)
                            best[q] = starts[b, 0] + at - half, starts[b, 1] + first + r, yaw, top / full
                            least = max(least, keep * best[q, 3])
    return best
