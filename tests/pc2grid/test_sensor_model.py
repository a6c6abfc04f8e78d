"""The kinds of sensors, and what sets them apart."""

from __future__ import annotations

import math

import pytest

from pc2grid.sensor_model import SENSOR_MODELS


def test_the_noise_of_a_camera_reaches_a_voxel_at_some_range() -> None:
    camera = SENSOR_MODELS["depth"]
    range_m = camera.range_of_noise_m(0.05)
    assert camera.noise_per_m2 * range_m**2 == pytest.approx(0.05)
    assert math.isinf(SENSOR_MODELS["lidar"].range_of_noise_m(0.05))
