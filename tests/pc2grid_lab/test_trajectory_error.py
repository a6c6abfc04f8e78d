"""Trajectories compared with the truth: by hand."""

import numpy as np
import pytest

from pc2grid.geometry import SE2, pose_from_rotation_vector
from pc2grid.model import Health, Trajectory
from pc2grid_lab.truth import trajectory_error


def trajectory(poses, health=()):
    stamps = np.arange(len(poses)) * 100_000_000
    return Trajectory(stamps_ns=stamps, T_session_base=np.array(poses), health=health)


def bend(count=60):
    return [SE2(0.1 * k, 0.002 * k * k, 0.04 * k).lift() for k in range(count)]


def test_a_trajectory_anywhere_and_in_other_axes_has_no_error():
    moved = pose_from_rotation_vector((0.3, -0.2, 1.0), (5.0, 2.0, 1.0))
    optical = pose_from_rotation_vector((-1.2, 1.2, -1.2))
    error = trajectory_error(trajectory([moved @ T @ optical for T in bend()]), trajectory(bend()))
    assert error.poses == 60
    assert error.ate_m == pytest.approx(0, abs=1e-9)


def test_scale_is_an_error_by_hand():
    straight = [SE2(0.1 * k, 0.0, 0.0).lift() for k in range(41)]
    longer = [SE2(0.11 * k, 0.0, 0.0).lift() for k in range(41)]
    error = trajectory_error(trajectory(longer), trajectory(straight))
    assert error.ate_m == pytest.approx(0.01 * np.sqrt(np.mean((np.arange(41) - 20.0) ** 2)))


def test_lost_poses_are_not_judged_and_truth_is_interpolated_but_not_over_gaps():
    truth = trajectory(bend())
    wrong = bend()
    wrong[7] = SE2(9.0, 9.0, 0.0).lift()
    health = [Health.FINE] * 60
    health[7] = Health.LOST
    assert trajectory_error(trajectory(wrong, tuple(health)), truth).ate_m == pytest.approx(0, abs=1e-9)
    sparse = Trajectory(stamps_ns=truth.stamps_ns[::2], T_session_base=truth.T_session_base[::2])
    assert trajectory_error(truth, sparse).ate_m < 0.001
    assert trajectory_error(truth, sparse).poses == 59  # not past the end
    gap = Trajectory(stamps_ns=truth.stamps_ns[::20], T_session_base=truth.T_session_base[::20])
    assert trajectory_error(truth, gap).poses == 3
    assert trajectory_error(trajectory(bend(2)), truth) is None
