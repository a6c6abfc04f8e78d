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
    res = target.resolution_m
    origin = (target.origin_m[0], target.origin_m[1], 0.0)
    turns = max(1, math.ceil(2 * half_a_rad / step_rad))
    step_rad = 2 * half_a_rad / turns
    found = _best_of_quarters(
        target.levels,
        target.halves,
        np.array(target.reaches_m) / res,
        np.asarray(walls_m, np.float32) / np.float32(res),
        (starts - origin) / (res, res, 1.0),
        2 * max(1, math.ceil(half_t_m / res / 2)),
        np.asarray(step_rad * (np.arange(turns) - 0.5 * (turns - 1)), np.float64),
        step_rad,
        int(255 * NEUTRAL),
        floor,
        keep if most > 1 else 1.0,
    )
    found = found[np.argsort(-found[:, 3], kind="stable")]
    found = found[found[:, 3] >= max(floor, keep * float(found[0, 3]))]
    found[:, :2] = found[:, :2] * res + origin[:2]
    return _apart(found, most, apart_m, apart_rad)


def _apart(found: F64, most: int, apart_m: float, apart_rad: float) -> F64:
    """Up to `most` of the poses (N, 4), best first, no two alike."""
    kept: list[int] = []
    if most == 1:
        return found[:1]
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
def _add_hanging_window(image: U8, row: int, column: int, sums: NDArray[np.uint16], outside: int) -> None:
    """The same for one window that hangs over the map, less what every cell out there counts: `outside`.

    Less than nothing wraps around, and comes back when `outside` is added."""
    height, width = image.shape
    tall, wide = sums.shape
    begin, end = min(max(-column, 0), wide), min(max(width - column, 0), wide)
    less = np.uint16(outside)
    for r in range(min(max(-row, 0), tall), min(max(height - row, 0), tall)):
        if begin < end:
            inside, total = image[row + r, column + begin : column + end], sums[r, begin:end]
            for k in range(end - begin):
                total[k] += np.uint16(np.uint16(inside[k]) - less)


@numba.njit(cache=True, nogil=True)
def _turned(
    points: F32, start: F64, turn: float, half: int, height: int, width: int, level: I64, cells: I64
) -> int:
    """Cells of points (N, 2) at a start (x, y, yaw) turned by `turn`, as level, row, column: `cells` (N, 3).

    First come those whose window, `half` cells and one to all sides, lies within the map. Returns how many.
    """
    c, s = math.cos(start[2] + turn), math.sin(start[2] + turn)
    inside, beyond = 0, len(points)
    for p in range(len(points)):
        x, y = points[p, 0], points[p, 1]
        i, j = math.floor(s * x + c * y + start[1]), math.floor(c * x - s * y + start[0])
        if half <= i < height - half - 1 and half <= j < width - half - 1:
            k = inside
            inside += 1
        else:
            beyond -= 1
            k = beyond
        cells[k, 0], cells[k, 1], cells[k, 2] = level[p], i, j
    return inside


@numba.njit(cache=True, nogil=True)
def _add_blocks(
    halves: U8, cover: I64, cells: I64, half: int, outside: int, sums: NDArray[np.uint16]
) -> None:
    """What no pose in a block of 2 x 2 cells exceeds, for all blocks of a window at one heading.

    cover : (L,) which maximum to look at for each level. cells : (N, 3) level, row, column of the points in
    the middle of the window. sums : written, a row of blocks each.
    """
    count, height, width = halves.shape
    tall, wide = sums.shape
    sums[:] = 0
    flat, corners, whole, base = halves.reshape(-1), np.empty(len(cells), np.int64), 0, 0
    for p in range(len(cells)):
        image, i, j = cover[cells[p, 0]], (cells[p, 1] - half) >> 1, (cells[p, 2] - half) >> 1
        if image >= count:
            base += 255
        elif i >= 0 and j >= 0 and i + tall < height and j + wide <= width:
            corners[whole] = (image * height + i) * width + j
            whole += 1
        else:
            base += outside
            _add_hanging_window(halves[image], i, j, sums, outside)
    _add_windows(flat, corners[:whole], width, sums)
    for r in range(tall):
        total = sums[r]
        for k in range(wide):
            total[k] += np.uint16(base)


@numba.njit(cache=True, nogil=True)
def _best_in_block(
    levels: U8, cells: I64, inside: int, down: int, right: int, last: int, outside: int
) -> tuple[int, int, int]:
    """The highest sum of the points' cells (N, 3) moved `down` and `right` or one further, but by `last` at
    most; and how far they were moved for it. The first `inside` stay within the map wherever they go."""
    _, height, width = levels.shape
    flat, one, below = levels.reshape(-1), np.uint64(1), np.uint64(width)
    s00, s01, s10, s11 = 0, 0, 0, 0
    for p in range(inside):
        at = np.uint64((cells[p, 0] * height + cells[p, 1] + down) * width + cells[p, 2] + right)
        s00 += flat[at]
        s01 += flat[at + one]
        s10 += flat[at + below]
        s11 += flat[at + below + one]
    for p in range(inside, len(cells)):
        image, i, j = levels[cells[p, 0]], cells[p, 1] + down, cells[p, 2] + right
        upper, lower = 0 <= i < height, -1 <= i < height - 1
        before, after = 0 <= j < width, -1 <= j < width - 1
        s00 += image[i, j] if upper and before else outside
        s01 += image[i, j + 1] if upper and after else outside
        s10 += image[i + 1, j] if lower and before else outside
        s11 += image[i + 1, j + 1] if lower and after else outside
    best, i, j = s00, down, right
    if right < last and s01 > best:
        best, j = s01, right + 1
    if down < last and s10 > best:
        best, i, j = s10, down + 1, right
    if right < last and down < last and s11 > best:
        best, i, j = s11, down + 1, right + 1
    return best, i, j


@numba.njit(cache=True, nogil=True)
def _highest(bounds: NDArray[np.uint16], span: I64) -> I64:
    """The one block of a span (heading, row, column: from, to) whose bound is the highest, as a span."""
    t0, t1, i0, i1, j0, j1 = span
    top, at = -1, span.copy()
    for t in range(t0, t1):
        for i in range(i0, i1):
            row = bounds[t, i, j0:j1]
            highest = np.uint16(0)
            for k in range(len(row)):
                highest = max(highest, row[k])
            if highest > top:
                top, j = int(highest), j0 + np.argmax(row)
                at[:] = t, t + 1, i, i + 1, j, j + 1
    return at


@numba.njit(cache=True, nogil=True)
def _best_of_quarters(
    levels: U8,
    halves: U8,
    reaches: F64,
    points: F32,
    starts: F64,
    half: int,
    turns: F64,
    step: float,
    outside: int,
    floor: float,
    keep: float,
) -> F64:
    """For each start the best pose in each quarter of its window (4 B, 4): x, y, yaw, score; in cells.

    A block of cells is looked at only if it may hold more than what the quarter has shown so far, and enough
    to be reported: `floor`, and `keep` times the best of all. `half` is even, so that no block lies in two
    quarters.
    """
    n, blocks, middle = len(points), half + 1, half // 2
    _, height, width = levels.shape
    level = levels_for(np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2), 0.5, 0.5 * step, reaches)
    # The first maximum that covers what a level does, from one cell to all beside it.
    whole_cells = np.ceil(reaches - 1e-6)
    cover = np.searchsorted(whole_cells, whole_cells + 1.0)
    best = np.empty((4 * len(starts), 4))
    full, least = 255.0 * n, floor
    # Whole vectors: what lies beyond the window belongs to other cells and is not looked at.
    bounds = np.empty((len(turns), blocks, -(-blocks // _LANES) * _LANES), np.uint16)
    cells, inside = np.empty((len(turns), n, 3), np.int64), np.empty(len(turns), np.int64)
    spans, shown = np.empty((2, 4, 6), np.int64), np.empty(4, np.int64)
    for q in range(4):
        spans[1, q, :2] = 0, len(turns)
        spans[1, q, 2:4] = (middle, blocks) if q >= 2 else (0, middle)
        spans[1, q, 4:] = (middle, blocks) if q % 2 else (0, middle)
    for b in range(len(starts)):
        for t in range(len(turns)):
            inside[t] = _turned(points, starts[b], turns[t], half, height, width, level, cells[t])
            _add_blocks(halves, cover, cells[t], half, outside, bounds[t])
        for q in range(4):
            best[4 * b + q] = starts[b, 0], starts[b, 1], starts[b, 2], -1.0
            spans[0, q], shown[q] = _highest(bounds, spans[1, q]), -1
        # First the most promising block of each quarter: what it shows spares most of the others.
        for k in range(8):
            q = k % 4
            t0, t1, i0, i1, j0, j1 = spans[k // 4, q]
            for t in range(t0, t1):
                for i in range(i0, i1):
                    for j in range(j0, j1):
                        if bounds[t, i, j] <= shown[q] or bounds[t, i, j] < full * least:
                            continue
                        down, right = 2 * i - half, 2 * j - half
                        total, down, right = _best_in_block(
                            levels, cells[t], inside[t], down, right, half, outside
                        )
                        if total > shown[q]:
                            shown[q], score = total, total / full
                            best[4 * b + q, :2] = starts[b, 0] + right, starts[b, 1] + down
                            best[4 * b + q, 2:] = starts[b, 2] + turns[t], score
                            least = max(least, keep * score)
    return best
