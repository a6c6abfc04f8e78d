"""The end of a session: its poses after loop closure, the map of each part, and its report with warnings."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import TrackingLost
from pc2grid.estimation.tracker import check_odometry
from pc2grid.geometry import F64, I64, SE2, wrap_angle
from pc2grid.mapping.graph import (
    between,
    compose,
    floor_warning,
    floors_apart_m,
    optimised_heights,
)
from pc2grid.mapping.keyframes import KeyframePoints, Keyframes, Track, grid_of
from pc2grid.mapping.parts import PARTS, odometry_warnings
from pc2grid.mapping.quality import consistency_warning, measure_consistency, precision_of, precision_warning
from pc2grid.model import Health, Loop, ReadReport, SessionMap, Trajectory, part_name
from pc2grid.settings import ProjectionConfig


@dataclass(frozen=True, slots=True)
class OptimisedKeyframes:
    """The poses of a session's keyframes after loop closure.

    scans : (K,) number of each keyframe's scan. poses : (K, 3) x, y, yaw of each in the session's frame.
    loops : between the scans at the anchors of local maps that overlap.
    segments : (K,) number of the segment of each; a new one begins where the pose relative to the keyframe
        before is unknown. parts : (K,) number of the part of each: segments that loops join. Poses of
        different parts are unrelated; see `pc2grid.mapping.parts`.
    anchors : (N,) numbers, in `scans`, of the keyframes at the anchors of the local maps.
    sigma_m : (N,) standard deviation of the position of each of these within its part, in the least certain
        direction; see `pc2grid.mapping.quality`.
    """

    scans: I64
    poses: F64
    loops: tuple[Loop, ...]
    segments: I64
    parts: I64
    anchors: I64
    sigma_m: F64

    @classmethod
    def empty(cls) -> OptimisedKeyframes:
        """Return those of a session without keyframes."""
        none = np.empty(0, np.int64)
        return cls(none, np.empty((0, 3)), (), segments=none, parts=none, anchors=none, sigma_m=np.empty(0))

    def undivided(self) -> OptimisedKeyframes:
        """Return the same keyframes as one part of one segment."""
        together = np.zeros(len(self.scans), np.int64)
        return replace(self, segments=together, parts=together)


def interpolate_corrections(tracked: F64, known: Sequence[int] | I64, corrected: F64) -> F64:
    """Return poses (N, 3) of all scans, from the corrected poses (K, 3) of those of them that are `known`.

    Between two of these the correction passes linearly from one to the other, so the tracked motion between
    them stays smooth.
    """
    index = np.asarray(known)
    scans = np.arange(len(tracked))
    left = np.clip(np.searchsorted(index, scans, side="right") - 1, 0, len(index) - 1)
    right = np.minimum(left + 1, len(index) - 1)
    a, b = _moved(tracked, index, corrected, left), _moved(tracked, index, corrected, right)
    span = np.maximum(index[right] - index[left], 1)
    share = np.clip((scans - index[left]) / span, 0.0, 1.0)[:, None]
    mixed: F64 = a + share * np.column_stack((b[:, :2] - a[:, :2], wrap_angle(b[:, 2] - a[:, 2])))
    mixed[:, 2] = wrap_angle(mixed[:, 2])
    return mixed


def _moved(tracked: F64, index: NDArray[np.integer], corrected: F64, which: NDArray[np.integer]) -> F64:
    """Move every scan as if rigidly attached to the known scan number `which` (N,)."""
    return compose(corrected[which], between(tracked[index[which]], tracked))


# --- the map of each part -----------------------------------------------------------------------------


def draw_parts(
    keyframes: Keyframes,
    track: Track,
    closed: OptimisedKeyframes,
    projection: ProjectionConfig,
    points: KeyframePoints | None = None,
) -> list[SessionMap]:
    """Draw the map of each part of a session in a frame of its own, and compare it with its scans.

    points : in space, of the keyframes; None: the maps have none.
    The maps have no name, no sensor and no submaps yet.
    """
    part, T_part_base = _optimised(track.trajectory, closed)
    floors_m = _level(T_part_base, part, closed, np.array(keyframes.above_floor_m))
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
            floor_warning(floors_m[number], projection.band_min_m),
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
    """Return the parts that are long enough to be recognised, or the longest one if none is."""
    kept = [part for part in parts if part.trajectory.length_m >= PARTS.least_travel_m]
    return kept or [max(parts, key=lambda part: part.trajectory.length_m)]


def _optimised(tracked: Trajectory, closed: OptimisedKeyframes) -> tuple[I64, F64]:
    """Return the part (N,) of each scan, and its pose (N, 4, 4) in the frame of the part after loop closure.

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


def _moved_in_plane(T_session_base: F64, tracked: F64, optimised: F64) -> F64:
    """Move spatial poses (N, 4, 4) as their planar poses (N, 3) move from `tracked` to `optimised`.

    Tilt and height stay as they are.
    """
    pairs = zip(optimised, tracked, strict=True)
    return np.array([(SE2(*new) @ SE2(*old).inverse()).lift() for new, old in pairs]) @ T_session_base


def _level(T_part_base: F64, part: I64, closed: OptimisedKeyframes, above_floor_m: F64) -> list[float | None]:
    """Set the heights of the poses (N, 4, 4) of all scans to those above one level floor, in place.

    above_floor_m : (K,) of the keyframes, as measured. Returns the spread of the floors of each part. Where
    no keyframe shows a floor, as on wheels, heights stay as they are.
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
        heights_m = optimised_heights(tracked_m, travel_m, seen_m, restarts)
        apart_m.append(floors_apart_m(heights_m, seen_m))
        raised_m = heights_m - tracked_m
        of_part = np.flatnonzero(part == number)
        T_part_base[of_part, 2, 3] += np.interp(of_part, scans, raised_m - raised_m[0])
    return apart_m


def _loops_within(loops: Iterable[Loop], scans: I64) -> tuple[Loop, ...]:
    """Return the loops between two of the scans, numbered within these."""
    number = {scan: k for k, scan in enumerate(scans.tolist())}
    return tuple(
        dataclasses.replace(loop, older=number[loop.older], newer=number[loop.newer])
        for loop in loops
        if loop.older in number and loop.newer in number
    )


def _of_scans(trajectory: Trajectory, scans: I64) -> Trajectory:
    """Select some scans of a trajectory, by their numbers (M,)."""
    return Trajectory(
        stamps_ns=trajectory.stamps_ns[scans],
        T_session_base=trajectory.T_session_base[scans],
        health=tuple(trajectory.health[k] for k in scans.tolist()),
    )


# --- reports and warnings -----------------------------------------------------------------------------

_MANY = 0.2
"""Share of degenerate scans above which there is a warning, and of lost ones above which a laser gives no map
without odometry, as its parts are not connected; chosen by hand."""
_STOREY_M = 2.0
"""A hand lifts a sensor by less than this, and storeys are at least 2.4 m high; chosen by hand."""


def _report(trajectory: Trajectory, of_map: Sequence[str]) -> ReadReport:
    """Return the report of a part alone: its scans, those that were lost, and warnings, the last ones
    `of_map`."""
    lost = [k for k, health in enumerate(trajectory.health) if health is Health.LOST]
    weak = sum(health is Health.DEGENERATE for health in trajectory.health)
    total, warnings = len(trajectory), []
    if lost:
        seconds = (trajectory.stamps_ns[lost[0]] - trajectory.stamps_ns[0]) * 1e-9
        warnings.append(
            f"registration was lost for {len(lost)} of {total} scans, first {seconds:.1f} s after the first "
            "scan; they are not in the map"
        )
    if weak > _MANY * total:
        warnings.append(
            f"{weak} of {total} scans did not fix the pose in every direction: there it rests on odometry "
            "or on the motion before"
        )
    skipped = {"registration lost": len(lost)} if lost else {}
    return ReadReport(scans_read=total, scans_skipped=skipped, warnings=(*warnings, *of_map))


def part_reports(
    report: ReadReport,
    session: str,
    parts: Sequence[SessionMap],
    kept: Sequence[SessionMap],
    walls_changed_ns: Collection[int] = (),
) -> list[ReadReport]:
    """Return the report of each part that is kept.

    report : of the reader. It becomes part of that of the first part; the scans of the others are counted in
        theirs.
    walls_changed_ns : as of a `Track`.
    """
    first, *others = (part.report for part in kept)
    elsewhere = sum(other.scans_read for other in others)
    left_out = sum(len(part.trajectory) for part in parts) - elsewhere - first.scans_read
    skipped = {"in a part too short to be of use": left_out} if left_out else {}
    division = [division_warning(session, parts, kept, walls_changed_ns)] if len(parts) > 1 else []
    first = dataclasses.replace(
        report,
        scans_read=report.scans_read - elsewhere,
        scans_skipped={**report.scans_skipped, **skipped, **first.scans_skipped},
        warnings=(*report.warnings, *division, *first.warnings),
    )
    return [first, *others]


def division_warning(
    session: str,
    parts: Sequence[SessionMap],
    kept: Sequence[SessionMap],
    walls_changed_ns: Collection[int] = (),
) -> str:
    """Return a warning with the parts of a divided recording, where they begin, and what to do."""
    start_ns = min(int(part.trajectory.stamps_ns[0]) for part in parts if len(part.trajectory))

    def begin_s(part: SessionMap) -> float:
        return (int(part.trajectory.stamps_ns[0]) - start_ns) * 1e-9

    short = len(parts) - len(kept)
    dropped = f"; {short} shorter than {PARTS.least_travel_m:.0f} m left out" if short else ""
    named = ", ".join(
        f"{part_name(session, k)} from {begin_s(part):.0f} s ({part.trajectory.length_m:.0f} m)"
        for k, part in enumerate(kept)
    )
    changed_s = [begin_s(part) for part in parts if part.trajectory.stamps_ns[0] in walls_changed_ns]
    if changed_s:
        times = " and ".join(f"{seconds:.0f}" for seconds in changed_s)
        return (
            f"the recording falls into {len(parts)} parts whose places relative to each other are not known: "
            f"{named}{dropped}; before {times} s after the first scan all walls changed while odometry stood "
            "still, as in a lift: cut the recording there, with --start and --duration, and name each floor "
            "with --floor"
        )
    advice = "come back to known places more often, to keep them together"
    if not any(part.odometry and part.odometry.compared for part in parts):
        advice = f"record with odometry, or {advice}"
    return (
        f"the recording falls into {len(parts)} parts whose places relative to each other are not known, "
        f"because tracking was lost: {named}{dropped}; {advice}"
    )


def check_followed(trajectory: Trajectory, name: str) -> None:
    """Raise TrackingLost if more than a fifth of the scans of the log `name` are lost."""
    lost = [health is Health.LOST for health in trajectory.health]
    if sum(lost) <= _MANY * len(lost):
        return
    first_s = (trajectory.stamps_ns[lost.index(True)] - trajectory.stamps_ns[0]) * 1e-9
    raise TrackingLost(
        f"{name}: {sum(lost)} of {len(lost)} scans could not be followed, first {first_s:.1f} s after the "
        "first scan, and the log has no odometry",
        hint="--odometry TOPIC names a topic with odometry, --start and --duration a part that can be "
        "followed; else record odometry, or scans that are closer together",
    )


def lost_warnings(health: Sequence[Health]) -> list[str]:
    """Return a warning if a query, with scans of this health, begins anew where tracking was lost; else
    nothing."""
    lost = [number for number, of_scan in enumerate(health, start=1) if of_scan is Health.LOST]
    if not lost:
        return []
    return [
        f"{len(lost)} of {len(health)} scans could not be followed, so only the last "
        f"{len(health) - lost[-1]} count; record odometry, or more scans a second, or corners and furniture "
        "in place of bare walls"
    ]


def with_track_warnings(report: ReadReport, track: Track) -> ReadReport:
    """Return the report of a recording with warnings of the track: assumptions, odometry and heights."""
    warnings, skipped = [*report.warnings], dict(report.scans_skipped)
    if track.warning is not None:
        warnings.append(track.warning)
    if track.left_out:
        skipped["before one that shows the floor"] = track.left_out
    warnings += height_warnings(track.heights_m, track.trajectory)
    warnings += odometry_warnings(track.trajectory, track.readings)
    return dataclasses.replace(report, scans_skipped=skipped, warnings=tuple(warnings))


def height_warnings(heights_m: F64, trajectory: Trajectory) -> list[str]:
    """Return a warning if some scans are higher (N,) than others by a floor of a house; else nothing."""
    known = np.flatnonzero(np.isfinite(heights_m))
    rise_m = heights_m[known] - heights_m[known[:1]]
    away = known[np.abs(rise_m) > _STOREY_M]
    if not len(away):
        return []
    begin_s = (trajectory.stamps_ns[away[0]] - trajectory.stamps_ns[0]) * 1e-9
    return [
        f"the height changes by {np.ptp(rise_m):.1f} m, and from {begin_s:.0f} s after the first scan on by "
        f"more than {_STOREY_M:.1f} m: a map is one floor, and this one shows several as one; cut the "
        "recording there, with --start and --duration, and name each floor with --floor"
    ]
