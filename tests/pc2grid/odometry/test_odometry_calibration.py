"""The systematic error of odometry is found by comparing it with poses, and taken out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.odometry.odometry_calibration import OdometryCalibration
from pc2grid.odometry.wheel_odometry import OdometryTrust

SCALE, DIRECTION, YAW_PER_M, TURN = 0.02, math.radians(0.6), math.radians(0.5), 0.03
STEP_M, WINDOW = 0.1, 20  # a window of 2 m, as in tracking


def true_step(reported: SE2) -> SE2:
    """The motion of a robot whose odometry reports another one."""
    d = (1.0 + SCALE) * SE2(0.0, 0.0, DIRECTION).apply(np.array([[reported.x, reported.y]]))[0]
    yaw = reported.yaw * (1.0 + TURN) + YAW_PER_M * math.hypot(reported.x, reported.y)
    return SE2(float(d[0]), float(d[1]), yaw)


def drive(
    calibration: OdometryCalibration, windows: int, *, noise_m: float = 0.002, wrong: bool = True
) -> None:
    """Show it windows of travel with turns; wrong : odometry has the systematic error of `true_step`."""
    rng = np.random.default_rng(3)
    for _ in range(windows):
        actual, turn = SE2(0.0, 0.0, 0.0), rng.normal(0.0, 0.03)
        for _ in range(WINDOW):
            reported = SE2(STEP_M, 0.0, float(turn))
            calibration.extend(reported.lift())
            actual = actual @ (true_step(reported) if wrong else reported)
        noise = SE2(*rng.normal(0.0, noise_m, 2).tolist(), rng.normal(0.0, noise_m))
        calibration.observe(actual @ noise, noise_m, noise_m)


def error_of(calibration: OdometryCalibration, reported: SE2) -> SE2:
    return true_step(reported).inverse() @ SE2.from_matrix(calibration.corrected(reported.lift()))


def test_the_systematic_error_is_found() -> None:
    calibration = OdometryCalibration()
    reported = SE2(1.0, 0.0, 0.3)
    before = error_of(calibration, reported)
    drive(calibration, 200)
    after = error_of(calibration, reported)
    assert math.hypot(after.x, after.y) < 0.1 * math.hypot(before.x, before.y)
    assert abs(after.yaw) < 0.1 * abs(before.yaw)


def test_exact_odometry_is_left_as_it_is() -> None:
    calibration = OdometryCalibration()
    assert calibration.corrected(SE2(1.0, 0.0, 0.3).lift()) == pytest.approx(SE2(1.0, 0.0, 0.3).lift())
    drive(calibration, 200, wrong=False)
    left = SE2(1.0, 0.0, 0.3).inverse() @ SE2.from_matrix(calibration.corrected(SE2(1.0, 0.0, 0.3).lift()))
    assert math.hypot(left.x, left.y) < 0.002 and abs(left.yaw) < 0.002


def test_wheels_that_slip_once_do_not_spoil_it() -> None:
    calibration = OdometryCalibration()
    drive(calibration, 100)
    settled = SE2.from_matrix(calibration.corrected(SE2(1.0, 0.0, 0.0).lift()))
    for _ in range(WINDOW):
        calibration.extend(SE2(STEP_M, 0.0, 0.0).lift())
    calibration.observe(SE2(0.5, 0.2, 0.8), 0.01, 0.01)
    slipped = settled.inverse() @ SE2.from_matrix(calibration.corrected(SE2(1.0, 0.0, 0.0).lift()))
    assert math.hypot(slipped.x, slipped.y) < 0.005 and abs(slipped.yaw) < 0.005


def test_tilt_and_height_stay() -> None:
    calibration = OdometryCalibration()
    drive(calibration, 50)
    motion = SE2(1.0, 0.0, 0.0).lift()
    motion[2, 3], (c, s) = 0.2, (math.cos(0.1), math.sin(0.1))
    motion[:3, :3] = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    corrected = calibration.corrected(motion)
    assert corrected[2, 3] == 0.2
    assert corrected[2, :3] == pytest.approx(motion[2, :3])
    assert corrected[:3, :3] @ corrected[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


def test_odometry_does_not_count_more_because_it_is_corrected() -> None:
    trust, wrong_rad = OdometryTrust(), math.radians(3.0) * STEP_M
    odometry, session = SE2(0.0, 0.0, 0.0), SE2(0.0, 0.0, 0.0)
    rng = np.random.default_rng(1)
    for _ in range(4000):
        step = SE2(STEP_M, 0.0, float(rng.normal(0.0, 0.05)))
        odometry, session = odometry @ step, session @ step @ SE2(0.0, 0.0, wrong_rad)
        trust.observe(odometry.lift(), session.lift(), True)
    corrected = SE2.from_matrix(trust.corrected(SE2(STEP_M, 0.0, 0.0).lift()))
    assert corrected.yaw == pytest.approx(wrong_rad, rel=0.2)
    # Unknown odometry would count 1, odometry that is right 0.25.
    assert trust.doubt > 0.5
