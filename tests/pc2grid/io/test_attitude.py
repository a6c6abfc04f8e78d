"""An IMU tells which way is up: by itself, and in a recording."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import FrameError, TopicError
from pc2grid.geometry import F64, invert_pose, motion_size, pose_from_rotation_vector, quat_xyzw_from_pose
from pc2grid.io import open_log
from pc2grid.io.frames import Attitude
from pc2grid.io.messages.types import Header, Imu
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Dialect, Message, read, ros, write_mcap

G = 9.81
RATE_HZ = 100
TILTED = pose_from_rotation_vector((0.5, -0.3, 1.0))


def message(k: int, T: F64, *, shaken: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Imu:
    """The k-th message of an IMU with an attitude (4, 4) at rest, shaken by an acceleration of the room."""
    felt = T[:3, :3].T @ (np.array(shaken) + (0.0, 0.0, G))  # noqa: RUF005
    return Imu(Header(T0 + k * 10**9 // RATE_HZ, "imu"), None, (0.0, 0.0, 0.0), tuple(felt))


def off_deg(found: F64 | None, true: F64) -> float:
    """How far two attitudes (4, 4) disagree about what is up."""
    assert found is not None
    return math.degrees(math.acos(min(1.0, float(found[2, :3] @ true[2, :3]))))


@pytest.mark.parametrize("T", [np.eye(4), TILTED, pose_from_rotation_vector((math.pi, 0.0, 0.0))])
def test_an_imu_at_rest_knows_what_is_up_however_it_is_mounted(T: F64) -> None:
    attitude = Attitude()
    for k in range(20):
        attitude.add(message(k, T), T0 + k * 10**7)
    assert off_deg(attitude.at(T0 + 10**8), T) < 1e-6


def test_the_shaking_of_steps_cancels() -> None:
    """Two steps a second push by a quarter of gravity: a single message takes that for 14 degrees."""
    attitude, worst = Attitude(), 0.0
    for k in range(4 * RATE_HZ):
        push = 0.25 * G * math.cos(2.0 * math.pi * 2.0 * k / RATE_HZ)
        attitude.add(message(k, TILTED, shaken=(push, 0.0, 0.0)), T0 + k * 10**7)
        if k > RATE_HZ:
            worst = max(worst, off_deg(attitude.at(T0 + k * 10**7), TILTED))
    assert worst < 1.6  # of a first-order mean: 14 degrees / (2 pi 2 Hz 1 s) = 1.1, and half as much again


def test_turns_are_those_of_the_gyroscope() -> None:
    """Half a turn about an axis that is tilted: up stays known, and the angle is that of the gyroscope."""
    attitude, rate = Attitude(), np.array([0.4, 0.9, 0.2])
    poses = [TILTED @ pose_from_rotation_vector(rate * k / RATE_HZ) for k in range(300)]
    for k, T in enumerate(poses):
        attitude.add(replace(message(k, T), turn_rate_rps=tuple(rate)), T0 + k * 10**7)
    first, last = attitude.at(T0 + 10**9), attitude.at(T0 + 2 * 10**9)
    assert first is not None
    assert last is not None
    assert off_deg(last, poses[200]) < 0.1
    wrong = invert_pose(invert_pose(first) @ last) @ invert_pose(poses[100]) @ poses[200]
    assert motion_size(wrong)[1] < 1e-3


def test_what_says_nothing_of_gravity_is_not_used() -> None:
    falling, fast = Attitude(), Attitude()
    for k in range(50):
        falling.add(replace(message(k, TILTED), acceleration_mps2=(0.0, 0.0, 1.0)), T0 + k * 10**7)
        fast.add(message(k, TILTED, shaken=(0.0, 0.0, 8.0)), T0 + k * 10**7)
    assert falling.at(T0 + 10**8) is None  # such as one that counts in standard gravities
    assert fast.at(T0 + 10**8) is None


def test_an_orientation_stands_in_for_accelerations_that_are_not_measured() -> None:
    x, y, z, w = quat_xyzw_from_pose(TILTED).tolist()
    attitude, silent = Attitude(), Attitude()
    for k in range(5):
        known = replace(message(k, TILTED), orientation=(x, y, z, w), acceleration_mps2=None)
        attitude.add(known, T0 + k * 10**7)
        silent.add(replace(known, orientation=None), T0 + k * 10**7)
    assert off_deg(attitude.at(T0), TILTED) < 1e-6
    assert silent.at(T0) is None


# --- in a recording -------------------------------------------------------------------------------------


def recording(path: Path, *, mounted: bool = True, odometry: bool = False, dialect: Dialect = "ros2") -> Path:
    """A lidar and an IMU on a base; the IMU feels 9.81 m/s2 along its x axis."""
    to = ros(dialect)
    messages: list[Message] = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    if mounted:
        messages.append(to.tf(T0, "base_link", "imu", 0.1, topic="/tf_static"))
    for k in range(20):
        messages.append(to.cloud("/points", T0 + k * STEP, [[1.0, 2.0, 3.0]]))
        messages += [to.imu("/imu/data", T0 + k * STEP + j * STEP // 10, (G, 0.0, 0.0)) for j in range(10)]
        if odometry:
            messages.append(to.odometry("/odom", T0 + k * STEP, 0.1 * k))
    messages.sort(key=lambda m: m.log_time_ns)
    return write_mcap(path, messages, dialect)


@pytest.mark.parametrize("dialect", ["ros1", "ros2"])
def test_a_recording_without_odometry_is_read_with_its_imu(tmp_path: Path, dialect: Dialect) -> None:
    path = recording(tmp_path / "a.mcap", dialect=dialect)
    with open_log(path) as log:
        choice = log.choose()
    assert choice.imu_topic == "/imu/data"
    assert "gravity from /imu/data" in choice.reason
    scans, report = read(path)
    assert report.warnings == ()
    for scan in scans:
        assert scan.T_level_base is not None
        np.testing.assert_allclose(scan.T_level_base[2, :3], (1.0, 0.0, 0.0), atol=1e-9)
    assert all(scan.T_level_base is None for scan in read(path, ReadConfig(imu="none"))[0])


def test_an_imu_is_not_read_beside_odometry_unless_it_is_named(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", odometry=True)
    assert all(scan.T_level_base is None for scan in read(path)[0])
    assert all(scan.T_level_base is not None for scan in read(path, ReadConfig(imu="/imu/data"))[0])


def test_an_imu_whose_place_is_not_known_is_not_used(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", mounted=False)
    with open_log(path) as log:
        choice = log.choose()
    assert choice.imu_topic is None
    assert "/imu/data is not used: tf does not connect frame imu to base_link" in choice.reason
    with pytest.raises(FrameError, match="imu"):
        read(path, ReadConfig(imu="/imu/data"))
    with pytest.raises(TopicError, match=r"no imu topic /imu; there is: /imu/data"):
        read(path, ReadConfig(imu="/imu"))


def test_an_imu_that_cannot_be_decoded_costs_nothing_but_gravity(tmp_path: Path) -> None:
    to = ros()
    messages = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    messages += [to.cloud("/points", T0 + k * STEP, [[1.0, 2.0, 3.0]]) for k in range(5)]
    messages += [Message("/imu/data", "sensor_msgs/Imu", T0 + k * STEP, b"\0\1\0\0") for k in range(5)]
    scans, _ = read(write_mcap(tmp_path / "a.mcap", messages))
    assert [scan.T_level_base for scan in scans] == [None] * 5
