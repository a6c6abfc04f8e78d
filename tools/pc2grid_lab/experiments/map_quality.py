"""Sessions mapped with the settings of a user, compared with bare KISS-ICP on the same scans."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64
from pc2grid.estimation.registration import BareKissIcp
from pc2grid.geometry import SE2
from pc2grid.model import Health, OccupancyGrid, Scan, Trajectory
from pc2grid.pipeline import map_scans
from pc2grid.simulate import Session
from pc2grid_lab.experiments.true_floor import GridQuality, TrueFloor
from signature.config import Config
from signature.localization.place_recognition import recognizer_for


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingRun:
    """The map of one session, and the poses of bare KISS-ICP for the same scans.

    loops : how many were closed. T_base_sensor : (4, 4) of the first scan.
    bare : KISS-ICP's poses, each at the end of its scan.
    map_ms, bare_ms : processor time per scan, for the whole map and for KISS-ICP's register_frame alone.
    """

    trajectory: Trajectory
    grid: OccupancyGrid
    loops: int
    T_base_sensor: F64
    bare: Trajectory
    map_ms: float
    bare_ms: float

    def share(self, health: Health) -> float:
        """Share of the scans in that state, 0..1."""
        return sum(h is health for h in self.trajectory.health) / max(len(self.trajectory), 1)


def map_beside_bare(scans: Iterable[Scan], config: Config) -> MappingRun:
    """Map the scans, and register each of them with bare KISS-ICP as well."""
    bare = BareKissIcp()
    stamps: list[int] = []
    poses: list[F64] = []
    mounts: list[F64] = []
    outside_s = bare_s = 0.0

    def tee() -> Iterator[Scan]:
        nonlocal outside_s, bare_s
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
            bare_s += end - middle
            outside_s += end - begin
            yield scan

    begin = time.process_time()
    grid, trajectory, loops = map_scans(tee(), config, recognizer=recognizer_for(config))
    map_s = time.process_time() - begin - outside_s
    count = max(len(stamps), 1)
    return MappingRun(
        trajectory=trajectory,
        bare=Trajectory(
            stamps_ns=np.array(stamps, np.int64), T_session_base=np.array(poses).reshape(-1, 4, 4)
        ),
        grid=grid,
        loops=len(loops),
        T_base_sensor=mounts[0] if mounts else np.eye(4),
        map_ms=1000 * map_s / count,
        bare_ms=1000 * bare_s / count,
    )


def map_simulated(
    session: Session, config: Config, progress: Callable[[float], None] | None = None
) -> tuple[MappingRun, Trajectory, GridQuality]:
    """Map a simulated session: the run, the true poses, and the quality of the grid.

    progress : called with the share that is done, 0..1.
    """
    floor = TrueFloor(session, config.projection)
    times: list[int] = []
    poses: list[F64] = []

    def scans() -> Iterator[Scan]:
        for reading in session.readings():
            floor.add(reading)
            times.append(reading.stamp_ns)
            poses.append(session.drive.pose(reading.time_s).lift())
            if progress is not None:
                progress(0.9 * (reading.index + 1) / session.scan_count)
            yield session.scan(reading)

    run = map_beside_bare(scans(), config)
    truth = Trajectory(stamps_ns=np.array(times, np.int64), T_session_base=np.array(poses))
    kept = np.array([h is not Health.LOST for h in run.trajectory.health])
    T_plan_map = SE2.fit(run.trajectory.planar()[kept, :2], truth.planar()[kept, :2])
    return run, truth, floor.judge(run.grid, T_plan_map)
