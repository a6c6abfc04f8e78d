"""What the header of a PNG claims, checked before OpenCV takes memory for it. https://www.w3.org/TR/png-3/"""

from __future__ import annotations

import struct
from typing import NamedTuple

MAGIC = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct(">8s4x4sIIBB")  # the first chunk of every PNG
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type; 3 is a palette
# Deflate expands one byte to 1032 at most (https://zlib.net/zlib_tech.html).
_MOST_INFLATED = 1032


class PngHeader(NamedTuple):
    """The size of an image; bits : of a channel."""

    width: int
    height: int
    bits: int
    channels: int


def read_header(content: bytes | memoryview) -> PngHeader:
    """The header of a PNG. Raises ValueError if there is none, or the file is too short for its claims."""
    if len(content) < _HEADER.size:
        raise ValueError("it is cut off")
    magic, kind, width, height, bits, colour = _HEADER.unpack_from(content)
    if magic != MAGIC:
        raise ValueError("not a PNG")
    if kind != b"IHDR" or colour not in _CHANNELS:
        raise ValueError("its header makes no sense")
    header = PngHeader(width, height, bits, _CHANNELS[colour])
    if width * height * bits * header.channels > 8 * len(content) * _MOST_INFLATED:
        raise ValueError(f"{len(content)} bytes cannot hold {width} x {height} pixels")
    return header
