"""How reliable the wheel odometry is: estimated from its agreement with the poses so far.

The error of wheel odometry is a percent on one robot and a tenth, in rotation, on another, and no recording
states it. If odometry has too much weight, its errors bend the map; if it has too little, the noise of every
scan does.
"""

from __future__ import annotations

import math

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2, invert_pose
from pc2grid.odometry.odometry_calibration import OdometryCalibration
from pc2grid.odometry.parameters import TRACKING_PARAMETERS, TrackingParameters


class OdometryTrust:
    """Compares odometry with the final poses, window by window of travel.

    Until there are enough windows, odometry counts as unknown: a tenth of the distance and of the rotation.
    """

    def __init__(self, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._parameters = parameters
        self._begin: tuple[F64, F64] | None = None  # T_odom_base, T_session_base where the window begins
        self._last: F64 | None = None  # T_odom_base
        self._travel_m = 0.0
        self._turn_rad = 0.0
        self._errors: list[float] = []  # of the last windows, in standard deviations of unknown odometry
        self._calibration = OdometryCalibration()

    def corrected(self, motion: F64) -> F64:
        """A motion (4, 4) that odometry reports, without the systematic error that it has shown so far."""
        return self._calibration.corrected(motion)

    @property
    def doubt(self) -> float:
        """Factor on the standard deviations of odometry, `trust_best` to `trust_worst`."""
        p = self._parameters
        if len(self._errors) < p.trust_min_windows:
            return p.trust_worst
        rms = math.sqrt(sum(e * e for e in self._errors) / len(self._errors))
        return min(max(p.trust_safety * rms, p.trust_best), p.trust_worst)

    def information(self, odometry: F64) -> F64:
        """Return the information (3, 3) on x, y, yaw after a motion (4, 4) that odometry reports."""
        sigma_m, sigma_rad = self._sigmas(*motion_size(odometry))
        sigma_m = self.doubt * (self._parameters.odometry_floor_m + sigma_m)
        sigma_rad = self.doubt * (self._parameters.odometry_floor_rad + sigma_rad)
        return np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])

    def observe(self, T_odom_base: F64, T_session_base: F64, sure: bool) -> None:
        """Compare odometry with a final pose; one that is not `sure` in every direction ends the window."""
        if self._begin is None or self._last is None or not sure:
            self._begin = (T_odom_base, T_session_base) if sure else None
            self._last, self._travel_m, self._turn_rad = T_odom_base, 0.0, 0.0
            self._calibration.restart()
            return
        motion = invert_pose(self._last) @ T_odom_base
        distance, turn = motion_size(motion)
        self._last = T_odom_base
        self._travel_m += distance
        self._turn_rad += turn
        self._calibration.extend(motion)
        if self._travel_m < self._parameters.trust_window_m:
            return
        reported = SE2.from_matrix(invert_pose(self._begin[0]) @ T_odom_base)
        actual = SE2.from_matrix(invert_pose(self._begin[1]) @ T_session_base)
        # Judged without the correction: an estimate from the poses must not make odometry count more in them.
        wrong = actual.inverse() @ reported
        sigma_m, sigma_rad = self._sigmas(self._travel_m, self._turn_rad)
        error = max(math.hypot(wrong.x, wrong.y) / sigma_m, abs(wrong.yaw) / sigma_rad)
        self._calibration.observe(actual, self.doubt * sigma_m, self.doubt * sigma_rad)
        self._errors = [*self._errors[1 - self._parameters.trust_windows :], error]
        self._begin, self._travel_m, self._turn_rad = (T_odom_base, T_session_base), 0.0, 0.0

    def _sigmas(self, distance_m: float, turn_rad: float) -> tuple[float, float]:
        """Standard deviations, metres and radians, of unknown odometry over a motion."""
        p = self._parameters
        return (
            p.slip_sigma * distance_m + p.slip_sigma_m_per_rad * turn_rad,
            p.slip_sigma * turn_rad + p.slip_sigma * distance_m,
        )


def motion_size(motion: F64) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) of a motion (4, 4)."""
    (xx, xy, xz, x), (yx, yy, yz, y), (zx, zy, zz, z), _ = motion.tolist()
    twice_sine = math.hypot(zy - yz, xz - zx, yx - xy)
    return math.hypot(x, y, z), math.atan2(twice_sine, xx + yy + zz - 1.0)


def is_plausible(odometry: F64, seconds: float, gap_s: float, parameters: TrackingParameters) -> bool:
    """Whether a motion (4, 4) that odometry reports over a time is one that a robot indoors can make.

    gap_s : a longer time is a gap in the log. Odometry over a gap is not plausible: its driver may have been
    restarted meanwhile.
    """
    p = parameters
    distance_m, turn_rad = motion_size(odometry)
    return (
        seconds <= gap_s
        and distance_m <= p.jump_m + p.fastest_mps * seconds
        and turn_rad <= p.jump_rad + p.fastest_radps * seconds
    )
