"""The weight of wheel odometry depends on its errors so far."""

import numpy as np
import pytest

from pc2grid.geometry import SE2, invert_pose, pose_from_rotation_vector, rotation_vector
from pc2grid.odometry.wheel_odometry import OdometryTrust, motion_size


def drive(scale, turn_error_rpm, metres=12.0, sure=lambda k: True):
    trust = OdometryTrust()
    reported, true = SE2(), SE2()
    for k in range(round(metres / 0.1)):
        trust.observe(reported.lift(), true.lift(), sure(k))
        reported = reported @ SE2(0.1 * scale, 0.0, 0.01 + 0.1 * turn_error_rpm)
        true = true @ SE2(0.1, 0.0, 0.01)
    return trust


def test_good_odometry_gets_weight_and_bad_odometry_little():
    assert drive(1.0, 0.0, metres=1.0).doubt == 1.0  # nothing is known yet
    assert drive(1.01, 0.0).doubt == 0.25
    assert 0.25 < drive(1.03, 0.02).doubt < 0.9
    assert drive(1.0, 0.08).doubt == 1.0
    assert drive(-1.0, 0.0).doubt == 1.0


def test_uncertain_poses_are_not_compared():
    assert drive(1.0, 0.0, sure=lambda k: k % 10).doubt == 1.0


def test_information_is_of_the_motion_that_odometry_reports():
    trust = OdometryTrust()
    short = np.linalg.inv(trust.information(SE2(0.05, 0.0, 0.0).lift()))
    far = np.linalg.inv(trust.information(SE2(0.5, 0.0, 0.0).lift()))
    assert np.sqrt(short[0, 0]) == pytest.approx(0.015) and np.sqrt(far[0, 0]) == pytest.approx(0.06)
    assert np.sqrt(far[2, 2]) == pytest.approx(0.06)
    information = np.linalg.inv(drive(1.0, 0.0).information(SE2(0.5, 0.0, 0.0).lift()))
    assert np.sqrt(information[0, 0]) == pytest.approx(0.015)


def test_where_the_odometry_frame_lies_does_not_matter():
    trust = OdometryTrust()
    frame = SE2(30.0, -4.0, 2.0).lift()
    for k in range(120):
        pose = SE2(0.1 * k, 0.0, 0.0).lift()
        trust.observe(invert_pose(frame) @ pose, pose, True)
    assert trust.doubt == 0.25


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 2.0, np.pi])
def test_the_size_of_a_motion_is_its_distance_and_its_angle(angle):
    motion = pose_from_rotation_vector(angle * np.array([0.6, 0.0, 0.8]), (1.0, 2.0, -2.0))
    assert motion_size(motion) == pytest.approx((3.0, np.linalg.norm(rotation_vector(motion))), abs=1e-12)
    assert motion_size(motion)[1] == pytest.approx(angle)
