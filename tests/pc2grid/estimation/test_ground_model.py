"""The floor under a robot on wheels, and which sensors are on wheels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.estimation.ground_model import GroundModel, is_rolling
from pc2grid.estimation.spatial import Beginning, begin
from pc2grid.geometry import F64, pose_from_rotation_vector
from pc2grid.model import Scan
from pc2grid.simulate import SimulationConfig, iter_session
from pc2grid.simulate.config import LidarConfig


def hall() -> tuple[F64, F64]:
    """Points (N, 3) of the floor of a hall, 1 m below the sensor, and of its walls."""
    x, y = np.meshgrid(np.linspace(-6, 6, 80), np.linspace(-4, 4, 60))
    floor = np.column_stack((x.ravel(), y.ravel(), np.full(x.size, -1.0)))
    along, up = np.meshgrid(np.linspace(-6, 6, 80), np.linspace(-1, 2, 20))
    wall = np.column_stack((along.ravel(), np.full(along.size, 4.0), up.ravel()))
    end = np.column_stack((np.full(along.size, 6.0), along.ravel() * 4 / 6, up.ravel()))
    return floor, np.concatenate((wall, end))


def scan_of(points_m: F64, *, mounted_m: float) -> Scan:
    T_base_sensor = pose_from_rotation_vector(np.zeros(3), (0.0, 0.0, mounted_m))
    return Scan(
        stamp_ns=0,
        sensor="lidar",
        points_m=np.asarray(points_m, np.float32),
        T_base_sensor=T_base_sensor,
    )


def shaft(slope_deg: float) -> F64:
    """Points (N, 3) that a camera sees of the floor of a narrow shaft, which rises from x = 1.2 m on, and of
    its side walls."""
    x, across = np.meshgrid(np.linspace(0.7, 5.0, 80), np.linspace(-0.7, 0.7, 30))
    z = np.maximum(x - 1.2, 0.0) * math.tan(math.radians(slope_deg))
    floor = np.column_stack((x.ravel(), across.ravel(), z.ravel()))
    up = (across.ravel() + 0.7) * 1.2
    walls = [np.column_stack((x.ravel(), np.full(x.size, side), up)) for side in (-0.7, 0.7)]
    return np.concatenate((floor, *walls))


def test_the_floor_of_a_robot_on_wheels_does_not_follow_a_ramp_ahead() -> None:
    level, ramp = (scan_of(shaft(slope_deg), mounted_m=0.6) for slope_deg in (0.0, 4.8))
    ground = GroundModel.start(level.points_m, level)
    for scan, scans in ((level, 200), (ramp, 80)):  # before the ramp for eight seconds
        for _ in range(scans):
            ground.follow(scan.points_m, scan)
    assert ground.ground is not None
    assert math.acos(ground.ground.normal[2]) < math.radians(1.0)


@pytest.mark.parametrize(
    ("height_m", "pitch_deg", "rolling"),
    [
        (0.0, 0.0, True),
        (0.01, 0.0, True),  # base_link above base_footprint, TurtleBot3
        (0.0, 0.3, True),  # pitch of an EKF
        (0.01, 0.3, True),
        (0.02, 5.2, False),  # depth/room, room_a
        (0.33, 1.4, False),  # room_b
        (0.02, 0.84, False),
    ],
)
def test_a_base_that_is_a_little_off_its_footprint_is_on_wheels(
    height_m: float, pitch_deg: float, rolling: bool
) -> None:
    floor, walls = hall()
    points = np.concatenate((floor, walls)) + np.array((0.0, 0.0, 1.0 - height_m))
    T_odom_base = pose_from_rotation_vector((0.0, math.radians(pitch_deg), 0.0), (0.0, 0.0, height_m))
    scan = replace(scan_of(points, mounted_m=1.0 - height_m), T_odom_base=T_odom_base)
    assert is_rolling(scan) is rolling


def moved(scan: Scan, height_m: float, pitch_deg: float) -> Scan:
    """A scan whose odometry reports the base at a height and a pitch, as an EKF in three dimensions does."""
    assert scan.T_odom_base is not None
    tilted = pose_from_rotation_vector((0.0, math.radians(pitch_deg), 0.0), (0.0, 0.0, height_m))
    return replace(scan, T_odom_base=scan.T_odom_base @ tilted)


@pytest.mark.parametrize(
    ("height_m", "pitch_deg", "carried"),
    [
        (lambda k: 0.25, lambda k: 0.0, False),  # base_link stands high above base_footprint
        (lambda k: 0.01, lambda k: 0.3 * math.sin(k), False),  # pitch of an EKF
        (lambda k: 0.01, lambda k: 0.0 if k < 5 else 4.0, True),  # a hand that begins level
        (lambda k: 0.02 * k, lambda k: 0.0, True),  # and one that lifts the sensor
        (lambda k: 0.0, lambda k: 0.0 if k < 30 else 7.0, False),  # a ramp after some seconds
    ],
)
@pytest.mark.parametrize("standing", [0, 40])
def test_the_scans_of_the_first_metres_decide_whether_a_robot_is_on_wheels(
    standing: int,
    height_m: Callable[[int], float],
    pitch_deg: Callable[[int], float],
    carried: bool,
) -> None:
    small = LidarConfig(rate_hz=5.0, columns=300)
    config = SimulationConfig(length_m=4.0, seed=3, clutter=0, lidar=small)
    driven = [scan for scan, _ in iter_session(sensor="lidar", config=config)]
    scans = [moved(scan, height_m(k), pitch_deg(k)) for k, scan in enumerate(driven)]
    assert len(scans) > 35
    beginning = begin(iter([scans[0]] * standing + scans))
    assert beginning.in_hand == carried
    assert len(beginning.scans) < standing + 35


def test_a_robot_that_stands_is_not_waited_for_longer_than_some_seconds() -> None:
    floor, walls = hall()
    scan = replace(scan_of(np.concatenate((floor, walls)), mounted_m=1.0), T_odom_base=np.eye(4))
    standing = [replace(scan, stamp_ns=k * 500_000_000) for k in range(60)]
    beginning = begin(iter(standing))
    assert not beginning.in_hand and len(beginning.scans) == 12


def test_a_laser_and_a_tilted_sensor_are_known_from_their_first_scan() -> None:
    floor, walls = hall()
    scan = replace(scan_of(np.concatenate((floor, walls)), mounted_m=1.0), T_odom_base=np.eye(4))
    laser = replace(scan, sensor="laser")
    assert begin(iter([laser] * 9)) == Beginning([laser])
    tilted = moved(scan, 0.0, 5.0)
    assert begin(iter([tilted] * 9)) == Beginning([tilted], in_hand=True)
