"""A fixed-lag smoother over the last poses of the base and over the readings that odometry should report.

The state of each of the last scans is the pose of the base in the session frame, and the pose that odometry
without noise would report. Between two scans both move alike, but for the drift of the odometry; a reading
differs from the second by noise. A reading that comes late or twice is then an outlier of that noise, a
driver that starts again is an outlier of the drift, and in both cases later readings count again. The
difference of the two poses is the pose of the odometry frame in the session frame (`map -> odom` of REP-105).

Further unknowns are the systematic errors of odometry, which are the same in every step: of the distance, of
its direction, of the turn on each metre, and of a turn, as in Censi et al., "Simultaneous calibration of
odometry and sensor parameters for mobile robots" (2013).

All measurements are factors with Cauchy weights (Suenderhauf and Protzel, "Switchable constraints", 2012;
Agarwal et al., 2013); the oldest scan is marginalised (Sibley, Matthies and Sukhatme, "Sliding window filter
with application to planetary landing", 2010). On wheels three of six degrees of freedom are free.

The window of factors, its states and the marginalised prior are tuples of arrays, which compiled code takes
directly.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotrs

from pc2grid.estimation.line_map import compiled_steps, inverse_adjoint, moved, steps
from pc2grid.geometry import F64, BoolGrid, invert_pose
from pc2grid.libraries import compiled

PLANAR: tuple[int, ...] = (0, 1, 5)
"""The free directions of a base on wheels: x, y, and the turn about z, in the base frame."""
SPATIAL: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
"""The free directions of a sensor in the hand: x, y, z, and the turns about them."""
KERNEL = 3.0
"""Standard deviations at which evidence counts half: scale of the Cauchy weights. Chosen by hand."""
ERRORS = 4
"""Systematic errors of odometry that are estimated."""
LEAST_S = 1e-3
"""Scans follow each other no faster."""
_LEAST_DRIFT = 1e-3  # standard deviation of odometry that reports no motion
_DAMPING = 1e-9  # so that unknowns without evidence can be solved for


class SmootherParameters(NamedTuple):
    """Numbers of the smoother; chosen by hand.

    lag : scans whose states are estimated together.
    reading_m, reading_rad : standard deviations of a reading of odometry: resolution, and jitter of its time.
    drift : standard deviation of odometry over one metre (m), over one radian and, for the turn, over one
        metre (rad); it grows with the square root of the way. drift_turn_m : that of the position over a turn
        of one radian.
    unsteady, growth : without odometry, the change of the motion from one scan to the next has the standard
        deviation `unsteady`, in m/s and rad/s, times the time between them to the power of 1 + `growth`: a
        robot indoors starts, stops and turns. With a growth of 0.5, that of a hand does not depend on the
        rate of the scans.
    gyroscope_radps : of a gyroscope, with its bias.
    steady_s : the velocity is averaged over this time, so that an error of one pose does not return in the
        next with the opposite sign.
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


@dataclass(frozen=True)
class PoseWithCovariance:
    """A pose (4, 4) T_session_base with its covariance (D, D) in the free directions (D,) of the base frame.

    As a density it has tails as heavy as the Cauchy weights of the factors.
    """

    pose: F64
    covariance: F64
    free: NDArray[np.intp]

    @cached_property
    def information(self) -> F64:
        """Return the inverse (D, D) of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)

    @cached_property
    def sigmas(self) -> tuple[float, float]:
        """Return the largest standard deviation of the position (m) and of the turn (rad)."""
        position = self.free < 3
        largest = (np.linalg.eigvalsh(self.covariance[np.ix_(k, k)])[-1] for k in (position, ~position))
        of_position_m, of_turn_rad = (math.sqrt(variance) for variance in largest)
        return of_position_m, of_turn_rad

    def chi2(self, pose: F64) -> float:
        """Return the squared Mahalanobis distance of a pose (4, 4)."""
        away = steps(self.pose[None], pose[None]).step[0, self.free]
        return float(away @ self.information @ away)

    def log_density(self, chi2: float) -> float:
        """Return the logarithm of the density at a squared Mahalanobis distance, but for a constant.

        Far off it falls as slowly as that of a factor.
        """
        return -0.5 * (KERNEL**2 * math.log1p(chi2 / KERNEL**2) + self._log_volume)

    @cached_property
    def _log_volume(self) -> float:
        return float(np.linalg.slogdet(self.covariance)[1])


@dataclass(frozen=True, slots=True)
class ScanFactors:
    """The measurements of one scan.

    seconds : since the scan before. T_odom_base : (4, 4) the reading of odometry, None if there is none.
    continues : True if that reading continues the one before. match : the pose (4, 4) of the scan on the
    local map with its information (D, D); None if it fits nowhere. motion : (4, 4) T_last_now by
    registration, with its information (D, D); None if it is not measured.
    """

    seconds: float
    T_odom_base: F64 | None = None
    continues: bool = True
    match: tuple[F64, F64] | None = None
    motion: tuple[F64, F64] | None = None


class FactorWindow(NamedTuple):
    """The measurements of the last N scans. A missing one has infinite standard deviations, or no
    information.

    seconds : (N,) since the scan before. jumps : (N,) True if the reading does not continue the one before.
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

    def part(self, begin: int, end: int) -> FactorWindow:
        """Return the rows of the scans from `begin` to before `end`."""
        return FactorWindow._make(rows[begin:end] for rows in self)

    def then(self, more: FactorWindow) -> FactorWindow:
        """Return the window with further scans."""
        return FactorWindow._make(map(np.concatenate, zip(self, more, strict=True)))


class WindowState(NamedTuple):
    """The estimates of the last N scans.

    poses : (N, 4, 4) T_session_base. readings : (N, 4, 4) T_odom_base as odometry without noise would report
    it.
    errors : (4,) systematic errors of odometry: scale, direction, yaw per metre, turn.
    """

    poses: F64
    readings: F64
    errors: F64

    def changed(self, errors: F64, changes: F64) -> WindowState:
        """Return the state after changes of the errors (4,), and (2, N, 6) of poses and readings."""
        of_poses, of_readings = changes
        return WindowState(
            moved(self.poses, of_poses), moved(self.readings, of_readings), self.errors + errors
        )

    def part(self, begin: int, end: int) -> WindowState:
        """Return the state of the scans from `begin` to before `end`."""
        return WindowState(self.poses[begin:end], self.readings[begin:end], self.errors)


class MarginalPrior(NamedTuple):
    """The marginalised scans as a Gaussian on the first unknowns: those of `about`, less `shift` (P,)."""

    about: WindowState
    shift: F64
    information: F64


class Smoother:
    """Adds scans one by one, and estimates the states of the last ones.

    free : directions that can change, `PLANAR` or `SPATIAL`: D of them.
    """

    def __init__(self, free: tuple[int, ...] = PLANAR, parameters: SmootherParameters = SMOOTHER) -> None:
        self._parameters = parameters
        self._free = np.array(free)

    # ------------------------------------------------------------------------------------------ prediction

    def start(self, T_session_base: F64, T_odom_base: F64 | None, speed: F64 | None = None) -> None:
        """Begin with a pose (4, 4), which defines the session frame, and a reading of odometry.

        speed : (6,) velocity at the beginning, per second; None: the sensor stands.
        """
        self._begins_at = np.zeros(6) if speed is None else speed
        p, d = self._parameters, len(self._free)
        reading = T_session_base if T_odom_base is None else T_odom_base
        self._state = WindowState(T_session_base[None].copy(), reading[None].copy(), np.zeros(ERRORS))
        self._window = self._row(ScanFactors(seconds=0.0), T_session_base, reading)
        self._begins = True  # no scan has been added since
        errors = np.array([p.scale, p.direction_rad, p.yaw_rad_per_m, p.turn])
        own = np.concatenate((np.full(d, 1e-4), self._noise(p.reading_m, p.reading_rad)))
        information = np.diag(np.concatenate((errors, own)) ** -2)
        self._prior = MarginalPrior(self._state, np.zeros(len(information)), information)
        self._covariance = np.diag(own[:d] ** 2)
        self._drift_scale = 1.0  # of the drift that the last steps show, in its standard deviations

    @property
    def belief(self) -> PoseWithCovariance:
        """Return the pose of the last scan."""
        return PoseWithCovariance(self._state.poses[-1], self._covariance, self._free)

    def by_odometry(self, T_odom_base: F64) -> PoseWithCovariance:
        """Predict the next pose from a reading (4, 4) of odometry."""
        p = self._parameters
        (reported,), _, _ = steps(self._state.readings[-1:], T_odom_base[None])
        motion, _, _ = corrected(reported, self._state.errors)
        drift = drift_variance(reported, p.drift, p.drift_turn_m)[self._free]
        variance = drift + 2.0 * self._noise(p.reading_m, p.reading_rad) ** 2
        return self.after(moved(np.eye(4)[None], motion[None])[0], np.sqrt(variance))

    def constant_velocity(self, seconds: float, turn: F64 | None = None) -> tuple[F64, F64]:
        """Predict the next motion (4, 4) over a time by constant velocity; returns it with standard
        deviations (D,).

        turn : (4, 4) by a gyroscope; None if there is none.
        """
        p = self._parameters
        step, over_s = self._latest()
        share = min(seconds / over_s, 1.0)
        motion, sigmas = moved(np.eye(4)[None], share * step[None])[0], self._change_sigmas(seconds)
        if turn is not None:
            motion[:3, :3] = turn[:3, :3]
            sigmas = np.where(self._free < 3, sigmas, p.gyroscope_radps * seconds)
        return motion, sigmas

    def _latest(self) -> tuple[F64, float]:
        """Return the motion (6,) over the last scans, and its duration in seconds."""
        spans_s = np.concatenate(((0.0,), np.cumsum(self._window.seconds[:0:-1])))  # back from the last scan
        back = min(int(np.searchsorted(spans_s, self._parameters.steady_s)), len(spans_s) - 1)
        if not back:
            return self._begins_at, 1.0
        step, _, _ = steps(self._state.poses[-1 - back :][:1], self._state.poses[-1:])
        return step[0], max(float(spans_s[back]), LEAST_S)

    @property
    def speed(self) -> F64:
        """Return the motion (6,) over the last scans, per second."""
        step, over_s = self._latest()
        return step / over_s

    def after(self, motion: F64, sigmas: F64) -> PoseWithCovariance:
        """Return the last pose after a motion (4, 4) with standard deviations (D,) of its own."""
        F = inverse_adjoint(motion)[np.ix_(self._free, self._free)]
        return PoseWithCovariance(
            self._state.poses[-1] @ motion, F @ self._covariance @ F.T + np.diag(sigmas**2), self._free
        )

    # ---------------------------------------------------------------------------------------------- update

    def add(self, guess: F64, evidence: ScanFactors) -> PoseWithCovariance:
        """Add a scan, and estimate its pose and again those of the scans before it.

        guess : (4, 4) initial T_session_base, for example the match with the local map.

        Without odometry, the first motion is taken to be that of `start`.
        """
        before, read = self._state, evidence.T_odom_base
        reading = before.readings[-1] @ invert_pose(before.poses[-1]) @ guess
        if read is not None and not evidence.continues:
            reading = read
        if self._begins and read is None and evidence.motion is None:
            motion, sigmas = self.constant_velocity(evidence.seconds)
            evidence = dataclasses.replace(evidence, motion=(motion, np.diag(sigmas**-2)))
        self._begins = False
        self._window = self._window.then(self._row(evidence, guess, reading))
        state = WindowState(
            np.concatenate((before.poses, guess[None])),
            np.concatenate((before.readings, reading[None])),
            before.errors,
        )
        self._state, factor = self._solved(state)
        self._covariance = self._last_covariance(factor)
        if len(self._state.poses) > self._parameters.lag:
            self._marginalise()
        return self.belief

    def _row(self, evidence: ScanFactors, pose: F64, reading: F64) -> FactorWindow:
        """Return the row of one scan; a pose (4, 4) and a reading take the place of missing measurements."""
        p, d = self._parameters, len(self._free)
        nothing, read = np.zeros((d, d)), (reading, np.full(d, np.inf))
        if evidence.T_odom_base is not None:
            read = evidence.T_odom_base, self._noise(p.reading_m, p.reading_rad)
        motion, information = evidence.motion or (np.eye(4), nothing)
        step, _, _ = steps(np.eye(4)[None], motion[None])
        match = evidence.match or (pose, nothing)
        row = (evidence.seconds, not evidence.continues, *read, *match, step[0], information)
        return FactorWindow(*(np.array(value)[None] for value in row))

    def _solved(self, state: WindowState) -> tuple[WindowState, F64]:
        """Solve by Gauss-Newton; returns the state and the Cholesky factor of the information on its
        unknowns.
        """
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
        """Return the covariance (D, D) of the last pose from the Cholesky factor of all information."""
        count, d = len(factor), len(self._free)
        last = np.zeros((count, d))
        last[count - 2 * d : count - d] = np.eye(d)
        solved, _ = dpotrs(factor, last)
        covariance: F64 = solved[count - 2 * d : count - d]
        return covariance

    def _marginalise(self) -> None:
        """Marginalise the first scan: replace it by a prior on the next two."""
        few = self._state.part(0, 3)
        H, g, _ = normal_equations(
            few, self._window.part(0, 3), self._prior, self._free, self._parameters, self._drift_scale, 1
        )
        information, gradient = _without(H, g, 2 * len(self._free))
        shift = np.asarray(
            np.linalg.solve(information + _DAMPING * np.eye(len(gradient)), gradient), np.float64
        )
        self._prior = MarginalPrior(few.part(1, 3), shift, information)
        self._state = self._state.part(1, len(self._state.poses))
        self._window = self._window.part(1, len(self._window.seconds))

    # --------------------------------------------------------------------------------------------- odometry

    def _noise(self, sigma_m: float, sigma_rad: float) -> F64:
        """Return the standard deviations (D,) of the free directions."""
        return np.where(self._free < 3, sigma_m, sigma_rad)

    def _change_sigmas(self, seconds: float) -> F64:
        """Return the standard deviations (D,) of the change of the motion from one scan to the next."""
        p = self._parameters
        return np.full(len(self._free), change_sigma(seconds, p.unsteady, p.growth))


def _without(H: F64, g: F64, first: int) -> tuple[F64, F64]:
    """Marginalise the `first` unknowns after the errors of odometry by the Schur complement.

    Returns the information and the gradient on the other unknowns.
    """
    old, rest = np.s_[ERRORS : ERRORS + first], np.delete(np.arange(len(H)), np.s_[ERRORS : ERRORS + first])
    A, B = H[old, old] + _DAMPING * np.eye(first), H[rest, old]
    solved = np.linalg.solve(A, np.column_stack((B.T, g[old])))
    reduced = H[rest][:, rest] - B @ solved[:, :-1]
    return 0.5 * (reduced + reduced.T), g[rest] - B @ solved[:, -1]


# --- compiled functions: the factors and their normal equations ---------------------------------------


@compiled()
def normal_equations(
    state: WindowState,
    window: FactorWindow,
    prior: MarginalPrior,
    free: NDArray[np.intp],
    parameters: SmootherParameters,
    drift_scale: float,
    few: int,
) -> tuple[F64, F64, float]:
    """Return the matrix (U, U) and the gradient (U,) of all factors of N scans at a state.

    free : (D,) directions. drift_scale : of the drift that the last steps show, in its standard deviations.
    few : only factors that begin with one of this many first scans are added.

    The third value is the scale of the drift, estimated again if there are more than three scans.
    """
    d, n, kernel = len(free), len(state.poses), parameters.kernel
    unknowns = ERRORS + 2 * d * n
    H, g, error = np.zeros((unknowns, unknowns)), np.zeros(unknowns), np.empty(d)
    _add_prior(state, prior, free, H, g)
    # A reading of odometry lies near what it should be, and a pose near where the scan fits the local map.
    off_reading, _, of_reading = compiled_steps(window.read, state.readings)
    off_pose, _, of_pose = compiled_steps(window.match, state.poses)
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
    moves = compiled_steps(state.poses[:-1], state.poses[1:])
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
    _add_constant_velocity(moves, window, free, parameters, few, H, g)
    return H, g, drift_scale


@compiled()
def _add_prior(state: WindowState, prior: MarginalPrior, free: NDArray[np.intp], H: F64, g: F64) -> None:
    """Add the marginalised prior on the errors and the first states."""
    d, m = len(free), len(prior.about.poses)
    off_pose, _, _ = compiled_steps(prior.about.poses, state.poses[:m])
    off_reading, _, _ = compiled_steps(prior.about.readings, state.readings[:m])
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


@compiled()
def _add_drifts(
    moves: tuple[F64, F64, F64],
    state: WindowState,
    window: FactorWindow,
    free: NDArray[np.intp],
    p: SmootherParameters,
    drift_scale: float,
    few: int,
    H: F64,
    g: F64,
) -> float:
    """Add the drift factors: a pose moves like the readings, but for systematic errors and drift. Return its
    scale.
    """
    (step, by_first, by_second), d, n = moves, len(free), len(state.poses)
    reports, read_first, read_second = compiled_steps(state.readings[:-1], state.readings[1:])
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
        # Slips and late readings are no evidence of errors that are the same in every step.
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


@compiled()
def _add_constant_velocity(
    moves: tuple[F64, F64, F64],
    window: FactorWindow,
    free: NDArray[np.intp],
    p: SmootherParameters,
    few: int,
    H: F64,
    g: F64,
) -> None:
    """Add factors of constant velocity for the steps that nothing else measures.

    These are the steps without registration, and without odometry that continues or that jumps together with
    a match.
    """
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
            information[a, a] = change_sigma(seconds, p.unsteady, p.growth) ** -2.0
        _add(ERRORS + 2 * d * k, error, jacobian, information, np.inf, H, g, 5 * d)


@compiled()
def corrected(reported: F64, errors: F64) -> tuple[F64, F64, F64]:
    """Remove the systematic errors (4,) from a step (6,) that odometry reports.

    Returns the step with its Jacobians with respect to the report, (6, 6), and to the errors, (6, 4).
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


@compiled()
def drift_variance(reported: F64, drift: float, drift_turn_m: float) -> F64:
    """Return the variances (6,) of the drift over a step (6,)."""
    x, y, z, roll, pitch, yaw = reported[0], reported[1], reported[2], reported[3], reported[4], reported[5]
    distance_m = math.sqrt(x * x + y * y + z * z)
    turn_rad = math.sqrt(roll * roll + pitch * pitch + yaw * yaw)
    variance = np.empty(6)
    for a in range(6):
        of_turn = drift_turn_m**2 * turn_rad if a < 3 else drift**2 * turn_rad
        variance[a] = drift**2 * distance_m + of_turn + _LEAST_DRIFT**2
    return variance


@compiled()
def change_sigma(seconds: float, unsteady: float, growth: float) -> float:
    """Return the standard deviation, m and rad, of the change of the motion from one scan to the next."""
    sigma: float = unsteady * seconds ** (1.0 + growth)
    return sigma


@compiled()
def _put(block: F64, factor: float, free: NDArray[np.intp], column: int, jacobian: F64) -> None:
    """Add a block (6, 6), times a factor, to a Jacobian (D, K) at a column."""
    for a in range(len(free)):
        for b in range(len(free)):
            jacobian[a, column + b] += factor * block[free[a], free[b]]


@compiled()
def _add(
    first: int, error: F64, jacobian: F64, information: F64, kernel: float, H: F64, g: F64, own: int
) -> None:
    """Add a factor to the normal equations H and g.

    It depends on `own` unknowns from `first` on; the remaining columns are errors of odometry. error : (D,).
    jacobian : (D, K). information : (D, D). kernel : scale of the Cauchy weight, standard deviations;
    infinite: the weight is 1.
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


@compiled()
def _product(A: F64, B: F64) -> F64:
    """Multiply two matrices (6, 6)."""
    result = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for k in range(6):
                result[i, k] += A[i, j] * B[j, k]
    return result


@compiled()
def _difference(step: F64, factor: float, other: F64, direction: int) -> float:
    """Return a component of a step (6,) minus a multiple of another step; a turn about z within half a
    turn."""
    difference: float = step[direction] - factor * other[direction]
    turns = math.floor(difference / (2.0 * math.pi) + 0.5) if direction == 5 else 0.0
    return difference - 2.0 * math.pi * turns
