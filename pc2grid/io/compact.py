"""The usable returns of a cloud in one pass over its bytes: the common layout, compiled."""

from __future__ import annotations

import numba
import numpy as np

from pc2grid.model import F32, I64


@numba.njit(cache=True, nogil=True)
def returns_of(x: F32, y: F32, z: F32) -> tuple[F32, I64]:
    """Finite returns (N, 3) that are not at the exact origin, and their numbers (N,), row by row.

    x, y, z : (H, W) float32 of this machine's byte order, any strides, aligned or not.
    """
    height, width = x.shape
    xyz = np.empty((height * width, 3), np.float32)
    index = np.empty(height * width, np.int64)  # as numpy wants them, which spares a copy
    count = 0
    for i in range(height):
        for j in range(width):
            a, b, c = x[i, j], y[i, j], z[i, j]
            # Written whether it is kept or not: no branch to guess wrong.
            xyz[count, 0] = a
            xyz[count, 1] = b
            xyz[count, 2] = c
            index[count] = i * width + j
            finite = np.isfinite(a) and np.isfinite(b) and np.isfinite(c)
            count += finite and (a != 0 or b != 0 or c != 0)
    return xyz[:count], index[:count]
