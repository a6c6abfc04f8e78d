"""Clouds that are registered already, and robots without a base_link."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import FrameError
from pc2grid.io import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Message, read, ros, write_mcap

SEEN = np.float32([[2.0, 1.0, 0.4], [3.0, -1.0, 0.1], [2.5, 0.5, -0.7], [1.0, 0.0, -0.7]])
"""Points in the frame of a lidar that stands 0.7 m above the floor."""
MOUNT_M = 0.7


def registered(
    frame: str = "odom", *, tf: bool = True, odometry: bool = False, mount: bool = True
) -> list[Message]:
    """A robot that moves 0.1 m a scan, whose driver publishes the points in a fixed frame."""
    to = ros()
    messages = [to.tf(T0, "base_link", "lidar_top", 0.0, z_m=MOUNT_M, topic="/tf_static")] if mount else []
    for i in range(5):
        stamp, x_m = T0 + i * STEP, 5.0 + 0.1 * i
        messages.append(to.cloud("/registered", stamp, SEEN + np.float32([x_m, 0.0, MOUNT_M]), frame=frame))
        if tf:
            messages.append(to.tf(stamp, frame, "base_link", x_m))
        if odometry:
            messages.append(to.odometry("/odom", stamp, x_m))
    return messages


@pytest.mark.parametrize("odometry", [False, True])
def test_points_in_a_fixed_frame_are_taken_back_to_the_sensor(odometry: bool, tmp_path: Path) -> None:
    scans, report = read(write_mcap(tmp_path / "a.mcap", registered(odometry=odometry)))
    assert len(scans) == 5 and not report.lossy
    for i, scan in enumerate(scans):
        np.testing.assert_allclose(scan.points_m, SEEN + np.float32([0.0, 0.0, MOUNT_M]), atol=1e-5)
        np.testing.assert_allclose(scan.T_base_sensor[:3, 3], (0.0, 0.0, MOUNT_M))
        assert scan.T_odom_base is not None
        assert scan.T_odom_base[0, 3] == pytest.approx(5.0 + 0.1 * i)


def test_a_fixed_frame_of_any_name_is_found_above_the_base(tmp_path: Path) -> None:
    (scan, *_), _ = read(write_mcap(tmp_path / "a.mcap", registered("lio_start")))
    np.testing.assert_allclose(scan.T_base_sensor[:3, 3], (0.0, 0.0, MOUNT_M))


@pytest.mark.parametrize(
    "messages",
    [
        registered(tf=False),
        registered(tf=False, odometry=True),
        registered(tf=False, mount=False),
        registered(mount=False),  # the base stands on the floor, so it cannot be where the sensor is
        [ros().tf(T0, "odom", "base_link", 1.0), ros().laser("/scan", T0, [2.0, 2.0], frame="odom")],
    ],
    ids=["no tf to the base", "odometry alone", "no tf", "no sensor", "a laser"],
)
def test_what_cannot_be_taken_back_is_refused(messages: list[Message], tmp_path: Path) -> None:
    with pytest.raises(FrameError, match="registered already, in the fixed frame odom") as error:
        read(write_mcap(tmp_path / "a.mcap", messages))
    assert "--topic" in str(error.value.hint)


def test_a_first_cloud_without_points_decides_nothing(tmp_path: Path) -> None:
    mount, _, *rest = registered()
    empty = ros().cloud("/registered", T0, np.empty((0, 3)), frame="odom")
    scans, _ = read(write_mcap(tmp_path / "a.mcap", [mount, empty, *rest]))
    assert len(scans) == 5
    path = write_mcap(tmp_path / "b.mcap", [empty, *rest])
    with pytest.raises(FrameError, match="registered already"):
        read(path)


def test_a_sensor_whose_own_frame_is_merely_named_like_a_fixed_one(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", registered("map", tf=False, mount=False))
    (scan, *_), _ = read(path, ReadConfig(assume_identity=True))
    assert scan.T_base_sensor.tolist() == np.eye(4).tolist()


def test_the_root_of_the_only_static_tree_is_the_base(tmp_path: Path) -> None:
    to = ros()
    messages = [
        to.tf(T0, "chassis", "mast", 0.1, topic="/tf_static"),
        to.tf(T0, "mast", "lidar", 0.2, topic="/tf_static"),
        *(to.cloud("/points", T0 + i * STEP, SEEN) for i in range(3)),
        *(to.tf(T0 + i * STEP, "odom", "chassis", 0.1 * i) for i in range(3)),
    ]
    path = write_mcap(tmp_path / "a.mcap", sorted(messages, key=lambda m: m.log_time_ns))
    scans, report = read(path)
    assert scans[2].T_base_sensor[0, 3] == pytest.approx(0.3)
    assert scans[2].T_odom_base is not None and scans[2].T_odom_base[0, 3] == pytest.approx(0.2)
    assert any("tf has no base_link: chassis, the root" in warning for warning in report.warnings)
    with open_log(path) as log:
        assert log.choose().base_frame == "chassis"


def test_of_several_static_trees_none_is_the_robot_s(tmp_path: Path) -> None:
    to = ros()
    messages = [
        to.tf(T0, "chassis", "lidar", 0.1, topic="/tf_static"),
        to.tf(T0, "arm", "camera", 0.2, topic="/tf_static"),
        to.cloud("/points", T0, SEEN),
    ]
    with pytest.raises(FrameError, match="tf does not connect frame lidar to the base"):
        read(write_mcap(tmp_path / "a.mcap", messages))
