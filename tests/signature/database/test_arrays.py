"""Arrays and documents as bytes: all comes back, and nothing is allocated for what is only claimed."""

from __future__ import annotations

import ast
import io
import json
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from signature.database import document as arrays
from signature.database.document import clean, pack, row_crc, to_json, unpack
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
