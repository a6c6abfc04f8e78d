"""Is the pose that a running robot believes in still right? `check_pose` that goes on.

After every metre, when the robot has stood for a while, and when its belief jumps, the last metres are
compared with the map at the pose that it believes in then.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.io.map_pose import MapPose
from pc2grid.model import Health, RegisteredScan
from signature.relocalization.map_index import MapIndex
from signature.relocalization.pose_check import CHECK, PoseCheck, judge_pose
from signature.relocalization.relocalizer import Query
from signature.relocalization.watcher import WATCH


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseLook:
    """What one look said of the pose. registered : the scan of the look. elapsed_s : time of the look."""

    checked: PoseCheck
    registered: RegisteredScan
    elapsed_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseWatchParameters:
    """Chosen by hand.

    most_scans : so many past scans are remembered with their poses; a belief may be as old as the oldest, at
        40 scans a second two minutes.
    most_waiting : so many beliefs wait for their scans; of more, the oldest are left out.
    nearest_s : a belief counts at the scan that is nearest to it in time, if it is as near as this.
    """

    most_scans: int = 5000
    most_waiting: int = 50
    nearest_s: float = 0.5


POSE_WATCH = PoseWatchParameters()


class PoseWatcher:
    """Takes in scans for as long as the robot runs, and judges what it believes. Its memory does not grow.

    index : where to look. believed : the newest pose in the map that the robot believes in, None before the
    first. session : whose map frame that is; may be None if there is only one.
    """

    uses_points = False

    def __init__(
        self,
        index: MapIndex,
        believed: Callable[[], MapPose | None],
        session: str | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._index, self._believed, self._session, self._clock = index, believed, session, clock
        self._heard: MapPose | None = None
        self.restart()

    def restart(self) -> None:
        """The scans do not go on from those before."""
        self._query = Query(self._index)
        self._driven: deque[tuple[int, SE2]] = deque(maxlen=POSE_WATCH.most_scans)
        self._forget()

    def _forget(self) -> None:
        """The motion from before to what comes next is not known."""
        self._driven.clear()
        self._waiting: deque[MapPose] = deque(maxlen=POSE_WATCH.most_waiting)
        self._T_map_session: SE2 | None = None
        self._judged: SE2 | None = None
        self._first_ns: int | None = None
        self._due = self._stood = False

    def add(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_look: bool = True
    ) -> PoseLook | None:
        """Take in the next scan; returns what a look said if there was one after it.

        may_look : if not, a look that is due is put off until it is true. Raises ConfigError for a missing or
        unknown session.
        """
        lost = registered.health is Health.LOST
        stamp_ns = registered.scan.stamp_ns
        if lost:
            self._forget()
        self._due = self._query.add(registered, planar_scan) or self._due
        if lost:
            return None
        T_session_base = SE2.from_matrix(registered.T_session_base)
        self._driven.append((stamp_ns, T_session_base))
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        if not self._stood and stamp_ns - self._first_ns > WATCH.standing_s * 1e9:
            self._stood = self._due = True
        T_map_session = self._belief()
        if T_map_session is None:
            return None
        self._due = self._due or self._jumped(T_map_session @ T_session_base, T_session_base)
        if not (self._due and may_look):
            return None
        begin = self._clock()
        try:
            seen = self._query.map()
            checked = judge_pose(
                seen,
                self._index,
                T_map_session @ T_session_base,
                session=self._session,
                last_metres=tuple(self._query.last_metres()),
            )
        except NoScans:  # the scans since registration was lost show nothing
            return None
        self._query.resume()
        self._due, self._judged = False, T_map_session
        return PoseLook(checked=checked, registered=registered, elapsed_s=self._clock() - begin)

    def _belief(self) -> SE2 | None:
        """The frame of the registered scans in the map, as the robot believes; None if it is not known.

        A belief that is older than the scans since registration was lost says nothing of now; one that is
        ahead of the scans waits for them.
        """
        newest = self._believed()
        if newest is not None and newest is not self._heard:
            self._heard = newest
            self._waiting.append(newest)
        while self._waiting and self._waiting[0].stamp_ns <= self._driven[-1][0]:
            pose = self._waiting.popleft()
            nearest_ns, T_session_base = self._nearest(pose.stamp_ns)
            if abs(nearest_ns - pose.stamp_ns) <= POSE_WATCH.nearest_s * 1e9:
                self._T_map_session = pose.T_map_base @ T_session_base.inverse()
        return self._T_map_session

    def _nearest(self, stamp_ns: int) -> tuple[int, SE2]:
        """The scan nearest in time: stamp and pose. A belief is recent, so the newest are looked at first."""
        later = self._driven[-1]
        for known in reversed(self._driven):
            if known[0] <= stamp_ns:
                return min(known, later, key=lambda scan: abs(scan[0] - stamp_ns))
            later = known
        return later

    def _jumped(self, T_map_base: SE2, T_session_base: SE2) -> bool:
        """Whether the robot believes in another place than at the last look."""
        if self._judged is None:
            return False
        before = self._judged @ T_session_base
        apart_m = math.hypot(T_map_base.x - before.x, T_map_base.y - before.y)
        apart_rad = abs(wrap_angle(T_map_base.yaw - before.yaw))
        return apart_m > CHECK.tolerance_m or apart_rad > CHECK.tolerance_rad
