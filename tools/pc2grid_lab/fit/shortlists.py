"""What the signatures decide: real windows, located in their order, in that of some of them, and in any.

    python -m pc2grid_lab.fit.shortlists DATA WORK [--only PATTERN] [--places 13000,100000]

DATA is the folder of recordings, WORK the one in which `compare recordings` has kept its maps and answers.
Each window whose place is known is asked in its map, in one map of each building as one database, and in that
together with so many office floors that it has 13,000 and 100,000 places. A row for each database and each
`signature.config.ShortlistBy`: how many windows there are, how many are located rightly and wrongly, and the
processor time of a look-up with its decision (median, s).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import get_args

import numpy as np
import typer

from pc2grid.geometry import SE2
from pc2grid_lab.experiments.answers import index_of as index_of_grid
from pc2grid_lab.experiments.recordings.catalogue import Catalogue
from pc2grid_lab.experiments.recordings.run import Folder
from pc2grid_lab.fit.posterior import RIGHT_M, RIGHT_RAD
from pc2grid_lab.fit.queries import Only, Window, error_of, index_of, office_floor, windows
from signature.config import Config, ShortlistBy
from signature.localization.decision import decide
from signature.localization.map_index import MapIndex
from signature.localization.query import QueryMap
from signature.paper import SignatureTable

_FEW = 200
"""Of fewer places, half or more are searched at once."""
_FIRST_FLOOR = 40_000
"""Seed of the first office floor: others than those that the weights were learned from."""


@dataclass(frozen=True, slots=True)
class Asked:
    """An answer: whether located, whether right, and its processor time."""

    located: bool
    right: bool
    cpu_s: float


@dataclass(frozen=True, slots=True)
class Database:
    """A database that windows are asked in.

    index : the one for a window; None if it is not asked there. truth : where the base is, by session.
    """

    name: str
    index: Callable[[Window], MapIndex | None]
    truth: Callable[[Window], Mapping[str, SE2]]


def asked(index: MapIndex, query: QueryMap, by: ShortlistBy, truth: Mapping[str, SE2]) -> Asked:
    """The answer in an order. truth : where the base is, by session of the index."""
    index.config = index.config.model_copy(update={"shortlist_by": by})
    begin = time.process_time()
    verdict, _ = decide(index, query)
    cpu_s = time.process_time() - begin
    errors = (error_of(index, query, place, truth) for place in verdict.hypotheses[:1])
    right = any(error_m <= RIGHT_M and error_rad <= RIGHT_RAD for error_m, error_rad in errors)
    return Asked(verdict.status == "located", right, cpu_s)


def together(maps: Mapping[str, MapIndex]) -> MapIndex:
    """The sessions of several databases, one each, as one index, by the names of their maps."""
    tables = [
        replace(index.places.table, session_index=np.full(len(index.places.table), number, np.int32))
        for number, index in enumerate(maps.values())
    ]
    grids = {name: index.grids[0] for name, index in maps.items()}
    return MapIndex(grids, SignatureTable.concatenated(tables), Config(), Config())


def databases(folder: Folder, sizes: Sequence[int]) -> Iterator[Database]:
    """The databases, one after the other. sizes : places of those with office floors."""

    @cache
    def opened(name: str) -> MapIndex:
        return index_of(folder.map(name))

    def its_map(window: Window, few: bool) -> MapIndex | None:
        index = opened(window.pair.map_name)
        return index if (len(index.places.table) < _FEW) == few else None

    yield Database(f"its map, up to {_FEW} places", lambda w: its_map(w, True), lambda w: w.truth)
    yield Database("its map, more places", lambda w: its_map(w, False), lambda w: w.truth)
    maps = {name: opened(name) for name in one_each(folder)}

    def one_truth(window: Window) -> Mapping[str, SE2]:
        return {window.pair.map_name: next(iter(window.truth.values()))}

    seed = _FIRST_FLOOR
    for size in (0, *sizes):
        while sum(len(index.places.table) for index in maps.values()) < size:
            maps[f"floor {seed}"] = index_of_grid("floor", office_floor(seed), Config())
            seed += 1
        every = together(maps)
        name = f"{len(maps)} buildings, {len(every.places.table)} places"
        yield Database(name, partial(_among, every), one_truth)


def _among(index: MapIndex, window: Window) -> MapIndex | None:
    """The index, if it has the map of the window."""
    return index if window.pair.map_name in index.sessions else None


def one_each(folder: Folder) -> list[str]:
    """The name of one map of each building."""
    catalogue, found = Catalogue.of(), dict[str, str]()
    for pair in catalogue.pairs:
        if pair.kind != "elsewhere" and folder.map(pair.map_name).exists():
            found.setdefault(catalogue.recordings[pair.map].building, pair.map_name)
    return list(found.values())


def row(database: Database, by: ShortlistBy, known: Sequence[Window]) -> str:
    """A row of the table: the windows asked in a database in an order."""
    found = [
        asked(index, window.whole, by, database.truth(window))
        for window in known
        if (index := database.index(window)) is not None
    ]
    located = [one.right for one in found if one.located]
    cpu_s = np.median([one.cpu_s for one in found]) if found else 0.0
    return (
        f"| {database.name} | {by} | {len(found)} | {sum(located)} | {located.count(False)} | {cpu_s:.2f} |"
    )


def main(data: Path, work: Path, only: Only = None, places: str = "13000,100000") -> None:
    """Print the table: windows located in each order. DATA and WORK are those of `compare recordings`."""
    folder = Folder(data.resolve(), work.resolve())
    known = [window for window in windows(Catalogue.of(only=only), folder) if window.truth]
    for database in databases(folder, [int(size) for size in places.split(",")]):
        for by in get_args(ShortlistBy):
            print(row(database, by, known), flush=True)


if __name__ == "__main__":
    typer.run(main)
