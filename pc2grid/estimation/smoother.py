"""A fixed-lag smoother over the pose of the sensor's carrier and over what its odometry should read.

The state of each of the last scans is the pose of the base in the session frame, and the pose that odometry
without errors would report. Between two scans both move alike, but for the drift of the odometry; a reading
lies near the second, but for noise. A reading that comes late or twice is then an outlier of that noise, a
driver that starts again is an outlier of the drift, and in both cases later readings count again. Where the
odometry frame lies in the session frame (`map -> odom` of REP-105) is the difference of the two poses.

Further unknowns are the systematic errors of odometry, which are the same in every step: of the distance, of
its direction, of the turn on each metre, and of a turn, as in Censi et al., "Simultaneous calibration of
odometry and sensor parameters for mobile robots" (2013).

All kinds of evidence are factors with Cauchy weights (Suenderhauf and Protzel, "Switchable constraints",
2012; Agarwal et al., 2013); the oldest scan is marginalised (Sibley, Matthies and Sukhatme, "Sliding window
filter with application to planetary landing", 2010). On wheels three of six degrees of freedom are free.

What the smoother keeps of the last scans: their evidence, what is estimated of them, and what those before
say. All are tuples of arrays, which compiled code takes as they are.

What is known of the pose of the base: a Gaussian with tails as heavy as those of the evidence.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotrs

from pc2grid.estimation.line_map import _compiled_steps, carried_on, moved, steps
from pc2grid.geometry import F64, BoolGrid, invert_pose

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
    off_reading, _, of_reading = _compiled_steps(window.read, state.readings)
    off_pose, _, of_pose = _compiled_steps(window.match, state.poses)
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
    moves = _compiled_steps(state.poses[:-1], state.poses[1:])
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
    off_pose, _, _ = _compiled_steps(prior.about.poses, state.poses[:m])
    off_reading, _, _ = _compiled_steps(prior.about.readings, state.readings[:m])
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
    reports, read_first, read_second = _compiled_steps(state.readings[:-1], state.readings[1:])
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


PLANAR: tuple[int, ...] = (0, 1, 5)
"""The free directions of a base on wheels: x, y, and the turn about z, in the base frame."""
SPATIAL: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
"""The free directions of a sensor in the hand: x, y, z, and the turns about them."""
KERNEL = 3.0
"""Standard deviations at which evidence counts half: scale of the Cauchy weights. Chosen by hand."""


@dataclass(frozen=True)
class Belief:
    """A pose (4, 4) T_session_base with its covariance (D, D) in the free directions (D,) of the base
    frame."""

    pose: F64
    covariance: F64
    free: NDArray[np.intp]

    @cached_property
    def information(self) -> F64:
        """Inverse (D, D) of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)

    @cached_property
    def sigmas(self) -> tuple[float, float]:
        """Largest standard deviation of the position (m) and of the turn (rad)."""
        position = self.free < 3
        largest = (np.linalg.eigvalsh(self.covariance[np.ix_(k, k)])[-1] for k in (position, ~position))
        of_position_m, of_turn_rad = (math.sqrt(variance) for variance in largest)
        return of_position_m, of_turn_rad

    def chi2(self, pose: F64) -> float:
        """Squared Mahalanobis distance of a pose (4, 4)."""
        away = steps(self.pose[None], pose[None]).step[0, self.free]
        return float(away @ self.information @ away)

    def log_density(self, chi2: float) -> float:
        """Logarithm of the density at a squared Mahalanobis distance, but for a constant; far off it falls as
        slowly as evidence."""
        return -0.5 * (KERNEL**2 * math.log1p(chi2 / KERNEL**2) + self._log_volume)

    @cached_property
    def _log_volume(self) -> float:
        return float(np.linalg.slogdet(self.covariance)[1])


ERRORS = 4
"""Systematic errors of odometry that are estimated."""
LEAST_S = 1e-3
"""Scans follow each other no faster."""


class SmootherParameters(NamedTuple):
    """Numbers of the smoother; chosen by hand.

    lag : scans whose states are estimated together.
    reading_m, reading_rad : standard deviations of a reading of odometry: resolution, and jitter of its time.
    drift : standard deviation of odometry over one metre (m), over one radian and, for the turn, over one
        metre (rad); it grows with the square root of the way. drift_turn_m : that of the position over a turn
        of one radian.
    unsteady, growth : without odometry, the change of the motion from one scan to the next is `unsteady`, in
        m/s and rad/s, times the time between them to the power of 1 + `growth`: a robot indoors starts, stops
        and turns. With a growth of 0.5, that of a hand does not depend on the rate of the scans.
    gyroscope_radps : of a gyroscope, with its bias.
    steady_s : the motion before is taken over this time, so that an error of one pose does not come back in
        the next with the other sign.
    scale, direction_rad, yaw_rad_per_m, turn : standard deviations, over robots, of the systematic errors.
    kernel : see `pc2grid.estimation.smoother.KERNEL`.
    iterations : of Gauss-Newton, at most. converged : they end when no unknown changes by more.
    """

    lag: int = 12
    reading_m: float = 0.01
    reading_rad: float = 0.004
    drift: float = 0.05
    drift_turn_m: float = 0.03
    unsteady: float = 0.4
    growth: float = 0.0
    gyroscope_radps: float = 0.02
    steady_s: float = 0.3
    scale: float = 0.05
    direction_rad: float = math.radians(2.0)
    yaw_rad_per_m: float = math.radians(2.0)
    turn: float = 0.05
    kernel: float = KERNEL
    iterations: int = 5
    converged: float = 1e-2


SMOOTHER = SmootherParameters()
IN_THE_HAND = SmootherParameters(
    reading_m=0.002, reading_rad=0.001, drift=0.005, drift_turn_m=0.005, unsteady=0.9, growth=0.5,
    scale=1e-6, direction_rad=1e-6, yaw_rad_per_m=1e-6, turn=1e-6,
)  # fmt: skip
"""For odometry in six degrees of freedom, which is visual and inertial: it is exact to millimetres from image
to image, drifts by a percent, and has no wheels whose errors are always the same. Chosen by hand."""


class Window(NamedTuple):
    """The evidence of the last N scans; what is not measured has infinite standard deviations, or no
    information.

    seconds : (N,) since the scan before. jumps : (N,) whether the reading does not go on from the one before.
    read : (N, 4, 4) T_odom_base, with read_sigma (N, D). match : (N, 4, 4) T_session_base, with
    match_information (N, D, D). motion : (N, 6) step from the scan before, with motion_information (N, D, D).
    """

    seconds: F64
    jumps: BoolGrid
    read: F64
    read_sigma: F64
    match: F64
    match_information: F64
    motion: F64
    motion_information: F64

    def part(self, begin: int, end: int) -> Window:
        """Of the scans from `begin` to before `end`."""
        return Window._make(rows[begin:end] for rows in self)

    def then(self, more: Window) -> Window:
        """With further scans."""
        return Window._make(map(np.concatenate, zip(self, more, strict=True)))


class State(NamedTuple):
    """What is estimated of the last N scans.

    poses : (N, 4, 4) T_session_base. readings : (N, 4, 4) T_odom_base as odometry without errors would
        report.
    errors : (4,) systematic errors of odometry: scale, direction, yaw per metre, turn.
    """

    poses: F64
    readings: F64
    errors: F64

    def changed(self, errors: F64, changes: F64) -> State:
        """After changes of the errors (4,), and (2, N, 6) of poses and readings."""
        of_poses, of_readings = changes
        return State(moved(self.poses, of_poses), moved(self.readings, of_readings), self.errors + errors)

    def part(self, begin: int, end: int) -> State:
        """Of the scans from `begin` to before `end`."""
        return State(self.poses[begin:end], self.readings[begin:end], self.errors)


class Prior(NamedTuple):
    """What the marginalised scans say: the first unknowns are those of `about`, less `shift` (P,)."""

    about: State
    shift: F64
    information: F64


_DAMPING = 1e-9  # so that unknowns without evidence can be solved for


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one scan adds.

    seconds : since the scan before. T_odom_base : (4, 4) the reading of odometry, None if there is none.
    continues : whether that reading goes on from the one before. match : where the scan lies on the local
    map, a pose (4, 4) with its information (D, D); None if it fits nowhere. motion : (4, 4) T_last_now by
    registration, with its information (D, D); None if it is not measured.
    """

    seconds: float
    T_odom_base: F64 | None = None
    continues: bool = True
    match: tuple[F64, F64] | None = None
    motion: tuple[F64, F64] | None = None


class Smoother:
    """Adds scans one by one, and keeps the states of the last ones.

    free : directions that can change, `PLANAR` or `SPATIAL`: D of them.
    """

    def __init__(self, free: tuple[int, ...] = PLANAR, parameters: SmootherParameters = SMOOTHER) -> None:
        self._parameters = parameters
        self._free = np.array(free)

    # ------------------------------------------------------------------------------------------ prediction

    def start(self, T_session_base: F64, T_odom_base: F64 | None, speed: F64 | None = None) -> None:
        """Begin with a pose (4, 4), which defines the session frame, and a reading of odometry.

        speed : (6,) of the steps before, per second; None: the sensor stands.
        """
        self._begins_at = np.zeros(6) if speed is None else speed
        p, d = self._parameters, len(self._free)
        reading = T_session_base if T_odom_base is None else T_odom_base
        self._state = State(T_session_base[None].copy(), reading[None].copy(), np.zeros(ERRORS))
        self._window = self._row(Evidence(seconds=0.0), T_session_base, reading)
        self._begins = True  # no scan has been added since
        errors = np.array([p.scale, p.direction_rad, p.yaw_rad_per_m, p.turn])
        own = np.concatenate((np.full(d, 1e-4), self._noise(p.reading_m, p.reading_rad)))
        information = np.diag(np.concatenate((errors, own)) ** -2)
        self._prior = Prior(self._state, np.zeros(len(information)), information)
        self._covariance = np.diag(own[:d] ** 2)
        self._drift_scale = 1.0  # of the drift that the last steps show, in its standard deviations

    @property
    def belief(self) -> Belief:
        """The pose of the last scan."""
        return Belief(self._state.poses[-1], self._covariance, self._free)

    def by_odometry(self, T_odom_base: F64) -> Belief:
        """The next pose if a reading (4, 4) of odometry is right."""
        p = self._parameters
        (reported,), _, _ = steps(self._state.readings[-1:], T_odom_base[None])
        motion, _, _ = corrected(reported, self._state.errors)
        drift = drift_variance(reported, p.drift, p.drift_turn_m)[self._free]
        variance = drift + 2.0 * self._noise(p.reading_m, p.reading_rad) ** 2
        return self.after(moved(np.eye(4)[None], motion[None])[0], np.sqrt(variance))

    def steady(self, seconds: float, turn: F64 | None = None) -> tuple[F64, F64]:
        """The next motion (4, 4), over a time, if that before goes on; with standard deviations (D,).

        turn : (4, 4) by a gyroscope; None if there is none.
        """
        p = self._parameters
        step, over_s = self._latest()
        share = min(seconds / over_s, 1.0)
        motion, sigmas = moved(np.eye(4)[None], share * step[None])[0], self._unsteadiness(seconds)
        if turn is not None:
            motion[:3, :3] = turn[:3, :3]
            sigmas = np.where(self._free < 3, sigmas, p.gyroscope_radps * seconds)
        return motion, sigmas

    def _latest(self) -> tuple[F64, float]:
        """The motion (6,) over the last scans, and over how many seconds."""
        spans_s = np.concatenate(((0.0,), np.cumsum(self._window.seconds[:0:-1])))  # back from the last scan
        back = min(int(np.searchsorted(spans_s, self._parameters.steady_s)), len(spans_s) - 1)
        if not back:
            return self._begins_at, 1.0
        step, _, _ = steps(self._state.poses[-1 - back :][:1], self._state.poses[-1:])
        return step[0], max(float(spans_s[back]), LEAST_S)

    @property
    def speed(self) -> F64:
        """The motion (6,) over the last scans, per second."""
        step, over_s = self._latest()
        return step / over_s

    def after(self, motion: F64, sigmas: F64) -> Belief:
        """The last pose after a motion (4, 4) with standard deviations (D,) of its own."""
        F = carried_on(motion)[np.ix_(self._free, self._free)]
        return Belief(
            self._state.poses[-1] @ motion, F @ self._covariance @ F.T + np.diag(sigmas**2), self._free
        )

    # ---------------------------------------------------------------------------------------------- update

    def add(self, guess: F64, evidence: Evidence) -> Belief:
        """Add a scan: estimate its pose and, again, those of the scans before it.

        guess : (4, 4) T_session_base where the estimate begins, such as where the scan fits.

        Without odometry, the sensor is taken to stand at the beginning, or to go on as before it.
        """
        before, read = self._state, evidence.T_odom_base
        reading = before.readings[-1] @ invert_pose(before.poses[-1]) @ guess
        if read is not None and not evidence.continues:
            reading = read
        if self._begins and read is None and evidence.motion is None:
            motion, sigmas = self.steady(evidence.seconds)
            evidence = dataclasses.replace(evidence, motion=(motion, np.diag(sigmas**-2)))
        self._begins = False
        self._window = self._window.then(self._row(evidence, guess, reading))
        state = State(
            np.concatenate((before.poses, guess[None])),
            np.concatenate((before.readings, reading[None])),
            before.errors,
        )
        self._state, factor = self._solved(state)
        self._covariance = self._last_covariance(factor)
        if len(self._state.poses) > self._parameters.lag:
            self._marginalise()
        return self.belief

    def _row(self, evidence: Evidence, pose: F64, reading: F64) -> Window:
        """The evidence of one scan; a pose (4, 4) and a reading stand for what is not measured."""
        p, d = self._parameters, len(self._free)
        nothing, read = np.zeros((d, d)), (reading, np.full(d, np.inf))
        if evidence.T_odom_base is not None:
            read = evidence.T_odom_base, self._noise(p.reading_m, p.reading_rad)
        motion, information = evidence.motion or (np.eye(4), nothing)
        step, _, _ = steps(np.eye(4)[None], motion[None])
        match = evidence.match or (pose, nothing)
        row = (evidence.seconds, not evidence.continues, *read, *match, step[0], information)
        return Window(*(np.array(value)[None] for value in row))

    def _solved(self, state: State) -> tuple[State, F64]:
        """Gauss-Newton from a state; returns the last one, and the Cholesky factor of the information on its
        unknowns."""
        p, n = self._parameters, len(state.poses)
        for _ in range(p.iterations):
            H, g, self._drift_scale = normal_equations(
                state, self._window, self._prior, self._free, p, self._drift_scale, n
            )
            H[np.diag_indices(len(g))] += _DAMPING
            factor, delta, failed = dposv(H, -g)
            if failed:
                raise np.linalg.LinAlgError("the information of the smoother is not positive definite")
            changes = np.zeros((2, n, 6))
            changes[:, :, self._free] = delta[ERRORS:].reshape(n, 2, -1).swapaxes(0, 1)
            state = state.changed(delta[:ERRORS], changes)
            if np.abs(delta).max() < p.converged:
                break
        return state, factor

    def _last_covariance(self, factor: F64) -> F64:
        """The covariance (D, D) of the last pose, by the Cholesky factor of all information."""
        count, d = len(factor), len(self._free)
        last = np.zeros((count, d))
        last[count - 2 * d : count - d] = np.eye(d)
        solved, _ = dpotrs(factor, last)
        covariance: F64 = solved[count - 2 * d : count - d]
        return covariance

    def _marginalise(self) -> None:
        """Replace the first scan by what it says of the next two."""
        few = self._state.part(0, 3)
        H, g, _ = normal_equations(
            few, self._window.part(0, 3), self._prior, self._free, self._parameters, self._drift_scale, 1
        )
        information, gradient = _without(H, g, 2 * len(self._free))
        shift = np.asarray(
            np.linalg.solve(information + _DAMPING * np.eye(len(gradient)), gradient), np.float64
        )
        self._prior = Prior(few.part(1, 3), shift, information)
        self._state = self._state.part(1, len(self._state.poses))
        self._window = self._window.part(1, len(self._window.seconds))

    # --------------------------------------------------------------------------------------------- odometry

    def _noise(self, sigma_m: float, sigma_rad: float) -> F64:
        """Standard deviations (D,) of the free directions."""
        return np.where(self._free < 3, sigma_m, sigma_rad)

    def _unsteadiness(self, seconds: float) -> F64:
        """Standard deviations (D,) of the change of the motion from one scan to the next."""
        p = self._parameters
        return np.full(len(self._free), unsteadiness(seconds, p.unsteady, p.growth))


def _without(H: F64, g: F64, first: int) -> tuple[F64, F64]:
    """The information and the gradient on the other unknowns when the `first` ones after the errors of
    odometry are marginalised: the Schur complement."""
    old, rest = np.s_[ERRORS : ERRORS + first], np.delete(np.arange(len(H)), np.s_[ERRORS : ERRORS + first])
    A, B = H[old, old] + _DAMPING * np.eye(first), H[rest, old]
    solved = np.linalg.solve(A, np.column_stack((B.T, g[old])))
    reduced = H[rest][:, rest] - B @ solved[:, :-1]
    return 0.5 * (reduced + reduced.T), g[rest] - B @ solved[:, -1]
