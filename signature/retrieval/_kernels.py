"""The headings of poses, compiled. The tests compare them with a plain form."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64


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
