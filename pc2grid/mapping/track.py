"""The tracked scans of a session."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import F64
from pc2grid.estimation.overruled import Disagreement
from pc2grid.model import Health, Scan, Trajectory

if TYPE_CHECKING:
    from pc2grid.estimation.tracker import Tracked

_NO_READING = np.full((4, 4), np.nan)


@dataclasses.dataclass(frozen=True, slots=True)
class Track:
    """The results of tracking for all scans of a session.

    trajectory : before loops are closed. disagreements : of odometry, at each scan. readings : (N, 4, 4) of
    odometry, NaN where there is none.
    walls_changed_ns : stamps of the scans before which the walls had changed while odometry stood still.
    left_out : scans before the first of the trajectory. warning : why, or what was assumed of that.
    """

    trajectory: Trajectory
    disagreements: Sequence[Disagreement | None]
    readings: F64
    walls_changed_ns: tuple[int, ...] = ()
    left_out: int = 0
    warning: str | None = None

    @property
    def with_odometry(self) -> bool:
        """Whether any scan has an odometry pose."""
        return bool(np.isfinite(self.readings).any())

    @property
    def heights_m(self) -> F64:
        """(N,) by odometry, as a base on wheels is tracked in the plane; without odometry as tracked."""
        poses = self.readings if self.with_odometry else self.trajectory.T_session_base
        return poses[:, 2, 3]


class TrackRecord:
    """Collects a track scan by scan; of a scan it keeps the pose, the reading of odometry and the health."""

    def __init__(self) -> None:
        self._stamps, self._poses, self._readings = array("q"), array("d"), array("d")
        self._health: list[Health] = []
        self._disagreements: list[Disagreement | None] = []
        self._walls_changed_ns: list[int] = []

    def __len__(self) -> int:
        return len(self._stamps)

    def append(self, scan: Scan, tracked: Tracked) -> None:
        """Add the next scan."""
        self._stamps.append(scan.stamp_ns)
        self._poses.extend(tracked.registered.T_session_base.ravel())
        self._health.append(tracked.registered.health)
        self._disagreements.append(tracked.disagreement)
        if tracked.walls_changed:
            self._walls_changed_ns.append(scan.stamp_ns)
        self._readings.extend((_NO_READING if scan.T_odom_base is None else scan.T_odom_base).ravel())

    def track(self, left_out: int, warning: str | None) -> Track:
        """The track of all scans; `left_out` and `warning` as of a `Track`."""
        trajectory = Trajectory(
            stamps_ns=np.array(self._stamps, dtype=np.int64),
            T_session_base=np.frombuffer(self._poses).reshape(-1, 4, 4),
            health=tuple(self._health),
        )
        readings = np.frombuffer(self._readings).reshape(-1, 4, 4)
        changed_ns = tuple(self._walls_changed_ns)
        return Track(trajectory, self._disagreements, readings, changed_ns, left_out, warning)
