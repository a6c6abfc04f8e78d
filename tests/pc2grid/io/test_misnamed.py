"""Scans whose frame, or whose times, cannot be what the message says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pc2grid.io.sensors.depth import T_BODY_OPTICAL
from tests.helpers.recordings import STEP, T0, Message, read, ros, write_mcap


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
