"""A recording becomes a session map: the point-cloud half from end to end."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Iterable, Iterator
from contextlib import closing
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import F64
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
    ReadReport,
    RegisteredScan,
    Scan,
    SessionMap,
    Trajectory,
)
from pc2grid.observer import Observer
from pc2grid.time_span import TimeSpan

if TYPE_CHECKING:
    from pc2grid.io import Log
    from pc2grid.mapping.keyframes import Keyframe, Keyframes
    from pc2grid.mapping.place_recognition import PlaceRecognizer
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

    The memory needed is that of one local map, however many scans there are.

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
        yield tracked.registered, tracked.planar_scan


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
    Raises NoScans if there is nothing to make a map from, TrackingLost if the scans of a laser without
    odometry cannot be followed.

    >>> import pc2grid
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = build_map(log, session="monday", span=pc2grid.TimeSpan(0.0, 2.0))
    >>> monday.sensor, len(monday.trajectory) > 10, monday.trajectory.planar()[0].tolist()
    ('laser', True, [0.0, 0.0, 0.0])
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

    mapped = _map(reported(), config, observer, recognizer)
    grid, trajectory = mapped.grid, mapped.trajectory
    if not len(trajectory):
        raise NoScans(f"{log.info.path}: no scans in the part asked for", hint="check --start and --duration")
    sensor = log.choose().sensor
    if sensor == "laser" and not has_odometry:
        check_followed(trajectory, str(log.info.path))
    graph, submaps = divide(grid, config.partition)
    observer.on_progress(1.0)
    return SessionMap(
        session=session,
        sensor=sensor,
        grid=grid,
        submaps=submaps,
        trajectory=trajectory,
        loops=mapped.loops,
        graph=graph,
        consistency=mapped.consistency,
        report=_with_warnings(log.report(), trajectory, mapped.consistency),
    )


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
    """Grid and trajectory of scans, and the loops that were found.

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
    mapped = _map(scans, config, observer, recognizer)
    return mapped.grid, mapped.trajectory, mapped.loops


@dataclasses.dataclass(frozen=True, slots=True)
class _Mapped:
    """What becomes of the scans of a session."""

    grid: OccupancyGrid
    trajectory: Trajectory
    loops: tuple[Loop, ...]
    consistency: Consistency


def _map(
    scans: Iterable[Scan], config: Config, observer: Observer, recognizer: PlaceRecognizer | None
) -> _Mapped:
    """Track the scans, close the loops, draw the map, and compare it with the scans; see `map_scans`."""
    from pc2grid.mapping.consistency import measure_consistency
    from pc2grid.mapping.keyframes import Keyframes
    from pc2grid.mapping.loop_closure import spread
    from pc2grid.odometry.tracker import Tracker

    tracker = Tracker(config.registration, config.projection)
    stamps, poses = array("q"), array("d")
    health: list[Health] = []
    with closing(Keyframes()) as keyframes:
        selection = _KeyframeSelection(keyframes, config.projection, recognizer)
        for scan in scans:
            tracked = tracker.track(scan)
            selection.add(tracked, index=len(stamps))
            stamps.append(scan.stamp_ns)
            poses.extend(tracked.registered.T_session_base.ravel())
            health.append(tracked.registered.health)
            observer.on_scan(tracked.registered)
        selection.finish()
        T_session_base = np.frombuffer(poses).reshape(-1, 4, 4)
        closed = selection.closer.finish()
        if closed.loops:
            tracked_poses = np.array([(p.x, p.y, p.yaw) for p in map(SE2.from_matrix, T_session_base)])
            settled_poses = spread(tracked_poses, closed.scans, closed.poses)
            T_session_base = _moved_in_plane(T_session_base, tracked_poses, settled_poses)
        trajectory = Trajectory(
            stamps_ns=np.array(stamps, dtype=np.int64), T_session_base=T_session_base, health=tuple(health)
        )
        grid = _draw(keyframes, T_session_base, config.projection)
        consistency = measure_consistency(keyframes, grid, trajectory)
    return _Mapped(grid, trajectory, closed.loops, consistency)


class _KeyframeSelection:
    """Stores the keyframes of a session and passes them to the loop closure.

    A keyframe is stored when the next one begins, together with the hits of the scans between them that the
    keyframe itself did not see.
    """

    def __init__(
        self, keyframes: Keyframes, projection: ProjectionConfig, recognizer: PlaceRecognizer | None
    ) -> None:
        from pc2grid.mapping.loop_closure import LoopCloser
        from pc2grid.mapping.unseen_hits import UnseenHits

        self.closer = LoopCloser(keyframes, recognizer=recognizer, projection=projection)
        self._keyframes = keyframes
        self._unseen_hits = UnseenHits(projection.max_range_m, projection.resolution_m)
        self._latest: Keyframe | None = None

    def add(self, tracked: Tracked, *, index: int) -> None:
        """The next scan, number `index` of the session."""
        from pc2grid.mapping.keyframes import Keyframe

        pose = SE2.from_matrix(tracked.registered.T_session_base)
        if tracked.keyframe:
            self.finish()
            self._latest = Keyframe(index, tracked.planar_scan, pose, tracked.restart)
            self._unseen_hits.restart(tracked.planar_scan, pose)
        elif self._latest is not None and tracked.registered.health is not Health.LOST:
            self._unseen_hits.add(tracked.planar_scan, pose)

    def finish(self) -> None:
        """Store the latest keyframe, if there is one."""
        if self._latest is not None:
            complete = dataclasses.replace(self._latest, unseen_hits_m=self._unseen_hits.take())
            self._keyframes.append(complete)
            self.closer.extend(self._latest)


def _draw(keyframes: Keyframes, T_session_base: F64, projection: ProjectionConfig) -> OccupancyGrid:
    """The occupancy grid of all keyframes, each at the pose (N, 4, 4) of its scan."""
    builder = GridBuilder(projection)
    for keyframe in keyframes:
        pose = SE2.from_matrix(T_session_base[keyframe.index])
        builder.add(keyframe.planar_scan, pose)
        builder.add_unseen_hits(pose.apply(keyframe.unseen_hits_m))
    return builder.grid()


def _with_warnings(report: ReadReport, trajectory: Trajectory, consistency: Consistency) -> ReadReport:
    """The report of the reader with the warnings of registration and of the map added."""
    from pc2grid.mapping.consistency import consistency_warning

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
    bent = consistency_warning(consistency, trajectory)
    if bent is not None:
        warnings.append(bent)
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
