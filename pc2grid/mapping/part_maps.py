"""The map of each part of a session: its keyframes drawn at their poses after loop closure."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.clouds.level import LEVEL
from pc2grid.config import ProjectionConfig
from pc2grid.estimation.overruled import check_odometry
from pc2grid.geometry import SE2
from pc2grid.mapping.consistency import consistency_warning, measure_consistency
from pc2grid.mapping.floor_levels import (
    FLOOR_LEVELS,
    HeightStep,
    floor_warning,
    floors_apart_m,
    rise_between,
    settled_heights,
)
from pc2grid.mapping.keyframe_points import KeyframePoints
from pc2grid.mapping.keyframes import Keyframes, grid_of
from pc2grid.mapping.parts import PARTS
from pc2grid.mapping.precision import precision_of, precision_warning
from pc2grid.mapping.settled import SettledKeyframes, interpolate_corrections
from pc2grid.mapping.track import Track
from pc2grid.model import Health, Loop, ReadReport, SessionMap, Trajectory

_WARN_DEGENERATE = 0.1
"""Share of degenerate scans above which the report says so; chosen by hand."""


def draw_parts(
    keyframes: Keyframes,
    track: Track,
    closed: SettledKeyframes,
    projection: ProjectionConfig,
    points: KeyframePoints | None = None,
) -> list[SessionMap]:
    """The map of each part of a session in a frame of its own, compared with its scans.

    points : in space, of the keyframes; None: the maps have none.
    The maps have no name, no sensor and no submaps yet.
    """
    part, T_part_base = _settled(track.trajectory, closed)
    floors_m = _level(T_part_base, part, closed, np.array(keyframes.above_floor_m), points)
    everywhere = dataclasses.replace(track.trajectory, T_session_base=T_part_base)
    drawn = []
    for number in range(int(part.max(initial=0)) + 1):
        scans = np.flatnonzero(part == number)
        trajectory = _of_scans(everywhere, scans)
        own = np.flatnonzero(closed.parts == number).tolist()
        poses = [SE2.from_matrix(T_part_base[closed.scans[k]]) for k in own]
        grid = grid_of(zip((keyframes[k] for k in own), poses, strict=True), projection)
        anchored = np.flatnonzero(closed.parts[closed.anchors] == number)
        anchor_scans = np.searchsorted(scans, closed.scans[closed.anchors[anchored]])
        consistency = measure_consistency((keyframes[k] for k in own), grid, everywhere)
        odometry = check_odometry(
            trajectory.stamps_ns.tolist(), [track.disagreements[k] for k in scans.tolist()]
        )
        precision = precision_of(trajectory, anchor_scans, closed.sigma_m[anchored])
        warnings = (
            consistency_warning(consistency, trajectory, with_odometry=odometry.compared > 0),
            precision_warning(precision, trajectory),
            floor_warning(floors_m[number]),
        )
        drawn.append(
            SessionMap(
                session="",
                sensor="",
                grid=grid,
                submaps=(),
                trajectory=trajectory,
                loops=_loops_within(closed.loops, scans),
                consistency=consistency,
                odometry=odometry,
                precision=precision,
                points=None if points is None else points.registered(T_part_base, part == number),
                report=_report(trajectory, [text for text in warnings if text is not None]),
            )
        )
    return drawn


def long_enough(parts: Sequence[SessionMap]) -> list[SessionMap]:
    """The parts that are long enough to be recognised, or the longest one if none is."""
    kept = [part for part in parts if part.trajectory.length_m >= PARTS.least_travel_m]
    return kept or [max(parts, key=lambda part: part.trajectory.length_m)]


def _report(trajectory: Trajectory, of_map: Sequence[str]) -> ReadReport:
    """The report of a part alone: its scans, those that were lost, and warnings, the last ones `of_map`."""
    lost = [k for k, health in enumerate(trajectory.health) if health is Health.LOST]
    weak = sum(health is Health.DEGENERATE for health in trajectory.health)
    total, warnings = len(trajectory), []
    if lost:
        seconds = (trajectory.stamps_ns[lost[0]] - trajectory.stamps_ns[0]) * 1e-9
        warnings.append(
            f"registration was lost for {len(lost)} of {total} scans, first {seconds:.1f} s after the first "
            "scan; they are not in the map"
        )
    if weak > _WARN_DEGENERATE * total:
        warnings.append(
            f"{weak} of {total} scans did not fix the pose in every direction: there it rests on odometry "
            "or on the motion before"
        )
    skipped = {"registration lost": len(lost)} if lost else {}
    return ReadReport(scans_read=total, scans_skipped=skipped, warnings=(*warnings, *of_map))


def _of_scans(trajectory: Trajectory, scans: I64) -> Trajectory:
    """Some scans of a trajectory, by their numbers (M,)."""
    return Trajectory(
        stamps_ns=trajectory.stamps_ns[scans],
        T_session_base=trajectory.T_session_base[scans],
        health=tuple(trajectory.health[k] for k in scans.tolist()),
    )


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


def _level(
    T_part_base: F64, part: I64, closed: SettledKeyframes, above_floor_m: F64, points: KeyframePoints | None
) -> list[float | None]:
    """Give the poses (N, 4, 4) of all scans their height above one level floor, in place.

    above_floor_m : (K,) of the keyframes, as seen. Returns how far the floors of each part lie apart. Where
    no keyframe sees a floor, as on wheels, heights stay as they are.
    """
    apart_m: list[float | None] = []
    for number in range(int(part.max(initial=0)) + 1):
        own = np.flatnonzero(closed.parts == number)
        scans, seen_m = closed.scans[own], above_floor_m[own]
        if not np.isfinite(seen_m).any():
            apart_m.append(None)
            continue
        tracked_m, way = T_part_base[scans, 2, 3], closed.poses[own, :2]
        travel_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(way, axis=0).T)))
        restarts = np.flatnonzero(np.diff(closed.segments[own])) + 1
        loops = [] if points is None else _height_loops(T_part_base, closed, own, points)
        heights_m = settled_heights(tracked_m, travel_m, seen_m, restarts, loops)
        apart_m.append(floors_apart_m(heights_m, seen_m))
        raised_m = heights_m - tracked_m
        of_part = np.flatnonzero(part == number)
        T_part_base[of_part, 2, 3] += np.interp(of_part, scans, raised_m - raised_m[0])
    return apart_m


def _height_loops(
    T_part_base: F64, closed: SettledKeyframes, own: I64, points: KeyframePoints
) -> list[HeightStep]:
    """The loops between some keyframes (K,), as far as the points of both tell how high these lie."""
    number, found = {int(closed.scans[k]): i for i, k in enumerate(own)}, []
    for loop in closed.loops:
        if not loop.accepted or loop.older not in number or loop.newer not in number:
            continue
        first, second = number[loop.older], number[loop.newer]
        older_m, newer_m = (
            points.around(int(own[k]), FLOOR_LEVELS.around, T_part_base) for k in (first, second)
        )
        rise_m = rise_between(older_m, newer_m)
        if rise_m is not None:
            apart_m = float(T_part_base[loop.newer, 2, 3] - T_part_base[loop.older, 2, 3])
            found.append(HeightStep(first, second, apart_m + rise_m, LEVEL.seen_m))
    return found


def _loops_within(loops: Iterable[Loop], scans: I64) -> tuple[Loop, ...]:
    """The loops between two of the scans, numbered within these."""
    number = {scan: k for k, scan in enumerate(scans.tolist())}
    return tuple(
        dataclasses.replace(loop, older=number[loop.older], newer=number[loop.newer])
        for loop in loops
        if loop.older in number and loop.newer in number
    )
