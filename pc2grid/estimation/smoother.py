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
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from pc2grid.arrays import F64, BoolGrid
from pc2grid.estimation.belief import KERNEL, PLANAR, Belief
from pc2grid.estimation.graph import Factors, normal_equations, without
from pc2grid.estimation.manifold import Steps, carried_on, moved, steps
from pc2grid.geometry import invert_pose, wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class SmootherParameters:
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
    kernel : see `pc2grid.estimation.belief.KERNEL`.
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

_ERRORS = 4  # systematic errors of odometry
_DAMPING = 1e-9  # so that unknowns without evidence can be solved for
_CERTAIN = np.array([np.inf])  # kernel of a factor whose weight is 1
_LEAST_S = 1e-3  # scans follow each other no faster
_LEAST_DRIFT = 1e-3  # standard deviation of odometry that reports no motion


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


class _Window(NamedTuple):
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

    def part(self, begin: int, end: int) -> _Window:
        """Of the scans from `begin` to before `end`."""
        return _Window._make(rows[begin:end] for rows in self)

    def then(self, more: _Window) -> _Window:
        """With further scans."""
        return _Window._make(map(np.concatenate, zip(self, more, strict=True)))

    @property
    def unmeasured(self) -> BoolGrid:
        """(N,) whether neither registration nor odometry nor, where that jumps, a match says where a scan
        lies."""
        informed = (self.match_information, self.motion_information)
        matched, moved_by = (information.any(axis=(1, 2)) for information in informed)
        read = np.isfinite(self.read_sigma[:, 0])
        without: BoolGrid = ~moved_by & ~(read & (matched | ~self.jumps))
        return without


@dataclass(frozen=True, slots=True)
class _State:
    """What is estimated of the last N scans.

    poses : (N, 4, 4) T_session_base. readings : (N, 4, 4) T_odom_base as odometry without errors would
        report.
    errors : (4,) systematic errors of odometry: scale, direction, yaw per metre, turn.
    """

    poses: F64
    readings: F64
    errors: F64

    def changed(self, errors: F64, changes: F64) -> _State:
        """After changes of the errors (4,), and (N, 2, 6) of poses and readings."""
        return _State(
            moved(self.poses, changes[:, 0]), moved(self.readings, changes[:, 1]), self.errors + errors
        )

    def part(self, begin: int, end: int) -> _State:
        """Of the scans from `begin` to before `end`."""
        return _State(self.poses[begin:end], self.readings[begin:end], self.errors)


@dataclass(frozen=True, slots=True)
class _Prior:
    """What the marginalised scans say: the first unknowns are those of `about`, less `shift` (P,)."""

    about: _State
    shift: F64
    information: F64


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
        self._state = _State(T_session_base[None].copy(), reading[None].copy(), np.zeros(_ERRORS))
        self._window = self._row(Evidence(seconds=0.0), T_session_base, reading)
        self._begins = True  # no scan has been added since
        errors = np.array([p.scale, p.direction_rad, p.yaw_rad_per_m, p.turn])
        own = np.concatenate((np.full(d, 1e-4), self._noise(p.reading_m, p.reading_rad)))
        information = np.diag(np.concatenate((errors, own)) ** -2)
        self._prior = _Prior(self._state, np.zeros(len(information)), information)
        self._covariance = np.diag(own[:d] ** 2)
        self._drift_scale = 1.0  # of the drift that the last steps show, in its standard deviations

    @property
    def belief(self) -> Belief:
        """The pose of the last scan."""
        return Belief(self._state.poses[-1], self._covariance, self._free)

    def by_odometry(self, T_odom_base: F64) -> Belief:
        """The next pose if a reading (4, 4) of odometry is right."""
        p = self._parameters
        reported, _, _ = steps(self._state.readings[-1:], T_odom_base[None])
        corrected, _, _ = self._corrected(reported, self._state.errors)
        variance = self._drift_variance(reported)[0] + 2.0 * self._noise(p.reading_m, p.reading_rad) ** 2
        return self.after(moved(np.eye(4)[None], corrected)[0], np.sqrt(variance))

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
        return step[0], max(float(spans_s[back]), _LEAST_S)

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
        state = _State(
            np.concatenate((before.poses, guess[None])),
            np.concatenate((before.readings, reading[None])),
            before.errors,
        )
        self._state, information = self._solved(state)
        self._covariance = self._last_covariance(information)
        if len(self._state.poses) > self._parameters.lag:
            self._marginalise()
        return self.belief

    def _row(self, evidence: Evidence, pose: F64, reading: F64) -> _Window:
        """The evidence of one scan; a pose (4, 4) and a reading stand for what is not measured."""
        p, d = self._parameters, len(self._free)
        nothing, read = np.zeros((d, d)), (reading, np.full(d, np.inf))
        if evidence.T_odom_base is not None:
            read = evidence.T_odom_base, self._noise(p.reading_m, p.reading_rad)
        motion, information = evidence.motion or (np.eye(4), nothing)
        step, _, _ = steps(np.eye(4)[None], motion[None])
        match = evidence.match or (pose, nothing)
        row = (evidence.seconds, not evidence.continues, *read, *match, step[0], information)
        return _Window(*(np.array(value)[None] for value in row))

    def _solved(self, state: _State) -> tuple[_State, F64]:
        """Gauss-Newton from a state; returns the last one, and the information matrix on its unknowns."""
        p, n = self._parameters, len(state.poses)
        count = _ERRORS + 2 * len(self._free) * n
        for _ in range(p.iterations):
            H, g = normal_equations(self._factors(state, self._window), count)
            H[np.diag_indices(count)] += _DAMPING
            delta = -cho_solve(cho_factor(H, check_finite=False), g, check_finite=False)
            changes = np.zeros((n, 2, 6))
            changes[:, :, self._free] = delta[_ERRORS:].reshape(n, 2, -1)
            state = state.changed(delta[:_ERRORS], changes)
            if np.abs(delta).max() < p.converged:
                break
        return state, H

    def _last_covariance(self, information: F64) -> F64:
        """The covariance (D, D) of the last pose."""
        count, d = len(information), len(self._free)
        last = np.zeros((count, d))
        last[count - 2 * d : count - d] = np.eye(d)
        solved = cho_solve(cho_factor(information, check_finite=False), last, check_finite=False)
        covariance: F64 = solved[count - 2 * d : count - d]
        return covariance

    def _marginalise(self) -> None:
        """Replace the first scan by what it says of the next two."""
        d = len(self._free)
        few, first = self._state.part(0, 3), _ERRORS + np.arange(2 * d)
        factors = (part.touching(first) for part in self._factors(few, self._window.part(0, 3)))
        H, g = normal_equations(factors, _ERRORS + 2 * d * len(few.poses))
        information, gradient = without(H, g, first)
        shift = np.asarray(
            np.linalg.solve(information + _DAMPING * np.eye(len(gradient)), gradient), np.float64
        )
        self._prior = _Prior(few.part(1, 3), shift, information)
        self._state = self._state.part(1, len(self._state.poses))
        self._window = self._window.part(1, len(self._window.seconds))

    # --------------------------------------------------------------------------------------------- factors

    def _factors(self, state: _State, window: _Window) -> Iterator[Factors]:
        """All factors of some scans at a state, the first of which is the oldest one."""
        of_poses = steps(state.poses[:-1], state.poses[1:])
        of_readings = steps(state.readings[:-1], state.readings[1:])
        yield self._prior_factor(state)
        yield self._reading_factors(state.readings, window)
        yield self._match_factors(state.poses, window)
        yield self._drift_factors(of_poses, of_readings, state.errors, window)
        yield self._motion_factors(of_poses, window)
        yield self._steadiness_factors(of_poses, window)

    def _prior_factor(self, state: _State) -> Factors:
        """What the marginalised scans say of errors and first states."""
        about, m = self._prior.about, len(self._prior.about.poses)
        poses, readings = steps(about.poses, state.poses[:m]), steps(about.readings, state.readings[:m])
        off = np.stack((poses.step, readings.step), axis=1)[:, :, self._free]
        error = np.concatenate((state.errors - about.errors, off.ravel())) + self._prior.shift
        identity, rows = np.eye(len(error)), np.arange(len(error))
        return Factors(rows[None], error[None], identity[None], self._prior.information[None], _CERTAIN)

    def _reading_factors(self, readings: F64, window: _Window) -> Factors:
        """A reading of odometry lies near what it should be."""
        off = steps(window.read, readings)
        rows = self._rows(np.arange(len(readings)), of_reading=True)
        return self._factor(rows, off.step, off.by_second[:, :, self._free], window.read_sigma)

    def _match_factors(self, poses: F64, window: _Window) -> Factors:
        """A pose lies near where the scan fits the local map."""
        off = steps(window.match, poses)
        jacobian = off.by_second[:, self._free[:, None], self._free]
        kernel = np.full(len(poses), self._parameters.kernel)
        rows = self._rows(np.arange(len(poses)))
        return Factors(rows, off.step[:, self._free], jacobian, window.match_information, kernel)

    def _drift_factors(self, of_poses: Steps, of_readings: Steps, errors: F64, window: _Window) -> Factors:
        """From scan to scan the pose moves as odometry should report it, but for its errors and its drift."""
        corrected, by_report, by_errors = self._corrected(of_readings.step, errors)
        error = _wrapped(of_poses.step - corrected)
        sigmas = np.sqrt(self._drift_variance(of_readings.step))
        sigmas[window.jumps[1:]] = np.inf
        scans = np.arange(len(error))
        rows = np.concatenate(
            (
                np.tile(np.arange(_ERRORS), (len(scans), 1)),
                self._rows(scans), self._rows(scans + 1),
                self._rows(scans, of_reading=True), self._rows(scans + 1, of_reading=True),
            ),
            axis=1,
        )  # fmt: skip
        chi2 = ((error[:, self._free] / sigmas) ** 2).sum(axis=1)
        if len(scans) > 2:  # not of the few that are marginalised
            self._drift_scale = math.sqrt(max(float(chi2.mean()) / len(self._free), 1.0))
        sigmas = self._drift_scale * sigmas
        # What slips, or comes late, says nothing of errors that are the same in every step.
        weight = 1.0 / (1.0 + chi2 / (self._drift_scale * self._parameters.kernel) ** 2)
        by_errors = by_errors * weight[:, None, None]
        jacobians = (
            of_poses.by_first,
            of_poses.by_second,
            -by_report @ of_readings.by_first,
            -by_report @ of_readings.by_second,
        )
        free = [a[:, :, self._free] for a in jacobians]
        return self._factor(rows, error, np.concatenate((-by_errors, *free), axis=2), sigmas)

    def _motion_factors(self, of_poses: Steps, window: _Window) -> Factors:
        """A pose follows the one before by the motion that registration measured."""
        scans = np.arange(len(of_poses.step))
        rows = np.concatenate((self._rows(scans), self._rows(scans + 1)), axis=1)
        jacobian = np.concatenate(
            (of_poses.by_first[:, :, self._free], of_poses.by_second[:, :, self._free]), axis=2
        )
        error = _wrapped(of_poses.step - window.motion[1:])[:, self._free]
        kernel = np.full(len(scans), self._parameters.kernel)
        return Factors(rows, error, jacobian[:, self._free], window.motion_information[1:], kernel)

    def _steadiness_factors(self, of_poses: Steps, window: _Window) -> Factors:
        """Where nothing else measures it, the motion goes on as it was."""
        p, scans = self._parameters, np.arange(len(of_poses.step) - 1)
        seconds = np.maximum(window.seconds, _LEAST_S)
        for_s = np.minimum(seconds[2:], np.maximum(seconds[1:-1], p.steady_s))
        ratio = (for_s / seconds[1:-1])[:, None]
        rows = np.concatenate([self._rows(scans + k) for k in range(3)], axis=1)
        of_first = -ratio[:, :, None] * of_poses.by_first[:-1]
        of_second = of_poses.by_first[1:] - ratio[:, :, None] * of_poses.by_second[:-1]
        of_third = of_poses.by_second[1:]
        jacobian = np.concatenate([J[:, :, self._free] for J in (of_first, of_second, of_third)], axis=2)
        sigmas = np.array([self._unsteadiness(s) for s in seconds[2:].tolist()]).reshape(-1, len(self._free))
        sigmas[~window.unmeasured[2:]] = np.inf
        error = _wrapped(of_poses.step[1:] - ratio * of_poses.step[:-1])
        return self._factor(rows, error, jacobian, sigmas, kernel=np.inf)

    def _factor(
        self, rows: NDArray[np.intp], error: F64, jacobian: F64, sigmas: F64, kernel: float | None = None
    ) -> Factors:
        """Factors of residuals (F, 6), of which the free directions count, with standard deviations (F,
        D)."""
        information = (sigmas**-2)[:, :, None] * np.eye(len(self._free))
        scale = np.full(len(rows), self._parameters.kernel if kernel is None else kernel)
        return Factors(rows, error[:, self._free], jacobian[:, self._free], information, scale)

    def _rows(self, scans: NDArray[np.intp], *, of_reading: bool = False) -> NDArray[np.intp]:
        """The numbers (F, D) of the unknowns of the poses, or of the readings, of scans (F,)."""
        d = len(self._free)
        rows: NDArray[np.intp] = _ERRORS + (2 * scans[:, None] + of_reading) * d + np.arange(d)
        return rows

    # --------------------------------------------------------------------------------------------- odometry

    def _noise(self, sigma_m: float, sigma_rad: float) -> F64:
        """Standard deviations (D,) of the free directions."""
        return np.where(self._free < 3, sigma_m, sigma_rad)

    def _unsteadiness(self, seconds: float) -> F64:
        """Standard deviations (D,) of the change of the motion from one scan to the next."""
        p = self._parameters
        return np.full(len(self._free), p.unsteady * seconds ** (1.0 + p.growth))

    def _drift_variance(self, reported: F64) -> F64:
        """Variances (N, D) of the drift over steps (N, 6)."""
        p = self._parameters
        distance_m = np.linalg.norm(reported[:, :3], axis=1)[:, None]
        turn_rad = np.linalg.norm(reported[:, 3:], axis=1)[:, None]
        of_position = p.drift**2 * distance_m + p.drift_turn_m**2 * turn_rad
        of_turn = p.drift**2 * (turn_rad + distance_m)
        variance: F64 = np.where(self._free < 3, of_position, of_turn) + _LEAST_DRIFT**2
        return variance

    def _corrected(self, reported: F64, errors: F64) -> tuple[F64, F64, F64]:
        """Steps (N, 6) that odometry reports, without its systematic errors (4,).

        Returns them with their Jacobians with respect to the steps, (6, 6), and to the errors, (N, 6, 4).
        """
        scale, direction, yaw_per_m, turn = errors.tolist()
        c, s = (1.0 + scale) * math.cos(direction), (1.0 + scale) * math.sin(direction)
        by_report = np.eye(6)
        by_report[:2, :2], by_report[5, 5] = [[c, -s], [s, c]], 1.0 + turn
        corrected = reported @ by_report.T
        distance_m = np.hypot(reported[:, 0], reported[:, 1])
        by_errors = np.zeros((len(reported), 6, _ERRORS))
        by_errors[:, :2, 0] = corrected[:, :2] / (1.0 + scale)
        by_errors[:, 0, 1], by_errors[:, 1, 1] = -corrected[:, 1], corrected[:, 0]
        by_errors[:, 5, 2], by_errors[:, 5, 3] = distance_m, reported[:, 5]
        corrected[:, 5] += yaw_per_m * distance_m
        return corrected, by_report, by_errors


def _wrapped(steps_between: F64) -> F64:
    """Differences (N, 6) of steps, the turn about z within half a turn."""
    result = steps_between.copy()
    result[:, 5] = wrap_angle(result[:, 5])
    return result
