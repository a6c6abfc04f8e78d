"""Walls show which way is up."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.clouds.ground import CAMERA_UPRIGHT, vertical_of

UP = np.array([0.0, 0.0, 1.0])


def room(tilt_rad: float, *, rng: np.random.Generator) -> np.ndarray:
    """What a lidar sees in a room of 6 x 4 m, in the frame of a base that is pitched up."""
    bearing, up = np.meshgrid(np.radians(np.arange(-180, 180, 1.0)), np.radians(np.linspace(-15, 15, 16)))
    beams = np.stack((np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)), axis=-1)
    beams = beams.reshape(-1, 3)
    c, s = math.cos(tilt_rad), math.sin(tilt_rad)
    level = beams @ np.array([(c, 0, -s), (0, 1, 0), (s, 0, c)]).T
    with np.errstate(divide="ignore"):
        away_m = np.minimum(3.0 / np.abs(level[:, 0]), 2.0 / np.abs(level[:, 1]))
    return beams * (away_m + rng.normal(0.0, 0.02, len(beams)))[:, None]


@pytest.mark.parametrize("tilt_deg", [-20.0, -4.8, 0.0, 4.8, 30.0])
def test_walls_show_the_tilt_of_the_base(tilt_deg: float) -> None:
    points = room(math.radians(tilt_deg), rng=np.random.default_rng(1))
    vertical = vertical_of(points, UP)
    assert vertical is not None
    assert math.degrees(math.asin(vertical[0])) == pytest.approx(tilt_deg, abs=0.7)
    assert abs(math.degrees(math.asin(vertical[1]))) < 0.7


def test_a_single_wall_does_not_show_it() -> None:
    y, z = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(0, 2, 20))
    assert vertical_of(np.column_stack((np.full(y.size, 2.0), y.ravel(), z.ravel())), UP) is None


def test_a_camera_sees_the_pitch_by_a_single_wall_ahead() -> None:
    rng = np.random.default_rng(1)
    pitch = math.radians(20.0)
    y, z = np.meshgrid(np.linspace(-1.5, 1.5, 80), np.linspace(-0.5, 1.5, 60))
    wall = np.column_stack((np.full(y.size, 2.0), y.ravel(), z.ravel())) + rng.normal(0, 0.005, (y.size, 3))
    c, s = math.cos(pitch), math.sin(pitch)
    points = wall @ np.array([(c, 0, -s), (0, 1, 0), (s, 0, c)])
    assert vertical_of(points, UP) is None
    vertical = vertical_of(points, UP, CAMERA_UPRIGHT)
    assert vertical is not None
    assert math.degrees(math.asin(vertical[0])) == pytest.approx(20.0, abs=0.5)
    beside = points[:, [1, 0, 2]] * (1.0, -1.0, 1.0)  # a wall along the way shows no pitch
    assert vertical_of(beside, UP, CAMERA_UPRIGHT) is None
