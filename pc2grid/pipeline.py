"""Recording -> session map: the point-cloud half from end to end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pc2grid.config import PartitionConfig, ProjectionConfig, RegistrationConfig
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import Health, RegisteredScan, Scan, SessionMap, Trajectory
from pc2grid.projection import GridBuilder
from pc2grid.sweep import Sweep

if TYPE_CHECKING:
    from pc2grid.io import Log

DRAW_TRAVEL_M = 0.1
DRAW_TURN_RAD = math.radians(5.0)


class PipelineConfig(Protocol):
    """The sections that the point-cloud half reads; `signature.config.Config` is one."""

    @property
    def registration(self) -> RegistrationConfig: ...
    @property
    def projection(self) -> ProjectionConfig: ...
    @property
    def partition(self) -> PartitionConfig: ...


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A sweep worth keeping: the robot had moved since the one before. T_map_base as tracked."""

    index: int
    sweep: Sweep
    T_map_base: SE2
    health: Health


def follow(scans: Iterable[Scan], config: PipelineConfig) -> Iterator[tuple[RegisteredScan, Sweep]]:
    """Each scan with its pose and its sweep, as they come. Memory is one local map, whatever the length."""
    from pc2grid.tracking import Tracker

    tracker = Tracker(config.registration, config.projection)
    for scan in scans:
        yield tracker.track(scan)


def build_map(
    log: Log,
    config: PipelineConfig,
    *,
    session: str,
    start_s: float = 0.0,
    duration_s: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> SessionMap:
    """Turn a recording, or `duration_s` of it from `start_s` on, into a map.

    progress : called with the share that is done, 0..1.
    Raises NoScans if there is nothing to make a map from.
    """
    from pc2grid.partition import partition

    begin_ns = log.info.start_ns + int(start_s * 1e9)
    span_ns = max(log.info.end_ns - begin_ns if duration_s is None else int(duration_s * 1e9), 1)
    stamps, poses, health, keyframes = [], [], [], []
    for registered, sweep in follow(log.scans(start_s, duration_s), config):
        pose = SE2.flatten(registered.T_map_base)
        if _moved(keyframes[-1].T_map_base if keyframes else None, pose):
            keyframes.append(Keyframe(len(stamps), sweep, pose, registered.health))
        stamps.append(registered.scan.stamp_ns)
        poses.append(registered.T_map_base)
        health.append(registered.health)
        if progress is not None:
            progress(min(0.9 * (registered.scan.stamp_ns - begin_ns) / span_ns, 0.9))
    if not stamps:
        raise NoScans(f"{log.info.path}: no scans in the part asked for", hint="check --start and --duration")
    builder = GridBuilder(config.projection)
    for keyframe in keyframes:
        if keyframe.health is not Health.LOST:
            builder.add(keyframe.sweep, keyframe.T_map_base)
    grid = builder.grid()
    submaps = partition(grid, config.partition)
    if progress is not None:
        progress(1.0)
    return SessionMap(
        session=session,
        sensor=log.choose().sensor,
        grid=grid,
        submaps=submaps,
        trajectory=Trajectory(
            stamps_ns=np.array(stamps, dtype=np.int64), T_map_base=np.array(poses), health=tuple(health)
        ),
        report=log.report(),
    )


def _moved(last: SE2 | None, now: SE2) -> bool:
    if last is None:
        return True
    step = last.inverse() @ now
    return math.hypot(step.x, step.y) >= DRAW_TRAVEL_M or abs(step.yaw) >= DRAW_TURN_RAD
