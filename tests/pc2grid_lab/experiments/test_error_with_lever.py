"""A camera that is carried in a curl, judged by the poses of a marker that is fixed to it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pc2grid.arrays import F64
from pc2grid.model import Health, Trajectory
from pc2grid_lab.experiments.trajectory_error import error_with_lever, trajectory_error

LEVER_M = np.array([0.05, -0.02, 0.08])


def trajectory(poses: F64) -> Trajectory:
    stamps_ns = np.arange(len(poses), dtype=np.int64) * 100_000_000
    return Trajectory(stamps_ns=stamps_ns, T_session_base=poses, health=(Health.FINE,) * len(poses))


def curl() -> F64:
    """Poses (60, 4, 4) that turn about all axes."""
    t = np.linspace(0.0, 2.0, 60)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler(
        "xyz", np.column_stack((np.sin(3 * t), np.cos(2 * t), t))
    ).as_matrix()
    poses[:, :3, 3] = np.column_stack((t, np.sin(t), 0.2 * np.cos(4 * t)))
    return poses


def test_a_lever_is_found_and_is_no_error() -> None:
    camera, marker = curl(), curl()
    marker[:, :3, 3] += camera[:, :3, :3] @ LEVER_M
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = Rotation.from_euler("z", 0.7).as_matrix(), (3.0, -1.0, 0.5)
    error_m, lever_m = error_with_lever(trajectory(camera), trajectory(world @ marker))
    assert lever_m == pytest.approx(LEVER_M, abs=1e-5)
    assert error_m < 1e-5
    assert trajectory_error(trajectory(camera), trajectory(world @ marker)).ate_m > 0.03


def test_an_error_that_is_no_lever_remains() -> None:
    camera, bent = curl(), curl()
    bent[:, 0, 3] += 0.1 * np.linspace(-1.0, 1.0, len(bent)) ** 2
    before = trajectory_error(trajectory(camera), trajectory(bent)).ate_m
    after, _ = error_with_lever(trajectory(camera), trajectory(bent))
    assert 0.3 * before < after <= before
