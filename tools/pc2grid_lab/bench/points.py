"""Points kept with the database (`convert --points`): what they cost in size, time and memory."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pc2grid.simulate.config import LidarConfig
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import Child, Row, program

VOXEL_M = 0.05
_FLOOR_M2 = 500.0  # the size goal is for this area of floor
_METRES_A_MINUTE = 24.5  # of a simulated drive, with its turns and stops
_LIDAR = LidarConfig(beams=16, columns=360, rate_hz=2.5)
"""A lidar with a fifth of a usual one's points, so that an hour is mapped in minutes."""


@dataclass(frozen=True, slots=True)
class _Kept:
    """`convert` of one log without and with points; the size of the database and the floor in it."""

    minutes: int
    scans: int
    without: Child
    with_points: Child
    size_mb: float
    floor_m2: float

    @property
    def size_500_mb(self) -> float:
        """Size for 500 m2 of floor."""
        return self.size_mb * _FLOOR_M2 / self.floor_m2

    @property
    def told(self) -> str:
        """Where the figures come from."""
        return (
            f"{self.minutes} min, {self.scans} scans; {self.size_mb:.1f} MB, {self.floor_m2:.0f} m2;"
            f" cpu {self.without.time.cpu:.0f} and {self.with_points.time.cpu:.0f} s,"
            f" {self.without.peak_mb:.0f} and {self.with_points.peak_mb:.0f} MB of memory"
        )


def kept(folder: Path, quick: bool) -> Iterator[Row]:
    """An hour in one building, and a quarter of it: the points must grow with the area, not with the time."""
    program("convert", _log(folder, 1)[0], "--points", VOXEL_M, "-o", folder / "first.submaps")  # compiles
    short, long = (_measured(folder, minutes) for minutes in ((2, 4) if quick else (15, 60)))
    yield Row(
        what=f"database with points of {100 * VOXEL_M:.0f} cm, for {_FLOOR_M2:.0f} m2 of floor",
        measured=long.size_500_mb,
        unit="MB",
        goal=60.0,
        note=long.told,
    )
    yield Row(
        what="the same, of a quarter of the log" if not quick else "the same, of half the log",
        measured=short.size_500_mb,
        unit="MB",
        note=short.told,
    )
    yield Row(
        what="convert with points, over without",
        measured=long.with_points.time.wall / long.without.time.wall,
        cpu=long.with_points.time.cpu / long.without.time.cpu,
        unit="x",
        goal=1.3,
    )
    yield Row(
        what="memory of convert with points, the longer log over the shorter",
        measured=long.with_points.peak_mb / short.with_points.peak_mb,
        unit="x",
        goal=1.1,
    )


def _log(folder: Path, minutes: int) -> tuple[Path, int]:
    """A drive through the office, and how many scans it has."""
    log = folder / f"{minutes}.mcap"
    return log, fixtures.lidar_log(log, _METRES_A_MINUTE * minutes, lidar=_LIDAR)


def _measured(folder: Path, minutes: int) -> _Kept:
    log, scans = _log(folder, minutes)
    out = folder / "out.submaps"
    without = program("convert", log, "-o", out, "--force")
    with_points = program("convert", log, "--points", VOXEL_M, "-o", out, "--force")
    sessions = json.loads(program("db", "info", out, "--json").stdout)["sessions"]
    log.unlink()
    return _Kept(
        minutes=minutes,
        scans=scans,
        without=without,
        with_points=with_points,
        size_mb=out.stat().st_size / 1e6,
        floor_m2=sum(session["area_m2"] for session in sessions),
    )
