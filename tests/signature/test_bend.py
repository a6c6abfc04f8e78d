"""A rigid motion that varies over a map."""

import math

import numpy as np
import pytest

from pc2grid.geometry import SE2
from signature.database.protocol import BuildingFrame, Deformation, largest_m, motions

ARC: Deformation = tuple(
    (x, 0.0, 0.0, -0.002 * x * x / 2, -0.002 * x) for x in np.arange(0.0, 41.0, 4.0).tolist()
)
"""A corridor of 40 m that was drawn as an arc: its heading was 0.002 rad off for each metre."""


def bent(bend: Deformation) -> BuildingFrame:
    """A session that is bent where it was drawn."""
    return BuildingFrame(name="x", T_building_session=SE2(), covariance=((0.0,) * 3,) * 3, bend=bend)  # type: ignore[arg-type]


def test_a_map_without_a_bend_stays_as_it_is() -> None:
    points_m = np.array([(1.0, 2.0), (-30.0, 7.0)])
    assert not motions((), points_m).any() and largest_m(()) == 0.0
    assert (bent(()).apply(points_m) == points_m).all() and (bent(()).to_session(points_m) == points_m).all()
    assert bent(ARC).apply(np.empty((0, 2))).shape == (0, 2)


def test_one_place_moves_the_map_as_a_rigid_body() -> None:
    """A quarter turn about (1, 0), which lies at (1, 1) then. The motion of a place is linear in its turn:
    for so large a one a point is moved along the tangent."""
    motion = motions(((1.0, 0.0, 0.0, 1.0, math.pi / 2),), np.array([(1.0, 0.0), (3.0, 0.0)]))
    assert motion.tolist() == pytest.approx(
        np.array([(0.0, 1.0, math.pi / 2), (0.0, 1.0 + math.pi, math.pi / 2)]), abs=1e-12
    )


def test_between_places_a_bend_is_smooth_and_beyond_them_it_goes_on() -> None:
    walls_m = np.column_stack((np.linspace(-5.0, 45.0, 501), np.tile((-1.0, 1.0, 0.0), 167)))
    moved = motions(ARC, walls_m)
    steps = np.abs(np.diff(moved[2::3], axis=0))
    # A step of 0.3 m in a bend that is nowhere steeper than 0.1: no jumps where other places become near.
    assert steps[:, :2].max() < 0.04 and steps[:, 2].max() < 0.003
    assert moved[0, 2] == pytest.approx(0.0, abs=0.004) and moved[-1, 2] == pytest.approx(-0.08, abs=0.004)


def test_what_is_straightened_is_found_where_it_was_drawn() -> None:
    rng = np.random.default_rng(0)
    points_m = rng.uniform((-5.0, -10.0), (45.0, 10.0), (1000, 2))
    # Three rounds, each of which leaves at most the slope of the bend, a tenth, of an error of 1.6 m.
    there_m = bent(ARC).apply(points_m)
    assert np.abs(bent(ARC).to_session(there_m) - points_m).max() < 1.6 * 0.1**3


def test_the_rigid_motion_around_a_point_brings_it_where_the_bend_does() -> None:
    points_m = np.array([(10.0, 1.0), (35.0, -2.0)])
    there = [T.apply(p[None])[0] for T, p in zip(bent(ARC).around(points_m), points_m, strict=True)]
    assert np.array(there) == pytest.approx(bent(ARC).apply(points_m), abs=1e-9)
    assert largest_m(ARC) == pytest.approx(1.6)
