"""PointCloud2 in every layout against a slow oracle that unpacks value by value."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pc2grid.errors import LimitExceeded, PointCloudError
from pc2grid.io.messages.types import Header, PointCloud2
from pc2grid.io.sensors.pointcloud2 import decode

STAMP = 1_700_000_000_123_456_789
XYZ = (("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1))
CODES = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d", 9: "q", 10: "Q", 11: "B"}


def cloud(rows: list[list[list[float]]], kind: int, big: bool, gap: int, pad: int) -> PointCloud2:
    """Rows of points (x, y, z, t) as a message: xyz of one datatype, t float64 at an odd offset."""
    order = ">" if big else "<"
    size = struct.calcsize(order + CODES[kind])
    step = gap + 3 * size + 8
    data = b""
    for row in rows:
        for *xyz, t in row:
            data += b"\xaa" * gap + struct.pack(f"{order}3{CODES[kind]}", *xyz) + struct.pack(order + "d", t)
        data += b"\xbb" * pad
    fields = tuple((name, gap + i * size, kind, 1) for i, name in enumerate("xyz"))
    fields = (*fields, ("time", gap + 3 * size, 8, 1))
    width = len(rows[0]) if rows else 0
    return PointCloud2(Header(STAMP, "lidar"), len(rows), width, fields, big, step, width * step + pad, data)


@st.composite
def clouds(draw: st.DrawFn) -> tuple[PointCloud2, list[list[float]]]:
    kind = draw(st.sampled_from(sorted(CODES)))
    special = st.sampled_from([math.nan, math.inf, -math.inf, 0.0])
    if kind in (7, 8):
        number = st.floats(-100, 100, width=32) | special
    else:
        number = st.integers(0 if kind in (2, 4, 6, 10, 11) else -100, 100)
    height, width = draw(st.integers(1, 3)), draw(st.integers(1, 5))
    point = st.tuples(number, number, number, st.floats(0, 0.1)).map(list)
    row = st.lists(point, min_size=width, max_size=width)
    rows = draw(st.lists(row, min_size=height, max_size=height))
    message = cloud(rows, kind, draw(st.booleans()), draw(st.integers(0, 5)), draw(st.integers(0, 7)))
    return message, [p for r in rows for p in r]


@settings(max_examples=100, deadline=None)
@given(clouds())
def test_round_trip_against_the_oracle(case: tuple[PointCloud2, list[list[float]]]) -> None:
    message, points = case
    good = [p for p in points if all(map(math.isfinite, p[:3])) and any(p[:3])]
    found = decode(message, unit="s")
    assert found.dropped == len(points) - len(good)
    np.testing.assert_array_equal(found.xyz_m, np.array([p[:3] for p in good]).reshape(-1, 3))
    times = [p[3] for p in good]
    if found.offsets_s is not None:
        np.testing.assert_array_equal(found.offsets_s, np.array(times, dtype=np.float32))
    else:
        assert len(set(times)) <= 1


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (7, [0.0, 0.05, 0.1]),
        (8, [STAMP * 1e-9, STAMP * 1e-9 + 0.05, STAMP * 1e-9 + 0.1]),
        (6, [0, 50_000_000, 100_000_000]),
        (6, [0, 50_000, 100_000]),
        (10, [STAMP, STAMP + 50_000_000, STAMP + 100_000_000]),
        (8, [0.0, 5e7, 1e8]),
        (10, [77 * 10**9, 77 * 10**9 + 50_000_000, 77 * 10**9 + 100_000_000]),
        (7, [0.0, 50.0, 100.0]),
        (5, [0, 50, 100]),
        (8, [STAMP * 1e-6, STAMP * 1e-6 + 50, STAMP * 1e-6 + 100]),
        (10, [STAMP // 1000, STAMP // 1000 + 50_000, STAMP // 1000 + 100_000]),
    ],
)
@pytest.mark.parametrize(
    "name", ["t", "time", "timestamp", "timestamps", "offset_time", "Time", "time_stamp"]
)
def test_per_point_times_in_every_spelling(kind: int, values: list[float], name: str) -> None:
    data = b"".join(struct.pack("<3f" + CODES[kind], 1, 2, 3, v) for v in values)
    fields = (("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), (name, 12, kind, 1))
    found = decode(PointCloud2(Header(STAMP, ""), 1, 3, fields, False, len(data) // 3, len(data), data))
    assert found.offsets_s is not None
    np.testing.assert_allclose(found.offsets_s, [0, 0.05, 0.1], atol=2e-6)


def test_times_that_decrease_or_end_at_the_stamp_keep_their_signs() -> None:
    fields = (*XYZ, ("t", 12, 5, 1))
    data = b"".join(struct.pack("<3fi", 1, 2, 3, v) for v in (0, -50_000_000, -100_000_000))
    found = decode(PointCloud2(Header(STAMP, ""), 1, 3, fields, False, 16, 48, data))
    assert found.offsets_s is not None
    np.testing.assert_allclose(found.offsets_s, [0, -0.05, -0.1], atol=1e-7)


def test_times_stay_with_their_points_where_rows_are_dropped() -> None:
    rows = [(1, 0, 0, 0.0), (math.nan, 0, 0, 0.03), (2, 0, 0, 0.05), (3, 0, 0, math.nan), (4, 0, 0, 0.1)]
    data = b"".join(struct.pack("<4f", *row) for row in rows)
    found = decode(PointCloud2(Header(STAMP, ""), 1, 5, (*XYZ, ("t", 12, 7, 1)), False, 16, 80, data))
    assert found.offsets_s is not None
    np.testing.assert_allclose(found.xyz_m[:, 0], [1, 2, 4])
    np.testing.assert_allclose(found.offsets_s, [0, 0.05, 0.1])
    assert found.dropped == 2


@pytest.mark.parametrize("wild", [0.0, 4e18, -1e300, math.inf])
@pytest.mark.parametrize("share", [0.001, 0.3])
@pytest.mark.parametrize(("scale", "begin_s"), [(1.0, STAMP * 1e-9), (1e9, STAMP * 1e-9), (1e6, -0.1)])
def test_wild_times_decide_no_unit(wild: float, share: float, scale: float, begin_s: float) -> None:
    seconds = np.linspace(0.0, 0.1, 2000)
    points = np.zeros(2000, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<f8")])
    points["x"], points["t"] = 1.0 + seconds, (begin_s + seconds) * scale
    odd = np.random.default_rng(3).random(2000) < share
    points["t"][odd] = wild
    fields, data = (*XYZ, ("t", 12, 8, 1)), points.tobytes()
    found = decode(PointCloud2(Header(STAMP, ""), 1, 2000, fields, False, 20, len(data), data))
    assert found.offsets_s is not None
    expected = seconds + (begin_s if begin_s < 0 else 0.0)
    if wild == 0.0 and begin_s < 0.0:  # a time of the scan, as far as one can tell
        expected = np.where(odd, 0.0, expected)
        odd[:] = False
    assert found.dropped == odd.sum()
    np.testing.assert_allclose(found.offsets_s, expected[~odd], atol=1e-3)
    assert bool(found.notes) == (found.dropped > 0)


def test_no_times_or_all_the_same_is_no_offsets() -> None:
    data = b"".join(struct.pack("<4f", 1, 2, 3, 0.5) for _ in range(3))
    same = decode(PointCloud2(Header(STAMP, ""), 1, 3, (*XYZ, ("t", 12, 7, 1)), False, 16, 48, data))
    assert same.offsets_s is None
    assert "all the same" in same.notes[0]
    assert decode(PointCloud2(Header(STAMP, ""), 1, 3, XYZ, False, 16, 48, data)).offsets_s is None


def test_an_absurd_size_is_refused_before_anything_is_allocated() -> None:
    with pytest.raises(LimitExceeded, match="max_points"):
        decode(PointCloud2(Header(STAMP, ""), 2**31, 2**31, XYZ, False, 12, 12, b""))


@pytest.mark.parametrize(
    ("unit", "kind", "values"),
    [
        ("s", 7, [0.0, 0.05, 1e30]),
        ("s", 8, [0.0, 0.05, 1e300]),
        ("s", 8, [0.0, 0.05, 2.1]),
        ("s", 8, [-1e300, 0.05, 1e308]),
        ("ns", 6, [0, 100_000_000, 0xFFFFFFFF]),
        ("ns", 10, [STAMP, STAMP + 100_000_000, 1 << 63]),
        ("us", 10, [STAMP, STAMP + 50_000_000, STAMP + 100_000_000]),
    ],
)
def test_times_of_a_known_unit_that_no_scan_can_span(unit: str, kind: int, values: list[float]) -> None:
    """One flipped bit, or another unit than declared: seconds become years."""
    data = b"".join(struct.pack("<3f" + CODES[kind], 1, 2, 3, v) for v in values)
    message = PointCloud2(
        Header(STAMP, ""), 1, 3, (*XYZ, ("t", 12, kind, 1)), False, len(data) // 3, len(data), data
    )
    with pytest.raises(PointCloudError, match=rf"field t: times that span .* s, read as {unit}") as caught:
        decode(message, unit=unit)
    assert "read.point_time=" in str(caught.value.hint)
    assert decode(message, unit="none").offsets_s is None
