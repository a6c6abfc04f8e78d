"""The slope of the floor that a camera sees ahead, which the robot has under its wheels a little later.

Between two smooth walls no scan shows which way is up. But before the robot is on a ramp it sees its foot,
and on the ramp its end. So the pitch there is the sum of the bends of the floor that it has driven over.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32
from pc2grid.clouds.ground import Ground
from pc2grid.clouds.parameters import CLOUD_PARAMETERS
from pc2grid.geometry import wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorAheadParameters:
    """How the slope ahead is measured. Chosen by hand, for a camera that sees the floor from 1.3 m on.

    near_m, far_m, half_width_m : of the floor that is looked at, in the base frame, x and to both sides.
    steepest_rad, noise_m : what rises by more is no floor; heights are noisy by this. A slope counts if its
        points lie along a line that well.
    every_m : travel from one measurement to the next.
    remembered : measurements whose median is that of a floor without a bend, since the floor's tilt in the
        base frame is known to half a degree only. A ramp shows two bends, and none in between.
    turned_rad : a robot that turns by more does not reach the floor that it saw.
    """

    near_m: float = 1.3
    far_m: float = 2.3
    half_width_m: float = 0.4
    steepest_rad: float = CLOUD_PARAMETERS.steepest_floor_rad
    noise_m: float = 0.03
    every_m: float = 0.1
    remembered: int = 150
    turned_rad: float = math.radians(20.0)


class FloorAhead:
    """Follows the pitch of a robot over the floor that it has seen ahead."""

    def __init__(self, parameters: FloorAheadParameters = FloorAheadParameters()) -> None:
        self._parameters = parameters
        self._bends_rad: deque[float] = deque(maxlen=parameters.remembered)
        self._seen: deque[tuple[float, float]] = deque()  # travel at which it is reached, and its pitch
        self._travel_m = 0.0
        self._measured_m = -math.inf
        self._yaw_rad = 0.0

    def move(self, forward_m: float, yaw_rad: float) -> None:
        """Take in the travel since the last scan, and the heading of the base in the session frame."""
        self._travel_m += forward_m
        if abs(wrap_angle(yaw_rad - self._yaw_rad)) > self._parameters.turned_rad:
            self._yaw_rad = yaw_rad
            self._seen.clear()
        while len(self._seen) > 1 and self._seen[1][0] <= self._travel_m:
            self._seen.popleft()

    @property
    def pitch_rad(self) -> float | None:
        """Pitch of the base, positive uphill; None if it did not look at the floor where it is."""
        if not self._seen or self._seen[0][0] > self._travel_m or len(self._seen) < 2:
            return None
        return self._seen[0][1]

    def look(self, points_m: F32, ground: Ground, pitch_rad: float) -> None:
        """Measure the floor ahead of a robot with a known pitch.

        points_m : (N, 3) in the base frame. ground : the floor in that frame.
        """
        p = self._parameters
        if self._travel_m - self._measured_m < p.every_m:
            return
        self._measured_m = self._travel_m
        x, heights = points_m[:, 0], ground.heights(points_m)
        floor = (
            (x > p.near_m)
            & (x < p.far_m)
            & (np.abs(points_m[:, 1]) < p.half_width_m)
            & (np.abs(heights) < math.tan(p.steepest_rad) * x + p.noise_m)
        )
        if floor.sum() < 3:
            return
        (slope, _), residual, *_ = np.polyfit(x[floor], heights[floor], 1, full=True)
        if math.sqrt(float(residual[0]) / floor.sum()) > p.noise_m:
            return
        self._bends_rad.append(math.atan(float(slope)))
        bend_rad = self._bends_rad[-1] - float(np.median(self._bends_rad))
        slope_rad = pitch_rad + bend_rad
        if self.pitch_rad is None and self._seen:
            # Between here and what was seen first the floor may bend: the pitch here is not known.
            slope_rad = self._seen[-1][1]
        self._seen.append((self._travel_m + 0.5 * (p.near_m + p.far_m), slope_rad))
