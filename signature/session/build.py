"""From a recording to a session map: tracking, loop closure, drawing, and division into submaps."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.errors import NoScans
from pc2grid.estimation.spatial import begin
from pc2grid.estimation.tracker import Disagreement, Tracker
from pc2grid.geometry import SE2
from pc2grid.libraries import one_blas_thread
from pc2grid.model import (
    SENSOR_MODELS,
    Health,
    Loop,
    OccupancyGrid,
    Scan,
    SessionMap,
    Trajectory,
    part_name,
)
from pc2grid.observer import Observer, TimeSpan
from pc2grid.submaps.submaps import divide
from signature.config import Config
from signature.session.keyframes import Keyframe, KeyframePoints, Keyframes, Track
from signature.session.local_maps import CAMERA_LOCAL_MAPS, LOCAL_MAPS
from signature.session.loops import LoopCloser, SessionRecognizer
from signature.session.part_maps import (
    check_followed,
    draw_parts,
    long_enough,
    part_reports,
    with_track_warnings,
)

if TYPE_CHECKING:
    from pc2grid.io.recording import Log

_SHARE_BEFORE_LOOPS = 0.8
"""Share of the work of `build_map` that is done when the last scan has been tracked; chosen by hand."""
_NO_READING = np.full((4, 4), np.nan)


def build_map(
    log: Log,
    config: Config = Config(),
    *,
    session: str,
    span: TimeSpan = TimeSpan(),
    observer: Observer = Observer(),
) -> SessionMap:
    """Turn a recording, or the part of it that `span` names, into a map with submaps.

    observer : gets the progress, and each scan with its tracked pose. Of a recording in several parts (see
    `build_maps`), the one with the longest travel is returned, and its report names the others. Raises
    NoScans if there is nothing to make a map from, TrackingLost if the scans of a laser, or of a sensor in
    the hand, cannot be followed without odometry.

    >>> import pc2grid
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = build_map(log, session="monday", span=pc2grid.TimeSpan(0.0, 2.0))
    >>> monday.sensor, len(monday.trajectory) > 10, bool(abs(monday.trajectory.planar()[0]).max() < 1e-9)
    ('laser', True, True)
    """
    return longest_of(build_maps(log, config, session=session, span=span, observer=observer))


@one_blas_thread
def build_maps(
    log: Log,
    config: Config = Config(),
    *,
    session: str,
    span: TimeSpan = TimeSpan(),
    observer: Observer = Observer(),
) -> tuple[SessionMap, ...]:
    """Turn a recording into a map, or into several if its parts cannot be placed to each other.

    A part ends where tracking was lost, unless a loop joins the scans before and after
    (`signature.session.loops`). The first map has the name `session`, the others `session#2`,
    `session#3`, ...; each has its own frame, the base at its first scan. The first map's report also holds
    the counts of the whole recording.

    Parameters and errors are those of `build_map`.

    >>> import pc2grid
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     [part.session for part in build_maps(log, session="monday", span=pc2grid.TimeSpan(0.0, 2.0))]
    ['monday']
    """
    start_ns, end_ns = log.info.start_ns, log.info.end_ns

    def reported() -> Iterator[Scan]:
        for scan in log.scans(span.start_s, span.duration_s):
            yield scan
            observer.on_progress(_SHARE_BEFORE_LOOPS * span.share_done(scan.stamp_ns, start_ns, end_ns))

    parts, track = _map(reported(), config, observer)
    sensor = log.choose().sensor
    planar = SENSOR_MODELS[sensor].planar
    if not any(len(part.trajectory) for part in parts):
        raise NoScans(f"{log.info.path}: no scans in the part asked for", hint="check --start and --duration")
    if planar and not track.with_odometry:
        check_followed(track.trajectory, str(log.info.path))
    kept = long_enough(parts)
    reports = part_reports(
        with_track_warnings(log.report(), track), session, parts, kept, track.walls_changed_ns
    )
    maps = []
    for k, (part, report) in enumerate(zip(kept, reports, strict=True)):
        graph, submaps = divide(part.grid, config.partition)
        named = dataclasses.replace(part, session=part_name(session, k), sensor=sensor, report=report)
        maps.append(dataclasses.replace(named, submaps=submaps, graph=graph))
    observer.on_progress(1.0)
    return tuple(maps)


def longest_of(maps: Sequence[SessionMap]) -> SessionMap:
    """Return the map with the longest travel of those of a recording, under the name of the recording.

    Its report is that of the whole recording, and names the maps that are left out.
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


@one_blas_thread
def map_scans(
    scans: Iterable[Scan],
    config: Config = Config(),
    observer: Observer = Observer(),
) -> tuple[OccupancyGrid, Trajectory, tuple[Loop, ...]]:
    """Return the grid and trajectory of scans, and their loops; never divided as by `build_maps`.

    observer : gets each scan with its tracked pose, before loops are closed.

    Only the pose of a scan stays in memory. The planar scan of a keyframe waits in a temporary file. So
    memory grows with the mapped area, not with the length of the recording. A robot that stands still adds
    nothing.

    >>> import pc2grid
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     grid, trajectory, loops = map_scans(log.scans(0.0, 2.0))
    >>> grid.resolution_m, bool(grid.occupied.any())
    (0.05, True)
    """
    (mapped,), _ = _map(scans, config, observer, whole=True)
    return mapped.grid, mapped.trajectory, mapped.loops


def _map(
    scans: Iterable[Scan],
    config: Config,
    observer: Observer,
    *,
    whole: bool = False,
) -> tuple[list[SessionMap], Track]:
    """Track the scans, close the loops, and draw a map of each part, see `build_maps`; returns also the
    track.

    whole : all scans are one part.
    """
    projection = config.projection
    rest = iter(scans)
    beginning = begin(rest)
    first = beginning.scans[:1]  # a recording has one kind of sensor
    narrow = any(SENSOR_MODELS[scan.sensor].narrow for scan in first)
    planar = any(SENSOR_MODELS[scan.sensor].planar for scan in first)
    with ExitStack() as stack:
        keyframes = stack.enter_context(closing(Keyframes()))
        points = None
        if projection.points_voxel_m is not None and not planar:
            points = KeyframePoints(projection.points_voxel_m, projection.max_range_m)
            stack.enter_context(closing(points))
        closer = LoopCloser(
            keyframes,
            recognizer=SessionRecognizer(config) if config.loops.recognize else None,
            projection=projection,
            local_map_parameters=CAMERA_LOCAL_MAPS if narrow else LOCAL_MAPS,
        )
        tracker = Tracker(config.registration, config.projection, in_hand=beginning.in_hand)
        track = _track(chain(beginning.scans, rest), tracker, closer, points, observer)
        track = dataclasses.replace(track, left_out=beginning.left_out, warning=beginning.warning)
        closed = closer.finish()
        if whole:
            together = np.zeros(len(closed.scans), np.int64)
            closed = dataclasses.replace(closed, segments=together, parts=together)
        parts = draw_parts(keyframes, track, closed, projection, points)
    return parts, track


def _track(
    scans: Iterable[Scan],
    tracker: Tracker,
    closer: LoopCloser,
    points: KeyframePoints | None,
    observer: Observer,
) -> Track:
    """Track all scans, keep the keyframes, and close loops on the way."""
    stamps_ns, poses, readings = array("q"), array("d"), array("d")
    health, disagreements, changed_ns = list[Health](), list[Disagreement | None](), list[int]()
    for scan in scans:
        tracked = tracker.track(scan)
        registered = tracked.registered
        if tracked.keyframe:
            pose = SE2.from_matrix(registered.T_session_base)
            closer.add(Keyframe(len(stamps_ns), tracked.planar_scan, pose, tracked.restart))
            if points is not None:
                points.append(len(stamps_ns), registered.scan)
        stamps_ns.append(scan.stamp_ns)
        poses.extend(registered.T_session_base.ravel())
        readings.extend((_NO_READING if scan.T_odom_base is None else scan.T_odom_base).ravel())
        health.append(registered.health)
        disagreements.append(tracked.disagreement)
        if tracked.walls_changed:
            changed_ns.append(scan.stamp_ns)
        observer.on_scan(registered)
    trajectory = Trajectory(
        stamps_ns=np.array(stamps_ns, dtype=np.int64),
        T_session_base=np.frombuffer(poses).reshape(-1, 4, 4),
        health=tuple(health),
    )
    return Track(trajectory, disagreements, np.frombuffer(readings).reshape(-1, 4, 4), tuple(changed_ns))
