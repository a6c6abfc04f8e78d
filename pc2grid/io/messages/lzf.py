"""LZF, the compression of `binary_compressed` PCD files (http://oldhome.schmorp.de/marc/liblzf.html).

The compressed data is a sequence of control bytes, each with what belongs to it. One below 32 is followed by
that many literal bytes and one. In another one the upper three bits are a length (7: go on in the next byte),
and the lower five with the next byte a distance back in what is written already, from where length + 2 bytes
are repeated.
"""

from __future__ import annotations

import numpy as np

from pc2grid.errors import PointCloudError


def decompress(data: bytes | memoryview, size: int) -> bytes:
    """The `size` bytes that were compressed. Raises PointCloudError if they do not come out."""
    from pc2grid.io.messages._kernels import expand_lzf

    out = np.empty(size, np.uint8)
    if expand_lzf(np.frombuffer(data, np.uint8), out) != size:
        raise PointCloudError("the compressed data of a PCD is damaged")
    return out.tobytes()


def expand(source: bytes, size: int) -> bytes | None:
    """The definition: `size` bytes, or None if the data does not expand to exactly as many."""
    out, at = bytearray(), 0
    while at < len(source):
        control = source[at]
        at += 1
        if control < 32:
            literals = source[at : at + control + 1]
            if len(literals) <= control:
                return None
            out += literals
            at += control + 1
        else:
            length = control >> 5
            follows = source[at : at + (2 if length == 7 else 1)]
            if len(follows) < (2 if length == 7 else 1):
                return None
            at += len(follows)
            length += follows[0] if length == 7 else 0
            start = len(out) - ((control & 31) << 8) - follows[-1] - 1
            if start < 0:
                return None
            for i in range(length + 2):  # one by one: the source may overlap with what is being written
                out.append(out[start + i])
        if len(out) > size:
            return None
    return bytes(out) if len(out) == size else None
