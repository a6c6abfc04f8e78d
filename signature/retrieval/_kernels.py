"""Compiled twins of the comparisons of isovists."""

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
    """Twin of `likeness.plain_rotate_and_compare` for one view, into `out` (B, N).

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
def compare_beside(
    turned: NDArray[np.uint8],
    ranges: NDArray[np.uint8],
    shift: I64,
    beside: I64,
    width: int,
    doubt: float,
    out: F64,
) -> None:
    """Twin of `place_index.plain_likeness_beside`, into `out` (C, V).

    turned (V, B, B) : ranges of each view at each rotation. 255 stands for a hidden one.
    """
    placements, views = beside.shape
    bearings = ranges.shape[1]
    full, unseen = np.int16(width), np.int16(255)
    for placement in range(placements):
        for view in range(views):
            if beside[placement, view] < 0:
                continue
            place = ranges[beside[placement, view]]
            for turn in range(-1, 2):
                mine = turned[view, (shift[placement] + turn) % bearings]
                total, count = np.int16(0), np.int16(0)
                for k in range(bearings):
                    a, b = np.int16(mine[k]), np.int16(place[k])
                    both = np.int16(a != unseen) & np.int16(b != unseen)
                    total += both * max(np.int16(full - abs(np.int16(a - b))), np.int16(0))
                    count += both
                likeness = total / full / (count + doubt)
                if likeness > out[placement, view]:
                    out[placement, view] = likeness
