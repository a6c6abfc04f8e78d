"""Arrays and documents as bytes: all comes back, and nothing is allocated for what is only claimed."""

import ast
import hashlib
import io
import json
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pc2grid.errors import DatabaseVersion
from signature.database import document as arrays, open_database, sqlite
from signature.database.document import clean, pack, row_crc, to_json, unpack
from signature.database.maintenance import check, store
from signature.database.protocol import FORMAT
from tests.helpers.databases import Content, craft, make_entry, sql
from tests.helpers.memory import Peak

VALUES = st.integers() | st.binary() | st.text()


@pytest.mark.parametrize("dtype", ["int8", "uint8", "int32", ">i8", "float32", "float64"])
@pytest.mark.parametrize("shape", [(5,), (0, 4), (2, 3, 4)])
@pytest.mark.parametrize("compress", [True, False])
def test_what_is_packed_comes_out(dtype: str, shape: tuple[int, ...], compress: bool) -> None:
    array = np.random.default_rng(1).integers(0, 2, shape).astype(dtype)
    given, turned = {"a": array, "turned": array.T}, {"x": [1, None, "b"]}
    document, found = unpack(pack(turned, given, compress=compress))
    assert document == turned and found.keys() == given.keys()
    for name, value in given.items():
        np.testing.assert_array_equal(found[name], value)
        assert found[name].dtype == array.dtype
    assert pack(turned, given, compress=compress) == pack(turned, given, compress=compress)


def members(**content: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in content.items():
            file.writestr(f"{name}.npy", data)
    return stream.getvalue()


def npy(array: Any, **head: Any) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {**np.lib.format.header_data_from_array_1_0(array), **head})
    return stream.getvalue() + array.tobytes()


ONE = np.arange(3, dtype="<f4")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"junk",
        pack({}, {"a": ONE})[:-9],
        members(a=npy(ONE)),
        members(a=b"\x93NUMPY"),
        members(a=npy(ONE, shape=(4,)), document=npy(ONE)),
        members(a=npy(ONE, shape=(2**40, 2**40)), document=npy(ONE)),
        members(a=npy(ONE, descr="|O"), document=npy(ONE)),
        members(a=npy(np.array([1, np.nan])), document=npy(ONE)),
        members(a=npy(np.array([1, -np.inf])), document=npy(ONE)),
        members(document=npy(np.frombuffer(b"{", np.uint8))),
    ],
)
def test_what_was_not_packed_is_refused(data: bytes) -> None:
    peak = Peak()
    with pytest.raises((ValueError, KeyError, TypeError, OverflowError, zipfile.BadZipFile)):
        unpack(data)
    assert peak.grown_bytes() < 8 << 20


def test_what_expands_without_end_is_not_expanded(monkeypatch: pytest.MonkeyPatch) -> None:
    bomb, peak = members(a=bytes(1 << 27)), Peak()
    monkeypatch.setattr(arrays, "MOST_BYTES", 1 << 20)
    with pytest.raises(ValueError, match="134217728 bytes, more than 1048576"):
        unpack(bomb)
    assert peak.grown_bytes() < 8 << 20


def test_what_is_no_text_and_what_is_no_number() -> None:
    assert clean("a\udcff\\") == r"a\xff" + "\\"
    assert json.loads(to_json({"a\udcff": ["\udcfe", "\U0001f642\\"]})) == {
        r"a\xff": [r"\xfe", "\U0001f642\\"]
    }
    with pytest.raises(ValueError, match="JSON"):
        to_json([float("nan")])


@given(st.lists(VALUES, max_size=6), st.lists(VALUES, max_size=6))
def test_rows_that_differ_have_other_checksums(a: list[Any], b: list[Any]) -> None:
    """The checksum covers types and lengths."""
    assert (row_crc(a) == row_crc(b)) == ([(type(v), v) for v in a] == [(type(v), v) for v in b])


@pytest.mark.parametrize(
    ("a", "b"), [(["ab", "c"], ["a", "bc"]), (["1"], [b"1"]), ([1], ["1"]), ([1, 2], [2, 1]), ([""], [])]
)
def test_values_that_look_alike(a: list[Any], b: list[Any]) -> None:
    assert row_crc(a) != row_crc(b)


def test_two_threads_never_read_headers_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python before 3.11.9 has one depth counter for all threads that parse; a server test met it."""
    reading, most, literal_eval = [0], [0], ast.literal_eval

    def slow(text: str) -> Any:
        reading[0] += 1
        most[0] = max(most[0], reading[0])
        time.sleep(0.002)
        reading[0] -= 1
        return literal_eval(text)

    monkeypatch.setattr(ast, "literal_eval", slow)
    with ThreadPoolExecutor(4) as pool:
        assert len(list(pool.map(unpack, [pack(1, {"a": ONE})] * 8))) == 8
    assert most[0] == 1


# --- The format of a database, written down: files of today must be readable tomorrow ---


def test_tables_and_checksums_are_unchanged() -> None:
    """If this fails, files exist that the change cannot read: it needs another `FORMAT`."""
    digest = hashlib.sha256(json.dumps(sqlite.TABLES, sort_keys=True).encode()).hexdigest()[:16]
    assert (FORMAT, digest) == (1, "18f09c183e83f1cc")
    assert row_crc([1, "ä", b"\0\1"]) == 0xBE567009


PARTS: dict[str, tuple[Any, dict[str, tuple[str, tuple[int, ...]]]]] = {
    "grid": (
        {"origin_m": [-1.25, 2 / 3], "resolution_m": 0.05, "height_m": None, "heights": None},
        {"cells": ("int8", (40, 60))},
    ),
    "trajectory": (
        {"health": ["fine", "degenerate", "fine", "fine", "fine", "fine", "lost"]},
        {"stamps_ns": ("int64", (7,)), "T_session_base": ("float64", (7, 4, 4))},
    ),
    "points": ({"voxel_m": 0.1}, {"origin_m": ("float64", (3,)), "steps": ("int32", (40, 3))}),
    "submaps": (
        {},
        {
            "submap_id": ("int32", (3,)),
            "center_m": ("float64", (3, 2)),
            "boundary": ("float32", (3, 50)),
            "freespace": ("float32", (3, 50)),
            "symmetry": ("float32", (3, 2)),
        },
    ),
    "seen": ({}, {"at_m": ("float32", (3, 2)), "place": ("int64", (3,)), "signatures": ("uint8", (3, 199))}),
    "frame": (None, {}),
}
"""What a session consists of; a field that is added to one of the stored types changes the format."""


def test_a_stored_session_is_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)
    stored = {name: unpack(data) for name, data in sql(path, "SELECT name, data FROM part")}
    loops, no_arrays = stored.pop("loops")
    found = {
        name: (document, {key: (array.dtype.name, array.shape) for key, array in arrays.items()})
        for name, (document, arrays) in stored.items()
    }
    assert found == PARTS
    assert {key: type(value) for key, value in loops[1].items()} == {
        "older": int, "newer": int, "T_older_newer": dict, "information": list, "accepted": bool
    }  # fmt: skip
    assert (len(loops), no_arrays) == (3, {})


@pytest.mark.fault(44)
def test_settings_of_the_future_are_refused_by_name_and_left_alone(tmp_path: Path) -> None:
    """The format is the same, but a session was made with a setting that this version does not know."""
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)

    def from_the_future(content: Content) -> None:
        origin: dict[str, Any] = content.document["provenance"]
        origin["config"]["partition"]["fractal"] = 3
        origin["versions"]["pc2grid"] = "9.1.0"

    craft(path, from_the_future)
    before = path.read_bytes()
    words = r"'monday' was made by pc2grid 9\.1\.0 with the setting partition\.fractal"
    with open_database(path) as database, pytest.raises(DatabaseVersion, match=words):
        database.sessions()
    with pytest.raises(DatabaseVersion, match=words):
        store(path, [make_entry("tuesday", 1)], keep=True)
    assert path.read_bytes() == before
    (problem,) = check(path)
    assert "partition.fractal" in problem.what
