"""One recording is one floor: the heights of its keyframes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import BEARINGS, PlanarScan
from pc2grid.geometry import F64, SE2
from pc2grid.mapping.graph import (
    HeightStep,
    floor_warning,
    floors_apart_m,
    optimised_heights,
    rise_between,
)
from pc2grid.mapping.keyframes import Keyframe, Keyframes, Track
from pc2grid.mapping.part_maps import OptimisedKeyframes, draw_parts
from pc2grid.model import Health, SessionMap, Trajectory
from pc2grid.settings import ProjectionConfig

COUNT, STEP_M, HAND_M = 200, 0.2, 1.4
"""Keyframes of a way of 40 m that goes up a corridor and back; the sensor is so high above the floor."""
WAY_M = STEP_M * np.arange(COUNT)
SWAY_M = 0.05 * np.sin(WAY_M)
TRACKED_M = SWAY_M + 0.01 * WAY_M  # rises by a percent of the way: the passes differ by up to 0.4 m
NO_RESTART = np.empty(0, np.int64)


def seen_floor(every: int = 1) -> F64:
    """How high the keyframes see themselves above the floor, 2 cm of noise; NaN but for one of `every`."""
    noise = 0.02 * np.random.default_rng(0).standard_normal(COUNT)
    return np.where(np.arange(COUNT) % every == 0, HAND_M + SWAY_M + noise, np.nan)


def off_m(heights_m: F64) -> float:
    """The largest error of the heights."""
    return float(np.abs(heights_m - HAND_M - SWAY_M).max())


def test_the_floor_pins_the_height_and_nothing_else_does() -> None:
    seen = seen_floor()
    assert off_m(optimised_heights(TRACKED_M, WAY_M, seen, NO_RESTART)) < 0.03
    nothing = optimised_heights(TRACKED_M, WAY_M, np.full(COUNT, np.nan), NO_RESTART)
    assert floors_apart_m(nothing, seen) == pytest.approx(0.36, abs=0.04)
    assert nothing == pytest.approx(TRACKED_M, abs=1e-6)


def test_floors_of_other_keyframes_pin_nothing() -> None:
    """The control: where a hand rises and sinks, heights that are shuffled contradict the steps."""
    seen = seen_floor()
    shuffled = np.random.default_rng(1).permutation(seen)
    right, wrong = (optimised_heights(TRACKED_M, WAY_M, of, NO_RESTART) for of in (seen, shuffled))
    assert off_m(wrong) > 2.0 * off_m(right)


def test_a_floor_that_is_seen_now_and_then_is_enough_and_a_table_is_no_floor() -> None:
    seen = seen_floor(every=10)
    seen[60:64], seen[130:133] = 0.7, 0.66
    assert off_m(optimised_heights(TRACKED_M, WAY_M, seen, NO_RESTART)) < 0.06


def test_loops_hold_the_height_where_no_floor_is_seen() -> None:
    """The floor is seen at the start only. The way back passes what was seen on the way there."""
    seen = np.where(np.arange(COUNT) < 10, seen_floor(), np.nan)
    loops = [HeightStep(k, COUNT - 1 - k, SWAY_M[COUNT - 1 - k] - SWAY_M[k], 0.03) for k in range(0, 100, 10)]
    alone = optimised_heights(TRACKED_M, WAY_M, seen, NO_RESTART)
    closed = optimised_heights(TRACKED_M, WAY_M, seen, NO_RESTART, loops)
    assert abs(alone[-1] - HAND_M - SWAY_M[-1]) > 0.3
    assert abs(closed[-1] - HAND_M - SWAY_M[-1]) < 0.05
    false = [*loops, HeightStep(0, COUNT - 1, 0.5, 0.03)]
    assert optimised_heights(TRACKED_M, WAY_M, seen, NO_RESTART, false) == pytest.approx(closed, abs=0.03)


def test_where_tracking_was_lost_the_height_begins_anew() -> None:
    tracked = TRACKED_M + np.where(np.arange(COUNT) < 100, 0.0, 0.8)
    assert off_m(optimised_heights(tracked, WAY_M, seen_floor(), np.array([100]))) < 0.03


def surfaces(rise_m: float, seed: int) -> F64:
    """A floor, a table and a wall that were seen, 1 cm of noise."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack((rng.uniform(0.0, 3.0, (4000, 2)), np.zeros(4000)))
    table = np.column_stack((rng.uniform(1.0, 2.0, (800, 2)), np.full(800, 0.72)))
    wall = np.column_stack((np.full(3000, 3.0), rng.uniform((0.0, 0.0), (3.0, 2.5), (3000, 2))))
    points = np.concatenate((floor, table, wall)) + np.array((0.0, 0.0, rise_m))
    return points + 0.01 * rng.standard_normal(points.shape)


@pytest.mark.parametrize("rise_m", [-0.37, 0.0, 0.05, 0.31])
def test_level_surfaces_tell_how_much_higher_one_pass_lies(rise_m: float) -> None:
    assert rise_between(surfaces(rise_m, 1), surfaces(0.0, 2)) == pytest.approx(rise_m, abs=0.02)


def test_walls_alone_tell_no_height() -> None:
    walls = [points[points[:, 0] > 2.9] for points in (surfaces(0.2, 1), surfaces(0.0, 2))]
    assert rise_between(*walls) is None
    assert rise_between(walls[0], walls[1] + (5.0, 0.0, 0.0)) is None


def map_of(tracked_m: F64, above_floor_m: F64) -> SessionMap:
    """The map of keyframes on the way, with a wall on either side."""
    keyframes = Keyframes()
    sides = np.array([(0.0, 1.0), (0.0, -1.0)], np.float32)
    scan = PlanarScan.of_hits(
        stamp_ns=0, hits_m=sides, origin_m=np.zeros(2), free_m=np.full(BEARINGS, 0.5, np.float32)
    )
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, 0, 3] = np.abs(WAY_M - WAY_M[COUNT // 2])
    poses[:, 2, 3] = tracked_m - tracked_m[0]
    for k, above_m in enumerate(above_floor_m.tolist()):
        seen = dataclasses.replace(scan, above_floor_m=None if np.isnan(above_m) else above_m)
        keyframes.append(Keyframe(k, seen, SE2.from_matrix(poses[k])))
    trajectory = Trajectory(stamps_ns=np.arange(COUNT), T_session_base=poses, health=(Health.FINE,) * COUNT)
    together, none = np.zeros(COUNT, np.int64), np.empty(0, np.int64)
    planar = np.column_stack((poses[:, :2, 3], np.zeros(COUNT)))
    closed = OptimisedKeyframes(
        np.arange(COUNT), planar, (), segments=together, parts=together, anchors=none, sigma_m=np.empty(0)
    )
    track = Track(trajectory, [None] * COUNT, np.full((COUNT, 4, 4), np.nan))
    (drawn,) = draw_parts(keyframes, track, closed, ProjectionConfig())
    return drawn


def test_both_passes_of_a_map_stand_on_one_floor() -> None:
    z_m = map_of(TRACKED_M, seen_floor()).trajectory.T_session_base[:, 2, 3]
    assert z_m[0] == 0.0
    assert np.ptp(z_m - SWAY_M) < 0.04
    unpinned = map_of(TRACKED_M, np.full(COUNT, np.nan)).trajectory.T_session_base[:, 2, 3]
    assert np.array_equal(unpinned, TRACKED_M - TRACKED_M[0])


def test_floors_that_lie_apart_are_told() -> None:
    """Two levels, 0.3 m apart, are seen in turn."""
    seen = seen_floor()
    two = np.where(np.arange(COUNT) % 3 == 0, seen - 0.3, seen)
    (said,) = [text for text in map_of(TRACKED_M, two).report.warnings if "floor" in text]
    assert "over 0.3" in said and "--start" in said
    assert not [text for text in map_of(TRACKED_M, seen).report.warnings if "floor" in text]
    assert floor_warning(None) is None
