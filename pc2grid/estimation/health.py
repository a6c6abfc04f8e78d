"""What the pose of a scan is worth: by how the scan fits the local map."""

from __future__ import annotations

from pc2grid.estimation.belief import Belief
from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.estimation.placing import Placed
from pc2grid.model import Health


class HealthJudge:
    """Judges each scan, and counts the lost ones in a row."""

    def __init__(self, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._parameters = parameters
        self._lost_scans = 0

    def judge(self, placed: Placed, unaided: Belief | None, *, bridged: bool) -> Health:
        """Judge a scan by where it was placed.

        unaided : what is known of the pose of a sensor in the hand by scans alone; None on wheels, which do
        not slip along a wall, and with odometry. bridged : odometry goes on from the scan before.

        A scan that fits is FINE; DEGENERATE if one direction of its position is not determined; LOST if a
        direction of an unaided pose is not known. One that does not fit is DEGENERATE, too, where odometry
        tells where it is from a scan that was not lost; else LOST.
        """
        p, (sigma_m, sigma_rad) = self._parameters, (0.0, 0.0) if unaided is None else unaided.sigmas
        fits = placed.first or placed.alone is not None
        if fits and sigma_m <= p.known_m and sigma_rad <= p.known_rad:
            self.restart()
            return Health.FINE if placed.first or placed.measured else Health.DEGENERATE
        if bridged and not self._lost_scans:
            return Health.DEGENERATE
        # A pose that fits anywhere along a wall does not become known by waiting.
        self._lost_scans += p.give_up_scans + 1 if fits else 1
        return Health.LOST

    @property
    def gives_up(self) -> bool:
        """Whether tracking must start again: so many scans in a row were lost."""
        return self._lost_scans > self._parameters.give_up_scans

    def restart(self) -> None:
        """Start to count again."""
        self._lost_scans = 0
