"""Values of a row to bytes and back, and the checksum of a row.

Everything that is read is checked before it is believed: length against shape, shape against a limit,
numbers for being finite. A ValueError says what is wrong; the caller knows where.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from pc2grid.model import Health, OccupancyGrid, Trajectory

Value = int | float | str | bytes | None

MAX_CELLS = 100_000_000
_HEALTH = tuple(Health)


def row_crc(values: Iterable[Value]) -> int:
    """crc32 of a row's values, with their types and lengths, so that no two rows look alike by shifting."""
    crc = 0
    for value in values:
        if value is None:
            head, body = b"n", b""
        elif isinstance(value, bytes):
            head, body = b"b" + struct.pack("<q", len(value)), value
        elif isinstance(value, str):
            body = value.encode("utf-8", "surrogatepass")
            head = b"s" + struct.pack("<q", len(body))
        elif isinstance(value, float):
            head, body = b"f", struct.pack("<d", value + 0.0)  # SQLite keeps no sign of zero
        else:
            head, body = b"i", struct.pack("<q", value)
        crc = zlib.crc32(body, zlib.crc32(head, crc))
    return crc


def pack_array(array: NDArray[np.generic], dtype: str) -> bytes:
    """Little-endian bytes of an array, row by row."""
    return np.ascontiguousarray(array, dtype=dtype).tobytes()


def unpack_array(data: bytes, dtype: str, shape: tuple[int, ...]) -> NDArray[np.generic]:
    """The array back, without a copy and read-only. ValueError if length or numbers are impossible."""
    array = unpack_raw(data, dtype, shape)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError("a number that is not finite")
    return array


def unpack_raw(data: bytes, dtype: str, shape: tuple[int, ...]) -> NDArray[np.generic]:
    """The same, for the caller to look at the numbers. ValueError if the length is impossible."""
    if not all(isinstance(extent, int) and extent >= 0 for extent in shape):
        raise ValueError(f"{len(data)} bytes cannot be {shape} of {dtype}")
    wanted = math.prod(shape) * np.dtype(dtype).itemsize
    if len(data) != wanted:
        raise ValueError(f"{len(data)} bytes where {shape} of {dtype} needs {wanted}")
    return np.frombuffer(data, dtype=dtype).reshape(shape)


def pack_cells(grid: OccupancyGrid) -> bytes:
    """Cells compressed with zlib."""
    return zlib.compress(np.ascontiguousarray(grid.cells).tobytes(), 6)


def unpack_cells(data: bytes, height: int, width: int) -> NDArray[np.int8]:
    """(height, width) int8. Never expands to more than the shape says."""
    if height < 0 or width < 0 or height * width > MAX_CELLS:
        raise ValueError(f"a grid of {height} x {width} cells")
    cells = np.frombuffer(_inflate(data, height * width), dtype=np.int8).reshape(height, width)
    if cells.size and (cells.min() < -1 or cells.max() > 100):
        raise ValueError("a cell outside -1..100")
    return cells


def pack_poses(trajectory: Trajectory) -> bytes:
    """The upper three rows of each pose, component by component: what is constant compresses to nothing."""
    components = trajectory.T_map_base[:, :3, :].reshape(len(trajectory), 12).T
    return zlib.compress(np.ascontiguousarray(components, dtype="<f8").tobytes(), 6)


def unpack_poses(data: bytes, count: int) -> NDArray[np.float64]:
    """(count, 4, 4) float64."""
    raw = _inflate(data, count * 12 * 8)
    poses = np.zeros((count, 4, 4))
    poses[:, :3, :] = unpack_array(raw, "<f8", (12, count)).T.reshape(count, 3, 4)
    poses[:, 3, 3] = 1.0
    return poses


def pack_health(trajectory: Trajectory) -> bytes:
    """One byte per pose; empty if all are fine."""
    return bytes(_HEALTH.index(health) for health in trajectory.health)


def unpack_health(data: bytes) -> tuple[Health, ...]:
    """The other way round."""
    if any(code >= len(_HEALTH) for code in data):
        raise ValueError("an unknown health code")
    return tuple(_HEALTH[code] for code in data)


def _inflate(data: bytes, size: int) -> bytes:
    """Decompress exactly `size` bytes; never allocates more than that."""
    inflate = zlib.decompressobj()
    try:
        # max_length 0 would mean "no limit".
        raw = inflate.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"compressed data: {error}") from None
    if len(raw) != size or not inflate.eof:
        raise ValueError(f"compressed data does not hold the {size} bytes it should")
    return raw
