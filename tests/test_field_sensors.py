"""Inputs from the field at fault in what a sensor writes: read right, refused, or warned of."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.field import convert, field_log, info

OPTIONS = ("--duration", "12")
"""Of the recording that the lasers are made of: it has driven 4.2 m then, and 51 m after two minutes."""

REFUSED = {
    "k_garbage": ("/camera/depth/camera_info: fx 80 and fy 1 are of no camera", "calibrate the camera"),
    "d_of_6": ("/camera/depth/camera_info: 6 coefficients of distortion; plumb_bob has 5", "calibrate"),
    "millimetres_only_ranges": ("every range lies outside the limits, 0.1 to 80 m", "metres are expected"),
    "real_gazebo_no_returns": (
        "none of 192 scans holds a return: nothing came back",
        "is the sensor covered",
    ),
    "livox_custom": ("no topic with scans", "with xfer_format 0 the livox driver publishes PointCloud2"),
    "oak": ("/oakd/stereo/image_raw (sensor_msgs/Image) holds depth", "--topic /oakd/stereo/image_raw"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_right_is_refused(tmp_path: Path, name: str) -> None:
    path = field_log(name)
    outcome = convert(path, tmp_path)
    assert outcome.code == 1
    for words in REFUSED[name]:
        assert words in outcome.said
    found = info(path)
    told = f"{found['problem']} {found['warnings']}"
    if found["problem"] is None:  # an empty scan is no fault, so that of the first ones it is only said
        assert "some scans hold no returns at all" in told
    else:
        assert all(words in told for words in REFUSED[name])


@pytest.mark.parametrize("name", ["optical_laser", "range_limits_nan", "angle_max_wrong"])
def test_a_laser_is_read_in_spite_of_its_fault(tmp_path: Path, name: str) -> None:
    outcome = convert(field_log(name), tmp_path, *OPTIONS)
    assert outcome.code == 0
    assert outcome.session is not None
    assert outcome.session["path_m"] == pytest.approx(4.2, abs=0.1)
    assert outcome.warned_of("angle_max is ignored") == (name == "angle_max_wrong")


def test_a_png_is_read_by_its_content(tmp_path: Path) -> None:
    outcome = convert(field_log("cd_png"), tmp_path)
    assert outcome.code == 0
    assert outcome.session is not None
    assert outcome.session["area_m2"] == pytest.approx(9.0, abs=1.0)


def test_the_unit_of_depths_is_doubted_and_can_be_set(tmp_path: Path) -> None:
    path, option = field_log("depth_fifth_mm"), ("--set", "read.depth_unit_m=0.0002")
    words = "the floor lies 5.0 times as far under the camera as tf says (0.60 m)"
    assert any(words in warning for warning in info(path)["warnings"])
    assert convert(path, tmp_path).warned_of(words)
    assert not info(path, *option)["warnings"]
    outcome = convert(path, tmp_path, *option)
    assert outcome.session is not None
    assert not outcome.warned_of("depth_unit_m")
    assert outcome.session["area_m2"] < 20.0


def test_a_depth_image_is_used_when_its_topic_is_named(tmp_path: Path) -> None:
    outcome = convert(field_log("oak"), tmp_path, "--topic", "/oakd/stereo/image_raw")
    assert outcome.code == 0
