"""Two scanners of one robot give the scans of one that looks all around."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, TopicError
from pc2grid.io import open_log
from pc2grid.io.live.targets import open_live
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
