"""The end of a session: its poses after loop closure, the map of each part, and its report with warnings.

The heights of keyframes drift as their positions do. For gravity-aligned poses height is independent of x, y
and yaw, so `optimised_heights` is a linear least-squares problem of its own: steps of tracking between
keyframes, and the height above the floor where it is visible. One recording is one floor, and a floor is
level.

Odometry that reports the opposite motion all the time, or none, does not merely slip: the sensor is mounted
upside down, or turned by half a turn, and tf does not contain it; or the odometry has a wrong sign, stands
still, or measures no turns. A map of such a recording may be mirrored (`odometry_warnings`).
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import identity, vstack
from scipy.sparse.linalg import splu

from pc2grid.clouds.ground import LEVEL
from pc2grid.errors import TrackingLost
from pc2grid.estimation.tracker import check_odometry
from pc2grid.geometry import F64, I64, SE2, invert_pose, rotation_vector, wrap_angle
from pc2grid.model import Health, Loop, ReadReport, SessionMap, Trajectory, part_name
from pc2grid.settings import ProjectionConfig
from signature.session.graph import POSE_GRAPH, between, compose
from signature.session.keyframes import KeyframePoints, Keyframes, Track, grid_of
from signature.session.quality import (
    LEAST_TRAVEL_M,
    consistency_warning,
    measure_consistency,
    precision_of,
    precision_warning,
)


@dataclass(frozen=True, slots=True)
class OptimisedKeyframes:
    """The poses of a session's keyframes after loop closure.

    scans : (K,) number of each keyframe's scan. poses : (K, 3) x, y, yaw of each in the session's frame.
    loops : between the scans at the anchors of local maps that overlap.
    segments : (K,) number of the segment of each; a new one begins where the pose relative to the keyframe
        before is unknown. parts : (K,) number of the part of each: segments that loops join. Poses of
        different parts are unrelated; see `signature.session.loops`.
    anchors : (N,) numbers, in `scans`, of the keyframes at the anchors of the local maps.
    sigma_m : (N,) standard deviation of the position of each of these within its part, in the least certain
        direction; see `signature.session.quality`.
    """

    scans: I64
    poses: F64
    loops: tuple[Loop, ...]
    segments: I64
    parts: I64
    anchors: I64
    sigma_m: F64


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
    everywhere = replace(track.trajectory, T_session_base=T_part_base)
    drawn = []
    for number in range(int(part.max(initial=0)) + 1):
        scans = np.flatnonzero(part == number)
        trajectory = Trajectory(
            stamps_ns=everywhere.stamps_ns[scans],
            T_session_base=T_part_base[scans],
            health=tuple(everywhere.health[k] for k in scans.tolist()),
        )
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
    kept = [part for part in parts if part.trajectory.length_m >= LEAST_TRAVEL_M]
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


_LOST_M = 1.0
"""Standard deviation of the height of a step where tracking was lost; chosen by hand."""


def optimised_heights(
    tracked_m: F64, travel_m: F64, above_floor_m: F64, restarts: Sequence[int] | I64
) -> F64:
    """Return the heights (K,) of keyframes above their one floor, by robust least squares.

    tracked_m : (K,) z as tracked. travel_m : (K,) metres of travel at each. above_floor_m : (K,) as measured,
    NaN where no floor is visible; it is visible somewhere. restarts : the keyframes before which tracking was
    lost.

    The robust scale begins so wide that the worst has half of its weight (Cauchy), and shrinks as that of
    `optimise`.
    """
    seen, steps = np.flatnonzero(np.isfinite(above_floor_m)), len(tracked_m) - 1
    sigma_m = np.full(steps + len(seen), LEVEL.seen_m)
    sigma_m[:steps] = np.sqrt(LEVEL.drift_per_m * np.maximum(np.diff(travel_m), 1e-3))
    sigma_m[np.asarray(restarts, np.int64) - 1] = _LOST_M
    rise_m = np.concatenate((np.diff(tracked_m), above_floor_m[seen]))
    # One row for each observation: the steps of tracking, then the floors.
    heights = identity(steps + 1, format="csr")
    A = vstack((heights[1:] - heights[:-1], heights[seen]))
    weight, scale, robust_sigmas = sigma_m**-2, np.inf, POSE_GRAPH.robust_sigmas
    for _ in range(POSE_GRAPH.iterations):
        heights_m = splu((A.T @ A.multiply(weight[:, None])).tocsc()).solve(A.T @ (weight * rise_m))
        off = np.abs(A @ heights_m - rise_m) / sigma_m
        scale = max(min(scale / POSE_GRAPH.annealing, off[steps:].max()), robust_sigmas)
        weight[steps:] = 1.0 / (sigma_m**2 * (1.0 + (off / scale) ** 2))[steps:]
    return np.asarray(heights_m)


def floors_apart_m(heights_m: F64, above_floor_m: F64) -> float | None:
    """Return the spread of the heights of the floor below keyframes at heights (K,), without the outer
    twentieths.

    None if no floor is visible.
    """
    floor_m = (heights_m - above_floor_m)[np.isfinite(above_floor_m)]
    if not len(floor_m):
        return None
    low_m, high_m = np.percentile(floor_m, (5.0, 95.0))
    return float(high_m - low_m)


def floor_warning(apart_m: float | None, obstacle_m: float) -> str | None:
    """Return a warning with the spread of the floors of a map and what to do; None if there is none.

    obstacle_m : height above the floor from which anything is an obstacle.
    """
    if apart_m is None or apart_m < obstacle_m:
        return None
    return (
        f"a floor is level, but what was seen of it lies over {apart_m:.2f} m of height: where it was passed "
        "twice, one floor may stand on the other as an obstacle; hold the sensor so that it sees the floor, "
        "or cut the recording at a step or ramp, with --start and --duration"
    )


def _loops_within(loops: Iterable[Loop], scans: I64) -> tuple[Loop, ...]:
    """Return the loops between two of the scans, numbered within these."""
    number = {scan: k for k, scan in enumerate(scans.tolist())}
    return tuple(
        replace(loop, older=number[loop.older], newer=number[loop.newer])
        for loop in loops
        if loop.older in number and loop.newer in number
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
    first = replace(
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
    dropped = f"; {short} shorter than {LEAST_TRAVEL_M:.0f} m left out" if short else ""
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
    # A base on wheels is tracked in the plane: odometry knows its height.
    poses = track.readings if track.with_odometry else track.trajectory.T_session_base
    warnings += height_warnings(poses[:, 2, 3], track.trajectory)
    warnings += odometry_warnings(track.trajectory, track.readings)
    return replace(report, scans_skipped=skipped, warnings=tuple(warnings))


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


# --- odometry against the scans -----------------------------------------------------------------------

_APART_NS = 10**9
"""Motions are compared over this time at least: late or bunched odometry has caught up by then; by hand."""
_LEAST_MOTION = 0.1
"""Motions of less than this, in metres or radians, are noise; chosen by hand."""
_OPPOSITE, _LEAST, _MOST = -0.5, 0.25, 1.75
"""Shares of what the scans show. Odometry that reports less than the first has the sign wrong; what is not
between the others is no measure of it. In eight real recordings it reports .93 to 1.15."""


@dataclass(frozen=True, slots=True)
class _Kind:
    """A kind of motion.

    columns : of motions (M, 6). least : with less in all, metres or radians, odometry is not judged; chosen
    by hand. opposite, otherwise : warnings for odometry that reports the opposite, and for odometry that does
    not measure it.
    """

    columns: slice
    least: float
    opposite: str
    otherwise: str


_KINDS = (
    _Kind(
        slice(3),
        2.0,
        "odometry reports travel the other way than the scans show: the sensor is mounted turned by half "
        "a turn and tf does not say so, or odometry counts backwards",
        "odometry reports {reported:.1f} m where the scans show {shown:.1f} m of travel, "
        "or in another direction: it stands still, has another unit, or the sensor is mounted otherwise "
        "than tf says; --odometry none ignores it",
    ),
    _Kind(
        slice(3, 6),
        1.5,
        "odometry turns the other way than the scans: the sensor is mounted upside down and tf does not "
        "say so, which mirrors the map, or odometry has left and right exchanged",
        "odometry reports {reported:.1f} rad where the scans show turns of {shown:.1f} rad "
        "in all, or about another axis; --odometry none ignores it",
    ),
)


def odometry_warnings(trajectory: Trajectory, readings: F64) -> list[str]:
    """Return at most two sentences for the user, on the travel and on the turns.

    readings : (N, 4, 4) T_odom_base at each scan, not finite where there is none.
    """
    motions = _motions(trajectory, readings)
    warnings = []
    for kind in _KINDS:
        shown, reported, share = _compared(*(motion[:, kind.columns] for motion in motions))
        if shown < kind.least or _LEAST <= share <= _MOST:
            continue
        text = kind.opposite if share < _OPPOSITE else kind.otherwise
        warnings.append(text.format(shown=shown, reported=reported))
    return warnings


def _motions(trajectory: Trajectory, readings: F64) -> tuple[F64, F64]:
    """Return motions (M, 6) by the scans and by odometry, in metres and as rotation vectors.

    They are between scans that fix the pose.
    """
    fixed = np.array([health in (Health.FINE, Health.OVERRULED) for health in trajectory.health], bool)
    lost = np.cumsum([health is Health.LOST for health in trajectory.health])
    usable = np.flatnonzero(fixed & np.isfinite(readings).all(axis=(1, 2)))
    ends = itertools.pairwise(_apart(trajectory.stamps_ns, usable))
    pairs = [(a, b) for a, b in ends if lost[a] == lost[b]]
    shown, reported = (
        np.array([_step(poses[a], poses[b]) for a, b in pairs]).reshape(-1, 6)
        for poses in (trajectory.T_session_base, readings)
    )
    return shown, reported


def _apart(stamps_ns: NDArray[np.int64], scans: NDArray[np.intp]) -> list[int]:
    """Select scans of which consecutive ones are at least `_APART_NS` apart."""
    chosen: list[int] = []
    for scan in scans.tolist():
        if not chosen or stamps_ns[scan] - stamps_ns[chosen[-1]] >= _APART_NS:
            chosen.append(scan)
    return chosen


def _step(a: F64, b: F64) -> F64:
    """Return the motion (6,) from a pose (4, 4) to another one."""
    motion = invert_pose(a) @ b
    return np.concatenate((motion[:3, 3], rotation_vector(motion)))


def _compared(shown: F64, reported: F64) -> tuple[float, float, float]:
    """Compare motions (M, 3) by the scans with reported ones (M, 3).

    Returns the sums of their lengths, and the reported share of the motion by the scans; a jump counts no
    more than twice.
    """
    lengths = np.linalg.norm(shown, axis=1)
    moves = lengths >= _LEAST_MOTION
    shown, reported, lengths = shown[moves], reported[moves], lengths[moves]
    shares = np.clip(np.einsum("nk,nk->n", shown, reported) / lengths**2, -2.0, 2.0)
    total = float(lengths.sum())
    share = float((lengths * shares).sum()) / total if total else 1.0
    return total, float(np.linalg.norm(reported, axis=1).sum()), share
