"""The map of each part of a session: its keyframes drawn at their poses after loop closure."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.config import ProjectionConfig
from pc2grid.estimation.overruled import check_odometry
from pc2grid.geometry import SE2
from pc2grid.mapping.consistency import measure_consistency
from pc2grid.mapping.keyframe_points import KeyframePoints
from pc2grid.mapping.keyframes import Keyframes, grid_of
from pc2grid.mapping.parts import PARTS
from pc2grid.mapping.precision import precision_of
from pc2grid.mapping.settled import SettledKeyframes, interpolate_corrections
from pc2grid.mapping.track import Track, chosen
from pc2grid.model import Consistency, Loop, OccupancyGrid, OdometryCheck, PointMap, Precision, Trajectory


@dataclasses.dataclass(frozen=True, slots=True)
class PartMap:
    """The map of a part of a session."""

    grid: OccupancyGrid
    trajectory: Trajectory
    loops: tuple[Loop, ...]
    consistency: Consistency
    odometry: OdometryCheck
    precision: Precision
    points: PointMap | None = None


def draw_parts(
    keyframes: Keyframes,
    track: Track,
    closed: SettledKeyframes,
    projection: ProjectionConfig,
    points: KeyframePoints | None = None,
) -> list[PartMap]:
    """The map of each part of a session in a frame of its own, compared with its scans.

    points : in space, of the keyframes; None: the maps have none.
    """
    tracked = track.trajectory
    part, T_part_base = _settled(tracked, closed)
    everywhere = dataclasses.replace(tracked, T_session_base=T_part_base)
    drawn = []
    for number in range(int(part.max(initial=0)) + 1):
        scans = np.flatnonzero(part == number)
        own = [k for k, other in enumerate(closed.parts.tolist()) if other == number]
        poses = [SE2.from_matrix(T_part_base[closed.scans[k]]) for k in own]
        grid = grid_of(zip((keyframes[k] for k in own), poses, strict=True), projection)
        trajectory = chosen(everywhere, scans)
        anchored = np.flatnonzero(closed.parts[closed.anchors] == number)
        anchor_scans = closed.scans[closed.anchors[anchored]]
        drawn.append(
            PartMap(
                grid=grid,
                trajectory=trajectory,
                loops=_loops_within(closed.loops, scans),
                consistency=measure_consistency((keyframes[k] for k in own), grid, everywhere),
                odometry=check_odometry(
                    tracked.stamps_ns[scans].tolist(), [track.disagreements[k] for k in scans.tolist()]
                ),
                precision=precision_of(
                    trajectory, np.searchsorted(scans, anchor_scans), closed.sigma_m[anchored]
                ),
                points=None if points is None else points.registered(T_part_base, part == number),
            )
        )
    return drawn


def long_enough(parts: Sequence[PartMap]) -> list[PartMap]:
    """The parts that are long enough to be recognised, or the longest one if none is."""
    kept = [part for part in parts if part.trajectory.length_m >= PARTS.least_travel_m]
    return kept or [max(parts, key=lambda part: part.trajectory.length_m)]


def _settled(tracked: Trajectory, closed: SettledKeyframes) -> tuple[I64, F64]:
    """The part (N,) of each scan, and its pose (N, 4, 4) in the frame of the part after loop closure.

    A scan belongs to the keyframe before it. Scans before the first keyframe belong to that. The frame of the
    first part is that of the session; that of another is the base at its first scan, levelled.
    """
    T_session_base = tracked.T_session_base.copy()
    if not len(closed.scans):
        return np.zeros(len(tracked), np.int64), T_session_base
    before = np.searchsorted(closed.scans, np.arange(len(tracked)), side="right") - 1
    keyframe = np.maximum(before, 0)
    planar = np.array([(p.x, p.y, p.yaw) for p in map(SE2.from_matrix, T_session_base)])
    for segment in np.unique(closed.segments):
        scans = np.flatnonzero(closed.segments[keyframe] == segment)
        known = closed.segments == segment
        poses = interpolate_corrections(planar[scans], closed.scans[known] - scans[0], closed.poses[known])
        T_session_base[scans] = _moved_in_plane(T_session_base[scans], planar[scans], poses)
    part: I64 = closed.parts[keyframe]
    for number in range(1, int(part.max()) + 1):
        scans = np.flatnonzero(part == number)
        first = SE2.from_matrix(T_session_base[scans[0]])
        T_session_base[scans] = first.inverse().lift() @ T_session_base[scans]
    return part, T_session_base


def _moved_in_plane(T_session_base: F64, tracked: F64, settled: F64) -> F64:
    """Spatial poses (N, 4, 4), moved as their planar poses (N, 3) move from `tracked` to `settled`.

    Tilt and height stay as they are.
    """
    turn_rad = settled[:, 2] - tracked[:, 2]
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    rotation = np.zeros((len(turn_rad), 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 1, 1] = c, -s, s, c
    rotation[:, 2, 2] = 1.0
    moved = T_session_base.copy()
    moved[:, :3, :3] = rotation @ T_session_base[:, :3, :3]
    moved[:, :2, 3] = settled[:, :2]
    return moved


def _loops_within(loops: Iterable[Loop], scans: I64) -> tuple[Loop, ...]:
    """The loops between two of the scans, numbered within these."""
    number = {scan: k for k, scan in enumerate(scans.tolist())}
    return tuple(
        dataclasses.replace(loop, older=number[loop.older], newer=number[loop.newer])
        for loop in loops
        if loop.older in number and loop.newer in number
    )
