"""Bounds on what a file claims of itself: reads and decompressions stop at a limit.

The readers of `mcap` and `rosbags` read as many bytes as a record says it has, and Python sets the memory
aside before it reads: a damaged length of 4 GB costs 4 GB. `mcap` takes fewer bytes than it asked for.
"""

from __future__ import annotations

import bz2
import io
import os
from collections.abc import Callable
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from pc2grid.errors import LimitExceeded, LogCorrupt, LogTruncated

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class BoundedFile(io.BufferedReader):
    """A file, open for reading.

    most_bytes : how many bytes one call may ask for.
    """

    def __init__(self, raw: io.FileIO, most_bytes: int) -> None:
        super().__init__(raw)
        self._most_bytes = most_bytes
        self._size = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """See io.BufferedReader.

        Raises LogTruncated if fewer bytes are left, LogCorrupt if `size` is negative (a length was smaller
        than what it counts), LimitExceeded if it is above the limit.
        """
        if size is None or size < 0:
            raise LogCorrupt(f"a length of {size} bytes where a record should begin")
        if size > self._size - self.tell():
            raise LogTruncated(f"the file ends within {size} bytes of a record")
        if size > self._most_bytes:
            raise LimitExceeded(
                f"a record has {size} bytes; the limit is {self._most_bytes}",
                hint="--set read.max_record_bytes=N raises it",
            )
        return super().read(size)


def plain_message(data: bytes | memoryview, limit: int) -> bytes | memoryview:
    """A message; decompressed if rosbag2 compressed it by itself. No encoding of messages begins like zstd.

    Raises as `unpacked` does.
    """
    return unpacked("zstd", limit, bytes(data)) if data[:4] == ZSTD_MAGIC else data


def unpacked(compression: str, limit: int, data: bytes) -> bytes:
    """Decompressed data. Raises LimitExceeded above `limit` bytes, LogCorrupt for damage."""
    try:
        found = expand(compression, data, limit + 1)
    except ValueError as error:
        raise LogCorrupt(f"{compression} data cannot be decompressed ({error})") from error
    if len(found) > limit:
        raise LimitExceeded(
            f"{compression} data would expand to more than {limit} bytes",
            hint="--set read.max_chunk_bytes=N raises the limit",
        )
    return found


def expand(compression: str, data: bytes | memoryview, most: int) -> bytes:
    """The first `most` bytes (> 0) of the decompressed data; `compression` is bz2, lz4, zstd or none.

    Raises ValueError for damage.
    """
    try:
        return _EXPAND[compression](bytes(data), most)
    except (OSError, EOFError, RuntimeError, zstandard.ZstdError) as error:
        raise ValueError(error) from error


def _zstd(data: bytes, most: int) -> bytes:
    # zstandard allocates the size that the frame declares, whatever max_output_size is.
    if zstandard.frame_content_size(data) > most:
        return bytes(most)
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=most)


def _whole(decompressor: Any, data: bytes, most: int) -> bytes:
    found = bytes(decompressor.decompress(data, max_length=most))
    if not decompressor.eof and len(found) < most:
        raise EOFError("it ends too early")
    return found


_EXPAND: dict[str, Callable[[bytes, int], bytes]] = {
    "none": lambda data, most: data[:most],
    "bz2": lambda data, most: _whole(bz2.BZ2Decompressor(), data, most),
    "lz4": lambda data, most: _whole(lz4.frame.LZ4FrameDecompressor(), data, most),
    "zstd": _zstd,
}
