"""The planar scans that the map of a session is made of; those of a long session are kept in a file."""

from __future__ import annotations

import math
import pickle
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.config import ProjectionConfig
from pc2grid.geometry import SE2
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.mapping.spool import Spool
from pc2grid.model import OccupancyGrid


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A planar scan that becomes part of the map, because the robot had moved since the one before.

    index : number of its scan in the session. T_session_base : as tracked, before loops are closed.
    restart : the first keyframe after tracking was lost: its pose relative to those before is not measured.
    """

    index: int
    planar_scan: PlanarScan
    T_session_base: SE2
    restart: bool = False


class Keyframes:
    """The keyframes of a session, a sequence that only grows; their planar scans are in a `Spool`.

    scans : (K,) number of the scan of each. restarts : those whose pose relative to the one before is not
    known. above_floor_m : (K,) as of a `PlanarScan`, NaN for None.
    """

    def __init__(self) -> None:
        self._planar_scans = Spool("scans")
        self.scans, self.above_floor_m = array("q"), array("d")
        self.restarts: set[int] = set()
        self._poses = array("d")  # x, y, yaw of one after the other

    def __len__(self) -> int:
        return len(self.scans)

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, number: int) -> Keyframe:
        planar_scan = pickle.loads(self._planar_scans[number])
        return Keyframe(self.scans[number], planar_scan, self.pose(number), number in self.restarts)

    def append(self, keyframe: Keyframe) -> None:
        """Add one. Raises OutputError if the disk is full."""
        self._planar_scans.append(pickle.dumps(keyframe.planar_scan))
        if keyframe.restart:
            self.restarts.add(len(self))
        self.scans.append(keyframe.index)
        above_m = keyframe.planar_scan.above_floor_m
        self.above_floor_m.append(math.nan if above_m is None else above_m)
        pose = keyframe.T_session_base
        self._poses.extend((pose.x, pose.y, pose.yaw))

    def poses(self) -> F64:
        """T_session_base of all as tracked, (K, 3): x, y, yaw."""
        return np.array(self._poses).reshape(-1, 3)

    def pose(self, number: int) -> SE2:
        """T_session_base of one as tracked."""
        return SE2(*self._poses[3 * number : 3 * number + 3])

    def close(self) -> None:
        """Delete the file."""
        self._planar_scans.close()


def grid_of(keyframes: Iterable[tuple[Keyframe, SE2]], projection: ProjectionConfig) -> OccupancyGrid:
    """The occupancy grid of keyframes, each with the pose of its base in the frame of the grid."""
    builder = GridBuilder(projection)
    for keyframe, pose in keyframes:
        builder.add(keyframe.planar_scan, pose)
    return builder.grid()
