"""LZF, the compression of `binary_compressed` PCD files. Imports numba: import it only when needed."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.errors import PointCloudError


def decompress(data: bytes | memoryview, size: int) -> bytes:
    """The `size` bytes that were compressed. Raises PointCloudError if they do not come out."""
    out = np.empty(size, np.uint8)
    if _expand(np.frombuffer(data, np.uint8), out) != size:
        raise PointCloudError("the compressed data of a PCD is damaged")
    return out.tobytes()


@njit(cache=True)
def _expand(data: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Bytes written, or -1 if the data makes no sense.

    A control byte below 32 is followed by that many literals and one; else its upper three bits and the
    next bytes are a length and a distance back in what is written already.
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
