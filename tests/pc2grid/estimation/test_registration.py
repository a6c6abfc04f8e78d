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
    registration.register(points, rounded)
    registration.update_map(rounded)
    for _ in range(2):
        pose = registration.register(points, rounded)
        registration.update_map(rounded)
    assert np.abs(pose - rounded).max() < 0.05
