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
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv, dpotrs

from pc2grid.arrays import F64
from pc2grid.estimation._smoother_kernels import corrected, drift_variance, normal_equations, unsteadiness
from pc2grid.estimation.belief import PLANAR, Belief
from pc2grid.estimation.manifold import carried_on, moved, steps
from pc2grid.estimation.window import ERRORS, LEAST_S, SMOOTHER, Prior, SmootherParameters, State, Window
from pc2grid.geometry import invert_pose

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
