"""The normal equations of the smoother once more: residuals in numpy, derivatives by small differences."""

import math
from typing import NamedTuple

import numpy as np

from pc2grid.estimation.line_map import steps
from pc2grid.estimation.smoother import Smoother, WindowState
from pc2grid.geometry import F64, wrap_angle


class Factor(NamedTuple):
    """error : (M,). information : (M, M). kernel : of its Cauchy weight. learned : how much the errors of
    odometry follow from it, 0..1."""

    error: F64
    information: F64
    kernel: float
    learned: float = 1.0


def plain_equations(smoother: Smoother, few: int) -> tuple[F64, F64]:
    """The matrix and the gradient of the factors that begin with one of the first `few` scans."""
    state = smoother._state
    here, step = factors(smoother, state, few), 1e-5
    unknowns = 4 + 2 * len(smoother._free) * len(state.poses)
    ahead, behind = (
        [factors(smoother, changed(smoother, state, way * np.eye(unknowns)[u]), few) for u in range(unknowns)]
        for way in (step, -step)
    )
    H, g = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for number, f in enumerate(here):
        columns = [
            (a[number].error - b[number].error) / (2 * step) for a, b in zip(ahead, behind, strict=True)
        ]
        J = np.stack(columns, axis=1)
        J[:, :4] *= f.learned
        weight = 1.0 / (1.0 + f.error @ f.information @ f.error / f.kernel**2)
        H += weight * J.T @ f.information @ J
        g += weight * J.T @ f.information @ f.error
    return H, g


def changed(smoother: Smoother, state: WindowState, by: F64) -> WindowState:
    """The state after a change (U,) of its unknowns."""
    changes = np.zeros((2, len(state.poses), 6))
    changes[:, :, smoother._free] = by[4:].reshape(len(state.poses), 2, -1).swapaxes(0, 1)
    return state.changed(by[:4], changes)


def between(first: F64, second: F64) -> F64:
    """The step (6,) from a pose (4, 4) to another."""
    return steps(first[None], second[None])[0][0]


def factors(smoother: Smoother, state: WindowState, few: int) -> list[Factor]:
    """All factors at a state."""
    p, free, w, prior = smoother._parameters, smoother._free, smoother._window, smoother._prior
    found, n, about = [], len(state.poses), smoother._prior.about
    pairs = [(about.poses, state.poses), (about.readings, state.readings)]
    off = [between(old[k], new[k])[free] for k in range(len(about.poses)) for old, new in pairs]
    off_errors = state.errors - about.errors
    found.append(Factor(np.concatenate((off_errors, *off)) + prior.shift, prior.information, np.inf))
    for k in range(few):
        read = between(w.read[k], state.readings[k])[free]
        found.append(Factor(read, np.diag(w.read_sigma[k] ** -2.0), p.kernel))
        found.append(Factor(between(w.match[k], state.poses[k])[free], w.match_information[k], p.kernel))
    moves = [between(*state.poses[k : k + 2]) for k in range(n - 1)]
    for k in range(min(few, n - 1)):
        report = between(*state.readings[k : k + 2])
        way, turn = math.hypot(*report[:2]), 1.0 + state.errors[3]
        c, s = math.cos(state.errors[1]), math.sin(state.errors[1])
        x, y = (1.0 + state.errors[0]) * np.array([[c, -s], [s, c]]) @ report[:2]
        right = np.array([x, y, *report[2:5], turn * report[5] + state.errors[2] * way])
        length, angle = np.linalg.norm(report[:3]), np.linalg.norm(report[3:])
        of_position = p.drift**2 * length + p.drift_turn_m**2 * angle
        variance = np.where(free < 3, of_position, p.drift**2 * (length + angle)) + 1e-6
        error, scale = wrapped(moves[k] - right)[free], smoother._drift_scale
        if not w.jumps[k + 1]:
            slips = (error**2 / variance).sum() / (scale * p.kernel) ** 2
            found.append(Factor(error, np.diag(1.0 / (scale**2 * variance)), p.kernel, 1.0 / (1.0 + slips)))
        measured = wrapped(moves[k] - w.motion[k + 1])[free]
        found.append(Factor(measured, w.motion_information[k + 1], p.kernel))
    for k in range(min(few, n - 2)):
        follows = not w.jumps[k + 2] or w.match_information[k + 2].any()
        if w.motion_information[k + 2].any() or (np.isfinite(w.read_sigma[k + 2, 0]) and follows):
            continue
        ratio = min(w.seconds[k + 2], max(w.seconds[k + 1], p.steady_s)) / w.seconds[k + 1]
        sigma = p.unsteady * w.seconds[k + 2] ** (1.0 + p.growth)
        error = wrapped(moves[k + 1] - ratio * moves[k])[free]
        found.append(Factor(error, np.eye(len(free)) / sigma**2, np.inf))
    return found


def wrapped(step: F64) -> F64:
    """A difference (6,) of steps, the turn about z within half a turn."""
    return np.array([*step[:5], wrap_angle(float(step[5]))])
