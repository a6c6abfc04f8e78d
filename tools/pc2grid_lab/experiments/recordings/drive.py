"""A recording as it was driven: its own trajectories, true poses, and what its scans are read with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2, invert_pose, leveling
from pc2grid.io import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import OccupancyGrid, Trajectory
from pc2grid.pipeline import follow
from pc2grid_cli.options import make_config
from pc2grid_lab.experiments.frames import AHEAD_M, SAME_NS, fit_frame, nearest, pose_at
from pc2grid_lab.experiments.recordings.catalogue import Recording
from pc2grid_lab.experiments.recordings.run import Folder
from signature.config import Config
from signature.database import open_database

_GAP_NS = 200_000_000
"""True poses farther apart are not interpolated, as a robot turns between them."""
_CARRIED_NS = 5_000_000_000
"""The own trajectory is laid on the true poses of so long before and after."""
_BEFORE_S = 2.0
"""A scan is looked for from so long before its stamp on."""
_KNOWN_M = 0.2
"""A wall hit lies on known ground if the map knows a cell this near: noise puts hits behind the wall."""


def sessions(folder: Folder, name: str) -> dict[str, Trajectory]:
    """The trajectories of the sessions of a map, empty if there is none."""
    if not folder.map(name).exists():
        return {}
    with open_database(folder.map(name)) as database:
        return {info.name: database.trajectory(info.name) for info in database.sessions()}


def mount(folder: Folder, recording: Recording) -> F64:
    """T_base_sensor (4, 4) of a recording's first scan."""
    with open_log(folder.source(recording), config_of(recording).read) as log:
        return next(iter(log.scans())).T_base_sensor


@dataclass(frozen=True)
class RecordedDrive:
    """A recording as it was driven: its own trajectories, and true poses if there are any.

    parts : the sessions of the map of the whole recording; none for a map that is no recording.
    truth : poses of the base in the world, whose z is up; None without. late_ns : see `Recording.late_s`.
    """

    parts: tuple[Trajectory, ...]
    truth: Trajectory | None
    late_ns: int = 0

    def own_pose(self, stamp_ns: int) -> tuple[int, SE2] | None:
        """The part and T_part_base of the scan with that stamp; None if no part has it."""
        for number, part in enumerate(self.parts):
            (k,) = nearest(part.stamps_ns, np.array([stamp_ns]))
            if k >= 0:
                return number, SE2.from_matrix(part.T_session_base[k])
        return None

    def where(self, stamp_ns: int) -> tuple[int, SE2] | None:
        """The same; of a recording with true poses the part is -1, and the pose the true one."""
        if self.truth is None:
            return self.own_pose(stamp_ns)
        true = self.true_pose(stamp_ns)
        return None if true is None else (-1, true)

    def true_pose(self, stamp_ns: int) -> SE2 | None:
        """T_world_base by the true poses; where they are far apart, carried on by the own trajectory."""
        assert self.truth is not None
        T = pose_at(self.truth, stamp_ns - self.late_ns, same_ns=SAME_NS, gap_ns=_GAP_NS)
        return self._carried(stamp_ns - self.late_ns) if T is None else SE2.from_matrix(T)

    def _carried(self, stamp_ns: int) -> SE2 | None:
        """The own trajectory around a stamp, laid on the true poses there."""
        assert self.truth is not None
        own = self.own_pose(stamp_ns + self.late_ns)
        near = np.flatnonzero(np.abs(self.truth.stamps_ns - stamp_ns) <= _CARRIED_NS)
        if own is None or not len(near):
            return None
        pairs = [
            (there[1], SE2.from_matrix(self.truth.T_session_base[k]))
            for k in near.tolist()
            if (there := self.own_pose(int(self.truth.stamps_ns[k]) + self.late_ns)) is not None
            and there[0] == own[0]
        ]
        if not pairs:
            return None
        return fit_frame(pairs, AHEAD_M) @ own[1]


@cache
def drive_of(recording: Recording, folder: Folder) -> RecordedDrive:
    """The drive of a recording whose whole map is in the folder."""
    parts = tuple(sessions(folder, recording.name).values())
    late_ns = round(recording.late_s * 1e9)
    poses = folder.poses(recording)
    if poses is None:
        return RecordedDrive(parts, None, late_ns)
    truth = read_tum(poses)
    if not recording.of_base:
        T_sensor_base = invert_pose(mount(folder, recording))
        truth = replace(truth, T_session_base=truth.T_session_base @ T_sensor_base)
    return RecordedDrive(parts, levelled(truth, parts, late_ns), late_ns)


@cache
def grids(folder: Folder, name: str) -> dict[str, OccupancyGrid]:
    """The sessions of a map by name."""
    with open_database(folder.map(name)) as database:
        return {info.name: database.grid(info.name) for info in database.sessions()}


def levelled(truth: Trajectory, parts: Sequence[Trajectory], late_ns: int = 0) -> Trajectory:
    """True poses of the base, turned so that z of the world is up.

    The world of a camera's poses may lie as its first image does. Which way is up in it is told by the own
    trajectories, which are levelled; without scans that have a true pose it stays as it is.
    """
    up = np.zeros(3)
    for part in parts:
        at = np.searchsorted(part.stamps_ns, truth.stamps_ns + late_ns).clip(max=len(part) - 1)
        same = np.abs(part.stamps_ns[at] - truth.stamps_ns - late_ns) <= SAME_NS
        # The third row of a rotation is the vertical of its frame, as the base sees it.
        vertical = part.T_session_base[at[same], 2, :3, None]
        up += (truth.T_session_base[same, :3, :3] @ vertical).sum(axis=(0, 2))
    if not up.any():
        return truth
    return replace(truth, T_session_base=leveling(up / np.linalg.norm(up)) @ truth.T_session_base)


def config_of(recording: Recording) -> Config:
    """The settings that the commands read a recording with."""
    given = dict(zip(recording.options[::2], recording.options[1::2], strict=True))
    return make_config(None, None, topic=given.get("--topic"), odometry=given.get("--odometry"))


def hits_at(folder: Folder, recording: Recording, stamp_ns: int) -> F64:
    """(N, 2) walls that the scan with that stamp shows, in the axes of the base."""
    config = config_of(recording)
    with open_log(folder.source(recording), config.read) as log:
        start_s = max((stamp_ns - log.info.start_ns) * 1e-9 - _BEFORE_S, 0.0)
        last = None
        for scan in log.scans(start_s, 2.0 * _BEFORE_S):
            if last is not None and scan.stamp_ns > stamp_ns:
                break
            last = scan
        assert last is not None  # `scans` raises NoScans
        ((_, planar_scan),) = follow([last], config)
    return np.asarray(planar_scan.hits_m, np.float64)


def known_share(grid: OccupancyGrid, points_m: F64) -> float:
    """Share 0..1 of points (N, 2) in the map frame that have a known cell within `_KNOWN_M`; 0 without."""
    if not len(points_m):
        return 0.0
    reach = round(_KNOWN_M / grid.resolution_m)
    known = cv2.dilate((grid.cells >= 0).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    cells = grid.to_cell(points_m)
    inside = ((cells >= 0) & (cells < known.shape)).all(axis=1)
    return float(known[tuple(cells[inside].T)].sum() / len(points_m))
