"""What the signatures decide: real windows, located with their shortlist, a shuffled one, and one at random.

    python -m pc2grid_lab.fit.shortlists DATA WORK [--only PATTERN]

DATA is the folder of recordings, WORK the one in which `compare recordings` has kept its maps and answers.
Each window whose place is known is asked in its map, if that has enough places to be chosen from, and in one
map of each building as one database. For both, a row for each shortlist: how many windows there are, how many
are located rightly and wrongly, and the processor time of a look-up with its decision (median, s).
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid_lab.experiments.frames import apart
from pc2grid_lab.experiments.recordings.catalogue import Catalogue
from pc2grid_lab.experiments.recordings.run import Folder
from pc2grid_lab.fit.posterior import RIGHT_M, RIGHT_RAD
from pc2grid_lab.fit.recorded_queries import Window, windows
from signature.config import Config, ShortlistBy
from signature.database import open_database
from signature.localization.decision import decide
from signature.localization.map_index import MapIndex
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


def asked(where: str, index: MapIndex, window: Window, truth: dict[str, SE2]) -> Iterator[Asked]:
    """The answers by each shortlist. truth : where the base is, by session of the index."""
    query = window.whole
    for by in get_args(ShortlistBy):
        index.config = index.config.model_copy(update={"shortlist_by": by})
        begin = time.process_time()
        verdict = decide(index, query, index.look_up(query))
        cpu_s = time.process_time() - begin
        best = verdict.hypotheses[0] if verdict.hypotheses else None
        there = None if best is None else truth.get(index.sessions[best.session_index])
        error = (math.inf, math.inf)
        if best is not None and there is not None:
            error = apart(there, best.fit.T_map_query @ query.T_odom_base)
        right = error[0] <= RIGHT_M and error[1] <= RIGHT_RAD
        yield Asked(where, by, verdict.status == "located", right, cpu_s)


def together(maps: dict[str, MapIndex]) -> MapIndex:
    """The sessions of several databases, one each, as one index, by the names of their maps."""
    grids: dict[str, OccupancyGrid] = {}
    tables: list[SignatureTable] = []
    for number, (name, index) in enumerate(maps.items()):
        table = index.places.table
        tables.append(replace(table, session_index=np.full(len(table), number, np.int32)))
        grids[name] = index.grids[0]
    config = Config()
    return MapIndex(grids, SignatureTable.concatenated(tables), config, config)


def answers(catalogue: Catalogue, folder: Folder, opened: ExitStack) -> Iterator[Asked]:
    """The answers to every window of the catalogue whose place is known. opened : closes the databases."""

    @functools.cache
    def index_of(name: str) -> MapIndex:
        database = opened.enter_context(open_database(folder.map(name)))
        return MapIndex.of(database, database.config())

    maps = {name: index_of(name) for name in one_each(folder)}
    every = together(maps)
    print(f"all maps: {len(maps)}, {len(every.places.table)} places", flush=True)
    for window in windows(catalogue, folder):
        name = window.pair.map_name
        if not window.truth:
            continue
        if len(index_of(name).places.table) >= _ENOUGH:
            yield from asked("its map", index_of(name), window, window.truth)
        if name in maps:
            yield from asked("all maps", every, window, {name: next(iter(window.truth.values()))})
        print(name, f"{window.span.start_s:.1f} s", flush=True)


def one_each(folder: Folder) -> Iterable[str]:
    """The name of one map of each building."""
    catalogue, found = Catalogue.of(), dict[str, str]()
    for pair in catalogue.pairs:
        if pair.kind != "elsewhere" and folder.map(pair.map_name).exists():
            found.setdefault(catalogue.recordings[pair.map].building, pair.map_name)
    return found.values()


def main() -> None:
    """Print the table."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--only", help="of these recordings, buildings or kinds of pairs only, a pattern")
    options = parser.parse_args()
    folder = Folder(options.data.resolve(), options.work.resolve())
    with ExitStack() as opened:
        found = list(answers(Catalogue.of(only=options.only), folder, opened))
    for where, by in dict.fromkeys((one.where, one.by) for one in found):
        rows = [one for one in found if (one.where, one.by) == (where, by)]
        located = [one.right for one in rows if one.located]
        cpu_s = np.median([one.cpu_s for one in rows])
        right, wrong = sum(located), len(located) - sum(located)
        print(f"| {where} | {by} | {len(rows)} | {right} | {wrong} | {cpu_s:.2f} |")


if __name__ == "__main__":
    main()
