"""PointCloud2 in every layout against a slow oracle that unpacks value by value."""

import dataclasses
import math
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pc2grid.errors import LimitExceeded, NoScans, Pc2GridError, PointCloudError
from pc2grid.io.messages.clouds import parser
from pc2grid.io.messages.types import Header, LaserScan, PointCloud2
from pc2grid.io.sensors.decode import decode_cloud, decode_laser
from pc2grid.model import ReadReport, Scan
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Message, read, ros, write_mcap

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


def timed(kind: int, values: Sequence[float], name: str = "t") -> PointCloud2:
    """Points at (1, 2, 3) with these times, of a datatype."""
    data = b"".join(struct.pack("<3f" + CODES[kind], 1, 2, 3, v) for v in values)
    fields, step = (*XYZ, (name, 12, kind, 1)), len(data) // len(values)
    return PointCloud2(Header(STAMP, ""), 1, len(values), fields, False, step, len(data), data)


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


@pytest.mark.fault(21)
@pytest.mark.fault(22)
@pytest.mark.fault(23)
@pytest.mark.fault(26)
@settings(max_examples=100, deadline=None)
@given(clouds())
def test_round_trip_against_the_oracle(case: tuple[PointCloud2, list[list[float]]]) -> None:
    message, points = case
    good = [p for p in points if all(map(math.isfinite, p[:3])) and any(p[:3])]
    found = decode_cloud(message, unit="s")
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
    found = decode_cloud(timed(kind, values, name))
    assert found.offsets_s is not None
    np.testing.assert_allclose(found.offsets_s, [0, 0.05, 0.1], atol=2e-6)


def test_times_that_decrease_or_end_at_the_stamp_keep_their_signs() -> None:
    found = decode_cloud(timed(5, (0, -50_000_000, -100_000_000)))
    assert found.offsets_s is not None
    np.testing.assert_allclose(found.offsets_s, [0, -0.05, -0.1], atol=1e-7)


def test_times_stay_with_their_points_where_rows_are_dropped() -> None:
    rows = [(1, 0, 0, 0.0), (math.nan, 0, 0, 0.03), (2, 0, 0, 0.05), (3, 0, 0, math.nan), (4, 0, 0, 0.1)]
    data = b"".join(struct.pack("<4f", *row) for row in rows)
    found = decode_cloud(PointCloud2(Header(STAMP, ""), 1, 5, (*XYZ, ("t", 12, 7, 1)), False, 16, 80, data))
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
    found = decode_cloud(PointCloud2(Header(STAMP, ""), 1, 2000, fields, False, 20, len(data), data))
    assert found.offsets_s is not None
    expected = seconds + (begin_s if begin_s < 0 else 0.0)
    if wild == 0.0 and begin_s < 0.0:  # a time of the scan, as far as one can tell
        expected = np.where(odd, 0.0, expected)
        odd[:] = False
    assert found.dropped == odd.sum()
    np.testing.assert_allclose(found.offsets_s, expected[~odd], atol=1e-3)
    assert bool(found.notes) == (found.dropped > 0)


@pytest.mark.fault(31)
def test_no_times_or_all_the_same_is_no_offsets() -> None:
    cloud = timed(7, [0.5] * 3)
    same = decode_cloud(cloud)
    assert same.offsets_s is None
    assert "all the same" in same.notes[0]
    assert decode_cloud(dataclasses.replace(cloud, fields=XYZ)).offsets_s is None


def test_an_absurd_size_is_refused_before_anything_is_allocated() -> None:
    with pytest.raises(LimitExceeded, match="max_points"):
        decode_cloud(PointCloud2(Header(STAMP, ""), 2**31, 2**31, XYZ, False, 12, 12, b""))


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
    message = timed(kind, values)
    with pytest.raises(PointCloudError, match=rf"field t: times that span .* s, read as {unit}") as caught:
        decode_cloud(message, unit=unit)
    assert "read.point_time=" in str(caught.value.hint)
    assert decode_cloud(message, unit="none").offsets_s is None


# --- Laser scans whose numbers no laser has, through a whole log ---


RANGES = np.linspace(2.0, 5.0, 180)


def scans_of(folder: Path, *messages: Message) -> tuple[list[Scan], ReadReport]:
    return read(write_mcap(folder / "a.mcap", messages))


def laser(i: int = 0, ranges: np.ndarray = RANGES, **options: object) -> Message:
    return ros().laser("/scan", T0 + i * STEP, ranges, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("angle_max", [0.0, -math.pi / 2, -3.0, 30.0, math.nan])
def test_a_wrong_angle_max_is_ignored_and_told(tmp_path: Path, angle_max: float) -> None:
    (right, wrong), report = scans_of(tmp_path, laser(0), laser(1, angle_max=angle_max))
    np.testing.assert_array_equal(right.points_m, wrong.points_m)
    assert any("angle_max is ignored" in w for w in report.warnings)


def test_angles_in_degrees_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PointCloudError, match="span 179 rad, more than a turn") as caught:
        scans_of(tmp_path, laser(angles=(-90.0, 1.0)))
    assert "in radians" in str(caught.value.hint)
    whole_turn = laser(0, np.linspace(2.0, 5.0, 361), angles=(-math.pi, math.radians(1.0)))
    assert len(scans_of(tmp_path, whole_turn)[0][0].points_m) == 361


@pytest.mark.parametrize(
    "limits_m", [(math.nan, math.nan), (math.inf, math.nan), (0.0, 0.0), (0.0, math.inf)]
)
def test_limits_that_are_not_set(tmp_path: Path, limits_m: tuple[float, float]) -> None:
    """The same largest range of several beams is what the driver writes for no return."""
    ranges = np.where(np.arange(180) % 10 == 0, 81.91, RANGES)
    (scan,), report = scans_of(tmp_path, laser(0, ranges, limits_m=limits_m))
    assert len(scan.points_m) == 162
    assert scan.points_m.max() < 5.0
    assert not [w for w in report.warnings if "tf" not in w]


@pytest.mark.parametrize(
    ("ranges", "limits_m", "error", "words"),
    [
        (1000 * RANGES, (0.1, 80.0), NoScans, "every range lies outside the limits, 0.1 to 80 m"),
        (RANGES, (80.0, 0.1), NoScans, "every range lies outside the limits, 80 to 0.1 m"),
        (np.full(180, np.inf), (0.1, 80.0), NoScans, "nothing came back"),
        (np.full(180, np.nan), (math.nan, math.nan), NoScans, "nothing came back"),
        (np.zeros(180), (0.0, 80.0), NoScans, "nothing came back"),
        (100 * RANGES, (10.0, 8000.0), PointCloudError, "farther than 100 m; metres are expected"),
        (1000 * RANGES, (100.0, 80_000.0), PointCloudError, "farther than 100 m; metres are expected"),
        (np.r_[0.05, 1000 * RANGES[1:]], (0.01, 80.0), PointCloudError, "metres are expected"),
        (100 * RANGES, (math.nan, math.nan), PointCloudError, "metres are expected"),
    ],
)
def test_ranges_without_a_return(
    tmp_path: Path, ranges: np.ndarray, limits_m: tuple[float, float], error: type[Pc2GridError], words: str
) -> None:
    with pytest.raises(error, match=words) as caught:
        scans_of(tmp_path, *(laser(i, ranges, limits_m=limits_m) for i in range(3)))
    assert "metres" in str(caught.value.hint)


@pytest.mark.fault(27)
def test_a_single_scan_without_returns_is_an_empty_one(tmp_path: Path) -> None:
    (first, _), report = scans_of(tmp_path, laser(0, np.full(180, np.inf)), laser(1))
    assert len(first.points_m) == 0
    assert any("some scans hold no returns at all: nothing came back" in w for w in report.warnings)


def test_the_plane_of_a_laser_is_x_y_of_its_frame(tmp_path: Path) -> None:
    """Also of a frame that is called optical; one that stands upright on the robot draws no floor plan."""
    (plain,), _ = scans_of(tmp_path, laser())
    (optical,), _ = scans_of(tmp_path, laser(frame="camera_depth_optical_frame"))
    np.testing.assert_array_equal(plain.points_m, optical.points_m)
    mount = ros().tf(
        T0, "base_link", "camera_optical", 0.2, quaternion=(-0.5, 0.5, -0.5, 0.5), topic="/tf_static"
    )
    with pytest.raises(
        PointCloudError, match="the plane of the laser stands upright: x-y of frame camera_optical"
    ):
        scans_of(tmp_path, mount, laser(frame="camera_optical"))


def beams(count: int = 5, **changes: float) -> LaserScan:
    start, step = changes.pop("angle_min", -0.2), changes.pop("angle_increment", 0.1)
    known = {
        "angle_min": start, "angle_max": start + (count - 1) * step, "angle_increment": step,
        "time_increment": 0.0, "scan_time": 0.1, "range_min": 0.1, "range_max": 30.0,
    }  # fmt: skip
    ranges = 1.0 + (np.arange(count) % 20).astype(np.float32)
    return LaserScan(Header(T0, "laser"), **(known | changes), ranges=ranges)


def test_laser_whose_beams_would_take_years_is_taken_at_one_time() -> None:
    for wrong in (0.5, -0.5, 1e30):
        found = decode_laser(beams(time_increment=wrong))
        assert found.offsets_s is None
        assert found.notes == ("time_increment makes a scan longer than 2 s: it is ignored",)
    assert decode_laser(beams(time_increment=0.4)).notes == ()


def test_beams_and_their_times() -> None:
    found = decode_laser(beams(time_increment=0.01, range_min=2.0, range_max=5.0))
    assert found.dropped == 2  # 1 m is too near, 5 m is the reach itself
    angles = np.array([-0.1, 0.0, 0.1])
    expected = np.array([2, 3, 4])[:, None] * np.column_stack((np.cos(angles), np.sin(angles), 0 * angles))
    np.testing.assert_allclose(found.xyz_m, expected, atol=1e-6)
    np.testing.assert_allclose(found.offsets_s, [0.01, 0.02, 0.03])
    unlimited = decode_laser(beams(range_max=0.0, range_min=0.0))
    assert len(unlimited.xyz_m) == 5
    assert unlimited.offsets_s is None
    assert len(decode_laser(beams(range_max=math.inf)).xyz_m) == 5
    assert len(decode_laser(beams(1, angle_increment=0.0)).xyz_m) == 1


def test_a_range_of_zero_is_no_return() -> None:
    ranges = np.array([0.0, 1.0, -1.0, np.inf, np.nan], np.float32)
    found = decode_laser(dataclasses.replace(beams(range_min=0.0), ranges=ranges))
    np.testing.assert_allclose(np.linalg.norm(found.xyz_m, axis=1), [1.0], rtol=1e-6)


@pytest.mark.parametrize(("count", "slack"), [(5, 2), (1000, 20)])
def test_angles_may_be_off_by_two_beams_or_two_percent(count: int, slack: int) -> None:
    """Drivers round the last angle, or leave a beam out."""

    def declared(beams_more: float) -> LaserScan:
        return beams(count, angle_increment=0.001, angle_max=-0.2 + 0.001 * (count - 1 + beams_more))

    for fine in (-slack + 0.01, slack - 0.01):
        assert decode_laser(declared(fine), max_points=10_000).notes == ()
    for wrong in (-slack - 0.5, slack + 0.5):
        (note,) = decode_laser(declared(wrong), max_points=10_000).notes
        assert "angle_max is ignored" in note


HEADER = Header(T0, "lidar")


@pytest.mark.fault(28)
def test_an_origin_that_is_nowhere() -> None:
    from pc2grid.io.sensors.decode import ScanDecoder

    cloud = parser("bin")(struct.pack("<8f", 1, 2, 3, 0, 2, 3, 4, 0), HEADER)
    decoder = ScanDecoder("/points", "lidar", ReadConfig())
    moved = dataclasses.replace(cloud, origin=(1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0))
    scan = decoder.scan(moved, T0, np.eye(4), None)
    np.testing.assert_allclose(scan.points_m, [[2, 2, 3.5], [3, 3, 4.5]])
    nowhere = dataclasses.replace(cloud, origin=(float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    with pytest.raises(PointCloudError, match="the origin of the points is not finite"):
        decoder.scan(nowhere, T0, np.eye(4), None)
    with pytest.raises(PointCloudError, match="every point is farther than 1 m"):
        ScanDecoder("/points", "lidar", ReadConfig(max_range_m=1.0)).scan(cloud, T0, np.eye(4), None)
