"""Measure what the program promises, one line each: `make bench`.

Machines differ and are noisy: figures are medians of interleaved runs, with the machine and versions above
them. Peers and goals come with each measure where there is one.
"""

from __future__ import annotations

import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pc2grid.config import PartitionConfig
from pc2grid.model import OccupancyGrid, SessionMap, Trajectory
from pc2grid.partition import partition
from pc2grid.simulate import office_floorplan
from signature.build import provenance
from signature.config import Config
from signature.database import open_database
from signature.database.sqlite import store
from signature.describe import Signature, describe


def main() -> None:
    """Print the table."""
    print(
        f"{platform.machine()}, {platform.system()} {platform.release()}, Python {platform.python_version()},"
    )
    print(f"numpy {np.__version__}")
    rows = [("measure", "median", "goal"), *help_rows(), *describe_rows(), *database_rows()]
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)))


def help_rows() -> list[tuple[str, str, str]]:
    """`pc2grid --help` beside an interpreter that does nothing."""
    ours = [sys.executable, "-c", "from pc2grid_cli.main import main; main()", "--help"]
    bare = [sys.executable, "-c", "pass"]
    pairs = [(_seconds(lambda: _quiet(ours)), _seconds(lambda: _quiet(bare))) for _ in range(11)]
    help_s, bare_s = (statistics.median(column) for column in zip(*pairs, strict=True))
    return [
        ("pc2grid --help", f"{help_s:.3f} s", "0.3 s"),
        ("python that does nothing", f"{bare_s:.3f} s", ""),
    ]


def describe_rows() -> list[tuple[str, str, str]]:
    """One submap to its signatures, on submaps of a procedural office."""
    submaps = partition(office_floorplan(0), PartitionConfig())
    for submap in submaps[:3]:
        describe(submap)  # compiled code warms up
    times = [_seconds(lambda submap=submap: describe(submap)) for submap in submaps]
    return [
        (f"describe a submap ({len(submaps)} of them)", f"{1e3 * statistics.median(times):.2f} ms", "2 ms")
    ]


def database_rows(submaps: int = 1_000_000, sessions: int = 100) -> list[tuple[str, str, str]]:
    """Open a large database and have all its signatures ready."""
    rng = np.random.default_rng(0)
    each = submaps // sessions
    grid = OccupancyGrid(cells=np.zeros((2, 2), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    empty = Trajectory(stamps_ns=np.empty(0, np.int64), T_map_base=np.empty((0, 4, 4)))
    origin = provenance(Path("bench"), "0" * 64, Config())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.submaps"
        from pc2grid.model import Submap

        parts = tuple(Submap(submap_id=i, center_m=(0.0, 0.0), radius_m=8.0, grid=grid) for i in range(each))
        noise = rng.random((each, 122)).astype(np.float32)
        signatures = [
            Signature(boundary=row[:80], freespace=row[80:120], symmetry=row[120:]) for row in noise
        ]
        entries = [
            (
                SessionMap(session=f"s{i}", sensor="map", grid=grid, submaps=parts, trajectory=empty),
                signatures,
                origin,
            )
            for i in range(sessions)
        ]
        written_s = _seconds(lambda: store(path, entries, keep=False))
        times = []
        for _ in range(3):
            begin = time.perf_counter()
            with open_database(path) as database:
                assert len(database.signatures()) == each * sessions
            times.append(time.perf_counter() - begin)
        size = path.stat().st_size / 1e6
    return [
        (f"write {each * sessions} submaps ({size:.0f} MB)", f"{written_s:.1f} s", ""),
        ("open them, all signatures ready", f"{statistics.median(times):.2f} s", "1 s"),
    ]


def _seconds(action: Callable[[], object]) -> float:
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def _quiet(command: list[str]) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
