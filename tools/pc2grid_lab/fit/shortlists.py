"""What the signatures decide: real windows, located with their shortlist, a shuffled one, and one at random.

    python -m pc2grid_lab.fit.shortlists DATA WORK [--only PATTERN]

DATA is the folder of recordings, WORK the one in which `compare recordings` has kept its maps and answers.
Each window whose place is known is asked in its map, if that has enough places to be chosen from, and in one
map of each building as one database. For both, a row for each shortlist: how many windows there are, how many
are located rightly and wrongly, and the processor time of a look-up with its decision (median, s).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
import typer

from pc2grid.geometry import SE2
from pc2grid_lab.experiments.recordings.catalogue import Catalogue
from pc2grid_lab.experiments.recordings.run import Folder
from pc2grid_lab.fit.posterior import RIGHT_M, RIGHT_RAD
from pc2grid_lab.fit.recorded_queries import Only, error_of, index_of, windows
from signature.config import Config, ShortlistBy
from signature.localization.decision import decide
from signature.localization.map_index import MapIndex
from signature.localization.query import QueryMap
from signature.similarity import SignatureTable

_ENOUGH = 200
"""Of fewer places, half or more are aligned at in any case."""


@dataclass(frozen=True, slots=True)
class Asked:
    """An answer: in which maps, by which shortlist; whether located, whether right, and its time."""

    where: str
    by: ShortlistBy
    located: bool
    right: bool
    cpu_s: float


def asked(where: str, index: MapIndex, query: QueryMap, truth: Mapping[str, SE2]) -> Iterator[Asked]:
    """The answers by each shortlist. truth : where the base is, by session of the index."""
    for by in get_args(ShortlistBy):
        index.config = index.config.model_copy(update={"shortlist_by": by})
        begin = time.process_time()
        verdict = decide(index, query, index.look_up(query))
        cpu_s = time.process_time() - begin
        errors = (error_of(index, query, place, truth) for place in verdict.hypotheses[:1])
        right = any(error_m <= RIGHT_M and error_rad <= RIGHT_RAD for error_m, error_rad in errors)
        yield Asked(where, by, verdict.status == "located", right, cpu_s)


def together(maps: Mapping[str, MapIndex]) -> MapIndex:
    """The sessions of several databases, one each, as one index, by the names of their maps."""
    tables = [
        replace(index.places.table, session_index=np.full(len(index.places.table), number, np.int32))
        for number, index in enumerate(maps.values())
    ]
    grids = {name: index.grids[0] for name, index in maps.items()}
    return MapIndex(grids, SignatureTable.concatenated(tables), Config(), Config())


def answers(catalogue: Catalogue, folder: Folder) -> Iterator[Asked]:
    """The answers to every window of the catalogue whose place is known."""
    maps = {name: index_of(folder.map(name)) for name in one_each(folder)}
    every = together(maps)
    print(f"all maps: {len(maps)}, {len(every.places.table)} places", flush=True)
    for window in windows(catalogue, folder):
        name = window.pair.map_name
        if not window.truth:
            continue
        own = index_of(folder.map(name))
        if len(own.places.table) >= _ENOUGH:
            yield from asked("its map", own, window.whole, window.truth)
        if name in maps:
            yield from asked("all maps", every, window.whole, {name: next(iter(window.truth.values()))})
        print(name, f"{window.span.start_s:.1f} s", flush=True)


def one_each(folder: Folder) -> list[str]:
    """The name of one map of each building."""
    catalogue, found = Catalogue.of(), dict[str, str]()
    for pair in catalogue.pairs:
        if pair.kind != "elsewhere" and folder.map(pair.map_name).exists():
            found.setdefault(catalogue.recordings[pair.map].building, pair.map_name)
    return list(found.values())


def main(data: Path, work: Path, only: Only = None) -> None:
    """Print the table: windows located by each shortlist. DATA and WORK are those of `compare recordings`."""
    found = list(answers(Catalogue.of(only=only), Folder(data.resolve(), work.resolve())))
    for where, by in dict.fromkeys((one.where, one.by) for one in found):
        rows = [one for one in found if (one.where, one.by) == (where, by)]
        located = [one.right for one in rows if one.located]
        cpu_s = np.median([one.cpu_s for one in rows])
        print(f"| {where} | {by} | {len(rows)} | {sum(located)} | {located.count(False)} | {cpu_s:.2f} |")


if __name__ == "__main__":
    typer.run(main)
