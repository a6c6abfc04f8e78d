"""Compiled functions. Imports numba: import it only when needed."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True)
def expand_lzf(data: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Fill `out` with what LZF data expands to (`lzf`); the number of bytes written, -1 for damaged data.

    Measured: a compressed PCD of 75,000 points in 2 ms instead of 180 ms. Open3D needs 9 ms, but reads only
    the first value of a field of several.
    """
    at = written = 0
    while at < len(data):
        control = int(data[at])
        at += 1
        if control < 32:
            count = control + 1
            if at + count > len(data) or written + count > len(out):
                return -1
            out[written : written + count] = data[at : at + count]
            at += count
        else:
            count = control >> 5
            if at + (2 if count == 7 else 1) > len(data):
                return -1
            if count == 7:
                count += int(data[at])
                at += 1
            start = written - ((control & 31) << 8) - int(data[at]) - 1
            at += 1
            count += 2
            if start < 0 or written + count > len(out):
                return -1
            for i in range(count):  # one by one: source and target may overlap
                out[written + i] = out[start + i]
        written += count
    return written
