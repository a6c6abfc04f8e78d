"""The normal equations of the smoother once more: residuals in numpy, derivatives by small differences."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pc2grid.estimation.line_map import moved, steps
from pc2grid.estimation.smoother import ERRORS, Smoother
from pc2grid.geometry import F64, wrap_angle


class Factor(NamedTuple):
    """error : (M,). information : (M, M). kernel : of its Cauchy weight. gradient : (M,) beside it.
    variance : over the one that is stated."""

    error: F64
    information: F64
    kernel: float
    gradient: F64 | float = 0.0
    variance: float = 1.0


def plain_equations(smoother: Smoother) -> tuple[F64, F64]:
    """The matrix and the gradient of all factors, at the smoother's own state."""
    poses, d = smoother._window.poses, len(smoother._free)
    unknowns, step = ERRORS + d * len(poses), 1e-5

    def after(change: F64) -> list[Factor]:
        changes = np.zeros((len(poses), 6))
        changes[:, smoother._free] = change[ERRORS:].reshape(-1, d)
        return factors(smoother, moved(poses, changes), smoother._errors + change[:ERRORS])

    ahead, behind = ([after(way * row) for row in np.eye(unknowns)] for way in (step, -step))
    H, g = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for number, f in enumerate(after(np.zeros(unknowns))):
        columns = [
            (a[number].error - b[number].error) / (2 * step) for a, b in zip(ahead, behind, strict=True)
        ]
        J = np.stack(columns, axis=1)
        weight = 1.0 / (f.variance + f.error @ f.information @ f.error / f.kernel**2)
        H += weight * J.T @ f.information @ J
        g += weight * J.T @ (f.information @ f.error + f.gradient)
    return H, g


def between(first: F64, second: F64) -> F64:
    """The step (6,) from a pose (4, 4) to another."""
    return steps(first[None], second[None]).step[0]


def factors(smoother: Smoother, poses: F64, errors: F64) -> list[Factor]:
    """All factors at poses (N, 4, 4) and errors (4,)."""
    p, free, w, prior = smoother._parameters, smoother._free, smoother._window, smoother._prior
    off = [between(old, new)[free] for old, new in zip(prior.poses, poses, strict=False)]
    state = np.concatenate((errors - prior.errors, *off))
    found = [Factor(state, prior.information, np.inf, prior.gradient)]
    for k, pose in enumerate(poses):
        found.append(Factor(between(w.match[k], pose)[free], w.information[k, 0], p.kernel))
    moves = [between(*poses[k : k + 2]) for k in range(len(poses) - 1)]
    for k, move in enumerate(moves, start=1):
        x, y, *tilt, turn = expected = w.step[k]
        if w.by_odometry[k]:
            c, s = math.cos(errors[1]), math.sin(errors[1])
            ahead = (1.0 + errors[0]) * np.array([[c, -s], [s, c]]) @ (x, y)
            expected = np.array([*ahead, *tilt, (1.0 + errors[3]) * turn + errors[2] * math.hypot(x, y)])
        elif w.steady[k]:
            expected = w.steady[k] * moves[k - 2]
        away = move - expected
        error = np.array([*away[:5], wrap_angle(float(away[5]))])[free]
        variance = smoother._overconfidence if w.by_odometry[k] else 1.0
        kernel = np.inf if w.steady[k] else p.kernel
        found.append(Factor(error, w.information[k, 1], kernel, variance=variance))
    return found
