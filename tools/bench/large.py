"""A million submaps: opening them, and finding the nearest."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import material
import numpy as np
from measure import Row, Time, median, run_python, timed

from pc2grid.model import F32
from signature.config import Config, SignatureConfig
from signature.similarity import SignatureTable, distances

COUNT, QUICK = 1_000_000, 20_000
K = 20


def retrieve_time(folder: Path, quick: bool) -> Iterator[Row]:
    """The 20 nearest of a million by Eq. 6, beside faiss's exact search on the same vectors."""
    config = Config().signature
    table = material.many_signatures(QUICK if quick else COUNT, Config())
    rng = np.random.default_rng(1)
    rows = rng.integers(0, len(table), 20 if quick else 50)
    queries = [_disturbed(table, int(row), rng) for row in rows]
    actions = {"exact": lambda q: np.argpartition(distances(q, table, config), K)[:K]}
    index = _faiss(table, config)
    if index is not None:
        actions["faiss"] = lambda q: index.search(_embedded(q.boundary[None], q.freespace[None], config), K)
    times: dict[str, list[Time]] = {name: [] for name in actions}
    for query in queries[: 5 if quick else 15]:
        for name, action in actions.items():
            times[name].append(timed(lambda action=action, query=query: action(query)))
    took = {name: median(values) for name, values in times.items()}
    wall, cpu = took["exact"].times(1e3)
    what = f"{K} nearest of {len(table)}"
    yield Row(what=f"{what}, exact path", measured=wall, cpu=cpu, unit="ms", goal=20.0)
    if index is not None:
        ratio = took["exact"].cpu / took["faiss"].cpu
        yield Row(what=f"{what}, exact path over faiss flat", measured=ratio, unit="x", goal=1.0)


def _disturbed(table: SignatureTable, row: int, rng: np.random.Generator) -> material.Signature:
    """A signature as another visit of the same place would give it."""

    def again(values: F32, spread: float) -> F32:
        return np.asarray(values * np.exp(spread * rng.standard_normal(len(values))), np.float32)

    boundary, freespace = again(table.boundary[row], 0.1), again(table.freespace[row], 0.1)
    return material.Signature(
        boundary=boundary / boundary.sum(),
        freespace=freespace / max(freespace.sum(), 1e-9),
        symmetry=again(table.symmetry[row], 0.1),
    )


def _embedded(boundary: F32, freespace: F32, config: SignatureConfig) -> F32:
    """Vectors whose inner product is the weighted Bhattacharyya coefficient."""
    weight = config.weight_boundary
    return np.hstack((np.sqrt(weight * boundary), np.sqrt((1 - weight) * freespace))).astype(np.float32)


def _faiss(table: SignatureTable, config: SignatureConfig) -> material.Any:
    try:
        import faiss
    except ImportError:
        return None
    index = faiss.IndexFlatIP(table.boundary.shape[1] + table.freespace.shape[1])
    index.add(_embedded(table.boundary, table.freespace, config))
    return index


_OPEN = """
import sys, time
import numpy as np
from signature.config import Config
from signature.database import open_database
from signature.similarity import SignatureTable, distances
from signature.describe import Signature
wall, cpu = time.perf_counter(), time.process_time()
with open_database(sys.argv[1]) as database:
    table = database.signatures()
    print(time.perf_counter() - wall, time.process_time() - cpu)
    query = Signature(boundary=table.boundary[0], freespace=table.freespace[0], symmetry=table.symmetry[0])
    wall, cpu = time.perf_counter(), time.process_time()
    assert np.argmin(distances(query, table, Config().signature)) == 0
print(time.perf_counter() - wall, time.process_time() - cpu)
"""


def open_time(folder: Path, quick: bool) -> Iterator[Row]:
    """Open a database of a million submaps in a new process, and ask it once."""
    path, count = folder / "bench.submaps", QUICK if quick else COUNT
    material.large_database(path, material.many_signatures(count, Config()), 100, Config())
    runs = [[float(f) for f in run_python(_OPEN, path).stdout.split()] for _ in range(3 if quick else 5)]
    opened, asked = (median(Time(*run[k : k + 2]) for run in runs) for k in (0, 2))
    what = f"open a database of {count}, {path.stat().st_size / 1e9:.2f} GB"
    yield Row(what=what, measured=opened.wall, cpu=opened.cpu, unit="s", goal=1.0)
    yield Row(what="its first query", measured=asked.wall, cpu=asked.cpu, unit="s")
