"""Decompression that stops at a limit: what a file claims, or turns out to be, never decides on memory."""

from __future__ import annotations

import bz2
from collections.abc import Callable

from pc2grid.errors import LimitExceeded, LogCorrupt

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def unpacker(compression: str, limit: int) -> Callable[[bytes], bytes]:
    """A function that unpacks `none`, `bz2`, `lz4` or `zstd`, and raises LimitExceeded above `limit` bytes.

    What is damaged raises LogCorrupt. Raises KeyError for another compression.
    """
    unpack = {"none": _stored, "bz2": _bz2, "lz4": _lz4, "zstd": _zstd}[compression]

    def bounded(data: bytes) -> bytes:
        try:
            found = unpack(bytes(data), limit + 1)
        except (OSError, EOFError, RuntimeError, ValueError) as error:
            raise LogCorrupt(f"{compression} data cannot be decompressed ({error})") from error
        if len(found) > limit:
            raise LimitExceeded(
                f"{compression} data would expand to more than {limit} bytes",
                hint="--set read.max_chunk_bytes=N raises the limit",
            )
        return found

    return bounded


def _stored(data: bytes, most: int) -> bytes:
    return data


def _bz2(data: bytes, most: int) -> bytes:
    decompressor = bz2.BZ2Decompressor()
    found = decompressor.decompress(data, max_length=most)
    if not decompressor.eof and len(found) < most:
        raise EOFError("it ends too early")
    return found


def _lz4(data: bytes, most: int) -> bytes:
    import lz4.frame  # type: ignore[import-untyped]

    decompressor = lz4.frame.LZ4FrameDecompressor()
    found = bytes(decompressor.decompress(data, max_length=most))
    if not decompressor.eof and len(found) < most:
        raise EOFError("it ends too early")
    return found


def _zstd(data: bytes, most: int) -> bytes:
    import zstandard

    try:
        # The frame's own claim is what zstandard allocates, whatever limit it is given.
        if zstandard.frame_content_size(data) > most:
            return bytes(most)
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=most)
    except zstandard.ZstdError as error:
        raise ValueError(error) from error
