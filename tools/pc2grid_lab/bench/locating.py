"""Time of `pc2grid relocalize`, from the start of the process to the answer, and of the answer alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from pc2grid.model import OccupancyGrid
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import Row, median, program, timed
from pc2grid_lab.bench.reading import bare_kiss
from signature.config import Config
from signature.localization.decision import judge

WINDOW_M = 15.0


def look_up_time(folder: Path, quick: bool) -> Iterator[Row]:
    """The time from a query's grid, drawn over 15 m, to its pose in the map of an office."""
    config = Config()
    index = fixtures.index_of(fixtures.grid_of(fixtures.drive(30.0 if quick else 150.0, seed=0)), config)
    windows = [
        window
        for seed in ((1,) if quick else (1, 2, 3))
        for window in _windows(list(fixtures.drive(16.0 if quick else 62.0, seed=seed)))
    ]
    index.look_up(fixtures.query_map(windows[0], config))  # compiles
    times = []
    for window in windows:
        grid = fixtures.grid_of(window)

        def locate(window: list[fixtures.PosedScan] = window, grid: OccupancyGrid = grid) -> None:
            query = fixtures.query_map(window, config, grid)
            judge(index, query, index.look_up(query))

        times.append(timed(locate))
    wall, cpu = median(times).times(1e3)
    what = f"query to pose in {len(index.places.table)} submaps"
    yield Row(what=what, measured=wall, cpu=cpu, unit="ms", goal=60.0, note=f"{len(times)} queries")


def _windows(scans: list[fixtures.PosedScan]) -> Iterator[list[fixtures.PosedScan]]:
    """The scans of each 15 m of travel."""
    start, path_m = 0, 0.0
    for k in range(1, len(scans)):
        a, b = scans[k - 1].T_map_base, scans[k].T_map_base
        path_m += math.hypot(b.x - a.x, b.y - a.y)
        if path_m >= WINDOW_M:
            yield scans[start : k + 1]
            start, path_m = k + 1, 0.0


def relocalize_time(folder: Path, quick: bool) -> Iterator[Row]:
    """`pc2grid relocalize` on 15 s of a recording, without the time that bare KISS-ICP needs for its scans.

    Also how much more processor time the first run in a fresh environment needs, where nothing is compiled
    yet.
    """
    mapped, log = folder / "monday.mcap", folder / "tuesday.mcap"
    fixtures.lidar_log(mapped, 10.0 if quick else 60.0, seed=0)
    fixtures.lidar_log(log, 12.0, seed=1)
    database = folder / "building.submaps"
    program("convert", mapped, "-o", database)
    cache = {"NUMBA_CACHE_DIR": str(folder / "numba")}
    first, second = (
        program("relocalize", log, "--duration", "15", "-d", database, environment=cache).time
        for _ in range(2)
    )
    yield Row(
        what="first relocalize in a fresh environment, over the second",
        measured=first.wall - second.wall,
        cpu=first.cpu - second.cpu,
        unit="s",
        goal=12.0,
        note=f"cpu: {first.cpu:.1f} s, then {second.cpu:.1f} s",
    )
    whole, bare = [], []
    for _ in range(1 if quick else 5):
        whole.append(program("relocalize", log, "--duration", "15", "-d", database, environment=cache).time)
        bare.append(bare_kiss(log, 15.0).same)
    took, kiss = median(whole), median(bare)
    yield Row(
        what="relocalize a 15 s log, process start to answer, without KISS-ICP",
        measured=took.wall - kiss.wall,
        cpu=took.cpu - kiss.cpu,
        unit="s",
        goal=3.0,
        note=f"cpu: {took.cpu:.1f} s in all, KISS-ICP alone {kiss.cpu:.1f} s",
    )
