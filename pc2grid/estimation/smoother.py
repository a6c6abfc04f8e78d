"""A fixed-lag smoother over the last poses of the base.

A pose lies near the match of its scan with the local map, and it moves from the pose before by the motion
that odometry reports, or registration; where nothing measures the motion, it moves on as before. A reading
that comes late or twice makes two motions that do not fit the matches; they count little.

Further unknowns are the systematic errors of odometry, which are the same in every step: of the distance, of
its direction, of the turn on each metre, and of a turn, as in Censi et al., "Simultaneous calibration of
odometry and sensor parameters for mobile robots" (2013). They are needed along corridors: without them the
map of killian (first 500 s) is 0.49 instead of 0.34 m off, and the track of intel 0.175 instead of 0.119 m.

All measurements are factors with Cauchy weights (Suenderhauf and Protzel, "Switchable constraints", 2012;
Agarwal et al., 2013); the oldest scan is marginalised (Sibley, Matthies and Sukhatme, "Sliding window filter
with application to planetary landing", 2010). On wheels three of six degrees of freedom are free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotrs

from pc2grid.estimation.line_map import inverse_adjoint, moved, steps
from pc2grid.geometry import F64, wrap_angle

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
_STILL = np.eye(4)[None]
_ORIGIN = 1e-4  # standard deviation, m and rad, of the first pose, which defines the session frame


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
    reading_m=7e-4, reading_rad=7e-4, drift=0.005, drift_turn_m=0.005, unsteady=0.9, growth=0.5,
    scale=1e-6, direction_rad=1e-6, yaw_rad_per_m=1e-6, turn=1e-6,
)  # fmt: skip
"""For odometry in six degrees of freedom, which is visual and inertial: it is exact to a millimetre from
image to image, drifts by a percent, and has no wheels whose errors are always the same. Chosen by hand."""


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

    seconds : since the scan before. reported : (4, 4) T_last_now by odometry; None if it does not say.
    match : the pose (4, 4) of the scan on the local map with its information (D, D); None if it fits nowhere.
    motion : (4, 4) T_last_now by registration, with its information (D, D), where odometry does not say.
    """

    seconds: float
    reported: F64 | None = None
    match: tuple[F64, F64] | None = None
    motion: tuple[F64, F64] | None = None


class Window(NamedTuple):
    """The last N scans: their poses, and two measurements of each.

    poses : (N, 4, 4) T_session_base. match : (N, 4, 4) the pose by the local map. step : (N, 6) from the scan
    before, as odometry or registration measure it. information : (N, 2, D, D) of the match and of the step; 0
    where there is none. by_odometry : (N,) 1 if odometry reports the step, else 0. steady : (N,) of a step
    that nothing measures, its share of the step before at constant velocity; 0 for others. seconds : (N,)
    since the scan before.
    """

    poses: F64
    match: F64
    step: F64
    information: F64
    by_odometry: F64
    steady: F64
    seconds: F64

    def part(self, begin: int, end: int | None = None) -> Window:
        """Return the scans from `begin` to before `end`."""
        return Window._make(rows[begin:end] for rows in self)


class MarginalPrior(NamedTuple):
    """The marginalised scans: gradient (P,) and information (P, P) at errors (4,) and poses (M, 4, 4)."""

    poses: F64
    errors: F64
    gradient: F64
    information: F64


class Smoother:
    """Adds scans one by one, and estimates the poses of the last ones.

    free : directions that can change, `PLANAR` or `SPATIAL`: D of them.
    """

    def __init__(self, free: tuple[int, ...] = PLANAR, parameters: SmootherParameters = SMOOTHER) -> None:
        self._parameters = parameters
        self._free = np.array(free)

    # ------------------------------------------------------------------------------------------ prediction

    def start(self, T_session_base: F64, speed: F64 | None = None) -> None:
        """Begin with a pose (4, 4), which defines the session frame.

        speed : (6,) velocity at the beginning, per second; None: the sensor stands.
        """
        p, d = self._parameters, len(self._free)
        self._begins_at = np.zeros(6) if speed is None else speed
        self._errors = np.zeros(ERRORS)
        self._overconfidence = 1.0  # of odometry: the variance of its last steps over the one that it states
        nothing = ScanFactors(seconds=0.0)
        self._window = self._row(T_session_base, nothing, np.eye(4), np.zeros((d, d)), 0.0)
        errors = np.array([p.scale, p.direction_rad, p.yaw_rad_per_m, p.turn])
        information = np.diag(np.concatenate((errors, np.full(d, _ORIGIN))) ** -2)
        self._prior = MarginalPrior(T_session_base[None], self._errors, np.zeros(ERRORS + d), information)
        self._covariance = np.diag(np.full(d, _ORIGIN**2))

    @property
    def belief(self) -> PoseWithCovariance:
        """Return the pose of the last scan."""
        return PoseWithCovariance(self._window.poses[-1], self._covariance, self._free)

    def by_odometry(self, reported: F64) -> tuple[F64, F64]:
        """Predict the next motion (4, 4) by the one that odometry reports; returns it with standard
        deviations (D,).
        """
        step = steps(_STILL, reported[None]).step
        right, _ = corrected(step, self._errors)
        return moved(_STILL, right)[0], self._drift(step[0])

    def constant_velocity(self, seconds: float, turn: F64 | None = None) -> tuple[F64, F64]:
        """Predict the next motion (4, 4) over a time by constant velocity; returns it with standard
        deviations (D,).

        turn : (4, 4) by a gyroscope; None if there is none.
        """
        p = self._parameters
        step, over_s = self._latest()
        share = min(seconds / over_s, 1.0)
        motion = moved(_STILL, share * step[None])[0]
        sigmas = np.full(len(self._free), p.unsteady * max(seconds, LEAST_S) ** (1.0 + p.growth))
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
        poses = self._window.poses
        step, _, _ = steps(poses[-1 - back :][:1], poses[-1:])
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
            self._window.poses[-1] @ motion, F @ self._covariance @ F.T + np.diag(sigmas**2), self._free
        )

    # ---------------------------------------------------------------------------------------------- update

    def add(self, guess: F64, evidence: ScanFactors) -> PoseWithCovariance:
        """Add a scan, and estimate its pose and again those of the scans before it.

        guess : (4, 4) initial T_session_base, for example the match with the local map.
        """
        window, steady = self._window, 0.0
        if evidence.reported is not None:
            motion = evidence.reported
            _, sigmas = self.by_odometry(motion)
            information = np.diag(sigmas**-2)
        elif evidence.motion is not None:
            motion, information = evidence.motion
        else:
            motion, sigmas = self.constant_velocity(evidence.seconds)
            information = np.diag(sigmas**-2)
            if len(window.poses) > 1:  # both steps are estimated together
                before_s = max(float(window.seconds[-1]), LEAST_S)
                steady = min(evidence.seconds, max(before_s, self._parameters.steady_s)) / before_s
                motion = np.eye(4)
        row = self._row(guess, evidence, motion, information, steady)
        self._window = Window._make(map(np.concatenate, zip(window, row, strict=True)))
        self._solve()
        if len(self._window.poses) > self._parameters.lag:
            self._marginalise()
        return self.belief

    def _row(self, pose: F64, evidence: ScanFactors, motion: F64, information: F64, steady: float) -> Window:
        """Return the row of one scan."""
        match, of_match = evidence.match or (pose, np.zeros_like(information))
        step = steps(_STILL, motion[None]).step[0]
        odometry = evidence.reported is not None
        row = pose, match, step, (of_match, information), odometry, steady, evidence.seconds
        return Window._make(np.array(value, np.float64)[None] for value in row)

    def _solve(self) -> None:
        """Solve by Gauss-Newton for the errors, the poses, and the covariance of the last one."""
        p, d = self._parameters, len(self._free)
        for _ in range(p.iterations):
            H, g = self._equations(self._window)
            factor, delta, failed = dposv(H, -g)
            if failed:
                raise np.linalg.LinAlgError("the information of the smoother is not positive definite")
            changes = np.zeros((len(self._window.poses), 6))
            changes[:, self._free] = delta[ERRORS:].reshape(-1, d)
            self._errors = self._errors + delta[:ERRORS]
            self._window = self._window._replace(poses=moved(self._window.poses, changes))
            if np.abs(delta).max() < p.converged:
                break
        self._covariance = dpotrs(factor, np.eye(len(g))[:, -d:])[0][-d:]

    def _equations(self, window: Window) -> tuple[F64, F64]:
        """Return the matrix (U, U) and the gradient (U,) of all factors of scans, and of the prior.

        Unknowns are the errors, and D changes of each pose. A pose lies near its match. It moves from the one
        before by the measured step, in which the errors of odometry are corrected; without measurement it
        moves on as before.
        """
        poses, d, n = window.poses, len(self._free), len(window.poses)
        count, unknowns, across = (
            ERRORS + 3 * d,
            ERRORS + d * n,
            np.ix_(np.arange(2 * n - 1), self._free, self._free),
        )
        found = steps(np.concatenate((window.match, poses[:-1])), np.concatenate((poses, poses[1:])))
        by_first, by_second = found.by_first[across], found.by_second[across]
        by_odometry, steady = window.by_odometry[1:, None, None], window.steady[2:, None, None]
        expected, by_errors = corrected(window.step[1:], self._errors)
        expected = np.where(by_odometry[..., 0], expected, window.step[1:])
        expected[1:] += steady[..., 0] * found.step[n:-1]
        away = found.step.copy()
        away[n:] -= expected
        away[:, 5] = wrap_angle(away[:, 5])
        # Of each scan the match and the step; columns are the errors, and the last three poses.
        error, jacobian = np.zeros((n, 2, d)), np.zeros((n, 2, d, count))
        error[:, 0], error[1:, 1] = away[:n, self._free], away[n:, self._free]
        jacobian[:, 0, :, -d:] = by_second[:n]
        jacobian[1:, 1, :, -d:] = by_second[n:]
        jacobian[1:, 1, :, -2 * d : -d] = by_first[n:]
        jacobian[2:, 1, :, -2 * d : -d] -= steady * by_second[n:-1]
        jacobian[2:, 1, :, -3 * d : -2 * d] = -steady * by_first[n:-1]
        jacobian[1:, 1, :, :ERRORS] = -by_odometry * by_errors[:, self._free]
        chi2 = np.einsum("nfa,nfab,nfb->nf", error, window.information, error)
        if n > 3:  # not of the few that are marginalised
            of_odometry = float(window.by_odometry @ chi2[:, 1])
            self._overconfidence = max(of_odometry / (d * max(float(window.by_odometry.sum()), 1.0)), 1.0)
        variance = np.ones_like(chi2)
        variance[window.by_odometry > 0.0, 1] = self._overconfidence
        weight = 1.0 / (variance + chi2 / self._parameters.kernel**2)
        weight[window.steady > 0.0, 1] = 1.0  # a change of the motion is no outlier
        weighed = (weight[..., None, None] * window.information @ jacobian).reshape(n, 2 * d, count)
        blocks = jacobian.reshape(n, 2 * d, count).swapaxes(1, 2) @ weighed
        gradients = (error.reshape(n, 1, 2 * d) @ weighed)[:, 0]
        at = np.arange(count) + d * np.arange(-2, n - 2)[:, None]
        at[:, :ERRORS] = np.arange(ERRORS)
        at = np.maximum(at, 0)  # nothing is before the first scan: zeros are added
        cells = (unknowns * at[:, :, None] + at[:, None]).ravel()
        H: F64 = (
            np.bincount(cells, blocks.ravel(), unknowns**2).astype(np.float64).reshape(unknowns, unknowns)
        )
        g: F64 = np.bincount(at.ravel(), gradients.ravel(), unknowns).astype(np.float64)
        prior = self._prior
        m, known = len(prior.poses), len(prior.gradient)
        off_poses = steps(prior.poses, poses[:m]).step[:, self._free]
        off = np.concatenate((self._errors - prior.errors, off_poses.ravel()))
        H[:known, :known] += prior.information
        g[:known] += prior.gradient + prior.information @ off
        return H, g

    def _marginalise(self) -> None:
        """Replace the first scan by a prior on the next two: the Schur complement of its pose."""
        first, known = self._window.part(0, 3), ERRORS + len(self._free)
        information = first.information.copy()
        information[1:, 0] = 0.0  # the first pose has no part in these
        if not first.steady[2]:
            information[2, 1] = 0.0
        H, g = self._equations(first._replace(information=information))
        old, rest = np.s_[ERRORS:known], np.r_[:ERRORS, known : len(g)]
        solved = np.linalg.solve(H[old, old], np.column_stack((H[old][:, rest], g[old])))
        reduced = H[np.ix_(rest, rest)] - H[rest, old] @ solved[:, :-1]
        gradient = g[rest] - H[rest, old] @ solved[:, -1]
        self._prior = MarginalPrior(first.poses[1:], self._errors, gradient, 0.5 * (reduced + reduced.T))
        self._window = self._window.part(1)
        if first.steady[2]:
            self._window.information[1, 1] = 0.0  # it is in the prior

    def _drift(self, reported: F64) -> F64:
        """Return the standard deviations (D,) of a step (6,) that odometry reports."""
        p = self._parameters
        distance_m, turn_rad = np.linalg.norm(reported[:3]), np.linalg.norm(reported[3:])
        position = p.drift**2 * distance_m + p.drift_turn_m**2 * turn_rad + 2.0 * p.reading_m**2
        turn = p.drift**2 * (distance_m + turn_rad) + 2.0 * p.reading_rad**2
        return np.sqrt(np.where(self._free < 3, position, turn))


def corrected(reported: F64, errors: F64) -> tuple[F64, F64]:
    """Remove the systematic errors (4,) from steps (N, 6) that odometry reports.

    Returns the steps with their derivatives (N, 6, 4) with respect to the errors.
    """
    way, direction_rad = 1.0 + errors[0], errors[1]
    step, by_errors = reported.copy(), np.zeros((len(reported), 6, ERRORS))
    c, s = math.cos(direction_rad), math.sin(direction_rad)
    ahead = reported[:, :2] @ np.array([[c, s], [-s, c]])
    distance_m = np.hypot(reported[:, 0], reported[:, 1])
    step[:, :2] = way * ahead
    step[:, 5] = (1.0 + errors[3]) * reported[:, 5] + errors[2] * distance_m
    by_errors[:, :2, 0] = ahead
    by_errors[:, 0, 1], by_errors[:, 1, 1] = -step[:, 1], step[:, 0]
    by_errors[:, 5, 2], by_errors[:, 5, 3] = distance_m, reported[:, 5]
    return step, by_errors
