"""PNG files are checked before they are decoded: checksums, sizes, and how far the data can expand.

Decoders allocate as much memory as a header says, also a damaged one. https://www.w3.org/TR/png-3/
"""

from __future__ import annotations

import zlib
from typing import NamedTuple

MAGIC = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type; 3 is a palette
_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_NEEDED = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
# Deflate expands one byte to 1032 at most (https://zlib.net/zlib_tech.html).
_MOST_INFLATED = 1032


class Png(NamedTuple):
    """A PNG with valid checksums.

    bits : per channel. data : the file, reduced to the chunks that the pixels need.
    """

    width: int
    height: int
    bits: int
    channels: int
    data: bytes


def inspect(content: bytes | memoryview) -> Png:
    """Check structure and checksums, and that the compressed data can hold as many pixels as declared.

    Raises ValueError saying what is wrong.
    """
    view = memoryview(content)
    if view[:8] != MAGIC:
        raise ValueError("not a PNG")
    kept, packed, at, kind = [MAGIC], 0, 8, b""
    while kind != b"IEND":
        kind = bytes(view[at + 4 : at + 8])
        length = int.from_bytes(view[at : at + 4], "big")
        end = at + 12 + length
        if end > len(view):
            raise ValueError(f"its chunk at byte {at} does not fit into {len(view)} bytes")
        if zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            raise ValueError(f"its chunk at byte {at} has a wrong checksum")
        if (at == 8) != (kind == b"IHDR"):
            raise ValueError("its header is not at its beginning")
        if kind in _NEEDED:
            kept.append(bytes(view[at:end]))
            packed += length if kind == b"IDAT" else 0
        at = end
    header = kept[1][8:-4]
    if len(header) != 13 or header[9] not in _CHANNELS or header[8] not in _DEPTHS[header[9]]:
        raise ValueError("its header makes no sense")
    width, height = int.from_bytes(header[:4], "big"), int.from_bytes(header[4:8], "big")
    bits, channels = header[8], _CHANNELS[header[9]]
    if width * height * bits * channels > 8 * packed * _MOST_INFLATED:
        raise ValueError(f"{packed} bytes of data cannot hold {width} x {height} pixels")
    return Png(width, height, bits, channels, b"".join(kept))
