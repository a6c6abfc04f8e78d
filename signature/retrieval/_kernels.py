"""Likeness of isovists, and the headings of poses, compiled. The tests compare both with plain forms."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64

_BLOCK = 64
"""Viewpoints at a time, so that the sums of a block stay small."""


@numba.njit(cache=True, nogil=True)
def compare_rotated(
    rays: I64,
    own: NDArray[np.uint16],
    others: NDArray[np.uint16],
    known: NDArray[np.bool_],
    width: int,
    doubt: float,
    out: F32,
) -> None:
    """Likeness of one isovist with others for each rotation by 2 pi s / B, into `out` (B, N).

    The mean over the rays that both sides know of a triangular kernel of the difference of their ranges, with
    `doubt` added to the number of rays.

    own : ranges of some `rays` of the view. others (N, B) : ranges of the viewpoints, `known` or not. Ranges
    that differ by `width` or more are not alike. Sums are exact in 16 bits.
    """
    n, bearings = others.shape
    full, scale, more = np.uint16(width), np.float32(1.0 / width), np.float32(doubt)
    most = bearings * min(n, _BLOCK)
    # Transposed, and the circle twice over, so that the partners of a ray at all rotations lie side by side.
    there, there_known = np.empty(2 * most, np.uint16), np.empty(2 * most, np.uint16)
    total, count = np.empty(most, np.uint16), np.empty(most, np.uint16)
    for first in range(0, n, _BLOCK):
        size = min(_BLOCK, n - first)
        around = bearings * size
        for i in range(size):
            for k in range(bearings):
                at = k * size + i
                there[at] = there[at + around] = others[first + i, k]
                there_known[at] = there_known[at + around] = known[first + i, k]
        total[:], count[:] = 0, 0
        for ray in range(len(rays)):
            here, at = own[ray], rays[ray] * size
            run, run_known = there[at : at + around], there_known[at : at + around]
            for j in range(around):
                apart = np.uint16(max(here, run[j]) - min(here, run[j]))
                total[j] += np.uint16(full - min(apart, full))
                count[j] += run_known[j]
        for shift in range(bearings):
            for i in range(size):
                j = shift * size + i
                out[shift, first + i] = np.float32(total[j]) * scale / (np.float32(count[j]) + more)


@numba.njit(cache=True, nogil=True)
def best_headings(
    scores: F32,
    squares: F32,
    block: NDArray[np.int32],
    low: I64,
    shape: I64,
    first: I64,
    at: NDArray[np.int32],
    viewpoint: I64,
    view: I64,
    steps: F64,
    out: F32,
    at_best: I64,
) -> None:
    """The sum of the `scores` (K, V) of all views at the best heading, into `out` (P,), and the number of
    that heading, into `at_best` (P,).

    squares : (K, 2) viewpoints in units of the lattice. block, low, shape, first, at : as in
    `place_index.Raster`. viewpoint, view : (P,) which view is put on which viewpoint. steps :
    `place_index.steps_between` in units of the lattice.
    """
    headings, views = steps.shape[0], steps.shape[1]
    for pose in range(len(viewpoint)):
        here, own = viewpoint[pose], view[pose]
        number = block[here]
        rows, columns = shape[number, 0], shape[number, 1]
        best = -np.inf
        for heading in range(headings):
            total = scores[here, own]
            for other in range(views):
                if other == own:
                    continue
                x = np.int64(np.rint(squares[here, 0] + steps[heading, own, other, 0])) - low[number, 0]
                y = np.int64(np.rint(squares[here, 1] + steps[heading, own, other, 1])) - low[number, 1]
                if 0 <= x < rows and 0 <= y < columns:
                    beside = at[first[number] + x * columns + y]
                    if beside >= 0:
                        total += scores[beside, other]
            if total > best:
                best, at_best[pose] = total, heading
        out[pose] = best
