"""The normal equations of the smoother, compiled. The tests compare them with plain residuals, which they
differentiate by small steps.

Each factor says how far the states are from what one piece of evidence says, with its derivatives and its
information. Unknowns are, in this order, the systematic errors of odometry, and for each scan the changes of
its pose and of its reading in the D free directions.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.estimation._kernels import steps
from pc2grid.estimation.window import ERRORS, LEAST_S, Prior, SmootherParameters, State, Window

_LEAST_DRIFT = 1e-3  # standard deviation of odometry that reports no motion


@njit(cache=True)
def corrected(reported: F64, errors: F64) -> tuple[F64, F64, F64]:
    """A step (6,) that odometry reports, without its systematic errors (4,).

    Returns it with its Jacobians with respect to the report, (6, 6), and to the errors, (6, 4).
    """
    way, distance_m = 1.0 + errors[0], math.hypot(reported[0], reported[1])
    c, s = way * math.cos(errors[1]), way * math.sin(errors[1])
    step, by_report, by_errors = np.empty(6), np.zeros((6, 6)), np.zeros((6, ERRORS))
    for a in range(6):
        step[a], by_report[a, a] = reported[a], 1.0
    x, y = c * reported[0] - s * reported[1], s * reported[0] + c * reported[1]
    step[0], step[1] = x, y
    step[5] = (1.0 + errors[3]) * reported[5] + errors[2] * distance_m
    by_report[0, 0], by_report[0, 1], by_report[1, 0], by_report[1, 1] = c, -s, s, c
    by_report[5, 5] = 1.0 + errors[3]
    by_errors[0, 0], by_errors[1, 0], by_errors[0, 1], by_errors[1, 1] = x / way, y / way, -y, x
    by_errors[5, 2], by_errors[5, 3] = distance_m, reported[5]
    return step, by_report, by_errors


@njit(cache=True)
def drift_variance(reported: F64, drift: float, drift_turn_m: float) -> F64:
    """Variances (6,) of the drift over a step (6,)."""
    x, y, z, roll, pitch, yaw = reported[0], reported[1], reported[2], reported[3], reported[4], reported[5]
    distance_m = math.sqrt(x * x + y * y + z * z)
    turn_rad = math.sqrt(roll * roll + pitch * pitch + yaw * yaw)
    variance = np.empty(6)
    for a in range(6):
        of_turn = drift_turn_m**2 * turn_rad if a < 3 else drift**2 * turn_rad
        variance[a] = drift**2 * distance_m + of_turn + _LEAST_DRIFT**2
    return variance


@njit(cache=True)
def unsteadiness(seconds: float, unsteady: float, growth: float) -> float:
    """Standard deviation, m and rad, of the change of the motion from one scan to the next."""
    sigma: float = unsteady * seconds ** (1.0 + growth)
    return sigma


@njit(cache=True)
def _put(block: F64, factor: float, free: NDArray[np.intp], column: int, jacobian: F64) -> None:
    """Add a block (6, 6), times a factor, to a Jacobian (D, K) at a column."""
    for a in range(len(free)):
        for b in range(len(free)):
            jacobian[a, column + b] += factor * block[free[a], free[b]]


@njit(cache=True)
def _add(
    first: int, error: F64, jacobian: F64, information: F64, kernel: float, H: F64, g: F64, own: int
) -> None:
    """Add a factor to the normal equations H and g.

    It depends on `own` unknowns from the first on, and on as many of the errors of odometry, which are the
    last columns, as there are left. error : (D,). jacobian : (D, K). information : (D, D). kernel : scale of
    the Cauchy weight, standard deviations; infinite: the weight is 1.
    """
    d, count = jacobian.shape
    Le, LJ, chi2 = np.zeros(d), np.zeros((d, count)), 0.0
    for a in range(d):
        for b in range(d):
            Le[a] += information[a, b] * error[b]
            for k in range(count):
                LJ[a, k] += information[a, b] * jacobian[b, k]
        chi2 += error[a] * Le[a]
    weight = 1.0 / (1.0 + chi2 / kernel**2)
    for j in range(count):
        row = first + j if j < own else j - own
        for a in range(d):
            left = weight * jacobian[a, j]
            if left == 0.0:
                continue
            g[row] += left * Le[a]
            for k in range(count):
                H[row, first + k if k < own else k - own] += left * LJ[a, k]


@njit(cache=True)
def normal_equations(
    state: State,
    window: Window,
    prior: Prior,
    free: NDArray[np.intp],
    parameters: SmootherParameters,
    drift_scale: float,
    few: int,
) -> tuple[F64, F64, float]:
    """The matrix (U, U) and the gradient (U,) of all factors of N scans at a state.

    free : (D,) directions. drift_scale : of the drift that the last steps show, in its standard deviations.
    few : only factors that begin with one of the first so many scans are added.

    Returns them with the scale of the drift, found anew if there are more than three scans.
    """
    d, n, kernel = len(free), len(state.poses), parameters.kernel
    unknowns = ERRORS + 2 * d * n
    H, g, error = np.zeros((unknowns, unknowns)), np.zeros(unknowns), np.empty(d)
    _add_prior(state, prior, free, H, g)
    # A reading of odometry lies near what it should be, and a pose near where the scan fits the local map.
    off_reading, _, of_reading = steps(window.read, state.readings)
    off_pose, _, of_pose = steps(window.match, state.poses)
    for k in range(few):
        of_match, of_read, read = np.zeros((d, d)), np.zeros((d, d)), np.zeros((d, d))
        _put(of_pose[k], 1.0, free, 0, of_match)
        _put(of_reading[k], 1.0, free, 0, of_read)
        for a in range(d):
            error[a] = off_pose[k, free[a]]
        at = ERRORS + 2 * d * k
        _add(at, error, of_match, window.match_information[k], kernel, H, g, d)
        for a in range(d):
            error[a], read[a, a] = off_reading[k, free[a]], window.read_sigma[k, a] ** -2.0
        _add(at + d, error, of_read, read, kernel, H, g, d)
    moves = steps(state.poses[:-1], state.poses[1:])
    drift_scale = _add_drifts(moves, state, window, free, parameters, drift_scale, few, H, g)
    # A pose follows the one before by the motion that registration measured.
    step, by_first, by_second = moves
    for k in range(min(few, n - 1)):
        of_motion = np.zeros((d, 3 * d))
        _put(by_first[k], 1.0, free, 0, of_motion)
        _put(by_second[k], 1.0, free, 2 * d, of_motion)
        for a in range(d):
            error[a] = _difference(step[k], 1.0, window.motion[k + 1], free[a])
        information = window.motion_information[k + 1]
        _add(ERRORS + 2 * d * k, error, of_motion, information, kernel, H, g, 3 * d)
    _add_steadiness(moves, window, free, parameters, few, H, g)
    return H, g, drift_scale


@njit(cache=True)
def _add_prior(state: State, prior: Prior, free: NDArray[np.intp], H: F64, g: F64) -> None:
    """What the marginalised scans say of errors and first states."""
    d, m = len(free), len(prior.about.poses)
    off_pose, _, _ = steps(prior.about.poses, state.poses[:m])
    off_reading, _, _ = steps(prior.about.readings, state.readings[:m])
    off = np.empty(len(prior.shift))
    for a in range(len(off)):
        off[a] = prior.shift[a]
    for a in range(ERRORS):
        off[a] += state.errors[a] - prior.about.errors[a]
    for k in range(m):
        for a in range(d):
            off[ERRORS + 2 * d * k + a] += off_pose[k, free[a]]
            off[ERRORS + 2 * d * k + d + a] += off_reading[k, free[a]]
    for a in range(len(off)):
        for b in range(len(off)):
            H[a, b] += prior.information[a, b]
            g[a] += prior.information[a, b] * off[b]


@njit(cache=True)
def _add_drifts(
    moves: tuple[F64, F64, F64],
    state: State,
    window: Window,
    free: NDArray[np.intp],
    p: SmootherParameters,
    drift_scale: float,
    few: int,
    H: F64,
    g: F64,
) -> float:
    """From scan to scan the pose moves as odometry should report it, but for its errors and its drift, whose
    scale is returned."""
    (step, by_first, by_second), d, n = moves, len(free), len(state.poses)
    reports, read_first, read_second = steps(state.readings[:-1], state.readings[1:])
    errors, variances, chi2, all_chi2 = np.empty((n - 1, d)), np.empty((n - 1, d)), np.zeros(n - 1), 0.0
    for k in range(n - 1):
        expected, _, _ = corrected(reports[k], state.errors)
        variance = drift_variance(reports[k], p.drift, p.drift_turn_m)
        for a in range(d):
            errors[k, a], variances[k, a] = _difference(step[k], 1.0, expected, free[a]), variance[free[a]]
            if not window.jumps[k + 1]:
                chi2[k] += errors[k, a] ** 2 / variance[free[a]]
        all_chi2 += chi2[k]
    if n > 3:  # not of the few that are marginalised
        drift_scale = math.sqrt(max(all_chi2 / ((n - 1) * d), 1.0))
    for k in range(min(few, n - 1)):
        if window.jumps[k + 1]:
            continue
        _, by_report, by_errors = corrected(reports[k], state.errors)
        # What slips, or comes late, says nothing of errors that are the same in every step.
        weight = 1.0 / (1.0 + chi2[k] / (drift_scale * p.kernel) ** 2)
        jacobian, information = np.zeros((d, 4 * d + ERRORS)), np.zeros((d, d))
        _put(by_first[k], 1.0, free, 0, jacobian)
        _put(_product(by_report, read_first[k]), -1.0, free, d, jacobian)
        _put(by_second[k], 1.0, free, 2 * d, jacobian)
        _put(_product(by_report, read_second[k]), -1.0, free, 3 * d, jacobian)
        for a in range(d):
            information[a, a] = 1.0 / (drift_scale**2 * variances[k, a])
            for b in range(ERRORS):
                jacobian[a, 4 * d + b] = -weight * by_errors[free[a], b]
        _add(ERRORS + 2 * d * k, errors[k], jacobian, information, p.kernel, H, g, 4 * d)
    return drift_scale


@njit(cache=True)
def _add_steadiness(
    moves: tuple[F64, F64, F64],
    window: Window,
    free: NDArray[np.intp],
    p: SmootherParameters,
    few: int,
    H: F64,
    g: F64,
) -> None:
    """The motion goes on as it was, where nothing else measures it: neither registration, nor odometry that
    goes on, nor odometry that jumps together with a match."""
    (step, by_first, by_second), d = moves, len(free)
    error, information = np.empty(d), np.zeros((d, d))
    for k in range(min(few, len(step) - 1)):
        matched, measured = 0.0, 0.0
        for a in range(d):
            matched += window.match_information[k + 2, a, a]
            measured += window.motion_information[k + 2, a, a]
        read = math.isfinite(window.read_sigma[k + 2, 0]) and (matched > 0.0 or not window.jumps[k + 2])
        if read or measured > 0.0:
            continue
        before_s, seconds = max(window.seconds[k + 1], LEAST_S), max(window.seconds[k + 2], LEAST_S)
        ratio = min(seconds, max(before_s, p.steady_s)) / before_s
        jacobian = np.zeros((d, 5 * d))
        _put(by_first[k], -ratio, free, 0, jacobian)
        _put(by_second[k], -ratio, free, 2 * d, jacobian)
        _put(by_first[k + 1], 1.0, free, 2 * d, jacobian)
        _put(by_second[k + 1], 1.0, free, 4 * d, jacobian)
        for a in range(d):
            error[a] = _difference(step[k + 1], ratio, step[k], free[a])
            information[a, a] = unsteadiness(seconds, p.unsteady, p.growth) ** -2.0
        _add(ERRORS + 2 * d * k, error, jacobian, information, np.inf, H, g, 5 * d)


@njit(cache=True)
def _product(A: F64, B: F64) -> F64:
    """Of two matrices (6, 6)."""
    result = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for k in range(6):
                result[i, k] += A[i, j] * B[j, k]
    return result


@njit(cache=True)
def _difference(step: F64, factor: float, other: F64, direction: int) -> float:
    """Of a step (6,) and a multiple of another in one direction, a turn about z within half a turn."""
    difference: float = step[direction] - factor * other[direction]
    turns = math.floor(difference / (2.0 * math.pi) + 0.5) if direction == 5 else 0.0
    return difference - 2.0 * math.pi * turns
