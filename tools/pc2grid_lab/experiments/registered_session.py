"""A registered session with its true poses: all that is needed to locate it and to judge the answer.

Registering a session takes far longer than locating it. It is registered once and stored like this, however
many maps it is located in and however many methods are compared on it.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import F64, SE2
from pc2grid.io.atomic import replace_file
from pc2grid.model import Health, RegisteredScan, Scan, SensorKind
from pc2grid.pipeline import follow
from pc2grid.settings import Config
from pc2grid_lab.experiments.truth import AHEAD_M, fit_frame


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredSession:
    """N scans of one session.

    planar_scans : one for each scan, with its stamp.
    T_odom_base : (N, 3) registered x, y, yaw, in the frame of the session.
    lost : (N,) whether registration was lost.
    T_world_base : (N, 3) true x, y, yaw, in the frame of the floor plan or of the ground truth; NaN where the
    truth is not known.
    """

    sensor: SensorKind
    planar_scans: tuple[PlanarScan, ...]
    T_odom_base: F64
    lost: NDArray[np.bool_]
    T_world_base: F64

    def __len__(self) -> int:
        return len(self.planar_scans)

    def path_m(self) -> F64:
        """(N,) metres travelled up to each scan, by the registered poses."""
        steps = np.hypot(*np.diff(self.T_odom_base[:, :2], axis=0).T)
        return np.concatenate(([0.0], np.cumsum(steps)))[: len(self)]

    def T_world_odom(self) -> SE2:
        """The true pose of the session's frame, by the end of the session.

        It is fitted over the scans of the last `AHEAD_M` whose true pose is known, because the heading of a
        single scan, taken while the robot turns, may be wrong by some degrees. Scans from before registration
        was lost are left out: the motion since is not known. (Unless no other pose is known.)
        """
        path_m = self.path_m()
        known = np.flatnonzero(~np.isnan(self.T_world_base[:, 0]))
        lost = np.flatnonzero(self.lost)
        first = min(lost[-1] + 1, len(self) - 1) if len(lost) else 0  # a lost last scan is a query of its own
        if known[-1] >= first:
            known = known[known >= first]
        known = known[path_m[known] >= path_m[known[-1]] - AHEAD_M]
        pairs = [(_pose(self.T_odom_base[k]), _pose(self.T_world_base[k])) for k in known]
        return fit_frame(pairs, AHEAD_M)

    def first(self, count: int) -> RegisteredSession:
        """The session until so many scans were taken."""
        return replace(
            self,
            planar_scans=self.planar_scans[:count],
            T_odom_base=self.T_odom_base[:count],
            lost=self.lost[:count],
            T_world_base=self.T_world_base[:count],
        )

    def scans(self) -> Iterator[tuple[RegisteredScan, PlanarScan]]:
        """Each scan (without its points) and its planar scan, in order of time."""
        no_points = np.empty((0, 3), np.float32)
        for planar_scan, pose, lost in zip(self.planar_scans, self.T_odom_base, self.lost, strict=True):
            scan = Scan(
                stamp_ns=planar_scan.stamp_ns, points_m=no_points, T_base_sensor=np.eye(4), sensor=self.sensor
            )
            health = Health.LOST if lost else Health.FINE
            yield RegisteredScan(scan=scan, T_session_base=_pose(pose).lift(), health=health), planar_scan

    def save(self, path: Path) -> None:
        """Write the session to a file, completely or not at all."""
        with replace_file(path) as draft:
            draft.write_bytes(pickle.dumps(self))

    @staticmethod
    def load(path: Path) -> RegisteredSession:
        """Read a file that `save` has written."""
        session: RegisteredSession = pickle.loads(path.read_bytes())
        return session


def register(
    scans: Iterable[tuple[Scan, SE2 | None]],
    config: Config,
    *,
    sensor: SensorKind,
    until_m: float = math.inf,
    see: Callable[[RegisteredScan], object] = lambda registered: None,
) -> RegisteredSession:
    """Register scans with the settings of a user, and stop after `until_m` of travel.

    scans : each with its true pose, None where it is not known; registration does not get it.
    see : called with each scan, whose points are not kept here.
    """
    truths: list[SE2 | None] = []

    def without_truth() -> Iterator[Scan]:
        for scan, truth in scans:
            truths.append(truth)
            yield scan

    planar_scans: list[PlanarScan] = []
    poses: list[SE2] = []
    lost: list[bool] = []
    travel_m = 0.0
    for registered, planar_scan in follow(without_truth(), config):
        pose = SE2.from_matrix(registered.T_session_base)
        if poses:
            travel_m += math.hypot(pose.x - poses[-1].x, pose.y - poses[-1].y)
        see(registered)
        planar_scans.append(planar_scan)
        poses.append(pose)
        lost.append(registered.health is Health.LOST)
        if travel_m >= until_m:
            break
    return RegisteredSession(
        sensor=sensor,
        planar_scans=tuple(planar_scans),
        T_odom_base=_array(poses),
        lost=np.array(lost, bool),
        T_world_base=_array(truths[: len(planar_scans)]),
    )


def _pose(row: F64) -> SE2:
    return SE2(float(row[0]), float(row[1]), float(row[2]))


def _array(poses: Sequence[SE2 | None]) -> F64:
    rows = [(p.x, p.y, p.yaw) if p else (math.nan,) * 3 for p in poses]
    return np.array(rows, np.float64).reshape(-1, 3)
