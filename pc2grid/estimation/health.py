"""What the pose of a scan is worth: by how the scan fits the local map."""

from __future__ import annotations

from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.estimation.placing import Placed
from pc2grid.model import Health


class HealthJudge:
    """Judges each scan, and counts the lost ones in a row."""

    def __init__(self, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._parameters = parameters
        self._lost_scans = 0

    def judge(self, placed: Placed, *, bridged: bool) -> Health:
        """Judge a scan by where it was placed.

        bridged : odometry goes on from the scan before.

        A scan that fits is FINE; DEGENERATE if one direction of its position is not determined. One that does
        not fit is DEGENERATE, too, where odometry tells where it is from a scan that was not lost; else LOST.
        """
        if placed.first or placed.alone is not None:
            self.restart()
            return Health.FINE if placed.first or placed.measured else Health.DEGENERATE
        if bridged and not self._lost_scans:
            return Health.DEGENERATE
        self._lost_scans += 1
        return Health.LOST

    @property
    def gives_up(self) -> bool:
        """Whether tracking must start again: so many scans in a row were lost."""
        return self._lost_scans > self._parameters.give_up_scans

    def restart(self) -> None:
        """Start to count again."""
        self._lost_scans = 0
