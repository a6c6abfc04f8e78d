"""How far odometry may be believed: learned from how well it agreed with the walls so far.

One robot's wheels are right to a percent, another's turn by a tenth too much, and no log says which. Taken
too seriously, odometry bends the map; not seriously enough, the noise of every scan does.
"""

from __future__ import annotations

import math

import numpy as np

from pc2grid.geometry import F64, SE2, invert_pose, rotation_vector

_WINDOW_M = 2.0  # of travel; what is compared must stand out from the noise of the poses
_WINDOWS = 5
_BEST, _WORST = 0.25, 1.0
_SAFETY = 2.0


class OdometryTrust:
    """Compares odometry with the poses that were settled on, window by window of travel.

    Doubts it (a tenth of the distance and of the rotation) until the windows say better.
    """

    def __init__(self) -> None:
        self._begin: tuple[F64, F64] | None = None
        self._travel_m = 0.0
        self._last: F64 | None = None
        self._turn_rad = 0.0
        self._errors: list[float] = []

    @property
    def doubt(self) -> float:
        """What its standard deviations are multiplied by, _BEST to _WORST."""
        if len(self._errors) < 3:
            return _WORST
        rms = math.sqrt(sum(e * e for e in self._errors) / len(self._errors))
        return min(max(_SAFETY * rms, _BEST), _WORST)

    def information(self, odometry: F64) -> F64:
        """Information (3, 3) on x, y, yaw after a motion (4, 4) that odometry reports."""
        sigma_m, sigma_rad = _sigmas(*_extent(odometry))
        sigma_m, sigma_rad = self.doubt * (0.01 + sigma_m), self.doubt * (0.01 + sigma_rad)
        return np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])

    def observe(self, T_odom_base: F64, T_map_base: F64, sure: bool) -> None:
        """A pose that was settled on; one that is not `sure` of all directions ends the window."""
        if self._begin is None or self._last is None or not sure:
            self._begin = (T_odom_base, T_map_base) if sure else None
            self._last, self._travel_m, self._turn_rad = T_odom_base, 0.0, 0.0
            return
        distance, turn = _extent(invert_pose(self._last) @ T_odom_base)
        self._last = T_odom_base
        self._travel_m += distance
        self._turn_rad += turn
        if self._travel_m < _WINDOW_M:
            return
        said = SE2.flatten(invert_pose(self._begin[0]) @ T_odom_base)
        was = SE2.flatten(invert_pose(self._begin[1]) @ T_map_base)
        wrong = was.inverse() @ said
        sigma_m, sigma_rad = _sigmas(self._travel_m, self._turn_rad)
        error = max(math.hypot(wrong.x, wrong.y) / sigma_m, abs(wrong.yaw) / sigma_rad)
        self._errors = [*self._errors[1 - _WINDOWS :], error]
        self._begin, self._travel_m, self._turn_rad = (T_odom_base, T_map_base), 0.0, 0.0


def _extent(motion: F64) -> tuple[float, float]:
    """Distance and angle of a motion (4, 4)."""
    return float(np.linalg.norm(motion[:3, 3])), float(np.linalg.norm(rotation_vector(motion)))


def _sigmas(distance_m: float, turn_rad: float) -> tuple[float, float]:
    """Standard deviations, metres and radians, of odometry that is not to be trusted."""
    return 0.1 * distance_m + 0.05 * turn_rad, 0.1 * turn_rad + 0.1 * distance_m
