"""What KISS-ICP is given."""

from __future__ import annotations

import numpy as np

from pc2grid.config import RegistrationConfig
from pc2grid.estimation.registration import KissRegistration
from pc2grid.geometry import pose_from_rotation_vector


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
    for icp in ("kiss-icp", "none"):
        registration = KissRegistration(RegistrationConfig(icp=icp))
        registration.add(walls, np.eye(4))
        found.append(registration.register(walls, guess))
    assert np.abs(found[0] - np.eye(4)).max() < 0.05
    assert np.array_equal(found[1], guess)
