"""What the pose of a scan is worth, judged by its match with the local map."""

from __future__ import annotations

from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.estimation.placed import Placed
from pc2grid.model import Health


class HealthJudge:
    """Judges each scan, and counts the poor ones in a row."""

    def __init__(self, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._parameters = parameters
        self._poor_scans = 0
        self._lost_scans = 0

    def judge(self, placed: Placed, *, bridged: bool) -> Health:
        """Judge a scan by where it was placed. bridged : odometry says where it is.

        A scan that shows too little is bridged by odometry for a while (DEGENERATE). A scan that does not
        fit, without odometry or for too long, is LOST. A scan that fits is DEGENERATE if one direction of
        its position is not determined, FINE otherwise.
        """
        p = self._parameters
        if placed.first:
            return Health.FINE
        if placed.overlap < p.min_overlap or placed.residual_m > p.max_residual_m:
            self._poor_scans += 1
            lost = not bridged or self._poor_scans > p.bridged_scans
            self._lost_scans += lost
            return Health.LOST if lost else Health.DEGENERATE
        self._poor_scans = self._lost_scans = 0
        return Health.FINE if placed.measured else Health.DEGENERATE

    @property
    def gives_up(self) -> bool:
        """Whether so many scans in a row were lost that tracking must start again."""
        return self._lost_scans > self._parameters.give_up_scans

    def restart(self) -> None:
        """Start to count again."""
        self._lost_scans = 0
