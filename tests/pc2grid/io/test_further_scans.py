"""Two scanners of one robot give the scans of one that looks all around."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import FrameError, TopicError
from pc2grid.io import open_log
from pc2grid.io.live.live_log import open_live
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Message, read, ros, write_mcap

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


def test_a_robot_that_runs_gives_the_same(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", robot(40))
    with open_log(path, BOTH) as log, open_live(str(path), BOTH) as live:
        for a, b in zip(log.scans(), live.scans(), strict=True):
            assert a.stamp_ns == b.stamp_ns
            np.testing.assert_array_equal(a.points_m, b.points_m)
        assert "with /rear" in live.choose().reason


def test_a_sensor_that_stops_leaves_the_other(tmp_path: Path) -> None:
    messages = [m for i, m in enumerate(robot(20)) if m.topic != "/rear" or i < 30]
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages), BOTH)
    assert len(scans) == 20
    assert {len(scan.points_m) for scan in scans} == {3, 6}
    assert len(scans[-1].points_m) == 3
    assert list(report.scans_skipped) == ["/rear: no scan near the first sensor's"]


def test_depth_cameras_keep_their_own_calibration(tmp_path: Path) -> None:
    to, messages = ros(), []
    for name, x_m in (("a", 1.0), ("b", 2.0)):
        messages.append(to.tf(T0, "base_link", f"{name}_optical", x_m, topic="/tf_static"))
    pixels = np.full((2, 2), 1000, np.uint16)
    for i in range(5):
        stamp = T0 + i * STEP
        for name, focal in (("a", 5.0), ("b", 10.0)):
            messages.append(to.camera(f"/{name}/depth/camera_info", stamp, 2, 2, focal))
            image = to.image(f"/{name}/depth/image", stamp, pixels, "16UC1", frame=f"{name}_optical")
            messages.append(image)
    config = ReadConfig(topic="/a/depth/image,/b/depth/image", depth_stride=1)
    scans, _ = read(write_mcap(tmp_path / "a.mcap", messages), config)
    assert len(scans) == 5
    a, b = scans[0].points_m[:4], scans[0].points_m[4:]
    assert np.ptp(a[:, 0]) == pytest.approx(0.2, abs=1e-3)  # 1 m away, a pixel is 1/5 wide
    assert np.ptp(b[:, 0]) == pytest.approx(0.1, abs=1e-3)


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


def test_cameras_on_one_topic_are_told_apart_by_their_frames(tmp_path: Path) -> None:
    to, messages = ros(), []
    pixels = np.full((2, 2), 1000, np.uint16)
    for name, x_m in (("a", 1.0), ("b", 2.0)):
        messages.append(to.tf(T0, "base_link", f"{name}_optical", x_m, topic="/tf_static"))
    for i in range(5):
        stamp = T0 + i * STEP
        for name, focal in (("a", 5.0), ("b", 10.0)):
            frame = f"{name}_optical"
            messages.append(to.camera("/depth/camera_info", stamp, 2, 2, focal, frame=frame))
            messages.append(to.image("/depth/image", stamp, pixels, "16UC1", frame=frame))
    scans, _ = read(write_mcap(tmp_path / "a.mcap", messages), ReadConfig(depth_stride=1))
    assert len(scans) == 5
    for scan in scans:
        assert np.ptp(scan.points_m[:4, 0]) == pytest.approx(0.2, abs=1e-3)
        assert np.ptp(scan.points_m[4:, 0]) == pytest.approx(0.1, abs=1e-3)


# --- several sensors on one topic ---------------------------------------------------------------------


def on_one_topic(messages: Sequence[Message]) -> list[Message]:
    return [m._replace(topic="/scan") if m.topic in ("/front", "/rear") else m for m in messages]


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


def test_a_robot_that_runs_may_have_two_sensors_on_one_topic(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", on_one_topic(robot(40)))
    with open_log(path) as log, open_live(str(path)) as live:
        assert live.choose() == log.choose()
        for a, b in zip(log.scans(), live.scans(), strict=True):
            np.testing.assert_array_equal(a.points_m, b.points_m)


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
