"""A database of a million submaps: opening it, and searching the nearest ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import Row, Time, median, run_python, timed
from signature.config import Config, SignatureConfig
from signature.describe import Signature
from signature.retrieval.signature_index import SignatureIndex
from signature.similarity import SignatureTable, distances

COUNT, QUICK = 1_000_000, 20_000
K = 20


def retrieve_time(folder: Path, quick: bool) -> Iterator[Row]:
    """The 20 nearest of a million by Eq. 6, compared with a scan of all rows and with faiss."""
    config = Config().signature
    table = fixtures.many_signatures(QUICK if quick else COUNT, Config())
    index, flat = SignatureIndex.of(table), _faiss(table, config)
    rng = np.random.default_rng(1)
    queries = [disturbed(table, int(r), rng) for r in rng.integers(0, len(table), 5 if quick else 11)]
    actions: dict[str, Callable[[Signature], NDArray[np.intp]]] = {
        "ours": lambda q: index.nearest(q, K, config).rows,
        "all rows": lambda q: np.argsort(distances(q, table, config), kind="stable")[:K],
        "faiss": lambda q: flat.search(_embedded(q.boundary[None], q.freespace[None], config), K)[1][0],
    }
    for action in actions.values():
        action(queries[0])  # compiles
    times: dict[str, list[Time]] = {name: [] for name in actions}
    hits = 0
    for query in queries:
        rows: dict[str, NDArray[np.intp]] = {}
        for name, action in actions.items():
            times[name].append(timed(lambda n=name, a=action, q=query, r=rows: r.update({n: a(q)})))
        hits += len(np.intersect1d(rows["ours"], rows["all rows"]))
    took = {name: median(values) for name, values in times.items()}
    what, (wall, cpu) = f"{K} nearest of {len(table)}", took["ours"].times(1e3)
    note = f"comparing all rows: {1e3 * took['all rows'].cpu:.0f} ms of cpu"
    yield Row(what=what, measured=wall, cpu=cpu, unit="ms", goal=20.0, note=note)
    share = hits / (K * len(queries))
    yield Row(what=f"{what}: recall against exact Eq. 6", measured=share, unit="", goal=0.999, at_least=True)
    yield Row(
        what=f"{what}: over faiss flat on the same vectors",
        measured=took["ours"].wall / took["faiss"].wall,
        cpu=took["ours"].cpu / took["faiss"].cpu,
        unit="x",
        goal=1.0,
        note=f"faiss: {1e3 * took['faiss'].cpu:.0f} ms of cpu",
    )


def disturbed(table: SignatureTable, row: int, rng: np.random.Generator) -> Signature:
    """A signature with the random differences that another visit of the same place has."""

    def vary(values: F32, spread: float) -> F32:
        return np.asarray(values * np.exp(spread * rng.standard_normal(len(values))), np.float32)

    boundary, freespace = vary(table.boundary[row], 0.1), vary(table.freespace[row], 0.1)
    return Signature(
        boundary=boundary / boundary.sum(),
        freespace=freespace / max(freespace.sum(), 1e-9),
        symmetry=vary(table.symmetry[row], 0.1),
    )


def _embedded(boundary: F32, freespace: F32, config: SignatureConfig) -> F32:
    """Vectors whose inner product is the weighted Bhattacharyya coefficient."""
    weight = config.weight_boundary
    return np.hstack((np.sqrt(weight * boundary), np.sqrt((1 - weight) * freespace))).astype(np.float32)


def _faiss(table: SignatureTable, config: SignatureConfig) -> Any:
    import faiss

    index = faiss.IndexFlatIP(table.boundary.shape[1] + table.freespace.shape[1])
    index.add(_embedded(table.boundary, table.freespace, config))
    return index


_OPEN = """
import sys, time
import numpy as np
from signature.config import Config
from signature.database import open_database
from signature.retrieval.signature_index import SignatureIndex
from signature.describe import Signature
wall, cpu = time.perf_counter(), time.process_time()
with open_database(sys.argv[1]) as database:
    table = database.signatures()
    print(time.perf_counter() - wall, time.process_time() - cpu)
    query = Signature(boundary=table.boundary[0], freespace=table.freespace[0], symmetry=table.symmetry[0])
    wall, cpu = time.perf_counter(), time.process_time()
    index = SignatureIndex.of(table)
    assert index.nearest(query, 20, Config().signature).rows[0] == 0
print(time.perf_counter() - wall, time.process_time() - cpu)
"""


def open_time(folder: Path, quick: bool) -> Iterator[Row]:
    """Open a database of a million submaps in a new process, and search it once."""
    path, count = folder / "bench.submaps", QUICK if quick else COUNT
    fixtures.large_database(path, fixtures.many_signatures(count, Config()), 100, Config())
    runs = [[float(f) for f in run_python(_OPEN, path).stdout.split()] for _ in range(3 if quick else 5)]
    opened, asked = (median(Time(*run[k : k + 2]) for run in runs) for k in (0, 2))
    what = f"open a database of {count}, {path.stat().st_size / 1e9:.2f} GB"
    yield Row(what=what, measured=opened.wall, cpu=opened.cpu, unit="s", goal=1.0)
    yield Row(
        what="then build the index and answer the first query", measured=asked.wall, cpu=asked.cpu, unit="s"
    )


_LOCATE = """
import resource, sys, time
from pc2grid.simulate import office_floorplan
from signature.database import open_database
from signature.localization.localizer import MapIndex, locate_map
part = office_floorplan(1).crop((12.0, 8.0), 6.0)
wall, cpu = time.perf_counter(), time.process_time()
with open_database(sys.argv[1]) as database:
    answer = locate_map(part, MapIndex.of(database, database.config()))
taken = time.perf_counter() - wall, time.process_time() - cpu
assert answer.session == "s1", answer.session
print(*taken, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
"""


def floors_time(folder: Path, quick: bool) -> Iterator[Row]:
    """Locate a part of one floor in a database of many floors, from opening it to the answer."""
    path, config = folder / "floors.submaps", Config()
    floors, area_m2 = fixtures.floors(path, 4 if quick else 24, 1 if quick else 9, config)
    runs = [[float(f) for f in run_python(_LOCATE, path).stdout.split()] for _ in range(2 if quick else 4)]
    took = median(Time(*run[:2]) for run in runs[1:])  # the first compiles
    yield Row(
        what=f"open {floors} floors of {area_m2:.0f} m2, and a first answer",
        measured=took.wall,
        cpu=took.cpu,
        unit="s",
        note=f"peak {runs[-1][2]:.0f} MB",
    )
