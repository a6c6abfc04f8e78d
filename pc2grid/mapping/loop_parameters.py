"""The numbers of loop closure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopParameters:
    """Numbers of loop closure. Chosen by hand and checked on the relations of fr079 and intel, unless noted.

    Cutting into local maps:

    travel_m : travel after which a local map is complete.
    turn_m_per_rad : travel that a turn on the spot counts as.

    Which pairs are compared:

    near_m : older local maps within this distance may overlap the newest one.
    compared : older local maps that the newest is compared with.

    How far is searched: as far as tracking may have drifted since the pose was last certain.

    certain_m, certain_rad : the window directly after a loop.
    drift_per_m, drift_rad_per_m : growth of the window per metre of travel.
    max_window_m, max_window_rad : its largest size.
    lost_m : travel that a lost stretch counts as; enough for the largest window.

    What they count in the pose graph:

    information_share : of the information that a match reports: the errors of points on one wall are
        correlated.
    tracking_sigma_m, tracking_sigma_per_m : standard deviation of a tracked step, constant and per metre.
    tracking_sigma_rad, tracking_sigma_rad_per_m : the same of its yaw: 0.45 degrees over 4 m, chosen on
        killian (`docs/method.md`).
    lost_sigma_m, lost_sigma_rad : the same where tracking was lost in between.

    Place recognition:

    stretch_maps : consecutive local maps that make a stretch: 12 m of travel, chosen on aces, csail and
        killian.
    recognized_m : window of the comparison that confirms a recognition; its yaw is within `certain_rad`.
    compared_pairs : pairs of local maps of the two stretches that are compared at most.
    """

    travel_m: float = 4.0
    turn_m_per_rad: float = 0.3
    near_m: float = 8.0
    compared: int = 10
    certain_m: float = 0.3
    certain_rad: float = math.radians(4.0)
    drift_per_m: float = 0.02
    drift_rad_per_m: float = 0.006
    max_window_m: float = 3.0
    max_window_rad: float = math.radians(20.0)
    lost_m: float = 150.0
    information_share: float = 0.1
    tracking_sigma_m: float = 0.02
    tracking_sigma_per_m: float = 0.01
    tracking_sigma_rad: float = math.radians(0.25)
    tracking_sigma_rad_per_m: float = math.radians(0.05)
    lost_sigma_m: float = 1.5
    lost_sigma_rad: float = math.radians(60.0)
    stretch_maps: int = 3
    recognized_m: float = 0.4
    compared_pairs: int = 4

    def window(self, drift_m: float) -> tuple[float, float]:
        """Half widths of the search window, metres and radians, after `drift_m` of travel."""
        return (
            min(self.certain_m + self.drift_per_m * drift_m, self.max_window_m),
            min(self.certain_rad + self.drift_rad_per_m * drift_m, self.max_window_rad),
        )

    def tracked_information(self, length_m: float, restart: bool) -> F64:
        """Information (3, 3) of a tracked step between anchors; restart: tracking was lost in between."""
        sigma_m = self.tracking_sigma_m + self.tracking_sigma_per_m * length_m
        sigma_rad = self.tracking_sigma_rad + self.tracking_sigma_rad_per_m * length_m
        if restart:
            sigma_m, sigma_rad = self.lost_sigma_m, self.lost_sigma_rad
        return np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])


LOOPS = LoopParameters()
EXACT_TRACKING = LoopParameters(
    tracking_sigma_m=0.01,
    tracking_sigma_per_m=0.003,
    tracking_sigma_rad=math.radians(0.15),
    tracking_sigma_rad_per_m=math.radians(0.04),
)
"""For a depth camera, and for a sensor in the hand, which is tracked in space.

Two local maps of a camera often show a place from two sides, so that its loops are less exact than its
tracking. So are those of a sensor in the hand, whose local maps are drawn in cells of 5 cm. About twice the
errors of tracking by a camera in simulated csail (`docs/method.md`); checked on lidar/hall.
"""
