"""Sessions mapped as a user would, beside bare KISS-ICP on the same scans: what each made of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.geometry import F64, SE2
from pc2grid.model import Health, OccupancyGrid, Scan, Trajectory
from pc2grid.pipeline import map_scans
from pc2grid.registration import BareKissIcp
from signature.config import Config
from signature.evaluation.true_floor import GridQuality, TrueFloor

if TYPE_CHECKING:
    from pc2grid.simulate import Session


@dataclass(frozen=True, slots=True, kw_only=True)
class Mapped:
    """One session, mapped as a user would, and what bare KISS-ICP made of the same scans.

    loops : how many were closed. T_base_sensor : (4, 4) of the first scan.
    bare : KISS-ICP's poses, each at the end of its scan.
    map_ms, bare_ms : processor time a scan, for the whole map and for KISS-ICP's register_frame alone.
    """

    trajectory: Trajectory
    grid: OccupancyGrid
    loops: int
    T_base_sensor: F64
    bare: Trajectory
    map_ms: float
    bare_ms: float

    def share(self, health: Health) -> float:
        """Share of the scans in that state."""
        return sum(h is health for h in self.trajectory.health) / max(len(self.trajectory), 1)


def map_beside_bare(scans: Iterable[Scan], config: Config) -> Mapped:
    """Map the scans, and give each of them to bare KISS-ICP as well."""
    bare = BareKissIcp()
    stamps: list[int] = []
    poses: list[F64] = []
    mounts: list[F64] = []
    outside = spent = 0.0

    def tee() -> Iterator[Scan]:
        nonlocal outside, spent
        source = iter(scans)
        while True:
            begin = time.process_time()
            scan = next(source, None)
            if scan is None:
                return
            if not mounts:
                mounts.append(scan.T_base_sensor)
            middle = time.process_time()
            poses.append(bare.register(scan))
            last_s = 0.0 if scan.offsets_s is None or not len(scan.offsets_s) else scan.offsets_s.max()
            stamps.append(scan.stamp_ns + round(float(last_s) * 1e9))
            end = time.process_time()
            spent += end - middle
            outside += end - begin
            yield scan

    begin = time.process_time()
    grid, trajectory, loops = map_scans(tee(), config)
    total = time.process_time() - begin - outside
    count = max(len(stamps), 1)
    return Mapped(
        trajectory=trajectory,
        bare=Trajectory(stamps_ns=np.array(stamps, np.int64), T_map_base=np.array(poses).reshape(-1, 4, 4)),
        grid=grid,
        loops=len(loops),
        T_base_sensor=mounts[0] if mounts else np.eye(4),
        map_ms=1000 * total / count,
        bare_ms=1000 * spent / count,
    )


def map_simulated(
    session: Session, config: Config, progress: Callable[[float], None] | None = None
) -> tuple[Mapped, Trajectory, GridQuality]:
    """Drive a session, map it, and judge the map: the map, the true poses, and the quality of its grid."""
    floor = TrueFloor(session, config.projection)
    times: list[int] = []
    poses: list[F64] = []

    def scans() -> Iterator[Scan]:
        for reading in session.readings():
            floor.look(reading)
            times.append(reading.stamp_ns)
            poses.append(session.drive.pose(reading.time_s).lift())
            if progress is not None:
                progress(0.9 * (reading.index + 1) / session.scan_count)
            yield session.scan(reading)

    mapped = map_beside_bare(scans(), config)
    truth = Trajectory(stamps_ns=np.array(times, np.int64), T_map_base=np.array(poses))
    sure = np.array([h is not Health.LOST for h in mapped.trajectory.health])
    T_plan_map = SE2.fit(mapped.trajectory.planar()[sure, :2], truth.planar()[sure, :2])
    return mapped, truth, floor.judge(mapped.grid, T_plan_map)
