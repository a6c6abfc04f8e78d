"""The pose graph: a loop that is rejected leaves the poses alone."""

import dataclasses
import itertools
import math
from statistics import median

import numpy as np
import pytest

from pc2grid.geometry import F64, SE2, wrap_angle
from pc2grid.model import Health, SessionMap, Trajectory
from pc2grid.settings import ProjectionConfig
from signature.session.graph import Edge, WallDirection, optimise
from signature.session.keyframes import Keyframe, Keyframes, Track
from signature.session.loops import LOOPS
from signature.session.part_maps import (
    OptimisedKeyframes,
    draw_parts,
    floor_warning,
    floors_apart_m,
    optimised_heights,
)
from signature.session.quality import position_sigmas
from tests.helpers.simulated_drives import flat_scan

POSES, TRUE_LOOPS, FALSE_LOOPS = 400, 90, 60
STEP_M, HALF_WIDTH_M = 2.0, 20.0
STEP_SIGMAS = np.array((0.1, 0.1, math.radians(1.0)))
LOOP_SIGMAS = np.array((0.3, 0.3, math.radians(4.0)))


def manhattan(rng: np.random.Generator) -> list[SE2]:
    """A drive along the streets of a square town, whose blocks are two metres wide."""
    poses = [SE2()]
    while len(poses) < POSES:
        turns = rng.permutation([0.0, 0.0, 0.0, 1.0, -1.0]).tolist()
        ahead = (poses[-1] @ SE2(0.0, 0.0, turn * math.pi / 2) @ SE2(STEP_M) for turn in (*turns, 2.0))
        poses.append(next(p for p in ahead if max(abs(p.x), abs(p.y)) <= HALF_WIDTH_M))
    return poses


def measured(rng: np.random.Generator, T: SE2, sigmas: F64) -> SE2:
    return T @ SE2(*(rng.normal(size=3) * sigmas).tolist())


def town(seed: int) -> tuple[list[SE2], list[Edge], list[Edge], list[Edge]]:
    """The true poses, the steps, true loops where a crossing is met again, and false ones anywhere."""
    rng = np.random.default_rng(seed)
    truth = manhattan(rng)
    of_step, of_loop = np.diag(STEP_SIGMAS**-2), np.diag(LOOP_SIGMAS**-2)
    steps = [
        Edge(k, k + 1, measured(rng, a.inverse() @ b, STEP_SIGMAS), of_step)
        for k, (a, b) in enumerate(itertools.pairwise(truth))
    ]
    met = [
        (i, j)
        for i, j in itertools.combinations(range(POSES), 2)
        if j - i > 20 and math.hypot(truth[i].x - truth[j].x, truth[i].y - truth[j].y) < 0.5 * STEP_M
    ]
    chosen = rng.choice(len(met), TRUE_LOOPS, replace=False).tolist()
    true = [
        Edge(i, j, measured(rng, truth[i].inverse() @ truth[j], LOOP_SIGMAS), of_loop, loop=True)
        for i, j in (met[k] for k in chosen)
    ]
    false = []
    for _ in range(FALSE_LOOPS):
        i, j = sorted(rng.choice(POSES, 2, replace=False).tolist())
        anywhere = SE2(*rng.normal(size=2).tolist(), rng.uniform(-math.pi, math.pi))
        false.append(Edge(i, j, anywhere, of_loop, loop=True))
    return truth, steps, true, false


def array(poses: list[SE2]) -> F64:
    return np.array([(p.x, p.y, p.yaw) for p in poses])


def rmse_m(poses: F64, truth: list[SE2]) -> float:
    true_m = array(truth)[:, :2]
    off_m = SE2.fit(poses[:, :2], true_m).apply(poses[:, :2]) - true_m
    return float(np.sqrt(np.square(off_m).sum(axis=1).mean()))


def test_sixty_false_loops_of_150_leave_a_map_as_exact_as_without_them() -> None:
    """With Cauchy weights alone, the false loops, each of them found, make the error 1.4 times as large."""
    errors = []
    for seed in range(10):
        truth, steps, true, false = town(seed)
        tracked = list(itertools.accumulate((e.T_first_second for e in steps), SE2.__matmul__, initial=SE2()))
        solved = [optimise(array(tracked), [*steps, *true, *more]) for more in ([], false)]
        assert not solved[1].accepted[-FALSE_LOOPS:].any()
        errors.append([rmse_m(poses, truth) for poses in (array(tracked), *(s.poses for s in solved))])
    assert median(as_tracked_m / by_true_m for as_tracked_m, by_true_m, _ in errors) > 4.0
    assert abs(median(with_false_m / by_true_m for _, by_true_m, with_false_m in errors) - 1.0) < 0.005
    _, by_true_m, with_false_m = map(median, zip(*errors, strict=True))
    assert abs(with_false_m / by_true_m - 1.0) < 0.01


def test_poses_do_not_hang_on_a_loop_at_the_edge_of_being_rejected() -> None:
    """A loop that contradicts a chain more and more: each millimetre moves the poses by less than four."""
    steps = [Edge(k, k + 1, SE2(1.0), np.diag([1e4, 1e4, 1e4])) for k in range(4)]
    start = array([SE2(float(k)) for k in range(5)])

    def end_m(off_m: float) -> tuple[float, bool]:
        loop = Edge(0, 4, SE2(4.0 + off_m), np.diag([1e4, 1e4, 1e4]), loop=True)
        solution = optimise(start, [*steps, loop])
        return float(solution.poses[-1, 0]), bool(solution.accepted[-1])

    ends_m, accepted = zip(*(end_m(0.001 * k) for k in range(1000)), strict=True)
    assert accepted[0] and not accepted[-1]
    assert np.abs(np.diff(ends_m)).max() < 0.004
    assert abs(ends_m[-1] - 4.0) < 0.01


# --- The axes of a building hold the headings where no loop does, and only where the walls are right-
# angled ---


AXES_STEP_M = 4.0
STEP_INFORMATION = LOOPS.tracked_information(AXES_STEP_M, restart=False)


def corridor(headings_rad: list[float]) -> np.ndarray:
    """Poses (N, 3) of a drive with these headings, 4 m from pose to pose."""
    poses = [(0.0, 0.0, headings_rad[0])]
    for heading in headings_rad[1:]:
        x, y, yaw = poses[-1]
        poses.append((x + AXES_STEP_M * math.cos(yaw), y + AXES_STEP_M * math.sin(yaw), heading))
    return np.array(poses)


def tracked(truth: np.ndarray, error_rad: np.ndarray) -> tuple[np.ndarray, list[Edge]]:
    """The poses and steps of a drive whose tracking turns by `error_rad` (N - 1,) too much in each step."""
    poses = [SE2(*truth[0])]
    edges = []
    for k, turned in enumerate(error_rad):
        step = SE2(*truth[k]).inverse() @ SE2(*truth[k + 1])
        step = SE2(step.x, step.y, step.yaw + turned)
        poses.append(poses[-1] @ step)
        edges.append(Edge(k, k + 1, step, STEP_INFORMATION))
    return np.array([(p.x, p.y, p.yaw) for p in poses]), edges


def walls_seen(truth: np.ndarray, wall_rad: np.ndarray | float) -> list[WallDirection]:
    """What drives past walls with these directions (N,) in the world show in the frame of each pose."""
    right = math.pi / 2
    seen = (wall_rad - truth[:, 2] + right / 2) % right - right / 2
    noise = np.random.default_rng(1).normal(0.0, math.radians(0.8), len(truth))
    return [WallDirection(float(angle), 0.8) for angle in seen + noise]


def off(poses: np.ndarray, truth: np.ndarray) -> float:
    """RMS distance in metres after the poses were placed on the truth."""
    placed = SE2.fit(poses[:, :2], truth[:, :2]).apply(poses[:, :2])
    return float(np.sqrt(((placed - truth[:, :2]) ** 2).sum(axis=1).mean()))


DRIFT_RAD = np.random.default_rng(3).normal(0.0, math.radians(0.3), 99)
"""What loop closure expects of tracking: 3 degrees after 99 steps."""
TURNING = [0.0] * 50 + [math.pi / 2] * 50


@pytest.mark.parametrize("building_rad", [0.0, 0.7])
def test_axes_straighten_a_drive_without_loops(building_rad: float) -> None:
    truth = corridor([heading + building_rad for heading in TURNING])
    poses, edges = tracked(truth, DRIFT_RAD)
    held = optimise(poses, edges, walls_seen(truth, building_rad)).poses
    assert np.allclose(optimise(poses, edges).poses, poses)
    assert off(held, truth) < 0.5 * off(poses, truth)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_walls_in_any_direction_leave_a_drive_as_it_is(seed: int) -> None:
    truth = corridor(TURNING)
    poses, edges = tracked(truth, np.zeros(len(truth) - 1))
    anyhow = np.random.default_rng(seed).uniform(0.0, math.pi / 2, len(truth))
    held = optimise(poses, edges, walls_seen(truth, anyhow)).poses
    assert off(held, truth) < 0.2 * off(tracked(truth, DRIFT_RAD)[0], truth)


def test_a_wing_at_another_angle_keeps_it() -> None:
    skew = math.radians(8.0)
    truth = corridor([0.0] * 30 + [skew] * 20)
    poses, edges = tracked(truth, np.zeros(len(truth) - 1))
    wall = np.array([0.0] * 30 + [skew] * 20)
    held = optimise(poses, edges, walls_seen(truth, wall)).poses
    turned = wrap_angle(held[35:, 2].mean() - held[:25, 2].mean())
    assert turned == pytest.approx(skew, abs=math.radians(1.0))


def test_a_heading_that_the_axes_hold_is_stated_to_be_more_precise() -> None:
    truth = corridor(TURNING)
    _, edges = tracked(truth, np.zeros(len(truth) - 1))
    alone = position_sigmas(truth, edges)
    held = position_sigmas(truth, edges, walls_seen(truth, 0.0))
    assert held.max() < 0.7 * alone.max()


# --- One recording is one floor: the heights of its keyframes ---


COUNT, FLOOR_STEP_M, HAND_M = 200, 0.2, 1.4
"""Keyframes of a way of 40 m that goes up a corridor and back; the sensor is so high above the floor."""
WAY_M = FLOOR_STEP_M * np.arange(COUNT)
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
    assert floors_apart_m(TRACKED_M, seen) == pytest.approx(0.36, abs=0.04)


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


def test_where_tracking_was_lost_the_height_begins_anew() -> None:
    tracked = TRACKED_M + np.where(np.arange(COUNT) < 100, 0.0, 0.8)
    assert off_m(optimised_heights(tracked, WAY_M, seen_floor(), np.array([100]))) < 0.03


def map_of(tracked_m: F64, above_floor_m: F64) -> SessionMap:
    """The map of keyframes on the way, with a wall on either side."""
    keyframes = Keyframes()
    scan = flat_scan([(0.0, 1.0), (0.0, -1.0)], 0.5)
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
    assert floor_warning(None, 0.2) is None
