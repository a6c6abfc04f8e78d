"""Frozen types as documents and arrays: all comes back, and bytes are checked before memory is allocated."""

from __future__ import annotations

import enum
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, freeze
from pc2grid.geometry import SE2
from signature.config import SignatureConfig
from signature.database import codec
from signature.database.codec import Packed, pack, unpack
from tests.helpers.memory import Peak

VALUES = st.none() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.binary() | st.text()


class Mood(enum.Enum):
    FAIR = "fair"
    GRIM = "grim"


@dataclass(frozen=True)
class Leaf:
    at: SE2
    spread: F32
    mood: Mood
    kept: bool
    count: int

    def __post_init__(self) -> None:
        freeze(self, "spread", np.float32, (2,))


@dataclass(frozen=True)
class Twig:
    length_m: float
    since_ns: int
    origin_m: tuple[float, float]


@dataclass(frozen=True)
class Tree:
    """One field of every kind that a stored type may have."""

    name: str
    height: float
    count: int
    since_ns: int
    kept: bool
    label: str | None
    twig: Twig | None
    twigs: tuple[Twig, ...]
    moods: tuple[Mood, ...]
    leaves: tuple[Leaf, ...]
    words: tuple[str, ...]
    counts: Mapping[str, int]
    config: SignatureConfig
    cells: NDArray[np.int8]
    stamps_ns: I64
    points_m: F64 | None


def tree(rng: np.random.Generator, leaves: int = 3, **changes: Any) -> Tree:
    fields: dict[str, Any] = {
        "name": "ash",
        "height": 1 / 3,
        "count": 7,
        "since_ns": -(2**62),
        "kept": True,
        "label": None,
        "twig": Twig(0.5, -1, (1.0, -2.0)),
        "twigs": (Twig(1.0, 2, (0.1, 0.2)), Twig(2.0, 3, (0.3, 0.4))),
        "moods": (Mood.FAIR, Mood.GRIM, Mood.FAIR),
        "leaves": tuple(
            Leaf(SE2(*rng.random(3).tolist()), rng.random(2), list(Mood)[k % 2], k != 1, k)
            for k in range(leaves)
        ),
        "words": ("a", "\udcff"),
        "counts": {"b": 2, "a": 1},
        "config": SignatureConfig.paper(),
        "cells": rng.integers(-1, 101, (4, 5)).astype(np.int8),
        "stamps_ns": np.arange(6),
        "points_m": rng.random((3, 2)),
    }
    return Tree(**(fields | changes))


def there_and_back(value: Any) -> Any:
    arrays: dict[str, Any] = {}
    document = codec.encode(type(value), value, "", arrays)
    stored = {name: unpack(pack(array)) for name, array in arrays.items()}
    found = codec.decode(type(value), codec.json.loads(codec.to_json(document)), "", stored)
    assert stored == {}
    return found


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"points_m": None, "twig": None, "label": "x"},
        {"leaves": 0, "twigs": (), "moods": (), "cells": np.empty((0, 5), np.int8)},
    ],
)
def test_every_kind_of_field_survives(changes: dict[str, Any]) -> None:
    wanted = tree(np.random.default_rng(3), **changes)
    found = there_and_back(wanted)
    for name, value in vars(wanted).items():
        got = getattr(found, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(got, value)
            assert got.dtype == value.dtype and not got.flags.writeable
        elif name == "words":
            assert got == ("a", r"\xff")
        elif name != "leaves":
            assert got == value and type(got) is type(value), name
    assert len(found.leaves) == len(wanted.leaves)
    for got, leaf in zip(found.leaves, wanted.leaves, strict=True):
        assert (got.at, got.mood, got.kept, got.count) == (leaf.at, leaf.mood, leaf.kept, leaf.count)
        np.testing.assert_array_equal(got.spread, leaf.spread)


def test_arrays_are_named_by_their_path_and_of_many_equal_things_column_by_column() -> None:
    arrays: dict[str, Any] = {}
    codec.encode(Tree, tree(np.random.default_rng(0)), "tree", arrays)
    assert {name: (array.dtype.name, array.shape) for name, array in arrays.items()} == {
        "tree.moods": ("uint8", (3,)),
        "tree.leaves.at.x": ("float64", (3,)),
        "tree.leaves.at.y": ("float64", (3,)),
        "tree.leaves.at.yaw": ("float64", (3,)),
        "tree.leaves.spread": ("float32", (3, 2)),
        "tree.leaves.mood": ("uint8", (3,)),
        "tree.leaves.kept": ("bool", (3,)),
        "tree.leaves.count": ("int64", (3,)),
        "tree.cells": ("int8", (4, 5)),
        "tree.stamps_ns": ("int64", (6,)),
        "tree.points_m": ("float64", (3, 2)),
    }


def test_what_is_no_number_is_not_stored() -> None:
    with pytest.raises(ValueError, match="JSON"):
        there_and_back(tree(np.random.default_rng(0), height=float("nan")))


# --- arrays -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["int8", "uint8", "bool", "int32", "int64", "float32", "float64"])
@pytest.mark.parametrize("shape", [(5,), (0,), (3, 4), (0, 4), (4, 0), (2, 3, 4)])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("compress", [True, False])
def test_arrays_survive(dtype: str, shape: tuple[int, ...], order: str, compress: bool) -> None:
    array = np.random.default_rng(1).integers(0, 2, shape).astype(np.dtype(dtype).newbyteorder(order))
    found = unpack(pack(array, compress=compress))
    np.testing.assert_array_equal(found, array)
    assert found.dtype == np.dtype(dtype) and not found.flags.writeable


def test_only_what_becomes_shorter_is_compressed() -> None:
    noise = np.random.default_rng(2).integers(0, 256, 1000).astype(np.uint8)
    assert pack(noise).data == noise.tobytes()
    assert len(pack(np.zeros(1000)).data) < 30
    assert pack(np.zeros(1000), compress=False).data == bytes(8000)


FLOATS = Packed("float32", "[3]", np.arange(3, dtype="<f4").tobytes())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"data": bytes(8)}, "compressed data: "),
        ({"data": bytes(13)}, "13 bytes where"),
        ({"shape": "[-1,2]"}, "shape is -1 instead of a count"),
        ({"shape": "[1.0]"}, "shape is 1.0 instead of a count"),
        ({"shape": "{}"}, "an array of float32 and the shape"),
        ({"shape": "[1099511627776,1099511627776]"}, "bytes, more than"),
        ({"shape": 3}, "shape is 3 instead of text"),
        ({"dtype": "complex64"}, "an array of complex64"),
        ({"dtype": None}, "dtype is None instead of text"),
        ({"data": np.array([1, np.nan, 0], "<f4").tobytes()}, "not finite"),
        ({"data": np.array([-np.inf, 1, 0], "<f4").tobytes()}, "not finite"),
    ],
)
def test_arrays_that_cannot_be(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        unpack(FLOATS._replace(**change))


def test_what_expands_without_end_is_not_expanded() -> None:
    bomb, peak = zlib.compress(bytes(1 << 28), 9), Peak()
    with pytest.raises(ValueError, match="does not hold the 400000 bytes"):
        unpack(Packed("int8", "[400000]", bomb))
    assert peak.grown_bytes() < 8 << 20


# --- checksums ----------------------------------------------------------------------------------------


@given(st.lists(VALUES, max_size=6), st.lists(VALUES, max_size=6))
def test_rows_that_differ_have_other_checksums(a: list[codec.Value], b: list[codec.Value]) -> None:
    """The checksum covers types and lengths; -0.0 equals 0.0, because SQLite keeps no sign of zero."""
    same = [(type(v), v) for v in a] == [(type(v), v) for v in b]
    assert (codec.row_crc(a) == codec.row_crc(b)) == same
    assert codec.row_crc([0.0]) == codec.row_crc([-0.0])


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
def test_values_that_look_alike(a: list[codec.Value], b: list[codec.Value]) -> None:
    assert codec.row_crc(a) != codec.row_crc(b)


def test_the_checksum_is_that_of_the_format() -> None:
    """A number of format 1, written down: files of today must be readable tomorrow."""
    assert codec.row_crc([1, 2.5, "ä", b"\0\1", None]) == 0xC6F225FB
