"""Decompression that stops at a limit, whatever size the file declares or expands to."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from typing import Any

from pc2grid.errors import LimitExceeded, LogCorrupt

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def plain_message(data: bytes | memoryview, limit: int) -> bytes | memoryview:
    """A message; decompressed if rosbag2 compressed it by itself. No encoding of messages begins like zstd.

    Raises as the function that `unpacker` gives.
    """
    return unpacker("zstd", limit)(bytes(data)) if data[:4] == ZSTD_MAGIC else data


def unpacker(compression: str, limit: int) -> Callable[[bytes], bytes]:
    """A function that decompresses; it raises LimitExceeded above `limit` bytes, LogCorrupt for damage."""

    def bounded(data: bytes) -> bytes:
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

    return bounded


def expand(compression: str, data: bytes | memoryview, most: int) -> bytes:
    """The first `most` bytes (> 0) of the decompressed data; `compression` is bz2, lz4, zstd or none.

    Raises ValueError for damage.
    """
    try:
        return _EXPAND[compression](bytes(data), most)
    except (OSError, EOFError, RuntimeError) as error:
        raise ValueError(error) from error


def _none(data: bytes, most: int) -> bytes:
    return data[:most]


def _bz2(data: bytes, most: int) -> bytes:
    return _whole(bz2.BZ2Decompressor(), data, most)


def _lz4(data: bytes, most: int) -> bytes:
    import lz4.frame  # type: ignore[import-untyped]

    return _whole(lz4.frame.LZ4FrameDecompressor(), data, most)


def _whole(decompressor: Any, data: bytes, most: int) -> bytes:
    found = bytes(decompressor.decompress(data, max_length=most))
    if not decompressor.eof and len(found) < most:
        raise EOFError("it ends too early")
    return found


def _zstd(data: bytes, most: int) -> bytes:
    import zstandard

    try:
        # zstandard allocates the size that the frame declares, whatever max_output_size is.
        if zstandard.frame_content_size(data) > most:
            return bytes(most)
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=most)
    except zstandard.ZstdError as error:
        raise ValueError(error) from error


_EXPAND = {"none": _none, "bz2": _bz2, "lz4": _lz4, "zstd": _zstd}
