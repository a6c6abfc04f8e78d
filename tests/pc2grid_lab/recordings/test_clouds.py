"""The truth of two recordings of one room, by their clouds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import F64, SE2, transform_points
from pc2grid_lab.truth import registered_clouds


def room(*, closet: bool, seed: int) -> F64:
    """Points (N, 3) of the floor and the walls of a room of 5 x 4 m, and of a closet; 1 cm of noise."""
    rng = np.random.default_rng(seed)

    def face(low: tuple[float, float, float], high: tuple[float, float, float]) -> F64:
        sides = np.subtract(high, low)
        area_m2 = np.prod(sides[sides > 0.0])
        return rng.uniform(low, high, (int(100 * area_m2), 3))

    faces = [face((0, 0, 0), (5, 4, 0))]
    faces += [face((x, 0, 0), (x, 4, 2)) for x in (0, 5)] + [face((0, y, 0), (5, y, 2)) for y in (0, 4)]
    if closet:
        faces += [face((3, 0, 0), (3, 2, 2)), face((0, 2, 0), (3, 2, 2))]
    points = np.concatenate(faces)
    return np.asarray(points + 0.01 * rng.standard_normal(points.shape))


def test_two_clouds_of_a_room_are_laid_onto_each_other() -> None:
    """The frames are turned by 100 degrees; the closet tells which of two places that fit is right."""
    T = SE2(-1.3, 2.1, math.radians(100.0))
    lifted = T.lift()
    lifted[2, 3] = 0.4
    target = transform_points(lifted, room(closet=True, seed=0))
    found = registered_clouds(room(closet=True, seed=1), target)
    assert found is not None
    assert math.hypot(found.x - T.x, found.y - T.y) < 0.02  # twice the noise
    assert found.yaw == pytest.approx(T.yaw, abs=0.01)
    back = registered_clouds(target, room(closet=True, seed=1))
    assert back is not None
    again = back @ found
    # The same candidates both ways; of two that differ by where ICP stopped, either may be the best.
    assert (again.x, again.y, again.yaw) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


def test_a_room_that_fits_turned_round_tells_nothing() -> None:
    assert registered_clouds(room(closet=False, seed=1), room(closet=False, seed=0)) is None
