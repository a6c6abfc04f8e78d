"""Recording -> session map: the point-cloud half from end to end."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pc2grid.config import PartitionConfig, ProjectionConfig, RegistrationConfig
from pc2grid.errors import NoScans
from pc2grid.geometry import F64, SE2
from pc2grid.model import (
    Health,
    Loop,
    OccupancyGrid,
    ReadReport,
    RegisteredScan,
    Scan,
    SessionMap,
    Trajectory,
)
from pc2grid.projection import GridBuilder
from pc2grid.sweep import Sweep

if TYPE_CHECKING:
    from pc2grid.io import Log


class PipelineConfig(Protocol):
    """The sections that the point-cloud half reads; `signature.config.Config` is one."""

    @property
    def registration(self) -> RegistrationConfig:
        """How scans are registered."""
        ...

    @property
    def projection(self) -> ProjectionConfig:
        """How they are drawn."""
        ...

    @property
    def partition(self) -> PartitionConfig:
        """How the map is divided."""
        ...


def follow(scans: Iterable[Scan], config: PipelineConfig) -> Iterator[tuple[RegisteredScan, Sweep]]:
    """Each scan with its pose and its sweep, as they come. Memory is one local map, whatever the length.

    >>> import pc2grid, signature
    >>> with pc2grid.open_log("tuesday.mcap") as log:
    ...     poses = [scan.T_map_base for scan, _ in follow(log.scans(0.0, 1.0), signature.Config())]
    >>> poses[0].shape, float(poses[0][0, 3])
    ((4, 4), 0.0)
    """
    from pc2grid.tracking import Tracker

    tracker = Tracker(config.registration, config.projection)
    for scan in scans:
        tracked = tracker.track(scan)
        yield tracked.registered, tracked.sweep


def build_map(
    log: Log,
    config: PipelineConfig,
    *,
    session: str,
    start_s: float = 0.0,
    duration_s: float | None = None,
    progress: Callable[[float], None] | None = None,
    watch: Callable[[RegisteredScan], None] | None = None,
) -> SessionMap:
    """Turn a recording, or `duration_s` of it from `start_s` on, into a map.

    progress : called with the share that is done, 0..1.
    watch : called with each scan where tracking puts it, before loops are closed.
    Raises NoScans if there is nothing to make a map from.

    >>> import pc2grid, signature
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = build_map(log, signature.Config(), session="monday", duration_s=2.0)
    >>> monday.sensor, len(monday.trajectory) > 10, monday.trajectory.planar()[0].tolist()
    ('laser', True, [0.0, 0.0, 0.0])
    """
    from pc2grid.partition import partition

    begin_ns = log.info.start_ns + int(start_s * 1e9)
    span_ns = max(log.info.end_ns - begin_ns if duration_s is None else int(duration_s * 1e9), 1)

    def see(registered: RegisteredScan) -> None:
        if progress is not None:
            progress(min(0.8 * (registered.scan.stamp_ns - begin_ns) / span_ns, 0.8))
        if watch is not None:
            watch(registered)

    grid, trajectory, loops = map_scans(log.scans(start_s, duration_s), config, see)
    if not len(trajectory):
        raise NoScans(f"{log.info.path}: no scans in the part asked for", hint="check --start and --duration")
    submaps = partition(grid, config.partition)
    if progress is not None:
        progress(1.0)
    return SessionMap(
        session=session,
        sensor=log.choose().sensor,
        grid=grid,
        submaps=submaps,
        trajectory=trajectory,
        loops=loops,
        report=_with_health(log.report(), trajectory),
    )


def map_scans(
    scans: Iterable[Scan],
    config: PipelineConfig,
    watch: Callable[[RegisteredScan], None] = lambda registered: None,
) -> tuple[OccupancyGrid, Trajectory, tuple[Loop, ...]]:
    """Grid and trajectory of scans, and the loops found on the way. `watch` is called with each scan where
    tracking puts it, before loops are closed.

    Of a scan only its pose is kept, and of a keyframe its sweep in a temporary file: memory follows the area,
    not the length. A robot that stands still adds nothing.

    >>> import pc2grid, signature
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     grid, trajectory, loops = map_scans(log.scans(0.0, 2.0), signature.Config())
    >>> grid.resolution_m, bool(grid.occupied.any())
    (0.05, True)
    """
    from pc2grid.glimpses import Glimpses
    from pc2grid.keyframes import Keyframe, Keyframes
    from pc2grid.loops import LoopCloser, spread
    from pc2grid.tracking import Tracker

    tracker = Tracker(config.registration, config.projection)
    stamps, poses = array("q"), array("d")
    health: list[Health] = []
    between = Glimpses(config.projection.max_range_m, config.projection.resolution_m)
    builder = GridBuilder(config.projection)
    with closing(Keyframes()) as keyframes:
        closer = LoopCloser(keyframes)
        latest: Keyframe | None = None

        def keep() -> None:
            if latest is not None:
                keyframes.append(dataclasses.replace(latest, glimpses_m=between.take()))
                closer.extend(latest)

        for scan in scans:
            tracked = tracker.track(scan)
            registered = tracked.registered
            pose = SE2.flatten(registered.T_map_base)
            if tracked.keyframe:
                keep()
                latest = Keyframe(len(stamps), tracked.sweep, pose, tracked.restart)
                between.restart(tracked.sweep, pose)
            elif latest is not None and registered.health is not Health.LOST:
                between.add(tracked.sweep, pose)
            stamps.append(scan.stamp_ns)
            poses.extend(registered.T_map_base.ravel())
            health.append(registered.health)
            watch(registered)
        keep()
        T_map_base = np.frombuffer(poses).reshape(-1, 4, 4)
        closed = closer.finish()
        if closed.loops:
            flat = np.array([(p.x, p.y, p.yaw) for p in map(SE2.flatten, T_map_base)])
            T_map_base = _replant(T_map_base, flat, spread(flat, closed.scans, closed.poses))
        for keyframe in keyframes:
            pose = SE2.flatten(T_map_base[keyframe.index])
            builder.add(keyframe.sweep, pose)
            builder.glimpse(pose.apply(keyframe.glimpses_m))
    trajectory = Trajectory(
        stamps_ns=np.array(stamps, dtype=np.int64), T_map_base=T_map_base, health=tuple(health)
    )
    return builder.grid(), trajectory, closed.loops


def _with_health(report: ReadReport, trajectory: Trajectory) -> ReadReport:
    """The reader's report and what registration has to confess."""
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
    if weak > 0.1 * total:
        warnings.append(
            f"{weak} of {total} scans did not fix the pose in every direction: there it rests on odometry "
            "or on the motion before"
        )
    return dataclasses.replace(report, scans_skipped=skipped, warnings=tuple(warnings))


def _replant(T_map_base: F64, flat: F64, settled: F64) -> F64:
    """Spatial poses (N, 4, 4) moved in the plane from `flat` to `settled` (N, 3); tilt, height stay."""
    turn = settled[:, 2] - flat[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.zeros((len(turn), 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 1, 1] = c, -s, s, c
    rotation[:, 2, 2] = 1.0
    moved = T_map_base.copy()
    moved[:, :3, :3] = rotation @ T_map_base[:, :3, :3]
    moved[:, :2, 3] = settled[:, :2]
    return moved
