"""The step of the learned boundary where compiling pays. The tests compare it with a plain form in numpy."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64


@numba.njit(cache=True)
def weighed_pairs(cells: I64, weights: F64, bin_of: NDArray[np.int32], bins: int) -> F64:
    """Products of the weights of all pairs of cells (N, 2), summed by the bin of their distance: (W, bins).

    weights (W, N). bin_of : as of `signature._kernels.pair_counts`.
    """
    sums = np.zeros((bins, len(weights)))
    for i in range(len(cells)):
        for j in range(i + 1, len(cells)):
            down, across = cells[j, 0] - cells[i, 0], cells[j, 1] - cells[i, 1]
            squared = down * down + across * across
            at = bin_of[squared] if squared < len(bin_of) else bins - 1
            for w in range(len(weights)):
                sums[at, w] += weights[w, i] * weights[w, j]
    return sums.T
