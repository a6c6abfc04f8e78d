"""The steps of the description where compiling pays. The tests compare them with plain forms in numpy."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64


@numba.njit(cache=True)
def in_sight(
    occupied: NDArray[np.bool_], cells: I64, first: NDArray[np.intp], second: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Whether the straight lines between the centres of cells[first] and cells[second] meet no occupied cell.

    occupied (H, W); cells (N, 2) as (row, column); first, second (P,) indices. Returns (P,).

    Every cell that a line passes through is tested, so no line crosses a wall of one pixel. A line through
    the common corner of four cells is blocked only if both cells beside the corner are occupied (Amanatides
    and Woo 1987, in integers).

    Measured: a disc of 8 m is described in 9.5 instead of 75 ms, a view of 5 m in 1.1 instead of 6.4 ms.
    """
    width = occupied.shape[1]
    flat = occupied.reshape(-1)
    visible = np.empty(len(first), np.bool_)
    for pair in range(len(first)):
        a, b = first[pair], second[pair]
        r0, c0, r1, c1 = cells[a, 0], cells[a, 1], cells[b, 0], cells[b, 1]
        rows, columns = abs(r1 - r0), abs(c1 - c0)
        down, across = (width if r1 > r0 else -width), (1 if c1 > c0 else -1)
        at, end = r0 * width + c0, r1 * width + c1
        lead = rows - columns
        while not flat[at] and at != end:
            if lead == 0:
                if flat[at + down] and flat[at + across]:
                    break
                at += down + across
                lead += 2 * (rows - columns)
            else:
                row = int(lead > 0)
                at += across + row * (down - across)
                lead += 2 * (rows - row * (rows + columns))
        visible[pair] = at == end and not flat[end]
    return visible


@numba.njit(cache=True)
def pair_counts(cells: I64, bin_of: NDArray[np.int32], bins: int) -> I64:
    """How many pairs of cells (N, 2) lie in each bin of their distance: (bins,).

    bin_of : the bin of each squared distance in cells; longer distances count in the last bin.

    Measured: 1,200 points of a disc of 8 m in 1.1 ms, where their distances as floating point take 5.
    """
    counts = np.zeros(bins, np.int64)
    rows, columns = np.empty(len(cells), np.int32), np.empty(len(cells), np.int32)
    for i in range(len(cells)):
        rows[i], columns[i] = cells[i, 0], cells[i, 1]
    for i in range(len(cells)):
        row, column = rows[i], columns[i]
        for j in range(i + 1, len(cells)):
            down, across = rows[j] - row, columns[j] - column
            squared = down * down + across * across
            counts[bin_of[squared] if squared < len(bin_of) else bins - 1] += 1
    return counts


@numba.njit(cache=True)
def weighed_pairs(points: F64, walls: F64, opens: F64, counts: F64) -> None:
    """Add the weights of all pairs of points (N, B, 2) to `counts` (N, R, bins + 2) of their distance.

    points : in units of the width of a bin; longer distances count in the last bin. walls, opens (N, R, B) :
    how far each point is on a wall, and how far there is none. A pair of walls counts in the bin of its
    distance, by the product of both weights; the last two bins hold the pairs of a wall and none, and of
    none and none.

    Measured: 48 points with four weights in 0.01 ms.
    """
    bins = counts.shape[2] - 2
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            for j in range(i + 1, points.shape[1]):
                x = points[row, i, 0] - points[row, j, 0]
                y = points[row, i, 1] - points[row, j, 1]
                at = min(int(np.sqrt(x * x + y * y) + 1e-6), bins - 1)
                for rim in range(walls.shape[1]):
                    counts[row, rim, at] += walls[row, rim, i] * walls[row, rim, j]
        for rim in range(walls.shape[1]):
            wall, none = walls[row, rim], opens[row, rim]
            counts[row, rim, bins] += wall.sum() * none.sum() - (wall * none).sum()
            counts[row, rim, bins + 1] += 0.5 * (none.sum() ** 2 - (none * none).sum())
