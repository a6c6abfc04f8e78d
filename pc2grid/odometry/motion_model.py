"""The motion that is expected before a scan is looked at: by odometry, or else as it was before."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import interpolate_pose, invert_pose
from pc2grid.model import Scan
from pc2grid.odometry.overruled import Disagreement
from pc2grid.odometry.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.odometry.wheel_odometry import OdometryTrust, is_plausible, motion_size


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """The expected motion from the last scan to this one.

    motion : (4, 4) T_last_now. seconds : the time between them.
    odometry : (4, 4) motion since odometry was last known, as it reports it; None if `motion` rests on the
        motion before instead.
    windowed : (4, 4) T_last_now as odometry reports it over the last second: from the pose a second ago. It
        differs from `motion` if odometry is late, or reports a motion again that the scans have shown before.
    credible : False if odometry is implausible and the local map confirms neither it nor the motion before.
    """

    motion: F64
    seconds: float
    odometry: F64 | None = None
    windowed: F64 | None = None
    credible: bool = True


class MotionModel:
    """Predicts motions from odometry and from the last poses; all use of odometry is here.

    last_pose : (4, 4) T_session_base of the last scan.
    heading_variance : rad^2, of the heading of that pose against the local map.
    """

    def __init__(self, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._parameters = parameters
        self._trust = OdometryTrust(parameters)
        self._window: list[tuple[int, F64, F64]] = []  # stamp, T_odom_base, T_session_base of the last second
        self._intervals_s: list[float] = []  # between the last scans
        self._recent: list[tuple[int, F64]] = []  # stamp and T_session_base of the last three scans
        self._measured: tuple[F64, F64] | None = (
            None  # T_odom_base, T_session_base of the last known odometry
        )
        self._last_had_odometry = False
        self.last_pose: F64 = np.eye(4)
        self.heading_variance = 0.0

    def predict(self, scan: Scan) -> Prediction:
        """Predict the motion up to a scan.

        Odometry spans the scans that had none: the poses of those were only predicted. Only for a scan
        that has no odometry itself is the motion before continued.
        """
        seconds = (scan.stamp_ns - self._recent[-1][0]) * 1e-9
        if scan.T_odom_base is None or self._measured is None:
            return self.continued(seconds)
        T_odom_then, T_session_then = self._measured
        odometry: F64 = self._trust.corrected(invert_pose(T_odom_then) @ scan.T_odom_base)
        motion = odometry
        if not self._last_had_odometry:
            motion = invert_pose(self.last_pose) @ T_session_then @ odometry
        windowed = None
        if self._window:
            _, T_odom_then, T_session_then = self._window[0]
            over_window = self._trust.corrected(invert_pose(T_odom_then) @ scan.T_odom_base)
            windowed = invert_pose(self.last_pose) @ T_session_then @ over_window
        return Prediction(motion=motion, seconds=seconds, odometry=odometry, windowed=windowed)

    def continued(self, seconds: float) -> Prediction:
        """Predict that the last motion continues.

        That motion is taken over two scans where they follow closely. It removes the skew of the next scan,
        and the error of a single pose, taken for motion, would come back in the next pose with the other
        sign, and grow.
        """
        motion = np.eye(4)
        now_ns, T_session_now = self._recent[-1]
        for k, (stamp_ns, T_session_then) in enumerate(self._recent[:-1]):
            span = (now_ns - stamp_ns) * 1e-9
            if span < self._parameters.steady_s or k == len(self._recent) - 2:
                before = invert_pose(T_session_then) @ T_session_now
                motion = interpolate_pose(np.eye(4), before, min(seconds / span, 1.0))
                break
        return Prediction(motion=motion, seconds=seconds)

    def is_plausible(self, prediction: Prediction) -> bool:
        """Whether the odometry that a prediction rests on, if any, is a motion that a robot can make."""
        odometry, p = prediction.odometry, self._parameters
        usual_s = float(np.median(self._intervals_s)) if self._intervals_s else prediction.seconds
        gap_s = max(p.gap_s, p.gap_intervals * usual_s)
        return odometry is None or is_plausible(odometry, prediction.seconds, gap_s, p)

    def owed(self, prediction: Prediction) -> tuple[float, float]:
        """Return by how much (m, rad) odometry over a step and over the last second differ; 0 if by little.

        Then odometry is late, or repeats a motion, and only the scan can tell which of the two is right.
        """
        p = self._parameters
        if prediction.windowed is None:
            return 0.0, 0.0
        distance_m, turn_rad = motion_size(invert_pose(prediction.motion) @ prediction.windowed)
        return (distance_m, turn_rad) if distance_m > p.owed_m or turn_rad > p.owed_rad else (0.0, 0.0)

    def disagreement(self, prediction: Prediction, T_session_base: F64) -> Disagreement | None:
        """Return by how much odometry differs from the motion to the final pose (4, 4) of a scan.

        None if the prediction does not rest on odometry. To be called before `observe`. Unknown odometry may
        be wrong by `slip_sigma` of the motion, and by `owed_m` and `owed_rad` on top of it.
        """
        if prediction.odometry is None or self._measured is None:
            return None
        p = self._parameters
        moved = invert_pose(self._measured[1]) @ T_session_base
        distance_m, turn_rad = motion_size(invert_pose(prediction.odometry) @ moved)
        (reported_m, reported_rad), (moved_m, moved_rad) = map(motion_size, (prediction.odometry, moved))
        overrules = distance_m > p.owed_m + p.slip_sigma * max(
            reported_m, moved_m
        ) or turn_rad > p.owed_rad + p.slip_sigma * max(reported_rad, moved_rad)
        return Disagreement(distance_m, turn_rad, overrules, reported_m=reported_m, moved_m=moved_m)

    def search_window(self, prediction: Prediction) -> tuple[float, float]:
        """Return how far (m, rad) the robot can be from where it is predicted."""
        p = self._parameters
        known = self.information if prediction.odometry is not None else self.information_on_continued
        variances = np.diag(np.linalg.inv(known(prediction)))
        sigma_m, sigma_rad = math.sqrt(variances[0]), math.sqrt(variances[2])
        return min(p.search_sigmas * sigma_m, p.search_most_m), min(
            p.search_sigmas * sigma_rad, p.search_most_rad
        )

    def forget_window(self) -> None:
        """Start the window of odometry again, because its frame has changed."""
        self._window = []

    def within(self, scan: Scan, prediction: Prediction | None) -> tuple[F64, float]:
        """Return the motion (4, 4) of the base while a scan is taken, and its duration in seconds.

        It is odometry's where that is used (or for the first scan, without a prediction), since a turn
        begins and ends within a scan; else the predicted motion.
        """
        if prediction is None or prediction.odometry is not None:
            times, motion = scan.offsets_s, scan.T_first_last
            if motion is not None and times is not None:
                seconds = float(times.max() - times.min())
                if is_plausible(motion, seconds, self._parameters.gap_s, self._parameters):
                    return motion, seconds
        return (np.eye(4), 0.0) if prediction is None else (prediction.motion, prediction.seconds)

    def information_on_continued(self, prediction: Prediction) -> F64:
        """Return the information (3, 3) that the motion before gives on x, y, yaw, without odometry."""
        p, seconds = self._parameters, prediction.seconds
        sigma_m, sigma_rad = p.unsteady_mps * seconds, p.unsteady_radps * seconds
        return np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])

    def leap_m(self, information: F64) -> float:
        """Return how far from the predicted position a robot hardly is, by `information` (3, 3) on it."""
        return self._parameters.leap_sigmas / math.sqrt(float(information[0, 0]))

    def information(self, prediction: Prediction) -> F64:
        """Return the information (3, 3) on x, y, yaw: of odometry, else of the pose that KISS-ICP found.

        Odometry counts less by what it owes.
        """
        if prediction.odometry is not None:
            information = self._trust.information(prediction.odometry)
            owed_m, owed_rad = self.owed(prediction)
            owed = np.diag([owed_m**2, owed_m**2, owed_rad**2])
            return np.linalg.inv(np.linalg.inv(information) + owed) if owed.any() else information
        p = self._parameters
        return np.diag([p.steady_sigma_m**-2, p.steady_sigma_m**-2, p.steady_sigma_rad**-2])

    def with_heading(self, information: F64) -> F64:
        """Return the information (3, 3) that a step of `information` leaves on the pose after it.

        The heading before the step is not exact: the variances of both add up (the prediction of a Kalman
        filter). Otherwise, while a turn shows little but a near wall, every scan would be held to a heading
        that odometry has turned too far already, as if it were certain.
        """
        variances = np.linalg.inv(information)
        variances[2, 2] += self.heading_variance
        return np.linalg.inv(variances)

    def observe_heading(self, information: F64) -> None:
        """Remember how exact the heading of a scan is: `information` (3, 3) by its prior and its points."""
        self.heading_variance = float(np.linalg.inv(information)[2, 2])

    def information_if_punctual(self, prediction: Prediction) -> F64 | None:
        """Return the information (3, 3) of odometry that owes a motion, if it owed none; None if it does not.

        Where the scan does not tell, the poses must follow odometry all the same. Else odometry that was once
        overruled is owed ever more, counts ever less, and the robot seems to stand still.
        """
        if prediction.odometry is None or not any(self.owed(prediction)):
            return None
        return self._trust.information(prediction.odometry)

    def observe(self, scan: Scan, T_session_base: F64, *, sure: bool) -> None:
        """Remember the final pose (4, 4) of a scan; `sure`: every direction of it was measured."""
        p = self._parameters
        if self._recent:
            seconds = (scan.stamp_ns - self._recent[-1][0]) * 1e-9
            self._intervals_s = [*self._intervals_s[-(p.usual_intervals - 1) :], seconds]
        self._recent = [*self._recent[-2:], (scan.stamp_ns, T_session_base)]
        self.last_pose = T_session_base
        self._last_had_odometry = scan.T_odom_base is not None
        if scan.T_odom_base is not None:
            self._measured = scan.T_odom_base, T_session_base
            begin_ns = scan.stamp_ns - p.window_s * 1e9
            kept = [past for past in self._window if past[0] >= begin_ns]
            self._window = [*kept, (scan.stamp_ns, scan.T_odom_base, T_session_base)]
            self._trust.observe(scan.T_odom_base, T_session_base, sure)


def not_credible(prediction: Prediction) -> Prediction:
    """Return the same prediction, marked as confirmed by nothing."""
    return dataclasses.replace(prediction, credible=False)
