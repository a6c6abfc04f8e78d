"""What KISS-ICP is given."""

from __future__ import annotations

import math
import os
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from pc2grid.estimation.registration import KissRegistration
from pc2grid.geometry import pose_from_rotation_vector
from pc2grid.io import open_log
from pc2grid.model import Health
from pc2grid.pipeline import follow
from pc2grid.settings import Config, RegistrationConfig

ICP = Literal["kiss-icp", "none"]
DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).resolve().parents[3] / ".." / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="PC2GRID_DATA is not there")


def test_a_matrix_that_is_nearly_a_rotation_does_not_end_the_process() -> None:
    """Rounded to 9 digits, its product with its transpose differs from 1 by 1e-10: too much for KISS-ICP."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-6, -4, -1), (6, 4, 2), (4000, 3))
    points[np.arange(4000), np.abs(points / (6, 4, 2)).argmax(axis=1)] *= 1.2
    rounded = np.round(pose_from_rotation_vector((0.3, 0.2, 0.1), (0.01, 0.0, 0.0)), 9)
    registration = KissRegistration(RegistrationConfig())
    registration.add(points, rounded)
    for _ in range(2):
        pose = registration.register(points, rounded)
        registration.add(points, pose)
    assert np.abs(pose - rounded).max() < 0.05


def test_kiss_icp_brings_a_scan_near_and_the_control_leaves_it_where_it_was() -> None:
    walls = np.random.default_rng(1).uniform((-6, -4, -1), (6, 4, 2), (4000, 3))
    faces = np.abs(walls / (6, 4, 2)).argmax(axis=1)
    walls[np.arange(4000), faces] = np.sign(walls[np.arange(4000), faces]) * np.array((6, 4, 2))[faces]
    guess = pose_from_rotation_vector((0.0, 0.0, 0.15), (0.4, -0.3, 0.0))
    found = []
    icp: ICP
    for icp in ("kiss-icp", "none"):
        registration = KissRegistration(RegistrationConfig(icp=icp))
        registration.add(walls, np.eye(4))
        found.append(registration.register(walls, guess))
    assert np.abs(found[0] - np.eye(4)).max() < 0.05
    assert np.array_equal(found[1], guess)


@needs_data
def test_a_laser_without_odometry_does_not_stand_still_in_a_corridor() -> None:
    """With KISS-ICP as the only beginning it stays behind by 1.3 m, from 24 s on."""
    with open_log(DATA / "laser/hallway/hallway.mcap") as log:
        poses = np.array([r.T_session_base[:2, 3] for r, _ in follow(log.scans(0.0, 29.0))])
    assert math.dist(poses[0], poses[-1]) == pytest.approx(11.6, abs=0.3)


@needs_data
@pytest.mark.parametrize(("icp", "lost"), [("kiss-icp", 0), ("none", 6)])
def test_a_lidar_in_the_hand_with_scans_far_apart_is_followed_by_kiss_icp(icp: ICP, lost: int) -> None:
    """Every third scan of the hall, 12 in all. Without KISS-ICP most are lost."""
    config = Config(registration=RegistrationConfig(icp=icp))
    with open_log(DATA / "lidar/hall.mcap") as log:
        healths = [r.health for r, _ in follow(islice(log.scans(), 0, None, 3), config)]
    found = healths.count(Health.LOST)
    assert (found == 0) if not lost else (found >= lost)
