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

The window of factors, its states and the marginalised prior are tuples of arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotrs

from pc2grid.estimation.line_map import DAMPING, moved, steps
from pc2grid.geometry import F64, BoolGrid, invert_pose, skew
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
    systematic, direction_rad, yaw_rad_per_m : standard deviations, over robots, of the systematic errors; the
        first is that of distances and of turns.
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
    systematic: float = 0.05
    direction_rad: float = math.radians(2.0)
    yaw_rad_per_m: float = math.radians(2.0)
    kernel: float = KERNEL
    iterations: int = 5
    converged: float = 1e-2


SMOOTHER = SmootherParameters()
IN_THE_HAND = SmootherParameters(
    reading_m=0.002, reading_rad=0.001, drift=0.005, drift_turn_m=0.005, unsteady=0.9, growth=0.5,
    systematic=1e-6, direction_rad=1e-6, yaw_rad_per_m=1e-6,
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
        n = np.count_nonzero(self.free < 3)
        largest = (np.linalg.eigvalsh(self.covariance[k, k])[-1] for k in (np.s_[:n], np.s_[n:]))
        of_position_m, of_turn_rad = (math.sqrt(variance) for variance in largest)
        return of_position_m, of_turn_rad

    def chi2(self, pose: F64) -> float:
        """Return the squared Mahalanobis distance of a pose (4, 4)."""
        away = steps(self.pose[None], pose[None])[0][0, self.free]
        return float(away @ self.information @ away)

    def log_density(self, chi2: float) -> float:
        """Return the logarithm of the density at a squared Mahalanobis distance, but for a constant.

        Far off it falls as slowly as that of a factor.
        """
        log_volume = float(np.linalg.slogdet(self.covariance)[1])
        return -0.5 * (KERNEL**2 * math.log1p(chi2 / KERNEL**2) + log_volume)


Measurement = tuple[F64, F64]
"""A pose or a motion (4, 4), with its information (D, D) in the axes of the base where it begins."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanMatch:
    """A scan matched with the local map; D directions of the pose are free.

    pose : (4, 4) T_session_base, with the expected pose as prior. alone : the pose by the points alone, with
    its information (D, D) in the axes of the base.
    overlap : share of the points that meet the map. measured : True if they fix every direction of the
    position.
    evidence : logarithm of the likelihood of the scan at that pose, but for a constant.
    credible : True if surfaces and free space there support the pose without any prior.
    """

    pose: F64
    alone: Measurement
    overlap: float
    measured: bool
    evidence: float
    credible: bool


class FactorWindow(NamedTuple):
    """The measurements of the last N scans. A missing one has infinite standard deviations, or no
    information.

    seconds : (N,) since the scan before. jumps : (N,) True if the reading does not continue the one before.
    read : (N, 4, 4) T_odom_base, with read_sigma (N, D). match : (N, 4, 4) T_session_base, with
    match_information (N, D, D). motion : (N, 6) step from the scan before, with motion_information (N, D, D).
    ratio : (N,) of the step at constant velocity to the step before. steadiness : (N,) information of that in
    each direction, 0 where something else measures the step.
    """

    seconds: F64
    jumps: BoolGrid
    read: F64
    read_sigma: F64
    match: F64
    match_information: F64
    motion: F64
    motion_information: F64
    ratio: F64
    steadiness: F64

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
        self._window = self._row(T_session_base, reading, 0.0, 0.0)
        self._begins = True  # no scan has been added since
        errors = np.array([p.systematic, p.direction_rad, p.yaw_rad_per_m, p.systematic])
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
        x, y, yaw, *drift = corrected(reported, self._state.errors, p.drift, p.drift_turn_m)
        motion = np.array([[x, y, *reported[2:5], yaw]])
        variance = self._noise(*drift) + 2.0 * self._noise(p.reading_m, p.reading_rad) ** 2
        return self.after(moved(np.eye(4)[None], motion)[0], np.sqrt(variance))

    def constant_velocity(self, seconds: float, turn: F64 | None = None) -> tuple[F64, F64]:
        """Predict the next motion (4, 4) over a time by constant velocity; returns it with standard
        deviations (D,).

        turn : (4, 4) by a gyroscope; None if there is none.
        """
        p = self._parameters
        step, over_s = self._latest()
        share = min(seconds / over_s, 1.0)
        motion = moved(np.eye(4)[None], share * step[None])[0]
        sigmas = np.full(len(self._free), self._change_sigma(seconds))
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
        # The adjoint of the inverse: maps a change of the pose to that of the pose after the motion.
        R, adjoint = motion[:3, :3].T, np.zeros((6, 6))
        adjoint[:3, :3], adjoint[3:, 3:], adjoint[:3, 3:] = R, R, R @ skew(-motion[None, :3, 3])[0]
        F = adjoint[np.ix_(self._free, self._free)]
        return PoseWithCovariance(
            self._state.poses[-1] @ motion, F @ self._covariance @ F.T + np.diag(sigmas**2), self._free
        )

    # ---------------------------------------------------------------------------------------------- update

    def add(
        self,
        guess: F64,
        seconds: float,
        T_odom_base: F64 | None = None,
        continues: bool = True,
        match: Measurement | None = None,
        motion: Measurement | None = None,
    ) -> PoseWithCovariance:
        """Add a scan, and estimate its pose and again those of the scans before it.

        guess : (4, 4) initial T_session_base, for example the match with the local map. seconds : since the
        scan before. T_odom_base : (4, 4) the reading of odometry, None if there is none. continues : True if
        that reading continues the one before. match : the pose (4, 4) of the scan on the local map with its
        information (D, D); None if it fits nowhere. motion : (4, 4) T_last_now by registration, with its
        information (D, D); None if it is not measured.

        Without odometry, the first motion is taken to be that of `start`.
        """
        before = self._state
        reading = before.readings[-1] @ invert_pose(before.poses[-1]) @ guess
        if T_odom_base is not None and not continues:
            reading = T_odom_base
        if self._begins and T_odom_base is None and motion is None:
            steady, sigmas = self.constant_velocity(seconds)
            motion = steady, np.diag(sigmas**-2)
        self._begins = False
        before_s = self._window.seconds[-1]
        row = self._row(guess, reading, before_s, seconds, T_odom_base, continues, match, motion)
        self._window = self._window.then(row)
        state = WindowState(
            np.concatenate((before.poses, guess[None])),
            np.concatenate((before.readings, reading[None])),
            before.errors,
        )
        self._state, factor = self._solved(state)
        d, last = len(self._free), np.zeros((len(factor), len(self._free)))
        last[-2 * d : -d] = np.eye(d)
        self._covariance = dpotrs(factor, last)[0][-2 * d : -d]
        if len(self._state.poses) > self._parameters.lag:
            self._marginalise()
        return self.belief

    def _row(
        self,
        pose: F64,
        reading: F64,
        before_s: float,
        seconds: float,
        T_odom_base: F64 | None = None,
        continues: bool = True,
        match: Measurement | None = None,
        motion: Measurement | None = None,
    ) -> FactorWindow:
        """Return the row of one scan; a pose (4, 4) and a reading take the place of missing measurements.

        before_s : duration of the step before. The others as of `add`.
        """
        p, d = self._parameters, len(self._free)
        nothing, read = np.zeros((d, d)), (reading, np.full(d, np.inf))
        if T_odom_base is not None:
            read = T_odom_base, self._noise(p.reading_m, p.reading_rad)
        moved_by, information = motion or (np.eye(4), nothing)
        step, _, _ = steps(np.eye(4)[None], moved_by[None])
        placed = match or (pose, nothing)
        lasts_s, before_s = max(seconds, LEAST_S), max(before_s, LEAST_S)
        ratio = min(lasts_s, max(before_s, p.steady_s)) / before_s
        # Odometry that jumps measures a step only together with a match.
        follows = T_odom_base is not None and (continues or placed[1].trace() > 0.0)
        steadiness = 0.0 if follows or information.trace() > 0.0 else self._change_sigma(lasts_s) ** -2.0
        row = seconds, not continues, *read, *placed, step[0], information, ratio, steadiness
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
            H.flat[:: len(g) + 1] += DAMPING
            factor, delta, failed = dposv(H.T, -g, overwrite_a=True)
            if failed:
                raise np.linalg.LinAlgError("the information of the smoother is not positive definite")
            changes = np.zeros((2, n, 6))
            changes[:, :, self._free] = delta[ERRORS:].reshape(n, 2, -1).swapaxes(0, 1)
            state = state.changed(delta[:ERRORS], changes)
            if np.abs(delta).max() < p.converged:
                break
        return state, factor

    def _marginalise(self) -> None:
        """Marginalise the first scan: replace it by a prior on the next two."""
        few = self._state.part(0, 3)
        H, g, _ = normal_equations(
            few, self._window.part(0, 3), self._prior, self._free, self._parameters, self._drift_scale, 1
        )
        information, gradient = _without(H, g, 2 * len(self._free))
        shift = np.asarray(
            np.linalg.solve(information + DAMPING * np.eye(len(gradient)), gradient), np.float64
        )
        self._prior = MarginalPrior(few.part(1, 3), shift, information)
        self._state = self._state.part(1, len(self._state.poses))
        self._window = self._window.part(1, len(self._window.seconds))

    # --------------------------------------------------------------------------------------------- odometry

    def _noise(self, sigma_m: float, sigma_rad: float) -> F64:
        """Return the standard deviations (D,) of the free directions."""
        return np.where(self._free < 3, sigma_m, sigma_rad)

    def _change_sigma(self, seconds: float) -> float:
        """Return the standard deviation, m and rad, of the change of the motion from one scan to the next."""
        return self._parameters.unsteady * float(seconds ** (1.0 + self._parameters.growth))


def _without(H: F64, g: F64, first: int) -> tuple[F64, F64]:
    """Marginalise the `first` unknowns after the errors of odometry by the Schur complement.

    Returns the information and the gradient on the other unknowns.
    """
    old, rest = np.s_[ERRORS : ERRORS + first], np.delete(np.arange(len(H)), np.s_[ERRORS : ERRORS + first])
    A, B = H[old, old] + DAMPING * np.eye(first), H[rest, old]
    solved = np.linalg.solve(A, np.column_stack((B.T, g[old])))
    reduced = H[rest][:, rest] - B @ solved[:, :-1]
    return 0.5 * (reduced + reduced.T), g[rest] - B @ solved[:, -1]


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
    p, about, (poses, readings, errors) = parameters, prior.about, state
    d, n, m = len(free), len(poses), len(about.poses)
    linear = steps(
        np.concatenate((window.match, window.read, poses[:-1], readings[:-1], about.poses, about.readings)),
        np.concatenate((poses, readings, poses[1:], readings[1:], poses[:m], readings[:m])),
    )
    unknowns, own = ERRORS + 2 * d * n, len(prior.shift)
    H, g = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    off = prior.shift.copy()
    off[:ERRORS] += errors - about.errors
    off[ERRORS:] += linear[0][4 * n - 2 :, free].reshape(2, m, d).swapaxes(0, 1).reshape(-1)
    H[:own, :own] = prior.information
    error, information, jacobian = np.empty((n + 1, 6)), np.empty((6, 6)), np.empty((2, 6, 5 * 6 + ERRORS))
    drift_scale = _add_factors(
        *linear, errors, window.jumps, window.read_sigma, window.match_information, window.motion,
        window.motion_information, window.ratio, window.steadiness, free, p.drift, p.drift_turn_m, p.kernel,
        drift_scale, few, off, error, information, jacobian, H, g,
    )  # fmt: skip
    return H, g, drift_scale


# --- compiled functions: the factors and their normal equations ---------------------------------------

_MATCH, _READ, _DRIFT, _MOTION, _VELOCITY = range(5)
"""Kinds of factors."""


@compiled(error_model="numpy")
def _add_factors(
    step: F64,
    by_first: F64,
    by_second: F64,
    errors: F64,
    jumps: BoolGrid,
    read_sigma: F64,
    match_information: F64,
    motion: F64,
    motion_information: F64,
    ratios: F64,
    steadiness: F64,
    free: NDArray[np.intp],
    drift: float,
    drift_turn_m: float,
    kernel: float,
    drift_scale: float,
    few: int,
    off: F64,
    error: F64,
    information: F64,
    jacobian: F64,
    H: F64,
    g: F64,
) -> float:
    """Add the factors to the normal equations H and g; return the scale of the drift.

    step, by_first, by_second : as of `steps`, N from matches to poses and N from readings to what they should
    be, then N - 1 from pose to pose and N - 1 from reading to reading. jumps .. steadiness : as of
    `FactorWindow`. H holds the information of the prior, off : (P,) its error. error (N + 1, 6), information
    (6, 6), jacobian (2, 6, 34) : room to work in. The others as for `normal_equations`.

    All is done in scalars: arrays made and cut out here, and functions called, took 5 s to compile.
    """
    d, n = len(free), len(jumps)
    moves, reports = 2 * n, 3 * n - 1
    for a in range(len(off)):
        for b in range(len(off)):
            g[a] += H[a, b] * off[b]
    c, s = (1.0 + errors[0]) * math.cos(errors[1]), (1.0 + errors[0]) * math.sin(errors[1])
    all_chi2 = 0.0
    for k in range(n - 1):
        report, chi2 = step[reports + k], 0.0
        x, y, yaw, of_position, of_turn = corrected(report, errors, drift, drift_turn_m)
        for a in range(d):
            to = free[a]
            expected = x if to == 0 else y if to == 1 else yaw if to == 5 else report[to]
            error[k, a] = step[moves + k, to] - expected
            if to == 5:
                error[k, a] -= 2.0 * math.pi * math.floor(error[k, a] / (2.0 * math.pi) + 0.5)
            if not jumps[k + 1]:
                chi2 += error[k, a] ** 2 / (of_position if to < 3 else of_turn)
        all_chi2 += chi2
    if n > 3:  # not of the few that are marginalised
        drift_scale = math.sqrt(max(all_chi2 / ((n - 1) * d), 1.0))
    for kind in range(_VELOCITY + 1):
        for k in range(min(few, n - (kind >= _DRIFT) - (kind == _VELOCITY))):
            # A reading of odometry lies near what it should be, and a pose near where the scan fits the local
            # map. A pose moves like the readings, but for systematic errors and drift; it follows the one
            # before by the motion that registration measured, or else at constant velocity.
            if kind == _DRIFT and jumps[k + 1]:
                continue
            if kind == _VELOCITY and not steadiness[k + 2]:
                continue
            at, own, cauchy, ratio, of_position, of_turn = moves + k, 3 * d, kernel, 1.0, 0.0, 0.0
            if kind < _DRIFT:
                at, own = n * kind + k, d
            elif kind == _DRIFT:
                own, report = 4 * d, step[reports + k]
                x, y, yaw, of_position, of_turn = corrected(report, errors, drift, drift_turn_m)
            elif kind == _VELOCITY:
                own, cauchy, ratio = 5 * d, math.inf, -ratios[k + 2]
            after, first, count = at + (kind == _VELOCITY), ERRORS + d * (2 * k + (kind == _READ)), own
            e, Le, J, LJ, chi2 = error[n - 1], error[n], jacobian[0], jacobian[1], 0.0
            for a in range(d):
                to = free[a]
                e[a] = step[after, to]
                if kind == _DRIFT:
                    e[a] = error[k, a]
                elif kind == _MOTION:
                    e[a] -= motion[k + 1, to]
                elif kind == _VELOCITY:
                    e[a] += ratio * step[at, to]
                if to == 5:
                    e[a] -= 2.0 * math.pi * math.floor(e[a] / (2.0 * math.pi) + 0.5)
                for b in range(d):
                    by, information[a, b] = free[b], 0.0
                    J[a, b], J[a, 2 * d + b] = ratio * by_first[at, to, by], ratio * by_second[at, to, by]
                    J[a, d + b] = J[a, 3 * d + b] = J[a, 4 * d + b] = 0.0
                    if kind == _MATCH:
                        information[a, b] = match_information[k, a, b]
                    elif kind == _MOTION:
                        information[a, b] = motion_information[k + 1, a, b]
                    if kind < _DRIFT:
                        J[a, b] = by_second[at, to, by]
                    elif kind == _DRIFT:
                        u, v = by_first[reports + k, to, by], by_second[reports + k, to, by]
                        if to == 0:
                            u = c * u - s * by_first[reports + k, 1, by]
                            v = c * v - s * by_second[reports + k, 1, by]
                        elif to == 1:
                            u = s * by_first[reports + k, 0, by] + c * u
                            v = s * by_second[reports + k, 0, by] + c * v
                        elif to == 5:
                            u, v = (1.0 + errors[3]) * u, (1.0 + errors[3]) * v
                        J[a, d + b], J[a, 3 * d + b] = -u, -v
                    elif kind == _VELOCITY:
                        J[a, 2 * d + b] += by_first[after, to, by]
                        J[a, 4 * d + b] = by_second[after, to, by]
                if kind == _READ:
                    information[a, a] = read_sigma[k, a] ** -2.0
                elif kind == _DRIFT:
                    variance = of_position if to < 3 else of_turn
                    information[a, a] = 1.0 / (drift_scale**2 * variance)
                    chi2 += e[a] ** 2 / variance
                elif kind == _VELOCITY:
                    information[a, a] = steadiness[k + 2]
            if kind == _DRIFT:
                # Slips and late readings are no evidence of errors that are the same in every step.
                learned, count = -1.0 / (1.0 + chi2 / (drift_scale * kernel) ** 2), own + ERRORS
                for a in range(d):
                    to = free[a]
                    for b in range(ERRORS):
                        J[a, own + b] = 0.0
                    if to == 0:
                        J[a, own], J[a, own + 1] = learned * (x / (1.0 + errors[0])), -learned * y
                    elif to == 1:
                        J[a, own], J[a, own + 1] = learned * (y / (1.0 + errors[0])), learned * x
                    elif to == 5:
                        J[a, own + 2] = learned * math.hypot(report[0], report[1])
                        J[a, own + 3] = learned * report[5]
            chi2 = 0.0
            for a in range(d):
                Le[a] = 0.0
                for j in range(count):
                    LJ[a, j] = 0.0
                for b in range(d):
                    Le[a] += information[a, b] * e[b]
                    for j in range(count):
                        LJ[a, j] += information[a, b] * J[b, j]
                chi2 += e[a] * Le[a]
            weight = 1.0 / (1.0 + chi2 / cauchy**2)
            for j in range(count):
                row = first + j if j < own else j - own
                for a in range(d):
                    left = weight * J[a, j]
                    if left == 0.0:
                        continue
                    g[row] += left * Le[a]
                    for i in range(count):
                        H[row, first + i if i < own else i - own] += left * LJ[a, i]
    return drift_scale


@compiled()
def corrected(
    reported: F64, errors: F64, drift: float, drift_turn_m: float
) -> tuple[float, float, float, float, float]:
    """Remove the systematic errors (4,) from a step (6,) that odometry reports.

    Returns its x, y and turn about z, and the variances of the drift over it: of positions and of turns.
    """
    c, s = (1.0 + errors[0]) * math.cos(errors[1]), (1.0 + errors[0]) * math.sin(errors[1])
    x, y, z, roll, pitch, yaw = reported[0], reported[1], reported[2], reported[3], reported[4], reported[5]
    distance_m = math.sqrt(x * x + y * y + z * z)
    turn_rad = math.sqrt(roll * roll + pitch * pitch + yaw * yaw)
    of_way = drift**2 * distance_m
    of_position = of_way + drift_turn_m**2 * turn_rad + _LEAST_DRIFT**2
    of_turn = of_way + drift**2 * turn_rad + _LEAST_DRIFT**2
    turned = (1.0 + errors[3]) * yaw + errors[2] * math.hypot(x, y)
    return c * x - s * y, s * x + c * y, turned, of_position, of_turn
