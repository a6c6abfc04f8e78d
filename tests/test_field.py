"""Inputs from the field at fault in odometry, times, frames or topics: right, refused, or warned of."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest import approx
from typer.testing import CliRunner

from pc2grid.geometry import SE2
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid.simulate.config import LaserConfig
from pc2grid.simulate.session import EPOCH_NS
from pc2grid_cli.main import app
from tests.helpers.field import DATA, Change, Outcome, altered, convert, field_log, info
from tests.helpers.shared_folders import shared_folder

FASTEST_M = 0.15
"""No step from scan to scan is longer: robots indoors, five to ten scans a second."""
ELSEWHERE = SE2(7.0, -3.0, 2.0)


@shared_folder()
def driven(folder: Path) -> None:
    """A laser on wheels, with odometry as a topic and in tf; 10 scans a second."""
    config = SimulationConfig(length_m=5.0, seed=3, laser=LaserConfig(step_deg=1.0))
    simulate_session(folder / "drive.mcap", sensor="laser", config=config)


@pytest.fixture
def drive(driven: Path) -> Path:
    return driven / "drive.mcap"


@pytest.fixture(scope="module")
def whole(driven: Path) -> Outcome:
    """What the drive is without a fault."""
    return convert(driven / "drive.mcap", driven)


def odometry_elsewhere(begin_ns: int) -> Change:
    """Odometry that begins at a time, at a pose that is not zero."""

    def change(topic: str, message: Any, log_time_ns: int) -> Any:
        if topic not in ("/odom", "/tf"):
            return message
        if log_time_ns < EPOCH_NS + begin_ns:
            return None
        pose = message.pose.pose if topic == "/odom" else message.transforms[0].transform
        at = pose.position if topic == "/odom" else pose.translation
        turn = pose.orientation if topic == "/odom" else pose.rotation
        moved = ELSEWHERE @ SE2(at.x, at.y, 2.0 * np.arctan2(turn.z, turn.w))
        at.x, at.y, turn.z, turn.w = moved.x, moved.y, np.sin(moved.yaw / 2.0), np.cos(moved.yaw / 2.0)
        return message

    return change


def without_returns(change: Change, begin_ns: int, end_ns: int) -> Change:
    """Scans of a time without returns, too."""

    def emptied(topic: str, message: Any, log_time_ns: int) -> Any:
        if topic == "/scan" and begin_ns <= log_time_ns - EPOCH_NS < end_ns:
            message.ranges = np.full_like(message.ranges, np.inf)
        return change(topic, message, log_time_ns)

    return emptied


@pytest.mark.parametrize(
    "change",
    [
        without_returns(odometry_elsewhere(150_000_000), 3_000_000_000, 3_100_000_000),
        without_returns(odometry_elsewhere(150_000_000), 0, 250_000_000),
    ],
    ids=["then a scan without returns", "first scans without returns"],
)
def test_odometry_that_begins_later_moves_nothing(
    change: Change, drive: Path, whole: Outcome, tmp_path: Path
) -> None:
    made = convert(altered(drive, tmp_path / "late.mcap", change), tmp_path)
    assert made.code == 0
    assert made.steps_m.max() < 0.1
    assert made.session is not None and whole.session is not None
    assert made.session["path_m"] == approx(whole.session["path_m"], abs=0.05)


@pytest.mark.parametrize("left_out", ["/tf", "/odom"])
def test_odometry_goes_on_where_scans_pause(
    left_out: str, drive: Path, whole: Outcome, tmp_path: Path
) -> None:
    """For three seconds there is no scan, then some without returns."""

    def paused(topic: str, message: Any, log_time_ns: int) -> Any:
        seconds = (log_time_ns - EPOCH_NS) * 1e-9
        if topic == left_out:
            return None
        if topic == "/scan" and 3.0 < seconds < 6.5:
            message.ranges = np.full_like(message.ranges, np.inf)
            return None if seconds < 6.0 else message
        return message

    made = convert(altered(drive, tmp_path / "paused.mcap", paused), tmp_path)
    assert made.poses is not None and whole.poses is not None
    assert np.linalg.norm(made.poses[-1][:2, 3] - whole.poses[-1][:2, 3]) < 0.1


def yaw(sign: float) -> Change:
    """Odometry whose turns are reversed, or not there."""

    def change(topic: str, message: Any, log_time_ns: int) -> Any:
        if topic == "/tf":
            return None
        if topic == "/odom":
            turn = message.pose.pose.orientation
            half = sign * np.arctan2(turn.z, turn.w)
            turn.z, turn.w = np.sin(half), np.cos(half)
        return message

    return change


def frozen(topic: str, message: Any, log_time_ns: int) -> Any:
    if topic == "/odom":
        message.pose.pose.position.x = message.pose.pose.position.y = message.pose.pose.orientation.z = 0.0
        message.pose.pose.orientation.w = 1.0
    return None if topic == "/tf" else message


def millimetres(topic: str, message: Any, log_time_ns: int) -> Any:
    if topic == "/odom":
        message.pose.pose.position.x *= 1000.0
        message.pose.pose.position.y *= 1000.0
    return message


def upside_down(topic: str, message: Any, log_time_ns: int) -> Any:
    if topic == "/scan":
        message.ranges = message.ranges[::-1].copy()
    return message


def turned(topic: str, message: Any, log_time_ns: int) -> Any:
    if topic == "/scan":
        message.angle_min, message.angle_max = message.angle_min + np.pi, message.angle_max + np.pi
    return message


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (yaw(-1.0), ["odometry turns the other way than the scans"]),
        (yaw(0.0), ["odometry reports 0.0 rad where the scans show turns of"]),
        (frozen, ["odometry reports 0.0 m where the scans show", "odometry reports 0.0 rad"]),
        (millimetres, ["m where the scans show"]),
        (upside_down, ["odometry turns the other way than the scans", "upside down"]),
        (turned, ["odometry reports travel the other way than the scans show"]),
    ],
    ids=["yaw reversed", "no yaw", "frozen", "millimetres", "upside down", "turned by half a turn"],
)
def test_odometry_that_the_scans_contradict_is_warned_of(
    change: Change, words: list[str], drive: Path, whole: Outcome, tmp_path: Path
) -> None:
    made = convert(altered(drive, tmp_path / "odd.mcap", change), tmp_path)
    for found in words:
        assert made.warned_of(found), made.warnings
    assert not any("odometry" in warning for warning in whole.warnings)


@pytest.mark.parametrize("left_out", ["", "/odom"])
def test_scans_by_another_clock_than_the_odometry_are_warned_of(
    left_out: str, drive: Path, tmp_path: Path
) -> None:
    def since_boot(topic: str, message: Any, log_time_ns: int) -> Any:
        if topic == "/scan":
            message.header.stamp.sec -= 1_690_000_000
        return None if topic == left_out else message

    path = altered(drive, tmp_path / "boot.mcap", since_boot)
    words = f"odometry from {'/tf' if left_out else '/odom'} are 1,690,000,000 s apart and never meet"
    described, made = info(path), convert(path, tmp_path)
    assert any(words in warning for warning in described["warnings"])
    assert described["choice"]["odometry_topic"] is None
    assert made.warned_of(words)
    assert made.session is not None and made.session["odometry"]["compared"] == 0


def test_odometry_of_other_times_is_warned_of(drive: Path, tmp_path: Path) -> None:
    def before(topic: str, message: Any, log_time_ns: int) -> Any:
        late = topic in ("/odom", "/tf") and log_time_ns > EPOCH_NS + 1_000_000_000
        return None if late or (topic == "/scan" and log_time_ns < EPOCH_NS + 5_000_000_000) else message

    made = convert(altered(drive, tmp_path / "before.mcap", before), tmp_path)
    assert made.warned_of("no scan has odometry: that from /odom is of other times")


def test_scans_since_boot_with_odometry_of_the_day_are_warned_of(tmp_path: Path) -> None:
    path = field_log("scan_clock_since_boot")
    words = "the clocks of the scans and of the odometry from /odom are 1,700,001,000 s apart"
    assert any(words in warning for warning in info(path)["warnings"])
    assert convert(path, tmp_path, "--duration", "20").warned_of(words)


# --- Inputs from the field at fault in what a sensor writes: read right, refused, or warned of ---


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


SHORT = ("--duration", "12")
"""Of the recording that three lasers are made of: it has driven 4.2 m then, and 51 m after two minutes."""


@pytest.mark.parametrize(
    ("name", "options", "wanted"),
    [
        # Odometry begins after the first scan, or scans are empty.
        ("real_neato_odom_late", (), {"path_m": approx(6.3, abs=0.15)}),
        ("real_neato_empty_scan", (), {"path_m": approx(5.4, abs=0.15)}),
        ("one_empty_scan", (), {"path_m": approx(10.9, abs=0.15)}),
        ("first_scan_empty", (), {"path_m": approx(10.9, abs=0.15)}),
        ("depth_odom_late", (), {"path_m": approx(1.3, abs=0.15)}),
        ("real_neato_one_return", (), {}),
        ("times_zero_in_a_few_points", (), {"path_m": approx(2.66, abs=0.05)}),
        ("registered_in_odom", (), {"path_m": approx(4.65, abs=0.05), "area_m2": approx(40.0, abs=2.0)}),
        ("optical_laser", SHORT, {"path_m": approx(4.2, abs=0.1)}),
        ("range_limits_nan", SHORT, {"path_m": approx(4.2, abs=0.1)}),
        ("angle_max_wrong", SHORT, {"path_m": approx(4.2, abs=0.1)}),
        ("upside_down_unsaid", ("--duration", "60"), {}),
        ("cd_png", (), {"area_m2": approx(9.0, abs=1.0)}),
        ("oak", ("--topic", "/oakd/stereo/image_raw"), {}),
    ],
)
def test_what_is_read_in_spite_of_its_fault(
    name: str, options: tuple[str, ...], wanted: dict[str, Any], tmp_path: Path
) -> None:
    made = convert(field_log(name), tmp_path, *options)
    assert made.code == 0 and made.session is not None and made.poses is not None
    assert {key: made.session[key] for key in wanted} == wanted
    if name != "upside_down_unsaid":  # its scans fit badly
        assert made.steps_m.max() < FASTEST_M
    for said, names in WARNED.items():
        assert made.warned_of(said) == (name in names)
    if name == "real_neato_one_return":
        assert made.poses[-1][:2, 3] == approx((-0.07, 0.25), abs=0.1)
    if name == "times_zero_in_a_few_points":
        assert made.session["report"]["points_dropped"] >= 120


WARNED = {
    "points whose times in field timestamp are not of their scan are left": ["times_zero_in_a_few_points"],
    "angle_max is ignored": ["angle_max_wrong"],
    "the sensor is mounted upside down and tf does not say so": ["upside_down_unsaid"],
}


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
    assert (pose["x"], pose["y"]) == (approx(x_m, abs=0.1), approx(y_m, abs=0.1))
    assert math.degrees(pose["yaw"]) == approx(yaw_deg, abs=2.0)


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
    assert outcome.session["area_m2"] == approx(72.3, rel=0.03)
