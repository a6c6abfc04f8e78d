"""`pc2grid compare paper`: the paper's Tables III and IV on the paper's maps, published beside measured.

The cells of the tables are tasks: each runs independently and keeps its results in a file. At the end stand
the numbers that the paper has printed: Tables I, III and IV.

`pc2grid compare scale`: how recall falls with the number of places. The queries are compared with the place
that they were drawn at, and with the places of other buildings, or with the other places of their own. How
many of those are at least as alike as the right place is counted for each query. Of N - 1 that are drawn from
them without replacement, the number that are is then hypergeometric: the curve over N needs no drawing, and
ends at what was counted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.stats import hypergeom

from pc2grid import libraries
from pc2grid.errors import ConfigError, MapFileError
from pc2grid.geometry import F64, I64
from pc2grid.io.maps import load_map
from pc2grid.model import UNKNOWN, OccupancyGrid, Submap
from pc2grid.settings import PartitionConfig
from pc2grid.simulate.plan import office_floorplan
from pc2grid.submaps.submaps import partition
from pc2grid_cli.console import Console, json_text
from pc2grid_cli.output import make_folder, show, table
from pc2grid_lab.commands import ComparePaper, CompareScale
from pc2grid_lab.pages import picture
from pc2grid_lab.paper.experiment import (
    NOISE_LEVELS,
    BestMatches,
    Experiment,
    MatchMeasures,
    best_matches,
    draw_queries,
)
from pc2grid_lab.paper.methods import (
    ABLATION,
    BOUNDARY_PARTS,
    COLUMNS,
    EXTRA_METHOD_NAMES,
    LEARNED,
    METHOD_NAMES,
    OURS,
    boundary_vector,
    differences,
    make_methods,
    metric,
)
from pc2grid_lab.runner import (
    BACK,
    FRONT,
    LABORATORY,
    digest_of_sources,
    grouped,
    in_processes,
    keep,
    kept,
    once,
    write_text,
)
from signature.config import SignatureConfig
from signature.paper import SignatureTable, describe as signature_of, score_matrix

RADII_M = (6.0, 8.0, 10.0)
"""Table IV."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperTask:
    """A method on one map at one noise level."""

    map_path: Path
    method: str
    level: int
    radius_m: float
    offset_m: float
    queries: int
    seed: int

    @property
    def map_name(self) -> str:
        """Name of the map, without suffix."""
        return self.map_path.stem

    def file(self, folder: Path) -> Path:
        """Return the file of the results."""
        return folder / (
            f"{self.map_name}.{self.method}.noise{self.level}.r{self.radius_m:g}.offset{self.offset_m:g}"
            f".q{self.queries}.seed{self.seed}.pickle"
        )


def paper_tasks(
    maps: Sequence[Path],
    *,
    methods: Sequence[str] = METHOD_NAMES,
    offsets_m: Sequence[float] = (1.0, 0.5),
    **setting: Any,
) -> Iterator[PaperTask]:
    """Yield every task of Tables III and IV. setting : of all tasks."""
    for offset_m, method, path in itertools.product(offsets_m, methods, maps):
        task = PaperTask(map_path=path, method=method, level=0, radius_m=8.0, offset_m=offset_m, **setting)
        yield from (replace(task, level=level) for level in range(len(NOISE_LEVELS)))
        if method in OURS:
            yield from (replace(task, level=1, radius_m=r) for r in RADII_M if r != task.radius_m)


def that_share_submaps(tasks: Iterable[PaperTask]) -> list[list[PaperTask]]:
    """Return the tasks of each map and radius, for `computed_cells`: by the queries that they share; the most
    first."""
    by_queries = sorted(tasks, key=lambda task: (task.offset_m, task.level))
    groups = grouped(((task.map_path, task.radius_m), task) for task in by_queries)
    return sorted(groups.values(), key=len, reverse=True)


def read_map(path: Path) -> OccupancyGrid:
    """Read a map in the size that the paper has it. Raises MapFileError.

    The image of killian has 0.10 m a pixel, while the paper says 0.05: it is read half as large.
    """
    grid, published = load_map(path), SIZE_PX.get(path.stem)
    return rescaled(grid, 0.5) if published and grid.cells.shape[1] > 1.5 * published[0] else grid


def rescaled(grid: OccupancyGrid, factor: float) -> OccupancyGrid:
    """Return the grid with the same resolution, but `factor` times as large in metres.

    A cell is occupied if any of the cells that it replaces is; else free if any is; else unknown.
    """
    height, width = grid.cells.shape
    size = (int(width * factor), int(height * factor))
    how = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_NEAREST
    occupied, free = (
        cv2.resize(mask.astype(np.float32), size, interpolation=how) > 0.0
        for mask in (grid.occupied, grid.free)
    )
    cells = np.where(occupied, 100, np.where(free, 0, UNKNOWN)).astype(np.int8)
    return OccupancyGrid(cells=cells, resolution_m=grid.resolution_m, origin_m=grid.origin_m)


@dataclass(frozen=True, slots=True)
class PaperCell:
    """One cell of a table: its task, the best match of every query, and the measures of these.

    half_widths : half of the interval from 5 to 95 % of each measure, by bootstrap over the queries.
    """

    task: PaperTask
    submaps: int
    matches: BestMatches
    measures: MatchMeasures
    half_widths: MatchMeasures

    @property
    def published(self) -> Measures | None:
        """Return what the paper has printed for it, or for its own method if it does not have this one; None
        of maps and settings that it does not have."""
        task = self.task
        if task.map_name not in MAPS:
            return None
        if task.radius_m == 8.0:
            rows = TABLE_3[task.level]
            return rows.get(task.method, rows["proposed"])[task.map_name]
        return TABLE_4[int(task.radius_m)].get(task.map_name)

    def summary(self) -> dict[str, Any]:
        """Return everything except the single queries, for JSON."""
        task = {**asdict(self.task), "map_path": self.task.map_name}
        half = {f"{name}_half_width": value for name, value in self.half_widths._asdict().items()}
        published = None if self.published is None else self.published._asdict()
        measures = {**self.measures._asdict(), **half, "published": published}
        return {**task, "submaps": self.submaps, **measures}


def computed_cells(tasks: Sequence[PaperTask], folder: Path) -> list[PaperCell]:
    """Return the results of tasks of one map and radius, kept in a folder. Raises MapFileError, OutputError.

    Methods are fitted once for all levels, and queries drawn once for all methods of a level: tasks that
    share queries stand together.
    """
    for cell in _run([task for task in tasks if not task.file(folder).exists()], folder):
        keep(cell.task.file(folder), cell)
    return [kept(task.file(folder)) for task in tasks]


def _run(tasks: Sequence[PaperTask], folder: Path) -> Iterator[PaperCell]:
    if not tasks:
        return
    grid = read_map(tasks[0].map_path)
    submaps = partition(grid, PartitionConfig.paper(tasks[0].radius_m))
    names = dict.fromkeys(task.method for task in tasks)
    learns = not LEARNED.keys().isdisjoint(names)
    within = within_others(tasks[0].map_path, tasks[0].radius_m, tasks[0].seed, folder) if learns else None
    matchers = {name: method(submaps) for name, method in make_methods(names, within).items()}
    for shared, some in itertools.groupby(tasks, lambda task: replace(task, method="")):
        by_method = {task.method: task for task in some}
        experiment = Experiment(queries=shared.queries, offset_m=shared.offset_m, seed=shared.seed)
        asked = {name: matchers[name] for name in by_method}
        found = best_matches(asked, grid, submaps, experiment, NOISE_LEVELS[shared.level])
        for name, matches in found.items():
            yield PaperCell(by_method[name], len(submaps), matches, matches.measures(), matches.half_widths())


def within_others(asked: Path, radius_m: float, seed: int, folder: Path) -> F64:
    """Return the `differences` of the maps beside one, each kept in a file of a folder. Raises
    MapFileError."""
    others = [path for path in known_maps(asked.parent) if path.stem != asked.stem]
    if not others:
        raise MapFileError(
            f"{asked.parent}: no other map to learn from",
            hint="put other maps beside it, or leave out the methods that learn",
        )

    def made(path: Path) -> F64:
        grid = read_map(path)
        return differences(grid, partition(grid, PartitionConfig.paper(radius_m)), seed)

    ending = f"r{radius_m:g}.seed{seed}.pickle"
    found = [once(folder / f"differences.{path.stem}.{ending}", partial(made, path)) for path in others]
    return np.concatenate(found)


def known_maps(path: Path) -> list[Path]:
    """Return the maps that a path names: itself, if it is a file; else those of the paper in the folder, in
    the paper's order; else every `*.yaml` in it, by name. Raises MapFileError if there is none."""
    if path.is_file():
        return [path]
    published = [path / f"{name}.yaml" for name in MAPS if (path / f"{name}.yaml").is_file()]
    found = published or sorted(path.glob("*.yaml"))
    if not found:
        raise MapFileError(
            f"{path}: no map is here", hint="a map.yaml, or a folder with intel.yaml, fr079.yaml, ..."
        )
    return found


_LEVELS = ("without noise", "noise level 1", "noise level 2")
_MEASURES = ("auc", "rp9", "f1", "r_at_1")
"""Those that the paper has come first."""


def print_tables(results: Sequence[PaperCell], methods: Sequence[str]) -> None:
    """Print Tables I, III and IV on stdout, in the order of a reader's questions: does the method hold, how
    do its rivals do, what beats it, and what does each of its parts add."""
    maps = list(dict.fromkeys(r.task.map_name for r in results))
    counts = {r.task.map_name: r.submaps for r in results if r.task.radius_m == 8.0}
    first = table("Table I, number of submaps", ["map"], ["paper", "ours"])
    for name in maps:
        first.add_row(name, str(SUBMAPS.get(name, "")), str(counts[name]))
    show(
        first,
        "Of three numbers: paper, ours, difference, in thousandths; +-: half of the interval from 5 to 95 %,"
        " by bootstrap over the queries. Methods that the paper does not have stand beside its own.",
    )
    ours, rivals, beyond, parts = (
        [name for name in methods if name in group]
        for group in (OURS, METHOD_NAMES, EXTRA_METHOD_NAMES, ("proposed", *ABLATION))
    )
    rivals, beyond = ([name for name in group if name not in OURS] for group in (rivals, beyond))
    at_8_m = [(str(level), level, 8.0) for level in range(len(_LEVELS))]
    by_radius = [(f"{radius_m:g} m", 1, radius_m) for radius_m in RADII_M]
    for offset_m in dict.fromkeys(r.task.offset_m for r in results):
        plain = [r for r in results if r.task.offset_m == offset_m]
        for title, heading, settings, group in (
            ("Table III, does it hold", "noise", at_8_m, ours),
            ("Table IV, noise level 1", "radius", by_radius, ours),
            ("Table III, its rivals", "noise", at_8_m, rivals),
            ("What beats it", "noise", at_8_m, beyond),
            ("What each signature adds", "noise", at_8_m, parts if len(parts) > 1 else []),
        ):
            where = f"{title}: queries within {offset_m:g} m of a submap centre"
            _print_measures(where, heading, settings, plain, maps, group)


def _print_measures(
    title: str,
    heading: str,
    settings: Sequence[tuple[str, int, float]],
    plain: Sequence[PaperCell],
    maps: Sequence[str],
    methods: Sequence[str],
) -> None:
    """Print a table of some methods: a row for each measure and setting (its name, noise level and radius), a
    column for each map and one for their mean."""
    shown = table(title, (heading, "measure", "method"), (*maps, "mean"))
    for (name, level, radius_m), measure, method in itertools.product(settings, _MEASURES, methods):
        wanted = (method, level, radius_m)
        row = {r.task.map_name: r for r in plain if (r.task.method, r.task.level, r.task.radius_m) == wanted}
        if row:
            title_of = "R@1" if measure == "r_at_1" else measure.upper()
            cells = [_cell([row[m]], measure) if m in row else "" for m in maps]
            shown.add_row(name, title_of, method, *cells, _cell(list(row.values()), measure))
    if shown.row_count:
        show(shown)


def _cell(cells: Sequence[PaperCell], measure: str) -> str:
    """Return the mean over maps: paper, ours, difference and interval; only ours if the paper lacks one of
    them."""
    ours = 1000 * float(np.mean([getattr(cell.measures, measure) for cell in cells]))
    halves = [getattr(cell.half_widths, measure) for cell in cells]
    # The queries of the maps are independent of each other.
    spread = f"+-{1000 * float(np.linalg.norm(halves)) / len(cells):<2.0f}"
    published = [p for cell in cells if (p := getattr(cell.published, measure, None)) is not None]
    if len(published) < len(cells):
        return f"{ours:.0f} {spread}"
    there = 1000 * float(np.mean(published))
    return f"{there:3.0f} {ours:4.0f} {ours - there:+4.0f} {spread}"


def draw_figure(results: Sequence[PaperCell], offset_m: float, out: Path) -> Path:
    """Draw figure-9-offset-OFFSET.png, precision over recall by map and noise level; returns its path."""
    from matplotlib import colormaps

    plain = [r for r in results if (r.task.offset_m, r.task.radius_m) == (offset_m, 8.0)]
    maps = list(dict.fromkeys(r.task.map_name for r in plain))
    path = out / f"figure-9-offset-{offset_m:g}.png"
    with picture(path, 3.2 * len(maps), 9.0) as figure:
        axes = figure.subplots(len(_LEVELS), len(maps), squeeze=False, sharex=True, sharey=True)
        colours = colormaps["tab20"]
        number = {name: k for k, name in enumerate(dict.fromkeys(r.task.method for r in plain))}
        for (level, title), (k, name) in itertools.product(enumerate(_LEVELS), enumerate(maps)):
            axis = axes[level, k]
            for cell in (r for r in plain if (r.task.level, r.task.map_name) == (level, name)):
                curve = cell.matches.curve()
                if len(curve.recall):
                    # Like the area under the curve: from recall 0 at the precision of the first point.
                    recall, precision = [0.0, *curve.recall], [curve.precision[0], *curve.precision]
                    colour = colours(number[cell.task.method] % colours.N)
                    axis.plot(recall, precision, label=cell.task.method, linewidth=1.2, color=colour)
            axis.set_title(f"{name}, {title}", fontsize=9)
            axis.set(xlim=(0, 1.01), ylim=(0, 1.01), xlabel="recall", ylabel="precision")
            axis.label_outer()
            axis.grid(alpha=0.3)
        if axes[0, 0].lines:
            figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return path


def compare_paper(given: ComparePaper, terminal: Console) -> None:
    """Compute the cells that are not in the folder yet, and write the tables and figures."""
    libraries.require({"paper": "compare paper"})
    out = given.out
    chosen = (*_chosen(given.methods), *(ABLATION if given.ablation else ()))
    offsets_m = tuple(given.offset or (1.0, 0.5))
    if min(offsets_m) <= 0:
        raise ConfigError("--offset: expected a distance above 0 m")
    found = known_maps(given.maps)
    make_folder(out)
    tasks = list(
        paper_tasks(found, methods=chosen, offsets_m=offsets_m, queries=given.queries, seed=given.seed)
    )
    folder, progress = kept_in(out, found), terminal.progress(f"{len(tasks)} cells of the tables")
    groups = [(group, folder) for group in that_share_submaps(tasks)]
    cells = in_processes(computed_cells, groups, jobs=given.jobs, progress=progress)
    by_task = {cell.task: cell for group in cells for cell in group}
    results = [by_task[task] for task in tasks]
    document = {"queries": given.queries, "seed": given.seed, "cells": [cell.summary() for cell in results]}
    write_text(out / "results.json", json_text(document) + "\n")
    pictures = [draw_figure(results, offset_m, out) for offset_m in offsets_m]
    print_tables(results, chosen)
    print(f"written: {out / 'results.json'}, {', '.join(map(str, pictures))}")


def kept_in(out: Path, maps: Sequence[Path]) -> Path:
    """Return the folder of the results of these sources, these maps, and those beside them to learn from."""
    beside = {path for folder in {path.parent for path in maps} for path in known_maps(folder)}
    images = {file for path in {*maps, *beside} for file in path.parent.glob(f"{path.stem}.*")}
    return out / "cells" / digest_of_sources((FRONT, BACK, LABORATORY, *sorted(images)))


def _chosen(methods: Sequence[str] | None) -> tuple[str, ...]:
    """Return the methods that are compared. Raises ConfigError if one is not known."""
    known = METHOD_NAMES + EXTRA_METHOD_NAMES
    for name in methods or ():
        if name not in known:
            raise ConfigError(f"--methods: no method {name!r}", hint=f"one of {', '.join(known)}")
    return tuple(methods or METHOD_NAMES)


# --- how recall falls with the number of places; not in the paper -------------------------------------

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
        rows = [(signature_of(s, LETTER), boundary_vector(s), s.center_m) for s in submaps]
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
    q, at_m = queries.signatures, queries.signatures.center_m
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
        distances = {
            "proposed": score_matrix(q.boundary, q.freespace, q.symmetry, others.signatures, LETTER),
            "learned": cdist(queries.vectors @ learned, others.vectors @ learned),
        }
        for method, away in distances.items():
            if source is own:
                limits[method] = away[np.arange(len(right)), right, None]
            before[method][:, source.kind] += (counts & (away <= limits[method])).sum(axis=1)
    return Counted(asked.stem, level, places, before)


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
        cells = [
            _recall(curve["recall"][at[n]], curve["half_width"][at[n]]) if n in at else "" for n in SHOWN
        ]
        last = f"{_recall(curve['recall'][-1], curve['half_width'][-1])} of {curve['places'][-1]:,}"
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
                _recall(*mean_recall(here, method, (kind,), 1, number)) for kind in range(len(PLACE_KINDS))
            ]
            alone.add_row(str(level), method, str(number), *cells)
    show(alone, "As many places of each kind as the smallest building has.")


def _recall(recall: float, half_width: float) -> str:
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
    folder = kept_in(out, sorted(maps.glob("*.yaml")))
    experiment = Experiment(queries=queries, seed=seed)
    described = [(source, folder) for source in [*map(own_of, asked), *sources]]
    progress = terminal.progress(f"places of {len(sources)} maps")
    in_processes(MapSource.places, described, jobs=given.jobs, progress=progress)
    tasks = [(path, level, experiment, sources, folder) for level in LEVELS for path in asked]
    progress = terminal.progress(f"queries of {len(asked)} maps")
    results = in_processes(count, tasks, jobs=given.jobs, progress=progress)
    drawn = list(curves(results))
    write_text(out / "results.json", json_text({"queries": queries, "seed": seed, "curves": drawn}) + "\n")
    draw_curves(drawn, out / "scale.png")
    print_curves(drawn, results)
    print(f"written: {out / 'results.json'}, {out / 'scale.png'}")


# --- the numbers of the paper -------------------------------------------------------------------------

MAPS = ("fr079", "intel", "csail", "aces", "killian")

SUBMAPS = dict(zip(MAPS, (67, 68, 102, 98, 91), strict=True))
"""Table I: number of submaps."""

SIZE_PX = dict(zip(MAPS, ((909, 322), (579, 581), (969, 1341), (1172, 1113), (2491, 1990)), strict=True))
"""Table I: width and height of the image. The paper says 0.05 m a pixel for all; killian's image has 0.10."""


class Measures(NamedTuple):
    """Area under the precision-recall curve, recall at a precision of 0.9, F1; each 0 .. 1."""

    auc: float
    rp9: float
    f1: float


def _rows(text: str) -> dict[str, dict[str, Measures]]:
    """Parse a table: each line has a name and, for each map, AUC, RP9 and F1 in thousandths."""
    rows = (line.split() for line in text.strip().splitlines())
    return {
        name: {m: Measures(*(int(n) / 1000 for n in numbers[3 * i : 3 * i + 3])) for i, m in enumerate(MAPS)}
        for name, *numbers in rows
    }


TABLE_3 = (
    _rows("""
shape_context 818 293 775 881 601 817 836 446 771 894 731 835 838 561 775
sift_bow      962 984 939 935 768 893 916 749 884 906 638 886 909 714 909
surf_bow      798 149 801 810 136 798 870 459 819 814 147 793 854 271 852
sift_tfidf    975 986 945 948 909 891 920 767 889 952 941 932 943 900 934
surf_tfidf    838 179 830 836 189 830 840 561 804 836 372 803 815 212 818
sdf           999 997 995 998 998 984 979 969 959 980 973 946 989 988 969
proposed      984 966 943 965 946 931 921 796 848 949 940 928 949 924 916
"""),
    _rows("""
shape_context 800 338 743 811 387 757 800 335 727 859 575 773 770 429 696
sift_bow      939 785 892 856 426 808 850 440 807 854 487 805 841 353 807
surf_bow      796 221 758 774 192 738 732 148 718 732 138 724 656 196 638
sift_tfidf    942 871 898 876 570 845 862 290 861 853 276 855 859 551 854
surf_tfidf    805 139 778 815 340 773 762 146 746 696  22 708 694  69 698
sdf           988 980 969 949 912 926 872 787 842 702 543 679 739 582 709
proposed      972 926 916 965 921 923 896 742 819 912 852 879 883 699 816
"""),
    _rows("""
shape_context 697 175 652 763 424 690 749 290 691 814 477 728 736 331 681
sift_bow      897 643 833 822 383 760 793 373 753 721  58 711 662 187 632
surf_bow      717 141 692 741 210 723 630  68 635 618  52 610 567  99 562
sift_tfidf    908 723 861 830 376 783 750 190 745 805 278 778 723 122 702
surf_tfidf    806 420 745 781 284 733 676 122 668 630 219 614 560 213 535
sdf           939 891 907 762 591 712 683 486 632 565 335 494 531 218 456
proposed      967 908 910 955 893 901 838 624 764 855 564 809 818 468 731
"""),
)
"""Table III by noise level, method and map."""

TABLE_4 = {
    int(radius): row
    for radius, row in _rows("""
6  951 831 876 935 850 876 880 751 822 889 733 836 816 476 729
8  972 926 916 965 921 923 896 742 819 912 852 879 883 699 816
10 986 960 945 985 976 951 918 762 843 957 964 934 931 825 863
""").items()
}
"""Table IV by submap radius in metres and map; its row for 8 m is noise level 1 of Table III."""
