"""Bytes of a row: all are checked, and sizes before memory is allocated."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pc2grid.geometry import SE2
from pc2grid.model import Health, OccupancyGrid, Trajectory
from signature.database import serialize
from tests.helpers.memory import Peak

VALUES = st.none() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.binary() | st.text()


@given(st.lists(VALUES, max_size=6), st.lists(VALUES, max_size=6))
def test_rows_that_differ_have_other_checksums(a: list[serialize.Value], b: list[serialize.Value]) -> None:
    """The checksum covers types and lengths; -0.0 equals 0.0, because SQLite keeps no sign of zero."""
    same = [(type(v), v) for v in a] == [(type(v), v) for v in b]
    assert (serialize.row_crc(a) == serialize.row_crc(b)) == same
    assert serialize.row_crc([0.0]) == serialize.row_crc([-0.0])


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (["ab", "c"], ["a", "bc"]),
        ([b"ab", b"c"], [b"a", b"bc"]),
        ([1], [1.0]),
        (["1"], [b"1"]),
        ([None], []),
        ([None], [b""]),
        ([1, 2], [2, 1]),
    ],
)
def test_values_that_look_alike(a: list[serialize.Value], b: list[serialize.Value]) -> None:
    assert serialize.row_crc(a) != serialize.row_crc(b)


def test_the_checksum_is_that_of_the_format() -> None:
    """A number of format 1, written down: files of today must be readable tomorrow."""
    assert serialize.row_crc([1, 2.5, "ä", b"\0\1", None]) == 0xC6F225FB


@pytest.mark.parametrize("dtype", ["<i4", "<i8", "<f4", "<f8"])
def test_arrays_survive(dtype: str) -> None:
    array = np.array([[1, -2, 3], [4, 5, 6]], dtype=dtype.replace("<", ">"))
    found = serialize.unpack_array(serialize.pack_array(array, dtype), dtype, (2, 3))
    np.testing.assert_array_equal(found, array)
    assert found.dtype == np.dtype(dtype)
    assert not found.flags.writeable


@pytest.mark.parametrize(
    ("data", "shape", "words"),
    [
        (bytes(8), (3,), r"8 bytes where \(3,\) of <f4 needs 12"),
        (bytes(13), (3,), "13 bytes"),
        (bytes(0), (-1, 2), "0 bytes"),
        (bytes(8), (-1, -2), "8 bytes"),
        (bytes(4), (-1, -1), "4 bytes cannot be"),
        (bytes(8), (1 << 40, 1 << 40), "8 bytes"),
        (np.array([1, np.nan], "<f4").tobytes(), (2,), "not finite"),
        (np.array([-np.inf, 1], "<f4").tobytes(), (2,), "not finite"),
    ],
)
def test_arrays_that_cannot_be(data: bytes, shape: tuple[int, ...], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        serialize.unpack_array(data, "<f4", shape)


def cells_of(*values: int) -> bytes:
    return zlib.compress(np.array(values, np.int8).tobytes())


def test_cells_survive() -> None:
    cells = np.random.default_rng(3).integers(-1, 101, (7, 5)).astype(np.int8)
    cells[0, :2] = -1, 100
    grid = OccupancyGrid(cells=np.asfortranarray(cells), resolution_m=1.0, origin_m=(0, 0))
    np.testing.assert_array_equal(serialize.unpack_cells(serialize.pack_cells(grid), 7, 5), cells)
    assert serialize.unpack_cells(zlib.compress(b""), 0, 5).shape == (0, 5)


@pytest.mark.parametrize(
    ("data", "height", "width", "words"),
    [
        (cells_of(1, 2), -1, -2, "a grid of -1 x -2"),
        (cells_of(1, 2), 1 << 20, 1 << 20, "a grid of 1048576 x 1048576"),
        (cells_of(1, 2), 10_000, 10_001, "a grid of 10000 x 10001"),
        (cells_of(1, 2), 1, 3, "does not hold the 3 bytes"),
        (cells_of(1, 2), 1, 1, "does not hold the 1 bytes"),
        (cells_of(1, 2), 0, 0, "does not hold the 0 bytes"),
        (cells_of(1, 2)[:-1], 1, 2, "does not hold the 2 bytes"),
        (b"junk", 1, 2, "compressed data: "),
        (cells_of(1, 101), 1, 2, r"a cell outside -1\.\.100"),
        (cells_of(1, -2), 1, 2, r"a cell outside -1\.\.100"),
    ],
)
def test_cells_that_cannot_be(data: bytes, height: int, width: int, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        serialize.unpack_cells(data, height, width)


def test_what_expands_without_end_is_not_expanded() -> None:
    bomb = zlib.compress(bytes(1 << 28), 9)
    peak = Peak()
    with pytest.raises(ValueError, match="does not hold the 4 bytes"):
        serialize.unpack_cells(bomb, 2, 2)
    assert peak.grown_bytes() < 8 << 20


def test_trajectories_survive() -> None:
    poses = np.stack([SE2(i, -i, 0.1 * i).lift() for i in range(5)])
    health = (Health.FINE, Health.LOST, Health.DEGENERATE, Health.OVERRULED, Health.FINE)
    trajectory = Trajectory(stamps_ns=np.arange(5), T_session_base=poses, health=health)
    np.testing.assert_array_equal(serialize.unpack_poses(serialize.pack_poses(trajectory), 5), poses)
    assert serialize.unpack_health(serialize.pack_health(trajectory)) == health
    empty = Trajectory(stamps_ns=np.arange(0), T_session_base=np.empty((0, 4, 4)))
    assert serialize.unpack_poses(serialize.pack_poses(empty), 0).shape == (0, 4, 4)
    with pytest.raises(ValueError, match="does not hold the 576 bytes"):
        serialize.unpack_poses(serialize.pack_poses(trajectory), 6)
    with pytest.raises(ValueError, match="an unknown health code"):
        serialize.unpack_health(bytes([0, len(Health)]))
