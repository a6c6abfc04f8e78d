"""What loop closure keeps of each keyframe: its scan and its tracked pose."""

from __future__ import annotations

from array import array

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.mapping.keyframes import Keyframe


class TrackedKeyframes:
    """Keyframes as they were tracked, before loops are closed; a sequence that only grows.

    scans : number of the scan of each.
    restarts : keyframes whose pose relative to the one before is unknown: tracking was lost.
    """

    def __init__(self) -> None:
        self.scans = array("q")
        self.restarts: set[int] = set()
        self._poses = array("d")  # x, y, yaw of one after the other

    def __len__(self) -> int:
        return len(self.scans)

    def append(self, keyframe: Keyframe) -> None:
        """Add one."""
        if keyframe.restart:
            self.restarts.add(len(self))
        self.scans.append(keyframe.index)
        pose = keyframe.T_session_base
        self._poses.extend((pose.x, pose.y, pose.yaw))

    def last_pose(self) -> SE2:
        """T_session_base of the last one."""
        return SE2(*self._poses[-3:])

    def poses(self) -> F64:
        """T_session_base of all, (K, 3): x, y, yaw."""
        return np.array(self._poses).reshape(-1, 3)
