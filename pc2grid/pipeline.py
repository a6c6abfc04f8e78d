"""A recording becomes a session map: the point-cloud half from end to end."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.config import Config, ProjectionConfig
from pc2grid.errors import NoScans, TrackingLost
from pc2grid.geometry import SE2
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.model import (
    Consistency,
    Health,
    Loop,
    OccupancyGrid,
    OdometryCheck,
    PointMap,
    Precision,
    ReadReport,
    RegisteredScan,
    Scan,
    SessionMap,
    Storey,
    Trajectory,
    part_name,
)
from pc2grid.observer import Observer
from pc2grid.sensor_model import SENSOR_MODELS
from pc2grid.time_span import TimeSpan

if TYPE_CHECKING:
    from pc2grid.io import Log
    from pc2grid.mapping.keyframes import Keyframe, Keyframes
    from pc2grid.mapping.loop_closure import LoopCloser
    from pc2grid.mapping.place_recognition import PlaceRecognizer
    from pc2grid.mapping.settled import SettledKeyframes
    from pc2grid.odometry.overruled import Disagreement
    from pc2grid.odometry.tracker import Tracked

_SHARE_BEFORE_LOOPS = 0.8
"""Share of the work of `build_map` that is done when the last scan has been tracked; chosen by hand."""
_MOST_LOST = 0.2
"""Share of lost scans above which a laser without odometry gives no map: its parts do not hang together.
Chosen by hand."""
_WARN_DEGENERATE = 0.1
"""Share of degenerate scans above which the report says so; chosen by hand."""


def follow(scans: Iterable[Scan], config: Config = Config()) -> Iterator[tuple[RegisteredScan, PlanarScan]]:
    """Each scan with its pose, and its planar scan, as they come.

    The memory needed is that of one local map, however many scans there are. Scans on the way to
    another floor, and the first one there, count as lost.

    >>> import pc2grid
    >>> with pc2grid.open_log("tuesday.mcap") as log:
    ...     poses = [scan.T_session_base for scan, _ in follow(log.scans(0.0, 1.0))]
    >>> poses[0].shape, float(poses[0][0, 3])
    ((4, 4), 0.0)
    """
    from pc2grid.odometry.tracker import Tracker

    tracker = Tracker(config.registration, config.projection)
    for scan in scans:
        tracked = tracker.track(scan)
        registered = tracked.registered
        if tracked.riding or tracked.arrived:
            # What was seen before says nothing of where the robot is after a ride.
            registered = dataclasses.replace(registered, health=Health.LOST)
        yield registered, tracked.planar_scan


def build_map(
    log: Log,
    config: Config = Config(),
    *,
    session: str,
    span: TimeSpan = TimeSpan(),
    observer: Observer = Observer(),
    recognizer: PlaceRecognizer | None = None,
) -> SessionMap:
    """Turn a recording, or the part of it that `span` names, into a map with submaps.

    observer : gets the progress, and each scan with its tracked pose.
    recognizer : finds loops that are farther off than the search near the tracked pose reaches.
    Of a recording that does not hang together (see `build_maps`), the part with the longest travel is
    returned, and its report says what is left out.
    Raises NoScans if there is nothing to make a map from, TrackingLost if the scans of a laser without
    odometry cannot be followed.

    >>> import pc2grid
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = build_map(log, session="monday", span=pc2grid.TimeSpan(0.0, 2.0))
    >>> monday.sensor, len(monday.trajectory) > 10, bool(abs(monday.trajectory.planar()[0]).max() < 1e-9)
    ('laser', True, True)
    """
    return longest_of(
        build_maps(log, config, session=session, span=span, observer=observer, recognizer=recognizer)
    )


def build_maps(
    log: Log,
    config: Config = Config(),
    *,
    session: str,
    span: TimeSpan = TimeSpan(),
    observer: Observer = Observer(),
    recognizer: PlaceRecognizer | None = None,
) -> tuple[SessionMap, ...]:
    """Turn a recording into a map, or into several if its parts cannot be placed to each other.

    That is so where tracking was lost, or where the map of the whole would contradict itself, and no loop
    joins what lies before and after (`pc2grid.mapping.parts`). The first map has the name `session`, the
    others `session#2`, `session#3`, ...; each has its own frame, the base at its first scan. What the report
    of the reader says of the whole recording stands in the first one's.

    Parameters and errors are those of `build_map`.

    >>> import pc2grid
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     [part.session for part in build_maps(log, session="monday", span=pc2grid.TimeSpan(0.0, 2.0))]
    ['monday']
    """
    from pc2grid.submaps.partition import divide

    start_ns, end_ns = log.info.start_ns, log.info.end_ns

    has_odometry = False

    def reported() -> Iterator[Scan]:
        nonlocal has_odometry
        for scan in log.scans(span.start_s, span.duration_s):
            has_odometry |= scan.T_odom_base is not None
            yield scan
            observer.on_progress(_SHARE_BEFORE_LOOPS * span.share_done(scan.stamp_ns, start_ns, end_ns))

    parts, track = _map(reported(), config, observer, recognizer)
    sensor = log.choose().sensor
    planar = SENSOR_MODELS[sensor].planar
    if not any(len(part.trajectory) for part in parts):
        raise NoScans(f"{log.info.path}: no scans in the part asked for", hint="check --start and --duration")
    if planar and not has_odometry:
        check_followed(_in_order([part.trajectory for part in parts]), str(log.info.path))
    kept = _of_use(parts)
    read = log.report()
    read = dataclasses.replace(read, warnings=(*read.warnings, *_ride_warnings(track)))
    if config.projection.points_voxel_m is not None and planar:
        no_points = "a 2D laser shows no points in space, so none are kept"
        read = dataclasses.replace(read, warnings=(*read.warnings, no_points))
    reached = [part.storey for part in kept]
    floors, heights_m = floor_names(track.storeys, reached), floor_heights(track.storeys, reached)
    reports = _reports(read, session, parts, kept, floors, slopes_unseen=planar)
    maps = []
    for number, (part, report) in enumerate(zip(kept, reports, strict=True)):
        graph, submaps = divide(part.grid, config.partition)
        maps.append(
            SessionMap(
                session=part_name(session, number),
                sensor=sensor,
                grid=part.grid,
                submaps=submaps,
                trajectory=part.trajectory,
                loops=part.loops,
                graph=graph,
                consistency=part.consistency,
                odometry=part.odometry,
                precision=part.precision,
                points=part.points,
                floor=floors[number],
                floor_height_m=heights_m[number],
                report=report,
            )
        )
    observer.on_progress(1.0)
    return tuple(maps)


def longest_of(maps: Sequence[SessionMap]) -> SessionMap:
    """The map with the longest travel of those of a recording, under the name of the recording.

    Its report is that of the whole recording, and says which maps are left out.
    """
    longest = max(maps, key=lambda part: part.trajectory.length_m)
    if len(maps) == 1:
        return longest
    others = ", ".join(part.session for part in maps if part is not longest)
    report = dataclasses.replace(
        maps[0].report,
        warnings=(*maps[0].report.warnings, f"only {longest.session} is used here, without {others}"),
    )
    return dataclasses.replace(longest, session=maps[0].session, report=report)


def _of_use(parts: Sequence[_Mapped]) -> list[_Mapped]:
    """The parts that are long enough to be recognised, or the longest one if none is."""
    from pc2grid.mapping.parts import PARTS

    kept = [part for part in parts if part.trajectory.length_m >= PARTS.least_travel_m]
    return kept or [max(parts, key=lambda part: part.trajectory.length_m)]


def floor_names(storeys: Sequence[Storey], reached: Sequence[int]) -> list[str | None]:
    """The names of the floors that parts of a recording are on, by height: 0, 1, 2, the lowest is 0.

    storeys : of the recording. reached : number of the storey of each part. A ride in a lift shows no height:
    what lies behind the first one is "lift 1", or "lift 1, floor 0" and so on if stairs lead on from there.
    None for all, if the recording stays on one floor.

    >>> floor_names([Storey(group=0, height_m=0.0), Storey(group=0, height_m=-3.0)], [0, 1, 0])
    ['1', '0', '1']
    >>> floor_names([Storey(group=0, height_m=0.0), Storey(group=1, height_m=0.0)], [0, 1])
    ['0', 'lift 1']
    """
    if len(storeys) == 1:
        return [None] * len(reached)
    names = []
    for storey in (storeys[k] for k in reached):
        heights = [other.height_m for other in storeys if other.group == storey.group]
        rank = str(sum(height < storey.height_m for height in heights))
        if storey.group:
            rank = f"lift {storey.group}" + (f", floor {rank}" if len(heights) > 1 else "")
        names.append(rank)
    return [*names]


def floor_heights(storeys: Sequence[Storey], reached: Sequence[int]) -> list[float | None]:
    """The heights in metres of the floors that parts of a recording are on, above the lowest one.

    Parameters are those of `floor_names`. None where no stairs lead, and behind a lift.

    >>> floor_heights([Storey(group=0, height_m=0.0), Storey(group=0, height_m=-3.0)], [0, 1, 0])
    [3.0, 0.0, 3.0]
    >>> floor_heights([Storey(group=0, height_m=0.0), Storey(group=1, height_m=0.0)], [0, 1])
    [None, None]
    """
    known = [storey.height_m for storey in storeys if not storey.group]
    if len(known) == 1:
        return [None] * len(reached)
    here = [storeys[k] for k in reached]
    return [None if storey.group else storey.height_m - min(known) for storey in here]


def check_followed(trajectory: Trajectory, name: str) -> None:
    """Raise TrackingLost if more than a fifth of the scans of the log `name` are lost."""
    lost = [health is Health.LOST for health in trajectory.health]
    if sum(lost) <= _MOST_LOST * len(lost):
        return
    first_s = (trajectory.stamps_ns[lost.index(True)] - trajectory.stamps_ns[0]) * 1e-9
    raise TrackingLost(
        f"{name}: {sum(lost)} of {len(lost)} scans could not be followed, first {first_s:.1f} s after the "
        "first scan, and the log has no odometry",
        hint="--odometry TOPIC names a topic with odometry, --start and --duration a part that can be "
        "followed; else record odometry, or scans that are closer together",
    )


def map_scans(
    scans: Iterable[Scan],
    config: Config = Config(),
    observer: Observer = Observer(),
    recognizer: PlaceRecognizer | None = None,
) -> tuple[OccupancyGrid, Trajectory, tuple[Loop, ...]]:
    """Grid and trajectory of scans, and the loops that were found; never divided as by `build_maps`.

    observer : gets each scan with its tracked pose, before loops are closed.
    recognizer : finds loops that are farther off than the search near the tracked pose reaches.

    Only the pose of a scan stays in memory. The planar scan of a keyframe waits in a temporary file. So
    memory grows with the mapped area, not with the length of the recording. A robot that stands still adds
    nothing.

    >>> import pc2grid
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     grid, trajectory, loops = map_scans(log.scans(0.0, 2.0))
    >>> grid.resolution_m, bool(grid.occupied.any())
    (0.05, True)
    """
    (mapped,), _ = _map(scans, config, observer, recognizer, whole=True)
    return mapped.grid, mapped.trajectory, mapped.loops


@dataclasses.dataclass(frozen=True, slots=True)
class _Mapped:
    """What becomes of the scans of a part of a session."""

    grid: OccupancyGrid
    trajectory: Trajectory
    loops: tuple[Loop, ...]
    consistency: Consistency
    odometry: OdometryCheck
    precision: Precision
    points: PointMap | None = None
    storey: int = 0


@dataclasses.dataclass(frozen=True, slots=True)
class _Track:
    """What tracking says of all scans of a session.

    trajectory : before loops are closed. disagreements : of odometry, at each scan. riding : (N,) scans on a
    ride from floor to floor. storey : (N,) number of the floor of each in `storeys`. carried : see
    `Tracker`.
    """

    trajectory: Trajectory
    disagreements: Sequence[Disagreement | None]
    riding: NDArray[np.bool_]
    storey: I64
    storeys: tuple[Storey, ...]
    carried: bool = False


def _map(
    scans: Iterable[Scan],
    config: Config,
    observer: Observer,
    recognizer: PlaceRecognizer | None,
    *,
    whole: bool = False,
) -> tuple[list[_Mapped], _Track]:
    """Track the scans, close the loops, and draw a map of each part; see `build_maps`. Returns what tracking
    says, too.

    A part whose map contradicts itself is divided, and drawn again. whole : all scans are one part.
    """
    from pc2grid.mapping.keyframe_points import KeyframePoints
    from pc2grid.mapping.keyframes import Keyframes
    from pc2grid.mapping.local_maps import CAMERA_LOCAL_MAPS, LOCAL_MAPS
    from pc2grid.mapping.loop_closure import LoopCloser
    from pc2grid.mapping.loop_parameters import CAMERA_LOOPS, LOOPS
    from pc2grid.mapping.parts import PARTS
    from pc2grid.odometry.tracker import Tracker

    tracker = Tracker(config.registration, config.projection)
    stamps, poses = array("q"), array("d")
    health: list[Health] = []
    disagreements: list[Disagreement | None] = []
    riding, storeys = array("b"), array("q")
    voxel_m = config.projection.points_voxel_m
    with ExitStack() as stack:
        keyframes = stack.enter_context(closing(Keyframes()))
        kept = None
        if voxel_m is not None:
            kept = stack.enter_context(closing(KeyframePoints(voxel_m, config.projection.max_range_m)))
        rest = iter(scans)
        begin = [scan for scan in (next(rest, None),) if scan is not None]
        narrow = bool(begin) and SENSOR_MODELS[begin[0].sensor].narrow
        closer = LoopCloser(
            keyframes,
            recognizer=recognizer,
            projection=config.projection,
            parameters=CAMERA_LOOPS if narrow else LOOPS,
            local_map_parameters=CAMERA_LOCAL_MAPS if narrow else LOCAL_MAPS,
        )
        selection = _KeyframeSelection(keyframes, config.projection, closer)
        for scan in chain(begin, rest):
            tracked = tracker.track(scan)
            selection.add(tracked, index=len(stamps))
            if kept is not None and tracked.keyframe and not SENSOR_MODELS[scan.sensor].planar:
                kept.append(len(stamps), tracked.registered.scan)
            stamps.append(scan.stamp_ns)
            poses.extend(tracked.registered.T_session_base.ravel())
            health.append(tracked.registered.health)
            disagreements.append(tracked.disagreement)
            riding.append(tracked.riding)
            storeys.append(tracked.storey)
            observer.on_scan(tracked.registered)
        selection.finish()
        trajectory = Trajectory(
            stamps_ns=np.array(stamps, dtype=np.int64),
            T_session_base=np.frombuffer(poses).reshape(-1, 4, 4),
            health=tuple(health),
        )
        track = _Track(
            trajectory,
            disagreements,
            np.array(riding, dtype=bool),
            np.array(storeys, dtype=np.int64),
            tracker.storeys,
            tracker.carried,
        )
        closed = selection.closer.finish()
        if whole:
            closed = closed.undivided()
        drawn = _draw_parts(keyframes, track, closed, config.projection)
        for _ in range(0 if whole else PARTS.rounds):
            divided = selection.closer.divide([run for part in drawn for run in _doubtful(part, trajectory)])
            if divided is None:
                break
            closed = divided
            drawn = _draw_parts(keyframes, track, closed, config.projection)
        if kept is not None:
            part, T_part_base = _settled(trajectory, closed)
            drawn = [
                dataclasses.replace(mapped, points=kept.registered(T_part_base, part == number))
                for number, mapped in enumerate(drawn)
            ]
    return drawn, track


def _draw_parts(
    keyframes: Keyframes,
    track: _Track,
    closed: SettledKeyframes,
    projection: ProjectionConfig,
) -> list[_Mapped]:
    """The map of each part of a session in a frame of its own, compared with its scans.

    The scans of a ride are in no part.
    """
    from pc2grid.mapping.consistency import measure_consistency
    from pc2grid.mapping.precision import precision_of
    from pc2grid.odometry.overruled import check_odometry

    tracked = track.trajectory
    part, T_part_base = _settled(tracked, closed)
    everywhere = dataclasses.replace(tracked, T_session_base=T_part_base)
    drawn = []
    for number in range(int(part.max(initial=0)) + 1):
        scans = np.flatnonzero((part == number) & ~track.riding)
        own = [k for k, other in enumerate(closed.parts.tolist()) if other == number]
        grid = _draw((keyframes[k] for k in own), T_part_base, projection)
        trajectory = _chosen(everywhere, scans)
        anchored = np.flatnonzero(closed.parts[closed.anchors] == number)
        anchor_scans = closed.scans[closed.anchors[anchored]]
        drawn.append(
            _Mapped(
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
                storey=int(track.storey[closed.scans[own[0]]]) if own else 0,
            )
        )
    return drawn


def _settled(tracked: Trajectory, closed: SettledKeyframes) -> tuple[I64, F64]:
    """The part (N,) of each scan, and its pose (N, 4, 4) in the frame of the part after loop closure.

    A scan belongs to the keyframe before it. Scans before the first keyframe belong to that. The frame of the
    first part is that of the session; that of another is the base at its first scan, levelled.
    """
    from pc2grid.mapping.settled import spread

    T_session_base = tracked.T_session_base.copy()
    if not len(closed.scans):
        return np.zeros(len(tracked), np.int64), T_session_base
    before = np.searchsorted(closed.scans, np.arange(len(tracked)), side="right") - 1
    keyframe = np.maximum(before, 0)
    planar = np.array([(p.x, p.y, p.yaw) for p in map(SE2.from_matrix, T_session_base)])
    for segment in np.unique(closed.segments):
        scans = np.flatnonzero(closed.segments[keyframe] == segment)
        known = closed.segments == segment
        poses = spread(planar[scans], closed.scans[known] - scans[0], closed.poses[known])
        T_session_base[scans] = _moved_in_plane(T_session_base[scans], planar[scans], poses)
    part: I64 = closed.parts[keyframe]
    for number in range(1, int(part.max()) + 1):
        scans = np.flatnonzero(part == number)
        first = SE2.from_matrix(T_session_base[scans[0]])
        T_session_base[scans] = first.inverse().lift() @ T_session_base[scans]
    return part, T_session_base


def _chosen(trajectory: Trajectory, scans: I64) -> Trajectory:
    """Some scans of a trajectory."""
    return Trajectory(
        stamps_ns=trajectory.stamps_ns[scans],
        T_session_base=trajectory.T_session_base[scans],
        health=tuple(trajectory.health[k] for k in scans.tolist()),
    )


def _loops_within(loops: Iterable[Loop], scans: I64) -> tuple[Loop, ...]:
    """The loops between two of the scans, numbered within these."""
    number = {scan: k for k, scan in enumerate(scans.tolist())}
    return tuple(
        dataclasses.replace(loop, older=number[loop.older], newer=number[loop.newer])
        for loop in loops
        if loop.older in number and loop.newer in number
    )


def _doubtful(part: _Mapped, tracked: Trajectory) -> list[range]:
    """The scans of the session in the stretches that contradict the map of a part, if it is bent."""
    if not part.consistency.bent:
        return []
    return [
        range(
            int(np.searchsorted(tracked.stamps_ns, stretch.from_ns)),
            int(np.searchsorted(tracked.stamps_ns, stretch.to_ns)) + 1,
        )
        for stretch in part.consistency.stretches
    ]


class _KeyframeSelection:
    """Stores the keyframes of a session and passes them to the loop closure.

    A keyframe is stored when the next one begins, together with the hits of the scans between them that the
    keyframe itself did not see.
    """

    def __init__(
        self,
        keyframes: Keyframes,
        projection: ProjectionConfig,
        closer: LoopCloser,
    ) -> None:
        from pc2grid.mapping.unseen_hits import UnseenHits

        self.closer = closer
        self._keyframes = keyframes
        self._unseen_hits = UnseenHits(projection.max_range_m, projection.resolution_m)
        self._latest: Keyframe | None = None
        self._storey = 0  # of the latest keyframe

    def add(self, tracked: Tracked, *, index: int) -> None:
        """The next scan, number `index` of the session."""
        from pc2grid.mapping.keyframes import Keyframe

        pose = SE2.from_matrix(tracked.registered.T_session_base)
        if tracked.keyframe:
            self.finish()
            self._latest = Keyframe(index, tracked.planar_scan, pose, tracked.restart)
            self._storey = tracked.storey
            self._unseen_hits.restart(tracked.planar_scan, pose)
        elif self._latest is not None and tracked.mapped and tracked.registered.health is not Health.LOST:
            self._unseen_hits.add(tracked.planar_scan, pose)

    def finish(self) -> None:
        """Store the latest keyframe, if there is one."""
        if self._latest is not None:
            complete = dataclasses.replace(self._latest, unseen_hits_m=self._unseen_hits.take())
            self._keyframes.append(complete)
            self.closer.extend(self._latest, self._storey)


def _draw(keyframes: Iterable[Keyframe], T_session_base: F64, projection: ProjectionConfig) -> OccupancyGrid:
    """The occupancy grid of keyframes, each at the pose (N, 4, 4) of its scan."""
    builder = GridBuilder(projection)
    for keyframe in keyframes:
        pose = SE2.from_matrix(T_session_base[keyframe.index])
        builder.add(keyframe.planar_scan, pose)
        builder.add_unseen_hits(pose.apply(keyframe.unseen_hits_m))
    return builder.grid()


def _reports(
    report: ReadReport,
    session: str,
    parts: Sequence[_Mapped],
    kept: Sequence[_Mapped],
    floors: Sequence[str | None],
    *,
    slopes_unseen: bool,
) -> list[ReadReport]:
    """The report of each part that is kept, with the warnings of registration and of its map.

    report : of the reader. It becomes that of the first part; the scans of the others are counted in theirs.
    """
    elsewhere = sum(len(part.trajectory) for part in kept[1:])
    warnings, skipped = list(report.warnings), dict(report.scans_skipped)
    if len(parts) > 1:
        warnings.append(_division_warning(session, parts, kept, floors))
    left_out = sum(len(part.trajectory) for part in parts) - elsewhere - len(kept[0].trajectory)
    if left_out:
        skipped["in a part too short to be of use"] = left_out
    first = dataclasses.replace(
        report,
        scans_read=report.scans_read - elsewhere,
        scans_skipped=skipped,
        warnings=tuple(warnings),
    )
    others = [ReadReport(scans_read=len(part.trajectory)) for part in kept[1:]]
    return [
        _with_warnings(r, part, slopes_unseen=slopes_unseen)
        for r, part in zip([first, *others], kept, strict=True)
    ]


def _division_warning(
    session: str, parts: Sequence[_Mapped], kept: Sequence[_Mapped], floors: Sequence[str | None]
) -> str:
    """One sentence that says into what a recording was divided, where, and what to do."""
    from pc2grid.mapping.parts import PARTS

    start_ns = min(int(part.trajectory.stamps_ns[0]) for part in parts if len(part.trajectory))

    def begin_s(part: _Mapped) -> float:
        return (int(part.trajectory.stamps_ns[0]) - start_ns) * 1e-9

    named = ", ".join(
        f"{part_name(session, k)} "
        + (f"(floor {floors[k]}) " if floors[k] is not None else "")
        + f"from {begin_s(part):.0f} s ({part.trajectory.length_m:.0f} m)"
        for k, part in enumerate(kept)
    )
    advice = "come back to known places more often, to keep them together"
    if not any(part.odometry.compared for part in parts):
        advice = f"record with odometry, or {advice}"
    short = len(parts) - len(kept)
    dropped = f"; {short} shorter than {PARTS.least_travel_m:.0f} m left out" if short else ""
    if len({part.storey for part in parts}) == len(parts):
        return f"the recording goes over {len(parts)} floors: {named}{dropped}"
    return (
        f"the recording falls into {len(parts)} parts whose places relative to each other are not known, "
        "because tracking was lost, stairs or a lift lay between, or the map would contradict itself: "
        f"{named}{dropped}; {advice}"
    )


def _ride_warnings(track: _Track) -> list[str]:
    """What may have been a ride to another floor that did not divide the recording, or a slope that was not
    noticed: where, and what to do."""
    from pc2grid.odometry.overruled import stalls
    from pc2grid.odometry.rides import RIDES

    if not len(track.trajectory):
        return []
    stamps_ns, heights_m = track.trajectory.stamps_ns, track.trajectory.T_session_base[:, 2, 3]
    advice = "the map shows two floors as one: convert each by itself, with --start, --duration and --floor"
    warnings = []
    if len(track.riding) and track.riding[-1]:
        last = int(np.flatnonzero(~track.riding)[-1]) if not track.riding.all() else -1
        begin_s = (stamps_ns[last + 1] - stamps_ns[0]) * 1e-9
        lost = len(track.riding) - 1 - last
        warnings.append(
            f"from {begin_s:.0f} s after the first scan on, the robot is on a slope that leads to another "
            f"floor, or less than {RIDES.settled_m:.0f} m behind it: these {lost} scans are in no map; "
            "record more of that floor"
        )
    for stall in stalls(stamps_ns.tolist(), track.disagreements):
        from_s, to_s = ((stamp_ns - stamps_ns[0]) * 1e-9 for stamp_ns in (stall.from_ns, stall.to_ns))
        warnings.append(
            f"from {from_s:.0f} to {to_s:.0f} s after the first scan odometry reports "
            f"{stall.reported_m:.1f} m of travel, and the scans show {stall.moved_m:.1f} m: unless the "
            "wheels spun, the robot was on a slope that was not noticed, and the map is wrong there; leave "
            "that part out with --start and --duration"
        )
    away = np.flatnonzero(np.abs(heights_m - heights_m[0]) > RIDES.storey_m)
    if track.carried and len(away):
        begin_s = (stamps_ns[away[0]] - stamps_ns[0]) * 1e-9
        farthest_m = float(max(heights_m - heights_m[0], key=abs))
        where = f"{abs(farthest_m):.1f} m {'above' if farthest_m > 0 else 'below'}"
        warnings.append(
            f"the sensor in the hand is up to {where} its first height, and more than {RIDES.storey_m:.1f} m "
            f"from {begin_s:.0f} s after the first scan on; if that was by stairs, {advice}"
        )
    return warnings


def _in_order(parts: Sequence[Trajectory]) -> Trajectory:
    """The scans of all parts in the order of time."""
    stamps_ns = np.concatenate([part.stamps_ns for part in parts])
    health = [state for part in parts for state in part.health]
    order = np.argsort(stamps_ns, kind="stable")
    return Trajectory(
        stamps_ns=stamps_ns[order],
        T_session_base=np.concatenate([part.T_session_base for part in parts])[order],
        health=tuple(health[k] for k in order.tolist()),
    )


def _with_warnings(report: ReadReport, part: _Mapped, *, slopes_unseen: bool) -> ReadReport:
    """The report of a part with the warnings of registration and of the map added."""
    from pc2grid.mapping.consistency import consistency_warning
    from pc2grid.mapping.precision import precision_warning

    trajectory = part.trajectory
    lost = sum(h is Health.LOST for h in trajectory.health)
    weak = sum(h is Health.DEGENERATE for h in trajectory.health)
    total, skipped, warnings = len(trajectory), dict(report.scans_skipped), list(report.warnings)
    if lost:
        skipped["registration lost"] = lost
        first = next(k for k, h in enumerate(trajectory.health) if h is Health.LOST)
        seconds = (trajectory.stamps_ns[first] - trajectory.stamps_ns[0]) * 1e-9
        warnings.append(
            f"registration was lost for {lost} of {total} scans, first {seconds:.1f} s after the first scan; "
            "they are not in the map"
        )
    if weak > _WARN_DEGENERATE * total:
        warnings.append(
            f"{weak} of {total} scans did not fix the pose in every direction: there it rests on odometry "
            "or on the motion before"
        )
    bent = consistency_warning(
        part.consistency,
        trajectory,
        slopes_unseen=slopes_unseen,
        with_odometry=part.odometry.compared > 0,
    )
    if bent is not None:
        warnings.append(bent)
    loose = precision_warning(part.precision, trajectory)
    if loose is not None:
        warnings.append(loose)
    return dataclasses.replace(report, scans_skipped=skipped, warnings=tuple(warnings))


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
