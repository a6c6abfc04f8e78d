"""The decompression of PCD files: the compiled function and the plain one agree, also on damaged data."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pc2grid.errors import PointCloudError
from pc2grid.io.messages.lzf import decompress

PARTS = st.one_of(
    st.binary(min_size=1, max_size=32).map(lambda raw: bytes([len(raw) - 1]) + raw),
    st.tuples(st.integers(1, 6), st.integers(0, 40)).map(lambda p: bytes([p[0] << 5, p[1]])),
    st.tuples(st.integers(0, 255), st.integers(0, 40)).map(lambda p: bytes([7 << 5, *p])),
    st.binary(max_size=3),
)


def expand(source: bytes, size: int) -> bytes | None:
    """By the description of the format: `size` bytes, or None if it does not expand to exactly as many."""
    out, at = bytearray(), 0
    while at < len(source):
        control = source[at]
        at += 1
        if control < 32:
            literals = source[at : at + control + 1]
            if len(literals) <= control:
                return None
            out += literals
            at += control + 1
        else:
            length = control >> 5
            follows = source[at : at + (2 if length == 7 else 1)]
            if len(follows) < (2 if length == 7 else 1):
                return None
            at += len(follows)
            length += follows[0] if length == 7 else 0
            start = len(out) - ((control & 31) << 8) - follows[-1] - 1
            if start < 0:
                return None
            for i in range(length + 2):  # one by one: the source may overlap with what is being written
                out.append(out[start + i])
        if len(out) > size:
            return None
    return bytes(out) if len(out) == size else None


@settings(max_examples=200, deadline=None)
@given(parts=st.lists(PARTS, max_size=6), more=st.sampled_from([0, 0, 0, -1, 1]))
@example(parts=[b"\x00a", b"\xe0\xff\x00"], more=0)  # one byte, and 264 like it
@example(parts=[b"\x00a", b"\xe0\xff\x00"], more=-1)
@example(parts=[b"\x00a", b"\x20\x01"], more=0)  # from before the beginning
@example(parts=[b"\x05abc"], more=0)
@example(parts=[b"\x02abc"], more=-1)
@example(parts=[b"\x00a", b"\xe0\x01"], more=0)
def test_lzf_is_expanded_as_by_its_description(parts: list[bytes], more: int) -> None:
    data = b"".join(parts)
    size = next((n for n in range(2000) if expand(data, n) is not None), 100) + more
    expected = expand(data, size) if size >= 0 else None
    if expected is not None:
        assert decompress(data, size) == expected
    elif size >= 0:
        with pytest.raises(PointCloudError, match="damaged"):
            decompress(data, size)
