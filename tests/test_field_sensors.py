"""Inputs from the field at fault in what a sensor writes: read right, refused, or warned of."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from pc2grid.simulate.session import EPOCH_NS
from pc2grid_cli.main import app
from tests.helpers.field import DATA, convert, field_log, info
from tests.helpers.recordings import Message, ros, write_mcap

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


@pytest.mark.parametrize(
    ("robot", "x_m", "y_m", "yaw_deg"), [("robot1", 21.37, 8.02, -21.9), ("robot2", 35.13, 7.87, 158.7)]
)
def test_each_of_two_robots_is_located_by_its_own_mount(
    robot: str, x_m: float, y_m: float, yaw_deg: float
) -> None:
    """Right is what a recording of one of them alone gives."""
    path, topic = field_log("two_robots_namespaced"), f"/{robot}/scan"
    found = info(path, "--topic", topic)
    assert found["choice"]["odometry_topic"] == f"/{robot}/odom"
    words = f"odometry from /{robot}/odom (also there: "
    assert words in found["choice"]["reason"] and any(words in warning for warning in found["warnings"])
    arguments = ["relocalize", str(path), "--topic", topic, "-d", str(DATA / "maps/fr079.yaml"), "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert words in result.stderr
    pose = json.loads(result.stdout)["pose"]
    assert (pose["x"], pose["y"]) == (pytest.approx(x_m, abs=0.1), pytest.approx(y_m, abs=0.1))
    assert math.degrees(pose["yaw"]) == pytest.approx(yaw_deg, abs=2.0)


def test_two_robots_are_not_chosen_among() -> None:
    problem = info(field_log("two_robots_namespaced"))["problem"]
    assert "several topics hold scans: /robot1/scan" in problem and "--topic /robot1/scan)" in problem


def test_two_lasers_on_one_topic_are_two_sensors(tmp_path: Path) -> None:
    """72 m2 is what one laser with the beams of both gives, and what the two topics together give."""
    path = field_log("two_lasers_one_topic")
    choice = info(path)["choice"]
    assert "of 2 sensors by their frames: right_laser, left_laser" in choice["reason"]
    outcome = convert(path, tmp_path)
    assert outcome.code == 0 and outcome.session is not None
    assert outcome.session["scans"] == 360
    assert outcome.session["area_m2"] == pytest.approx(72.3, rel=0.03)


def halves(whole: Path, target: Path, *, dead: bool = False) -> Path:
    """A recording of one laser of 270 degrees as that of two, whose scans are on one topic; the left one is
    10 ms late. dead : with the scans of a third driver, which sees nothing."""
    to, turn, messages = ros(), math.radians(67.5), []
    with whole.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            kind, log_time_ns = schema.name.replace("/msg/", "/"), message.log_time
            if channel.topic == "/odom":
                messages.append(Message(channel.topic, kind, log_time_ns, message.data))
            if channel.topic != "/scan":
                continue
            scan = to.store.deserialize_cdr(message.data, schema.name)
            middle = len(scan.ranges) // 2
            for k, (frame, yaw) in enumerate((("right_laser", -turn), ("left_laser", turn))):
                part = scan.ranges[:middle] if k == 0 else scan.ranges[middle:]
                first = scan.angle_min + k * middle * scan.angle_increment - yaw
                late_ns = log_time_ns + k * 10_000_000
                angles = first, scan.angle_increment
                messages.append(to.laser("/scan", late_ns, part, frame, angles=angles, limits_m=(0.1, 25.0)))
            if dead:
                nothing = to.laser("/scan", log_time_ns - EPOCH_NS + 1, [np.inf] * 9, "laser_frame")
                messages.append(nothing._replace(log_time_ns=log_time_ns))
    for frame, yaw in (("right_laser", -turn), ("left_laser", turn)):
        rotation = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        mount = to.tf(EPOCH_NS, "base_link", frame, 0.15, z_m=0.28, quaternion=rotation, topic="/tf_static")
        messages.append(mount)
    return write_mcap(target, sorted(messages, key=lambda m: m.log_time_ns))


def test_halves_of_a_laser_on_one_topic_give_the_map_of_the_whole(tmp_path: Path) -> None:
    drawn, whole = DATA / "maps/fr079.yaml", tmp_path / "whole.mcap"
    if not drawn.is_file():
        pytest.skip(f"{drawn}: no such map here; PC2GRID_DATA names its folder")
    simulate = ["simulate", str(drawn), str(whole), "--sensor", "laser", "--length", "30", "--seed", "3"]
    assert CliRunner().invoke(app, simulate).exit_code == 0
    part = "--start", "22", "--duration", "36"
    for dead in (False, True):
        outcome = convert(halves(whole, tmp_path / "halves.mcap", dead=dead), tmp_path, *part)
        assert outcome.code == 0 and outcome.session is not None
        assert outcome.session["area_m2"] == pytest.approx(84.0, rel=0.03)
        assert outcome.warned_of("frame laser_frame of /scan is left out") == dead
