"""RVL, the second compression of compressedDepth: A. D. Wilson, Fast Lossless Depth Image Compression, 2017.

Runs of zeros and of other pixels take turns. The numbers are their lengths and, of the other pixels, the
differences to the one before. Each is stored in groups of three bits, the lowest first; a fourth bit says
that more follow. Eight groups are a word of 32 bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import I64

_MOST_GROUPS = 10  # more than the 17 bits of a difference, or the length of a run, can need
_MOST_BYTES = 4  # of a pixel with its share of the lengths


def decode(data: memoryview, count: int) -> NDArray[np.uint16]:
    """The (count,) pixels. Raises ValueError if the data is damaged."""
    if len(data) > _MOST_BYTES * (count + 1):
        raise ValueError("it is longer than its pixels need")
    numbers = _numbers(data)
    filled, differences = np.zeros(count, np.bool_), []
    pixel = at = 0
    while pixel < count:
        zeros, others = numbers[at : at + 2].tolist() if at + 1 < len(numbers) else (count, 1)
        pixel, at = pixel + zeros, at + 2
        if pixel + others > count or at + others > len(numbers):
            raise ValueError("its runs do not make the image")
        differences.append(numbers[at : at + others])
        filled[pixel : pixel + others] = True
        pixel, at = pixel + others, at + others
    packed = np.concatenate(differences) if differences else np.empty(0, np.int64)
    values = np.cumsum((packed >> 1) ^ -(packed & 1))
    if len(values) and not 0 <= values.min() <= values.max() <= 0xFFFF:
        raise ValueError("a pixel has more than 16 bits")
    pixels = np.zeros(count, np.uint16)
    pixels[filled] = values
    return pixels


def _numbers(data: memoryview) -> I64:
    """All numbers of the stream."""
    words = np.frombuffer(data, "<u4", count=len(data) // 4)
    groups = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 0xF).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(groups < 8)
    starts = np.concatenate(([0], ends[:-1] + 1)) if len(ends) else ends
    lengths = ends - starts + 1
    if len(ends) and lengths.max() > _MOST_GROUPS:
        raise ValueError("a number is too long")
    place = np.arange(lengths.sum()) - np.repeat(starts, lengths)
    parts = (groups[: len(place)] & 7) << (3 * place)
    numbers: I64 = np.add.reduceat(parts, starts) if len(starts) else ends
    return numbers
