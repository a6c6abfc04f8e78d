"""Odd but whole recordings: stamps, gaps, empty and short messages, dialects, schemas, checksums."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import NoScans
from pc2grid.io import open_log
from pc2grid.io import stream as scan_stream
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import (
    STEP,
    T0,
    Message,
    check_drive,
    drive,
    raw_log,
    read,
    ros,
    write_clouds,
    write_mcap,
)

POINT = [[1.0, 2.0, 3.0]]
DAY = 86_400_000_000_000


def cloud(stamp_ns: int, log_time_ns: int | None = None) -> Message:
    message = ros().cloud("/points", stamp_ns, POINT)
    return message._replace(log_time_ns=stamp_ns if log_time_ns is None else log_time_ns)


@pytest.mark.parametrize("dialect", ["ros1", "ros2"])
def test_both_dialects_read_what_an_independent_encoder_wrote(tmp_path: Path, dialect: str) -> None:
    name = "ros1" if dialect == "ros1" else "ros2"
    path = write_mcap(tmp_path / "a.mcap", drive(name), name)
    with open_log(path) as log:
        assert log.info.format == f"mcap/{dialect}"
        assert log.choose().odometry_topic == "/odom"
        check_drive(list(log.scans()))
        assert not log.report().lossy


@pytest.mark.parametrize("dialect", ["ros1", "ros2"])
def test_a_laser_of_both_dialects(tmp_path: Path, dialect: str) -> None:
    name = "ros1" if dialect == "ros1" else "ros2"
    ranges = [1.0, np.inf, 0.05, np.nan, 2.0, 30.0, 0.0]
    (scan,), _ = read(write_mcap(tmp_path / "a.mcap", [ros(name).laser("/scan", T0, ranges)], name))
    angles = -np.pi / 2 + 0.01 * np.array([0, 4])
    expected = np.array([[1.0], [2.0]]) * np.column_stack((np.cos(angles), np.sin(angles), [0, 0]))
    np.testing.assert_allclose(scan.points_m, expected, atol=1e-6)
    assert scan.sensor == "laser"
    assert scan.dropped == 5


# --- stamps (33) and gaps (34) ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "stamp_ns", "reason"),
    [
        (7, 0, "stamp is zero or negative"),
        (3, -5 * STEP, "stamp is zero or negative"),
        (15, T0 + 3 * STEP + 1, "stamp goes back in time"),
        (8, T0 + 8 * STEP + DAY, "stamp jumps"),
    ],
)
def test_one_wrong_stamp_among_good_ones_is_skipped_and_counted(
    tmp_path: Path, bad: int, stamp_ns: int, reason: str
) -> None:
    messages = [cloud(stamp_ns if i == bad else T0 + i * STEP, T0 + i * STEP) for i in range(20)]
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert [s.stamp_ns for s in scans] == [T0 + i * STEP for i in range(20) if i != bad]
    assert report.scans_skipped == {reason: 1}
    assert report.lossy


def test_small_disorder_is_sorted_without_loss(tmp_path: Path) -> None:
    order = [0, 2, 1, 3, 5, 6, 4, 7, 9, 8]
    messages = [cloud(T0 + k * STEP, T0 + i * STEP) for i, k in enumerate(order)]
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert [s.stamp_ns for s in scans] == [T0 + i * STEP for i in range(10)]
    assert not report.lossy


@pytest.mark.parametrize(("limit", "taken"), [(10**9, 20), (300, 4)])
def test_what_waits_for_its_turn_is_bounded_in_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int, taken: int
) -> None:
    """Scans of one moment, however many and large, are not all held in memory."""
    monkeypatch.setattr(scan_stream, "PARAMETERS", scan_stream.StreamParameters(max_waiting_bytes=limit))
    seen: list[int] = []
    take = scan_stream.Stream._take_scan
    monkeypatch.setattr(
        scan_stream.Stream,
        "_take_scan",
        lambda self, topic, data, time: (seen.append(time), take(self, topic, data, time))[1],
    )
    path = write_mcap(tmp_path / "a.mcap", [cloud(T0 + i * 1_000_000) for i in range(20)])
    with open_log(path) as log:
        first = next(iter(log.scans()))
    assert first.stamp_ns == T0
    assert len(seen) == pytest.approx(taken, abs=1)


def test_a_clock_that_was_set_is_continued_and_reported(tmp_path: Path) -> None:
    messages = [cloud(T0 + i * STEP + (DAY if i >= 8 else 0), T0 + i * STEP) for i in range(25)]
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert len(scans) == 25
    assert any("jumps forward" in w for w in report.warnings)


def test_a_gap_is_reported_and_not_bridged_by_odometry(tmp_path: Path) -> None:
    to = ros()
    gap = 30 * 10**9
    stamps = [T0 + i * STEP + (gap if i >= 10 else 0) for i in range(20)]
    messages = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    for i, stamp in enumerate(stamps):
        messages.append(cloud(stamp))
        if i not in (9, 10):
            messages.append(to.odometry("/odom", stamp, 0.1 * i))
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert len(scans) == 20
    assert any("gaps of more than 5 s" in w for w in report.warnings)
    # 0.1 s from the last sample it still counts; it is held, not interpolated towards the far side.
    for i in (9, 10):
        pose = scans[i].T_odom_base
        assert pose is not None
        assert pose[0, 3] == pytest.approx(0.8 if i == 9 else 1.1)


# --- schemas (17, 19) and checksums (8) ---------------------------------------------------------------

# As rosidl_adapter writes it for a LaserScan, reduced to what a parser has to cope with.


def test_the_same_type_in_two_schema_records(tmp_path: Path) -> None:
    schema = ros().schema("sensor_msgs/LaserScan")
    name = "sensor_msgs/msg/LaserScan"
    first, second = (ros().laser("/scan", T0 + i * STEP, [1.0, 2.0]).data for i in range(2))
    both = raw_log(
        tmp_path / "a.mcap",
        [("/a", name, "ros2msg", schema, first), ("/b", name, "ros2msg", schema + b"# again", second)],
    )
    with open_log(both) as log:
        assert [t.topic for t in log.info.topics] == ["/a", "/b"]
    assert len(read(both, ReadConfig(topic="/a"))[0]) == len(read(both, ReadConfig(topic="/b"))[0]) == 1
    # One topic whose recorder registered the type anew, as after a restart: all messages are found.
    one = raw_log(
        tmp_path / "b.mcap",
        [("/a", name, "ros2msg", schema, first), ("/a", name, "ros2msg", schema + b"# again", second)],
    )
    assert len(read(one)[0]) == 2


@pytest.mark.parametrize("chunked", [True, False])
def test_absent_checksums_are_said(tmp_path: Path, chunked: bool) -> None:
    options = {"enable_crcs": False, "enable_data_crcs": False, "use_chunking": chunked}
    scans, report = read(write_mcap(tmp_path / "a.mcap", drive(), **options))
    check_drive(scans)
    assert any("no checksum: damage would not be seen" in w for w in report.warnings)
    safe = write_mcap(tmp_path / "b.mcap", drive(), enable_data_crcs=True, use_chunking=chunked)
    assert not any("checksum" in w for w in read(safe)[1].warnings)


# --- parts of a recording -----------------------------------------------------------------------------


def test_a_part_is_chosen_by_seconds_after_the_first_scan(tmp_path: Path) -> None:
    with open_log(write_clouds(tmp_path / "a.mcap")) as log:
        scans = list(log.scans(1.0, 0.5))
        assert [s.stamp_ns - T0 for s in scans] == [10 * STEP + i * STEP for i in range(5)]
        assert scans[0].T_base_sensor[:3, 3].tolist() == [0.2, 0.0, 0.5]
        # Odometry comes 10 ms after each scan: 0.1 m per 0.1 s, so the scan is 0.01 m behind.
        assert scans[0].T_odom_base is not None
        assert scans[0].T_odom_base[0, 3] == pytest.approx(0.99)
        with pytest.raises(NoScans, match=r"lasts 3\.9 s"):
            list(log.scans(100.0))
