"""The pose graph: a loop that is rejected leaves the poses alone."""

from __future__ import annotations

import itertools
import math
from statistics import median

import numpy as np

from pc2grid.geometry import F64, SE2
from pc2grid.mapping.graph import Edge, optimise

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
