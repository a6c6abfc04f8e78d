"""A fleet's database on a real PostgreSQL: storing, and reading one building or all of it.

python -m pc2grid_lab.bench.fleet [--submaps N]     also a measure of run.py
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psycopg

from pc2grid.model import OccupancyGrid, SessionMap, Submap, Trajectory
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import ROOT, Row, machine, table
from signature.config import Config
from signature.database import Label, SubmapDatabase, maintenance, open_database
from signature.database.protocol import Entry
from signature.sessions import provenance
from signature.similarity import SignatureTable

COUNT, QUICK = 100_000, 5_000
IN_A_BUILDING = 1_000
REPEATS = 9


def fleet_reading(folder: Path, quick: bool) -> Iterator[Row]:
    """Storing a fleet's sessions, and what a robot reads that knows its building, or does not."""
    yield from measured(QUICK if quick else COUNT)


def measured(count: int) -> Iterator[Row]:
    """The rows of the table for a database of `count` submaps."""
    entries = list(sessions(fixtures.many_signatures(count, Config())))
    with server() as made:
        url, what = made.url(), f"{count} submaps in PostgreSQL"

        def cpu_s() -> float:
            return float(made.cpu_s()) + time.process_time()

        begin, cpu = time.perf_counter(), cpu_s()
        maintenance.store(url, entries, keep=False)
        yield Row(
            what=f"{what}: store",
            measured=1e6 * (time.perf_counter() - begin) / count,
            cpu=1e6 * (cpu_s() - cpu) / count,
            unit="us each",
        )
        with psycopg.connect(url) as connection:
            (size,) = connection.execute("SELECT pg_total_relation_size('pc2grid.array')").fetchone()
        yield Row(what=f"{what}: on disk", measured=size / count, unit="bytes each")
        for name, building in (("one building", "b0"), ("all of it", None)):
            reads: dict[str, Callable[[SubmapDatabase], object]] = {
                "open, and its sessions": lambda database: database.sessions(),
                "open, and its signatures": lambda database: database.signatures(),
            }
            for words, read in reads.items():
                times = []
                for _ in range(REPEATS):
                    begin, cpu = time.perf_counter(), cpu_s()
                    with open_database(url) as database:
                        if building is not None:
                            database.keep_only(building=building)
                        read(database)
                    times.append((time.perf_counter() - begin, cpu_s() - cpu))
                wall, cpu = (1e3 * float(np.median(values)) for values in zip(*times, strict=True))
                yield Row(what=f"{what}: {name}: {words}", measured=wall, cpu=cpu, unit="ms")


def sessions(signatures: SignatureTable) -> Iterator[Entry]:
    """A session for every thousand, in a building of its own."""
    grid = OccupancyGrid(cells=np.zeros((2, 2), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    still = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    config = Config()
    for number, begin in enumerate(range(0, len(signatures), IN_A_BUILDING)):
        rows = range(begin, min(begin + IN_A_BUILDING, len(signatures)))
        submaps = tuple(
            Submap(submap_id=row - begin, center_m=(0.0, 0.0), radius_m=config.partition.radius_m, grid=grid)
            for row in rows
        )
        made = SessionMap(session=f"s{number}", sensor="map", grid=grid, submaps=submaps, trajectory=still)
        origin = provenance("bench", "0" * 64, config, label=Label(building=f"b{number}"))
        yield made, [fixtures.signature_of(signatures, row) for row in rows], origin


@contextlib.contextmanager
def server() -> Iterator[Any]:
    """A PostgreSQL server with the shared memory that a database server usually has."""
    sys.path.append(str(ROOT))
    from tests.helpers.postgresql import Server

    made = Server(shared_buffers="4GB", maintenance_work_mem="4GB", max_wal_size="8GB")
    try:
        yield made
    finally:
        made.remove()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--submaps", type=int, default=COUNT)
    print(table(list(measured(parser.parse_args().submaps))))
    print("\n".join(f"{key}: {value}" for key, value in machine().items()))
