"""`pc2grid compare scale`: how recall falls with the number of places; not in the paper.

The queries of the experiment are compared with the place that they were drawn at, and with the places of
other buildings, or with the other places of their own. How many of those are at least as alike as the right
place is counted for each query. Of N - 1 that are drawn from them without replacement, the number that are is
then hypergeometric: the curve over N needs no drawing, and ends at what was counted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.stats import hypergeom

from pc2grid import libraries
from pc2grid.geometry import F64, I64
from pc2grid.io.maps import load_map
from pc2grid.model import OccupancyGrid, Submap
from pc2grid.settings import PartitionConfig
from pc2grid.simulate.plan import office_floorplan
from pc2grid.submaps.submaps import partition
from pc2grid_cli.console import Console, json_text
from pc2grid_cli.output import make_folder, show, table
from pc2grid_lab.commands import CompareScale
from pc2grid_lab.pages import picture
from pc2grid_lab.paper.experiment import NOISE_LEVELS, Experiment, draw_queries
from pc2grid_lab.paper.methods import BOUNDARY_PARTS, COLUMNS, Signatures, boundary_vector, metric
from pc2grid_lab.paper.tables import kept_in, known_maps, read_map, rescaled, within_others
from pc2grid_lab.runner import in_processes, once, write_text
from signature.config import SignatureConfig
from signature.paper import SignatureTable, score_matrix

LETTER = SignatureConfig.paper()
PLACES = PartitionConfig.paper().model_copy(update={"spacing_m": 1.0})
"""The junctions of the paper, and between them, as in the product, a place for each metre of the skeleton."""
FACTORS = (1.0, 0.8)
"""Sizes of the maps of other buildings. A mirrored map would be no other place: neither a histogram of
distances nor one of path lengths changes."""
FLOORS = 12
"""Simulated office floors beside them."""
PLACE_KINDS = ("real", "rescaled", "simulated", "own building")
"""Of places that are not the right one."""
APART_M = 3.0
"""A place of the own building is another one if it is so far from the query."""
LEVELS, RANKS, METHODS = (0, 2), (1, 20), ("proposed", "learned")
SHOWN = (100, 1000, 10_000)
"""Numbers of places of the printed table, which has the largest that was counted as well."""


@dataclass(frozen=True, slots=True)
class Described:
    """N submaps, described for Eq. 6 and for the learned metric: vectors (N, 218)."""

    signatures: SignatureTable
    vectors: F64

    @staticmethod
    def of(submaps: Iterable[Submap]) -> Described:
        """Describe submaps."""
        rows = [(Signatures().of(s, LETTER), boundary_vector(s), s.center_m) for s in submaps]
        signatures, vectors, centers_m = zip(*rows, strict=True)
        return Described(SignatureTable.of(signatures, centers_m), np.array(vectors))


@dataclass(frozen=True, slots=True)
class MapSource:
    """A map whose places are in the database: name and kind of the building, file of its places."""

    building: str
    kind: int
    file: str
    load: Callable[[], OccupancyGrid]

    def places(self, folder: Path) -> Described:
        """Return its places, kept in a folder."""
        return once(
            folder / f"places.{self.file}.pickle", lambda: Described.of(partition(self.load(), PLACES))
        )


def sources_of(maps: Path) -> list[MapSource]:
    """Return the maps beside each other in a folder, at all sizes, and the simulated floors."""
    found = [
        MapSource(path.stem, int(factor != 1.0), f"{path.stem}.x{factor:g}", partial(_sized, path, factor))
        for path in sorted(maps.glob("*.yaml"))
        for factor in FACTORS
    ]
    floors = (f"floor{seed}" for seed in range(FLOORS))
    return found + [MapSource(n, 2, n, partial(office_floorplan, seed)) for seed, n in enumerate(floors)]


def own_of(asked: Path) -> MapSource:
    """Return the map that is asked, in the size that the paper has it."""
    return MapSource(
        asked.stem, PLACE_KINDS.index("own building"), f"{asked.stem}.own", partial(read_map, asked)
    )


def _sized(path: Path, factor: float) -> OccupancyGrid:
    grid = load_map(path)
    return grid if factor == 1.0 else rescaled(grid, factor)


@dataclass(frozen=True, slots=True)
class Counted:
    """For Q queries of a map at a noise level, by kind (Q, PLACE_KINDS): how many places there are that are
    not the right one, and how many of them each method finds at least as alike."""

    map_name: str
    level: int
    places: I64
    before: Mapping[str, I64]

    def recall(self, method: str, kinds: Sequence[int], rank: int, number: int) -> F64:
        """Return the probability (Q,) that the right place is among the first `rank` of `number` places:
        itself, and others of these kinds that are drawn at random; all of them, if there are fewer."""
        pairs = np.stack([table[:, kinds].sum(axis=1) for table in (self.places, self.before[method])])
        (others, before), each = np.unique(pairs, axis=1, return_inverse=True)
        ahead = np.arange(rank)[:, None]
        drawn = np.minimum(number - 1, others)
        return np.asarray(hypergeom.pmf(ahead, others, before, drawn).sum(axis=0)[each.reshape(-1)])


def count(
    asked: Path, level: int, experiment: Experiment, sources: Sequence[MapSource], folder: Path
) -> Counted:
    """Ask the queries of a map."""
    file = f"counted.{asked.stem}.noise{level}.q{experiment.queries}.seed{experiment.seed}.pickle"
    return once(folder / file, lambda: _count(asked, level, experiment, sources, folder))


def _count(
    asked: Path, level: int, experiment: Experiment, sources: Sequence[MapSource], folder: Path
) -> Counted:
    grid = read_map(asked)
    centers_m = np.array([submap.center_m for submap in partition(grid, PartitionConfig.paper())])
    drawn = draw_queries(grid, centers_m, PLACES.radius_m, experiment, NOISE_LEVELS[level])
    queries = Described.of(drawn)
    at_m = queries.signatures.center_m
    columns = [column for part in BOUNDARY_PARTS for column in range(*COLUMNS[part].indices(1000))]
    learned = metric(within_others(asked, PLACES.radius_m, experiment.seed, folder)[:, columns])
    own = own_of(asked)
    here = own.places(folder)
    right = cKDTree(here.signatures.center_m).query(centers_m[cKDTree(centers_m).query(at_m)[1]])[1]
    is_other = cdist(at_m, here.signatures.center_m) > APART_M
    places = np.zeros((len(at_m), len(PLACE_KINDS)), np.int64)
    before = {method: places.copy() for method in METHODS}
    limits: dict[str, F64] = {}
    for source in (own, *(s for s in sources if s.building != asked.stem)):
        others = source.places(folder)
        counts = is_other if source is own else np.ones((1, len(others.vectors)), bool)
        places[:, source.kind] += counts.sum(axis=1)
        for method, away in _distances(queries, others, learned).items():
            if source is own:
                limits[method] = away[np.arange(len(right)), right, None]
            before[method][:, source.kind] += (counts & (away <= limits[method])).sum(axis=1)
    return Counted(asked.stem, level, places, before)


def _distances(queries: Described, others: Described, learned: F64) -> dict[str, F64]:
    q = queries.signatures
    return {
        "proposed": score_matrix(q.boundary, q.freespace, q.symmetry, others.signatures, LETTER),
        "learned": cdist(queries.vectors @ learned, others.vectors @ learned),
    }


def mean_recall(
    results: Sequence[Counted], method: str, kinds: Sequence[int], rank: int, number: int
) -> tuple[float, float]:
    """Return the mean over maps, and half of its interval from 5 to 95 %, by bootstrap over the queries."""
    rng = np.random.default_rng(0)
    recalls = [counted.recall(method, kinds, rank, number) for counted in results]
    drawn = [recall[rng.integers(len(recall), size=(300, len(recall)))].mean(axis=1) for recall in recalls]
    half_width = np.diff(np.quantile(np.mean(drawn, axis=0), (0.05, 0.95)))[0] / 2
    return float(np.mean([recall.mean() for recall in recalls])), float(half_width)


DATABASES: Mapping[str, Sequence[int]] = {"other buildings": (0, 1, 2), "own building": (3,)}


def curves(results: Sequence[Counted]) -> Iterator[dict[str, Any]]:
    """Yield every curve: noise level, database, method, rank; numbers of places, recall, half of its
    interval. The last point is of all places, the mean number of the maps."""
    for level in LEVELS:
        here = [counted for counted in results if counted.level == level]
        for database, kinds in DATABASES.items():
            there = [counted.places[:, kinds].sum(axis=1) for counted in here]
            least, most = (1 + int(bound) for bound in (min(map(np.min, there)), max(map(np.max, there))))
            mean = 1 + round(float(np.mean([counts.mean() for counts in there])))
            numbers = {*np.geomspace(2, least, 12).astype(int).tolist(), *(n for n in SHOWN if n < least)}
            at = {**{n: n for n in sorted(numbers) if n < mean}, mean: most}
            for method, rank in itertools.product(METHODS, RANKS):
                points = [mean_recall(here, method, kinds, rank, n) for n in at.values()]
                yield {
                    **{"level": level, "database": database, "method": method, "rank": rank},
                    **{"places": [*at], "recall": [recall for recall, _ in points]},
                    "half_width": [half for _, half in points],
                }


def print_curves(drawn: Sequence[Mapping[str, Any]], results: Sequence[Counted]) -> None:
    """Print the curves at some numbers of places, and each kind of places alone, on stdout."""
    columns = [f"{n:,}" for n in SHOWN]
    shown = table("Recall, in thousandths", ("noise", "database", "method", "rank"), (*columns, "all"))
    for curve in drawn:
        at = {n: i for i, n in enumerate(curve["places"])}
        cells = [_cell(curve["recall"][at[n]], curve["half_width"][at[n]]) if n in at else "" for n in SHOWN]
        last = f"{_cell(curve['recall'][-1], curve['half_width'][-1])} of {curve['places'][-1]:,}"
        shown.add_row(
            str(curve["level"]), curve["database"], curve["method"], f"R@{curve['rank']}", *cells, last
        )
    show(shown, "+-: half of the interval from 5 to 95 %, by bootstrap over the queries.")
    alone = table("R@1 by the kind of places, in thousandths", ("noise", "method", "places"), PLACE_KINDS)
    for level in LEVELS:
        here = [counted for counted in results if counted.level == level]
        number = int(min(counted.places.min() for counted in here)) + 1
        for method in METHODS:
            cells = [
                _cell(*mean_recall(here, method, (kind,), 1, number)) for kind in range(len(PLACE_KINDS))
            ]
            alone.add_row(str(level), method, str(number), *cells)
    show(alone, "As many places of each kind as the smallest building has.")


def _cell(recall: float, half_width: float) -> str:
    return f"{1000 * recall:.0f} +-{1000 * half_width:.0f}"


def draw_curves(drawn: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw recall over the number of places, a panel for each noise level."""
    colors = dict(zip(METHODS, ("tab:blue", "tab:red"), strict=True))
    with picture(path, 9.5, 4.0) as figure:
        for axis, level in zip(figure.subplots(1, len(LEVELS), sharey=True), LEVELS, strict=True):
            for curve in (c for c in drawn if c["level"] == level):
                n, recall, half = (np.array(curve[key]) for key in ("places", "recall", "half_width"))
                own = curve["database"] == "own building"
                name = f"{curve['method']}, R@{curve['rank']}" + (", own building" if own else "")
                style = {"color": colors[curve["method"]], "linestyle": "-" if curve["rank"] == 1 else "--"}
                axis.plot(
                    n, recall, label=name, linewidth=0.8 if own else 1.6, marker="." if own else "", **style
                )
                axis.fill_between(
                    n, recall - half, recall + half, color=style["color"], alpha=0.15, linewidth=0
                )
            axis.set(xscale="log", ylim=(0.6, 1.005), xlabel="places", ylabel="recall")
            axis.set_title(f"noise level {level}" if level else "without noise", fontsize=9)
            axis.label_outer()
            axis.grid(alpha=0.3)
        figure.axes[0].legend(fontsize=7, loc="lower left")


def compare_scale(given: CompareScale, terminal: Console) -> None:
    """Count what is not in the folder yet, and write and draw the curves."""
    libraries.require({"paper": "compare scale"})
    maps, out, queries, seed = given.maps, given.out, given.queries, given.seed
    asked, sources = known_maps(maps), sources_of(maps)
    make_folder(out)
    kept = kept_in(out, sorted(maps.glob("*.yaml")))
    experiment = Experiment(queries=queries, seed=seed)
    with terminal.progress(f"places of {len(sources)} maps") as advance:
        described = [(source, kept) for source in [*map(own_of, asked), *sources]]
        in_processes(MapSource.places, described, jobs=given.jobs, advance=advance)
    tasks = [(path, level, experiment, sources, kept) for level in LEVELS for path in asked]
    with terminal.progress(f"queries of {len(asked)} maps") as advance:
        results = in_processes(count, tasks, jobs=given.jobs, advance=advance)
    drawn = list(curves(results))
    write_text(out / "results.json", json_text({"queries": queries, "seed": seed, "curves": drawn}) + "\n")
    draw_curves(drawn, out / "scale.png")
    print_curves(drawn, results)
    print(f"written: {out / 'results.json'}, {out / 'scale.png'}")
