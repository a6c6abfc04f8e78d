"""Odd but whole recordings: stamps, gaps, empty and short messages, dialects, schemas, checksums."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import FrameError, NoScans, TopicError
from pc2grid.io import stream
from pc2grid.io.live.live_log import open_live
from pc2grid.io.recording import open_log
from pc2grid.io.sensors.depth import T_BODY_OPTICAL
from pc2grid.settings import ReadConfig
from tests.helpers import foxglove_messages as foxglove
from tests.helpers.recordings import (
    STEP,
    T0,
    Message,
    check_drive,
    drive,
    laser_drive,
    raw_log,
    read,
    ros,
    write_clouds,
    write_mcap,
    write_rosbag2,
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


@pytest.mark.fault(33)
@pytest.mark.parametrize(
    ("bad", "stamp_ns", "reason"),
    [
        (7, 0, "stamp is zero or negative"),
        (3, -5 * STEP, "stamp is zero or negative"),
        (5, T0 + 4 * STEP, "stamp is a duplicate"),
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
    monkeypatch.setattr(stream, "PARAMETERS", stream.StreamParameters(max_waiting_bytes=limit))
    seen: list[int] = []
    take = stream.Stream._take_scan
    monkeypatch.setattr(
        stream.Stream,
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


@pytest.mark.fault(34)
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


@pytest.mark.fault(17)
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


@pytest.mark.fault(8)
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


# --- Two scanners of one robot give the scans of one that looks all around ---


BOTH = ReadConfig(topic="/front,/rear")


def robot(
    scans: int = 10, *, late_ns: int = 40_000_000, odometry: bool = True, tf: bool = True
) -> list[Message]:
    """A front and a rear laser, 0.5 m before and 1 m behind the base, which moves 0.1 m a scan; the rear one
    is `late_ns` behind. Each has three beams, all 2 m long."""
    to = ros()
    messages = []
    if tf:
        messages.append(to.tf(T0, "base_link", "front_laser", 0.5, topic="/tf_static"))
        messages.append(to.tf(T0, "base_link", "rear_laser", -1.0, topic="/tf_static"))
    for i in range(scans):
        stamp = T0 + i * STEP
        messages.append(to.laser("/front", stamp, [2.0, 2.0, 2.0], frame="front_laser"))
        if odometry:
            messages.append(to.odometry("/odom", stamp, 0.1 * i))
        messages.append(to.laser("/rear", stamp + late_ns, [2.0, 2.0, 2.0], frame="rear_laser"))
    if odometry:
        messages.append(to.odometry("/odom", T0 + scans * STEP, 0.1 * scans))
    return messages


def test_points_stand_where_each_sensor_is_moved_by_odometry_to_one_time(tmp_path: Path) -> None:
    scans, report = read(write_mcap(tmp_path / "a.mcap", robot()), BOTH)
    assert len(scans) == 10
    for i, scan in enumerate(scans):
        assert scan.stamp_ns == T0 + i * STEP
        assert len(scan.points_m) == 6
        front, rear = scan.points_m[:3], scan.points_m[3:]
        np.testing.assert_allclose(front[:, 0].min(), 0.5, atol=0.05)
        # The base has moved 0.04 m when the rear laser scans.
        np.testing.assert_allclose(rear - front, [[-1.5 + 0.04, 0.0, 0.0]] * 3, atol=1e-6)
        np.testing.assert_allclose(scan.T_base_sensor[:3, 3], [-0.25, 0.0, 0.0])
        assert scan.offsets_s is None
    assert not report.lossy


def test_without_odometry_their_times_are_told(tmp_path: Path) -> None:
    scans, _ = read(write_mcap(tmp_path / "a.mcap", robot(odometry=False)), BOTH)
    for scan in scans:
        assert scan.offsets_s is not None
        np.testing.assert_allclose(scan.offsets_s, [0, 0, 0, 0.04, 0.04, 0.04], atol=1e-6)
        np.testing.assert_allclose(scan.points_m[3:] - scan.points_m[:3], [[-1.5, 0.0, 0.0]] * 3, atol=1e-6)


def test_a_sensor_that_stops_leaves_the_other(tmp_path: Path) -> None:
    messages = [m for i, m in enumerate(robot(20)) if m.topic != "/rear" or i < 30]
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages), BOTH)
    assert len(scans) == 20
    assert {len(scan.points_m) for scan in scans} == {3, 6}
    assert len(scans[-1].points_m) == 3
    assert list(report.scans_skipped) == ["/rear: no scan near the first sensor's"]


@pytest.mark.parametrize("names", [("/a", "/b"), ("", "")], ids=["on two topics", "on one topic"])
def test_depth_cameras_keep_their_own_calibration(tmp_path: Path, names: tuple[str, str]) -> None:
    """On one topic they are told apart by their frames."""
    to, pixels = ros(), np.full((2, 2), 1000, np.uint16)
    mounts = (("first_optical", 1.0), ("second_optical", 2.0))
    messages = [to.tf(T0, "base_link", frame, x_m, topic="/tf_static") for frame, x_m in mounts]
    for i in range(5):
        for name, frame, focal in zip(names, ("first_optical", "second_optical"), (5.0, 10.0), strict=True):
            camera = to.camera(f"{name}/depth/camera_info", T0 + i * STEP, 2, 2, focal, frame=frame)
            image = to.image(f"{name}/depth/image", T0 + i * STEP, pixels, "16UC1", frame=frame)
            messages += [camera, image]
    topic = ",".join(f"{name}/depth/image" for name in dict.fromkeys(names))
    config = ReadConfig(topic=topic, depth_stride=1)
    scans, _ = read(write_mcap(tmp_path / "a.mcap", messages), config)
    assert len(scans) == 5
    for scan in scans:
        assert np.ptp(scan.points_m[:4, 0]) == pytest.approx(0.2, abs=1e-3)  # 1 m away, a pixel is 1/5 wide
        assert np.ptp(scan.points_m[4:, 0]) == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize(
    ("topic", "messages", "kind", "words"),
    [
        ("/front,/points", [*robot(3), ros().cloud("/points", T0, [[1, 2, 3]])], TopicError, "put together"),
        ("/front,/side", robot(3), TopicError, "no topic /side"),
        ("/front,/rear", robot(3, tf=False), FrameError, "without tf"),
        (None, robot(3), TopicError, "several topics hold scans"),
    ],
)
def test_mistakes(
    tmp_path: Path, topic: str | None, messages: Sequence[Message], kind: type[Exception], words: str
) -> None:
    with pytest.raises(kind, match=words) as error:
        read(write_mcap(tmp_path / "a.mcap", messages), ReadConfig(topic=topic))
    assert getattr(error.value, "hint", None)
    if topic is None:
        assert "--topic /front,/rear" in error.value.in_short


# --- several sensors on one topic ---------------------------------------------------------------------


def on_one_topic(messages: Sequence[Message]) -> list[Message]:
    return [m._replace(topic="/scan") if m.topic in ("/front", "/rear") else m for m in messages]


@pytest.mark.fault(35)
@pytest.mark.parametrize("late_ns", [0, 10_000_000, 40_000_000])
@pytest.mark.parametrize("odometry", [True, False])
def test_sensors_of_two_frames_on_one_topic_are_read_as_two_topics(
    tmp_path: Path, late_ns: int, odometry: bool
) -> None:
    messages = robot(40, late_ns=late_ns, odometry=odometry)
    of_two, _ = read(write_mcap(tmp_path / "two.mcap", messages), BOTH)
    path = write_mcap(tmp_path / "one.mcap", on_one_topic(messages))
    of_one, report = read(path)
    assert not report.lossy and not [w for w in report.warnings if "frame" in w]
    for a, b in zip(of_one, of_two, strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.points_m, b.points_m)
        np.testing.assert_array_equal(a.T_base_sensor, b.T_base_sensor)
    with open_log(path) as log:
        assert "of 2 sensors by their frames: front_laser, rear_laser" in log.choose().reason
        assert log.choose().further_frames == ("rear_laser",)


@pytest.mark.parametrize("one_topic", [False, True])
def test_a_robot_that_runs_gives_the_same(tmp_path: Path, one_topic: bool) -> None:
    messages, config = (on_one_topic(robot(36)), None) if one_topic else (robot(36), BOTH)
    path = write_mcap(tmp_path / "a.mcap", messages)
    with open_log(path, config) as log, open_live(str(path), config) as live:
        assert live.choose() == log.choose()
        assert one_topic or "with /rear" in live.choose().reason
        for a, b in zip(log.scans(), live.scans(), strict=True):
            assert a.stamp_ns == b.stamp_ns
            np.testing.assert_array_equal(a.points_m, b.points_m)


def test_an_image_has_the_calibration_of_its_time_of_a_robot_too(tmp_path: Path) -> None:
    """Of a camera that focuses, while images wait for odometry and a robot's first seconds are held back."""
    to, pixels = ros(), np.full((2, 2), 1000, np.uint16)
    messages = [to.tf(T0, "base_link", "optical", 1.0, topic="/tf_static")]
    for i in range(6):
        messages.append(to.camera("/depth/camera_info", T0 + i * STEP, 2, 2, 5.0 + i, frame="optical"))
        messages.append(to.image("/depth/image", T0 + i * STEP, pixels, "16UC1", frame="optical"))
    ordered = [m._replace(log_time_ns=m.log_time_ns + k) for k, m in enumerate(messages)]
    path, config = write_mcap(tmp_path / "a.mcap", ordered), ReadConfig(depth_stride=1)
    for opened in (open_log(path, config), open_live(str(path), config)):
        with opened as log:
            widths = [float(np.ptp(scan.points_m[:, 0])) for scan in log.scans()]
        assert widths == pytest.approx([1.0 / (5.0 + i) for i in range(6)], abs=1e-3)


def dead(scans: int, ranges: Sequence[float], frame: str, begin_ns: int | None = T0) -> list[Message]:
    """A second driver on /scan, ahead of the first one. begin_ns : its first stamp; None: all are zero."""
    stamps = [T0 + i * STEP for i in range(scans)]
    shift_ns = [-t if begin_ns is None else begin_ns - T0 for t in stamps]
    laser = [ros().laser("/scan", t + k, ranges, frame) for t, k in zip(stamps, shift_ns, strict=True)]
    return [m._replace(log_time_ns=t - 1000) for m, t in zip(laser, stamps, strict=True)]


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (dead(10, [np.inf] * 3, "rear_laser"), "beside frame front_laser, its scans hold no return"),
        (dead(10, [np.inf] * 3, "nowhere", begin_ns=STEP), "its scans hold no return"),
        (dead(10, [2.0] * 3, "rear_laser", begin_ns=STEP), "1,700,000,000 s apart from those of frame front"),
        (dead(10, [2.0] * 3, "rear_laser", begin_ns=None), "1,700,000,000 s apart from those of frame front"),
        (dead(10, [], "rear_laser"), "its scans hold no return"),
    ],
)
@pytest.mark.parametrize("tf", [True, False])
def test_a_dead_driver_beside_a_live_one_is_named_and_left_out(
    tmp_path: Path, other: list[Message], why: str, tf: bool
) -> None:
    alone = on_one_topic([m for m in robot(10, tf=tf) if m.topic != "/rear"])
    messages = sorted([*alone, *other], key=lambda m: m.log_time_ns)
    scans, report = read(write_mcap(tmp_path / "both.mcap", messages))
    expected, _ = read(write_mcap(tmp_path / "alone.mcap", alone))
    for a, b in zip(scans, expected, strict=True):
        np.testing.assert_array_equal(a.points_m, b.points_m)
        np.testing.assert_array_equal(a.T_base_sensor, b.T_base_sensor)
    assert not report.lossy
    assert any("of /scan is left out" in w and why in w for w in report.warnings)


def test_a_sensor_that_sees_nothing_at_first_is_used_later(tmp_path: Path) -> None:
    rear = [*dead(20, [np.inf] * 3, "rear_laser"), *dead(40, [2.0] * 3, "rear_laser")[20:]]
    alone = on_one_topic([m for m in robot(40) if m.topic != "/rear"])
    path = write_mcap(tmp_path / "a.mcap", sorted([*alone, *rear], key=lambda m: m.log_time_ns))
    scans, _ = read(path)
    assert [len(scan.points_m) for scan in scans] == [3] * 19 + [6] * 21  # from 0.1 s before


def test_scans_go_on_when_the_first_sensor_stops_or_is_renamed(tmp_path: Path) -> None:
    front, rear = ([m for m in robot(80) if m.topic == topic] for topic in ("/front", "/rear"))
    others = [m for m in robot(80) if m.topic not in ("/front", "/rear")]

    def scans_of(*lasers: Message) -> list[int]:
        messages = sorted([*others, *on_one_topic(lasers)], key=lambda m: m.log_time_ns)
        return [len(s.points_m) for s in read(write_mcap(tmp_path / "a.mcap", messages))[0]]

    assert scans_of(*front[:30], *rear) == [6] * 30 + [3] * 50
    assert scans_of(*front[:30], *rear[30:]) == [3] * 80
    assert scans_of(*front, *rear[40:]) == [3] * 40 + [6] * 40
    assert scans_of(*front[40:], *rear) == [3] * 39 + [6] * 41


def test_sensors_on_one_topic_need_tf(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", on_one_topic(robot(5, tf=False)))
    words = "/scan in frame front_laser, /scan in frame rear_laser: without tf"
    with pytest.raises(FrameError, match=words) as error:
        read(path)
    assert "--set read.assume_identity=true takes frame front_laser alone" in str(error.value.hint)
    scans, _ = read(path, ReadConfig(assume_identity=True))
    assert {len(scan.points_m) for scan in scans} == {3}


# --- A recording lasts from its first scan to its last one, whatever else it holds ---


S = 10**9
WEEK_S = 7 * 24 * 3600


def with_strays() -> list[Message]:
    """A drive of 11.9 s. A transform comes a week later, and odometry begins 40 s before the first scan."""
    late = ros().tf(T0 + WEEK_S * S, "base_link", "camera", 0.1, topic="/tf_static")
    early = [ros().odometry("/odom", T0 - 40 * S + k * S, 0.0) for k in range(40)]
    return [*early, *laser_drive(), late]


@pytest.mark.parametrize("container", ["mcap", "loose", "sqlite3"])
def test_strays_do_not_count(tmp_path: Path, container: str) -> None:
    messages = with_strays()
    if container == "sqlite3":
        path = write_rosbag2(tmp_path / "a", messages, "sqlite3")
    else:
        path = write_mcap(tmp_path / "a.mcap", messages, use_chunking=container == "mcap", chunk_size=2000)
    with open_log(path) as log:
        assert (log.info.start_ns, log.info.end_ns) == (T0, T0 + 119 * S // 10)
        assert len(list(log.scans())) == 120
        # Odometry is known at all of them.
        part = list(log.scans(5.0, 2.0))
        assert [scan.stamp_ns for scan in part] == [T0 + 5 * S + k * S // 10 for k in range(20)]
        assert all(scan.T_odom_base is not None for scan in part)


def test_without_scans_the_times_are_those_of_all_messages(tmp_path: Path) -> None:
    messages = [m for m in laser_drive() if m.topic != "/scan"]
    with open_log(write_mcap(tmp_path / "a.mcap", messages)) as log:
        assert log.info.start_ns == T0 and log.info.duration_s == pytest.approx(11.95)


def test_of_several_scanners_the_times_are_those_of_the_one_that_is_read(tmp_path: Path) -> None:
    later = [ros().laser("/second", T0 + (20 + k) * S, [1.0] * 30) for k in range(3)]
    path = write_mcap(tmp_path / "a.mcap", [*laser_drive(), *later])
    with open_log(path, ReadConfig(topic="/scan")) as log:
        assert log.info.duration_s == pytest.approx(11.9)
    with open_log(path) as log:
        assert log.info.duration_s == pytest.approx(22.0)


# --- Scans whose frame, or whose times, cannot be what the message says ---


def images(frame: str) -> list[Message]:
    """A camera 0.5 m above the base, whose axes are those of the base."""
    to = ros()
    wall = np.full((6, 8), 1000, "<u2")
    return [
        to.tf(T0, "base_link", frame, 0.1, z_m=0.5, topic="/tf_static"),
        to.camera("/depth/camera_info", T0, 8, 6, 10.0),
        *(to.image("/depth/image", T0 + i * STEP, wall, "16UC1", frame=frame) for i in range(3)),
    ]


def test_an_image_in_a_frame_of_the_body_looks_forward(tmp_path: Path) -> None:
    (scan, *_), report = read(write_mcap(tmp_path / "a.mcap", images("camera_link")))
    np.testing.assert_allclose(scan.T_base_sensor[:3, :3], T_BODY_OPTICAL[:3, :3])
    np.testing.assert_allclose(scan.points_m[:, 0], 1.1, atol=1e-6)
    assert any("the images are in frame camera_link, whose z axis points up" in w for w in report.warnings)


def test_a_camera_that_looks_up_does_so_in_its_optical_frame(tmp_path: Path) -> None:
    (scan, *_), report = read(write_mcap(tmp_path / "a.mcap", images("camera_optical_frame")))
    np.testing.assert_allclose(scan.points_m[:, 2], 1.5, atol=1e-6)
    assert not report.warnings


@pytest.mark.parametrize(("increment_s", "ignored"), [(0.0009, False), (0.0015, True)])
def test_a_time_increment_longer_than_the_period_is_ignored(
    increment_s: float, ignored: bool, tmp_path: Path
) -> None:
    to = ros()
    messages = [to.laser("/scan", T0 + i * STEP, np.full(100, 2.0)) for i in range(6)]
    store = to.store
    for i, message in enumerate(messages):
        scan = store.deserialize_cdr(message.data, "sensor_msgs/msg/LaserScan")
        scan.time_increment = increment_s
        data = bytes(store.serialize_cdr(scan, "sensor_msgs/msg/LaserScan"))
        messages[i] = message._replace(data=data)
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert all((scan.offsets_s is None) == ignored for scan in scans)
    assert any("time_increment makes a scan longer than 0.11 s" in w for w in report.warnings) == ignored


@pytest.mark.parametrize("seconds", [10**10, 10**30, -(10**30)])
def test_stamps_past_all_calendars_are_skipped(tmp_path: Path, seconds: int) -> None:
    def change(fields: dict[str, Any]) -> None:
        fields["timestamp"]["sec"] = seconds

    path = json_clouds(tmp_path / "a.mcap", change)
    scans, report = read(path)
    assert len(scans) == 19
    (reason,) = report.scans_skipped
    assert "stamp" in reason


def json_clouds(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """20 clouds in JSON, of which the eleventh is changed."""
    clouds = [foxglove.jsonable(foxglove.cloud(T0 + i * STEP, [[1, 2, 3]])[3]) for i in range(20)]
    change(clouds[10])
    points = "/points", "foxglove.PointCloud", "jsonschema", b"{}"
    return raw_log(path, [(*points, json.dumps(fields).encode()) for fields in clouds], "json")


@pytest.mark.parametrize("late", [1 << 63, (1 << 64) - 1])
def test_times_of_recording_past_all_calendars(tmp_path: Path, late: int) -> None:
    """Stamps are zero, so the times of recording have to do, and these do not."""
    messages = [ros().cloud("/points", 0, [[1, 2, 3]])._replace(log_time_ns=T0 + i * STEP) for i in range(20)]
    messages[-1] = messages[-1]._replace(log_time_ns=late)
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert len(scans) == 19
    assert report.scans_skipped == {"stamp is past the year 2262": 1}
