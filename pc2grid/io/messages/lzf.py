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
