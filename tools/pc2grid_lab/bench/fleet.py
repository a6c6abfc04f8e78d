"""A fleet's database on a real PostgreSQL: recall of the index, latency, and queries per second.

python -m pc2grid_lab.bench.fleet [--submaps N]     also a measure of run.py
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.model import OccupancyGrid, SessionMap, Trajectory
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.large_database import disturbed
from pc2grid_lab.bench.measure import ROOT, Row, machine, table
from signature.config import Config
from signature.database import Label, open_database
from signature.database.postgres import database, schema
from signature.describe import Signature
from signature.sessions import provenance
from signature.similarity import SignatureTable, distances

COUNT, QUICK = 100_000, 5_000
K = 20
CLIENTS = 16
IN_A_BUILDING = 1_000


def fleet_search(folder: Path, quick: bool) -> Iterator[Row]:
    """Recall and latency of the 20 nearest, and queries per second with 16 clients."""
    yield from measured(QUICK if quick else COUNT, seconds=2.0 if quick else 10.0)


def measured(count: int, seconds: float) -> Iterator[Row]:
    """The rows of the table for a database of `count` submaps."""
    signatures = fixtures.many_signatures(count, Config())
    rng = np.random.default_rng(2)
    chosen = rng.integers(0, count, 100)
    queries = [disturbed(signatures, int(row), rng) for row in chosen]
    with server() as made:
        url = made.url()
        begin, cpu = time.perf_counter(), made.cpu_s() + time.process_time()
        fill(url, signatures)
        loaded, fill_s = time.perf_counter(), made.cpu_s() + time.process_time() - cpu
        with schema.connect(url, url) as connection:
            schema.inspect(connection, url)
            cpu = made.cpu_s()
            index(connection, signatures)
            built, index_s = time.perf_counter(), made.cpu_s() - cpu
            sizes = connection.execute(
                "SELECT pg_total_relation_size('pc2grid.signature') - pg_relation_size(o),"
                " pg_relation_size(o) FROM (SELECT 'pc2grid.signature_embedding'::regclass AS o)"
            ).fetchone()
        what = f"{count} submaps in PostgreSQL"
        yield Row(
            what=f"{what}: load",
            measured=1e6 * (loaded - begin) / count,
            cpu=1e6 * fill_s / count,
            unit="us each",
        )
        yield Row(
            what=f"{what}: build the index",
            measured=1e6 * (built - loaded) / count,
            cpu=1e6 * index_s / count,
            unit="us each",
        )
        yield Row(what=f"{what}: signatures on disk", measured=sizes[0] / count, unit="bytes each")
        yield Row(what=f"{what}: index", measured=sizes[1] / count, unit="bytes each")
        yield from searched(what, made, signatures, queries, chosen)
        yield from at_once(what, made, queries, seconds)


def searched(
    what: str, made: Any, signatures: SignatureTable, queries: Sequence[Signature], chosen: Any
) -> Iterator[Row]:
    """One client: recall against Eq. 6 on all submaps, and the time of a query."""
    config = Config().signature
    found, first = 0, 0
    filters: dict[str, list[dict[str, str]]] = {
        "anywhere": [{} for _ in queries],
        "in one building": [{"building": f"b{int(row) // IN_A_BUILDING}"} for row in chosen],
    }
    with open_database(made.url()) as database:
        for name, wanted in filters.items():
            database.nearest(queries[0], K)  # the first query loads the index
            answers, times = [], []
            cpu = made.cpu_s() + time.process_time()
            for query, more in zip(queries, wanted, strict=True):
                begin = time.perf_counter()
                answers.append(database.nearest(query, K, **more))
                times.append(time.perf_counter() - begin)
            cpu = made.cpu_s() + time.process_time() - cpu
            p95 = 1e3 * float(np.percentile(times, 95))
            yield Row(
                what=f"{what}: one query, {name}",
                measured=1e3 * statistics.median(times),
                cpu=1e3 * cpu / len(queries),
                unit="ms",
                note=f"95 %: {p95:.3g} ms",
            )
            if name != "anywhere":
                continue
            for query, answer in zip(queries, answers, strict=True):
                scores = distances(query, signatures, config)
                numbers = [number_of(n.session, n.submap_id) for n in answer]
                found += len(set(np.argpartition(scores, K)[:K].tolist()) & set(numbers))
                first += numbers[0] == int(scores.argmin())
    yield Row(
        what=f"{what}: recall of the {K} nearest against exact Eq. 6",
        measured=found / (K * len(queries)),
        unit="",
        goal=0.99,
        at_least=True,
    )
    yield Row(
        what=f"{what}: the first result is the nearest by Eq. 6", measured=first / len(queries), unit=""
    )


def at_once(what: str, made: Any, queries: Sequence[Signature], seconds: float) -> Iterator[Row]:
    """Queries per second of many clients, each a process with a connection of its own."""
    context = multiprocessing.get_context("fork")
    ready, go = context.Barrier(CLIENTS + 1), context.Event()
    answers = context.Queue()
    clients = [
        context.Process(target=_client, args=(made.url(), queries[k::CLIENTS], seconds, ready, go, answers))
        for k in range(CLIENTS)
    ]
    for client in clients:
        client.start()
    ready.wait()
    server_s = made.cpu_s()
    go.set()
    counts, cpu_s, latencies = zip(*(answers.get() for _ in clients), strict=True)
    for client in clients:
        client.join()
    server_s = made.cpu_s() - server_s
    total = sum(counts)
    p95 = 1e3 * float(np.percentile(np.concatenate(latencies), 95))
    yield Row(
        what=f"{what}: queries per second, {CLIENTS} clients and the server on {os.cpu_count()} cores",
        measured=total / seconds,
        unit="/s",
        note=f"95 %: {p95:.3g} ms; CPU a query: {1e3 * server_s / total:.3g} ms on the server,"
        f" {1e3 * sum(cpu_s) / total:.3g} ms in the client",
    )


def _client(
    url: str, queries: Sequence[Signature], seconds: float, ready: Any, go: Any, answers: Any
) -> None:
    with open_database(url) as database:
        database.nearest(queries[0], K)
        ready.wait()
        go.wait()
        begin, cpu, times = time.perf_counter(), time.process_time(), []
        while (now := time.perf_counter()) - begin < seconds:
            database.nearest(queries[len(times) % len(queries)], K)
            times.append(time.perf_counter() - now)
        answers.put((len(times), time.process_time() - cpu, np.array(times)))


def number_of(session: str, submap_id: int) -> int:
    """Row of the table that a submap was made from."""
    return int(session[1:]) * IN_A_BUILDING + submap_id


def fill(url: str, signatures: SignatureTable) -> None:
    """Store the signatures: a session for every thousand, in a building of its own.

    The index is made afterwards, because adding rows to an existing one takes several times as long.
    """
    grid = OccupancyGrid(cells=np.zeros((2, 2), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    still = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    config, entries = Config(), []
    for s in range(-(-len(signatures) // IN_A_BUILDING)):
        session = SessionMap(session=f"s{s}", sensor="map", grid=grid, submaps=(), trajectory=still)
        origin = provenance("bench", "0" * 64, config, label=Label(building=f"b{s}"))
        entries.append((session, [], origin))
    database.store(url, entries, keep=False)
    with schema.connect(url, url) as connection:
        schema.inspect(connection, url)
        keys = dict(connection.execute("SELECT name, id FROM pc2grid.session").fetchall())
        for s in range(len(entries)):
            first = s * IN_A_BUILDING
            described = [
                {
                    "building": f"b{s}",
                    "session_id": keys[f"s{s}"],
                    "submap_id": row - first,
                    "floor": "",
                    "center_x_m": 0.0,
                    "center_y_m": 0.0,
                    "boundary": signatures.boundary[row].tobytes(),
                    "freespace": signatures.freespace[row].tobytes(),
                    "symmetry": signatures.symmetry[row].tobytes(),
                }
                for row in range(first, min(first + IN_A_BUILDING, len(signatures)))
            ]
            database.copy_signatures(connection, described, config)


def index(connection: Any, signatures: SignatureTable) -> None:
    """Build the index that `convert` builds in an empty database."""
    connection.execute("SET max_parallel_maintenance_workers = 1")
    bins = signatures.boundary.shape[1] + signatures.freespace.shape[1]
    schema.index_embeddings(connection, bins)
    connection.execute("ANALYZE pc2grid.signature")


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
    parser.add_argument("--seconds", type=float, default=20.0, help="of asking with all clients")
    arguments = parser.parse_args()
    print(table(list(measured(arguments.submaps, arguments.seconds))))
    print("\n".join(f"{key}: {value}" for key, value in machine().items()))
