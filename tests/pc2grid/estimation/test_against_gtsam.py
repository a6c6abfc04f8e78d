"""The smoother against GTSAM: the same evidence, solved by another program, over all scans at once.

GTSAM is no dependency: `pip install gtsam` in an environment of its own, and these tests run; else they are
skipped. The robust weights are switched off on both sides, since GTSAM's stop at another optimum of a cost
with several; what remains, the factors, their derivatives, the marginalisation and the covariance, agree.
"""

import itertools

import numpy as np
import pytest

from pc2grid.estimation.smoother import PLANAR, SMOOTHER, PoseWithCovariance, Smoother
from pc2grid.geometry import F64, SE2

gtsam = pytest.importorskip("gtsam")
GAUSSIAN = SMOOTHER._replace(
    kernel=1e6, iterations=20, converged=1e-9,
    systematic=1e-9, direction_rad=1e-9, yaw_rad_per_m=1e-9,
)  # fmt: skip
MATCH = np.diag([0.05**-2, 0.02**-2, 0.01**-2])
SEEN_EVERY = 4  # of four scans one fits the map; odometry carries the others


def drive(scans: int = 40) -> tuple[list[SE2], list[SE2], dict[int, SE2]]:
    """True poses on a curve, readings of wheels that slip, and where some of the scans fit."""
    rng = np.random.default_rng(3)
    true, read = [SE2()], [SE2()]
    for _ in range(scans - 1):
        true.append(true[-1] @ SE2(0.1, 0.0, 0.05))
        dx, dy, turn = rng.normal(0.0, [0.01, 0.005, 0.01]).tolist()
        read.append(read[-1] @ SE2(0.1 + dx, dy, 0.05 + turn))
    noise = rng.normal(size=(scans, 3)) / np.sqrt(np.diag(MATCH))
    return true, read, {k: true[k] @ SE2(*noise[k].tolist()) for k in range(SEEN_EVERY, scans, SEEN_EVERY)}


def by_pc2grid(read: list[SE2], seen: dict[int, SE2]) -> PoseWithCovariance:
    """The last pose by the smoother, which forgets scans behind its lag."""
    smoother = Smoother(PLANAR, GAUSSIAN)
    smoother.start(np.eye(4), read[0].lift())
    for k in range(1, len(read)):
        match = (seen[k].lift(), MATCH) if k in seen else None
        guess = smoother.by_odometry(read[k].lift()).pose
        smoother.add(guess, 0.1, read[k].lift(), match=match)
    return smoother.belief


def by_gtsam(read: list[SE2], seen: dict[int, SE2]) -> tuple[F64, F64]:
    """The last pose x, y, yaw and its covariance, with the same factors over all scans."""
    p, graph, values = GAUSSIAN, gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas
    reading = noise(np.array([p.reading_m, p.reading_m, p.reading_rad]))
    poses, readings = (
        [gtsam.symbol("x", k) for k in range(len(read))],
        [gtsam.symbol("o", k) for k in range(len(read))],
    )
    for k, T in enumerate(read):
        measured = gtsam.Pose2(T.x, T.y, T.yaw)
        values.insert(poses[k], measured)
        values.insert(readings[k], measured)
        graph.add(gtsam.PriorFactorPose2(readings[k], measured, reading))
        if k in seen:
            at = gtsam.Pose2(seen[k].x, seen[k].y, seen[k].yaw)
            graph.add(gtsam.PriorFactorPose2(poses[k], at, gtsam.noiseModel.Gaussian.Information(MATCH)))
    graph.add(gtsam.PriorFactorPose2(poses[0], gtsam.Pose2(), noise(np.full(3, 1e-4))))
    for a, b in itertools.pairwise(range(len(read))):
        step = read[a].inverse() @ read[b]
        distance_m, turn_rad = float(np.hypot(step.x, step.y)), abs(step.yaw)
        drift_m = np.sqrt(p.drift**2 * distance_m + p.drift_turn_m**2 * turn_rad + 1e-6)
        drift_rad = np.sqrt(p.drift**2 * (turn_rad + distance_m) + 1e-6)
        keys = [poses[a], poses[b], readings[a], readings[b]]
        graph.add(gtsam.CustomFactor(noise(np.array([drift_m, drift_m, drift_rad])), keys, _drift))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    last = found.atPose2(poses[-1])
    covariance = gtsam.Marginals(graph, found).marginalCovariance(poses[-1])
    return np.array([last.x(), last.y(), last.theta()]), covariance


def _drift(factor: object, values: object, jacobians: list[F64] | None) -> F64:
    """The pose moves as odometry should read it."""
    keys = factor.keys()
    at = [values.atPose2(key) for key in keys]

    def error(x1: object, x2: object, o1: object, o2: object) -> F64:
        moved, reported = x1.between(x2), o1.between(o2)
        away = np.array(
            [moved.x() - reported.x(), moved.y() - reported.y(), moved.theta() - reported.theta()]
        )
        away[2] = np.arctan2(np.sin(away[2]), np.cos(away[2]))
        return away

    if jacobians is not None:
        small = 1e-6
        for number in range(4):
            columns = []
            for axis in np.eye(3):
                both = [
                    error(*(T.retract(sign * small * axis) if k == number else T for k, T in enumerate(at)))
                    for sign in (1.0, -1.0)
                ]
                columns.append((both[0] - both[1]) / (2.0 * small))
            jacobians[number] = np.column_stack(columns)
    return error(*at)


def test_pose_and_covariance_are_those_of_gtsam() -> None:
    """Twelve scans of lag against all forty; what is forgotten is linearised once: 0.1 mm."""
    _, read, seen = drive()
    belief, (pose, covariance) = by_pc2grid(read, seen), by_gtsam(read, seen)
    ours = SE2.from_matrix(belief.pose)
    assert np.abs(np.array([ours.x, ours.y, ours.yaw]) - pose).max() < 1e-4
    assert belief.covariance == pytest.approx(covariance, rel=0.01, abs=1e-7)


def test_without_matches_only_the_drift_remains() -> None:
    """The control: what odometry alone gives lies elsewhere, and both say by how much."""
    true, read, _ = drive()
    belief, (pose, covariance) = by_pc2grid(read, {}), by_gtsam(read, {})
    ours = SE2.from_matrix(belief.pose)
    assert np.abs(np.array([ours.x, ours.y, ours.yaw]) - pose).max() < 1e-4
    assert belief.covariance == pytest.approx(covariance, rel=0.01, abs=1e-7)
    assert np.hypot(ours.x - true[-1].x, ours.y - true[-1].y) > 0.02
