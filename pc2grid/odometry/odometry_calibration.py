"""The systematic error of wheel odometry, estimated while the poses are tracked.

A laser that is mounted half a degree askew, wheels that differ by a millimetre, a wheelbase that was measured
badly: such errors are the same in every step. As the prior of scan matching they pull every pose to the same
side, so that straight corridors bend. Compared with the poses over some metres, they can be told from noise
and taken out, as in the calibration of Censi et al., "Simultaneous calibration of odometry and sensor
parameters for mobile robots" (2013), here recursively by a Kalman filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2, wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationParameters:
    """Numbers of the estimate; chosen by hand.

    scale_sigma : standard deviation, over robots, of the share by which odometry reports a distance wrong.
    direction_sigma_rad : of the direction of travel in the frame of the scans: how far the sensor is askew.
    yaw_sigma_rad_per_m : of the turn that is reported wrong on each metre.
    turn_sigma : of the share by which a turn is reported wrong.
    steady_m : travel in which each of these may change by its standard deviation: tyres warm up, floors vary.
    outlier_sigmas : standard deviations at which a window counts half: wheels slip, odometry comes late.
    """

    scale_sigma: float = 0.05
    direction_sigma_rad: float = math.radians(2.0)
    yaw_sigma_rad_per_m: float = math.radians(2.0)
    turn_sigma: float = 0.05
    steady_m: float = 1000.0
    outlier_sigmas: float = 3.0


CALIBRATION = CalibrationParameters()


class OdometryCalibration:
    """Kalman filter over the four systematic errors of odometry: scale, direction, yaw per metre, turn."""

    def __init__(self, parameters: CalibrationParameters = CALIBRATION) -> None:
        self._parameters = parameters
        p = parameters
        self._prior = np.array([p.scale_sigma, p.direction_sigma_rad, p.yaw_sigma_rad_per_m, p.turn_sigma])
        self._errors = np.zeros(4)
        self._covariance = np.diag(self._prior**2)
        self.restart()

    def corrected(self, motion: F64) -> F64:
        """A motion (4, 4) that odometry reports, without its systematic error."""
        if not self._errors.any():
            return motion
        step = SE2.from_matrix(motion)
        scale, direction, yaw_per_m, turn = self._errors.tolist()
        distance_m = math.hypot(step.x, step.y)
        yaw = yaw_per_m * distance_m + turn * step.yaw
        # Translation and rotation are corrected apart from each other; tilt and height stay.
        result = motion.copy()
        c, s = (1.0 + scale) * math.cos(direction), (1.0 + scale) * math.sin(direction)
        result[:2, 3] = c * step.x - s * step.y, s * step.x + c * step.y
        result[:3, :3] = SE2(0.0, 0.0, yaw).lift()[:3, :3] @ motion[:3, :3]
        return result

    def restart(self) -> None:
        """Begin a new window of travel."""
        self.pose = SE2(0.0, 0.0, 0.0)
        self._jacobian = np.zeros((3, 4))
        self._travel_m = 0.0

    def extend(self, motion: F64) -> None:
        """Add a motion (4, 4), as odometry reports it, to the window."""
        step, corrected = SE2.from_matrix(motion), SE2.from_matrix(self.corrected(motion))
        distance_m = math.hypot(step.x, step.y)
        c, s = math.cos(self.pose.yaw), math.sin(self.pose.yaw)
        R = np.array([[c, -s], [s, c]])
        x, y = corrected.x, corrected.y
        self._jacobian[:2] += np.outer(R @ (-y, x), self._jacobian[2])
        self._jacobian[:2, 0] += R @ (step.x, step.y)
        self._jacobian[:2, 1] += R @ (-y, x)
        self._jacobian[2, 2:] += distance_m, step.yaw
        self.pose = self.pose @ corrected
        self._travel_m += distance_m

    def observe(self, actual: SE2, sigma_m: float, sigma_rad: float) -> None:
        """End the window: `actual` is the motion over it, by poses that the scans determine.

        sigma_m, sigma_rad : standard deviations of the accidental error of odometry over the window.
        """
        p = self._parameters
        J = self._jacobian
        difference = np.array(
            [
                actual.x - self.pose.x,
                actual.y - self.pose.y,
                wrap_angle(actual.yaw - self.pose.yaw),
            ]
        )
        self._covariance = self._covariance + np.diag(self._prior**2) * (self._travel_m / p.steady_m)
        noise = np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
        innovation = J @ self._covariance @ J.T + noise
        chi2 = float(difference @ np.linalg.solve(innovation, difference))
        innovation = J @ self._covariance @ J.T + noise * (1.0 + chi2 / p.outlier_sigmas**2)
        gain = self._covariance @ J.T @ np.linalg.inv(innovation)
        self._errors = self._errors + gain @ difference
        self._covariance = (np.eye(4) - gain @ J) @ self._covariance
        self.restart()
