"""What the pose of a scan is worth: by how the scan fits the local map."""

from __future__ import annotations

from pc2grid.arrays import F64
from pc2grid.estimation.belief import Belief
from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.estimation.placing import Placed
from pc2grid.geometry import invert_pose, motion_size
from pc2grid.model import Health, Scan


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
        if fits:  # a pose that fits anywhere along a wall does not become known by waiting
            return self.give_up()
        self._lost_scans += 1
        return Health.LOST

    @property
    def gives_up(self) -> bool:
        """Whether tracking must start again: so many scans in a row were lost."""
        return self._lost_scans > self._parameters.give_up_scans

    def give_up(self) -> Health:
        """Start tracking again at once: the scan is lost."""
        self._lost_scans += self._parameters.give_up_scans + 1
        return Health.LOST

    def restart(self) -> None:
        """Start to count again."""
        self._lost_scans = 0


class Standstill:
    """Notices that the walls have changed for good while odometry stood still, as after a ride in a lift.

    Walls that come back, while the base stands or when it leaves, have not changed.
    """

    def __init__(self, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._parameters = parameters
        self._known: tuple[int, F64] | None = None  # stamp and T_odom_base of the last scan that fits well

    def left(self, scan: Scan, *, sure: bool) -> bool:
        """Take in the next scan; returns whether the base leaves a place whose walls have changed.

        sure : it fits the local map well; not so the first scan of a map, which fits in any case. Where no
        scan has fitted well yet, as behind glass, nothing can be said to have changed.
        """
        T_odom_base = scan.T_odom_base
        if sure and T_odom_base is not None:
            self._known = scan.stamp_ns, T_odom_base
        known = self._known
        if sure or known is None or T_odom_base is None:
            return False
        p, (distance_m, turn_rad) = self._parameters, motion_size(invert_pose(known[1]) @ T_odom_base)
        if distance_m <= p.standing_m and turn_rad <= p.standing_rad:
            return False
        self._known = scan.stamp_ns, T_odom_base
        return (scan.stamp_ns - known[0]) * 1e-9 > p.changed_s
