"""What odometry reports from scan to scan, and whether that can be."""

from __future__ import annotations

from pc2grid.arrays import F64
from pc2grid.estimation.overruled import Disagreement, disagreement
from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.geometry import invert_pose, motion_size
from pc2grid.model import Scan


class Odometer:
    """Remembers the last reading, and the pose of the base then. begin_ns : stamp of the first scan."""

    def __init__(self, begin_ns: int = 0, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._parameters, self._begin_ns = parameters, begin_ns
        self._scans = 0
        self._last: tuple[F64, F64] | None = None  # T_odom_base and T_session_base

    def remember(self, scan: Scan, pose: F64) -> None:
        """Keep the reading of a scan, if it has one, with its final pose (4, 4)."""
        self._scans += 1
        if scan.T_odom_base is not None:
            self._last = scan.T_odom_base, pose

    def reported(self, scan: Scan) -> F64 | None:
        """The motion (4, 4) since the last reading; None if there is none."""
        if scan.T_odom_base is None or self._last is None:
            return None
        return invert_pose(self._last[0]) @ scan.T_odom_base

    def continues(self, scan: Scan, seconds: float) -> bool:
        """Whether odometry goes on from where it was last known; `seconds` since the last scan.

        It does not if it reports an impossible motion, nor over a gap in which the log has neither scans nor
        readings: its driver may have been restarted meanwhile. Nor does its first reading: odometry may begin
        after the first scan, anywhere.
        """
        if scan.T_odom_base is None:
            return True
        reported = self.reported(scan)
        usual_s = (scan.stamp_ns - self._begin_ns) * 1e-9 / max(self._scans, 1)
        gap = min(seconds, scan.odometry_gap_s) > self._parameters.gap * usual_s
        return reported is not None and not gap and self.is_possible(reported, seconds)

    def is_possible(self, motion: F64, seconds: float) -> bool:
        """Whether a robot or a person indoors can make a motion (4, 4) in a time."""
        p, (distance_m, turn_rad) = self._parameters, motion_size(motion)
        return max(distance_m, turn_rad) <= p.jump + p.fastest * seconds

    def disagreement(self, scan: Scan, pose: F64) -> Disagreement | None:
        """By how much the reported motion differs from that to the final pose (4, 4) of a scan."""
        reported = self.reported(scan)
        if reported is None or self._last is None:
            return None
        return disagreement(reported, invert_pose(self._last[1]) @ pose)
