"""The windows of `pc2grid compare recordings`, asked once more: what tells for each place that is found.

    python -m pc2grid_lab.fit.recorded_queries DATA WORK OUT.json [--everywhere]

DATA is the folder of recordings, WORK the one in which `compare recordings` has kept its maps and answers.
Each window is asked in its map and in that of another building, with --everywhere in those of seven or eight;
where the map knows its place, also with all that it sees there made unknown ("blanked"), and standing, by its
last scan alone. `posterior` fits the posterior to them.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pc2grid.errors import Pc2GridError
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.model import OccupancyGrid
from pc2grid.pipeline import follow
from pc2grid.time_span import TimeSpan
from pc2grid_lab.experiments.answers import unseen_by
from pc2grid_lab.experiments.frames import apart
from pc2grid_lab.experiments.recordings.catalogue import Catalogue, Pair
from pc2grid_lab.experiments.recordings.drive import config_of
from pc2grid_lab.experiments.recordings.judging import Judge
from pc2grid_lab.experiments.recordings.run import Folder
from signature.config import Config
from signature.database import SubmapDatabase, open_database
from signature.localization.hypotheses import Hypothesis
from signature.localization.map_index import MapIndex
from signature.localization.posterior import evidence_of, tail_of
from signature.localization.query import Query, QueryMap

OTHERS = ("fr079", "wean 2", "kidnap dec13 before", "workshop_1", "birmingham", "csail", "jarvis nav", "hall")
"""Maps that the queries of other buildings are asked in, in turn or all."""


@dataclass(frozen=True, slots=True)
class Window:
    """A window with its query, whole and standing, and where its base is in each session of its map."""

    pair: Pair
    span: TimeSpan
    whole: QueryMap
    standing: QueryMap
    truth: dict[str, SE2]
    covered: bool


def windows(catalogue: Catalogue, folder: Folder) -> Iterator[Window]:
    """Every window whose place is known, or that is of another building."""
    judge = Judge(catalogue, folder)
    for pair in catalogue.pairs:
        recording = catalogue.recordings[pair.query]
        if folder.missing(recording) or not folder.map(pair.map_name).exists():
            continue
        for span, truth, covered in judge.truths(pair):
            config = config_of(recording)
            query, last = Query(config, config.relocalize), Query(config, config.relocalize)
            try:
                with open_log(folder.source(recording), config.read) as log:
                    for scan in follow(log.scans(span.start_s, span.duration_s), config):
                        query.add(*scan)
            except Pc2GridError:
                continue
            last.add(*scan)
            yield Window(pair, span, query.map(), last.map(), truth, covered)


def rows(
    window: Window, index: MapIndex, others: Mapping[str, MapIndex], catalogue: Catalogue
) -> Iterator[dict[str, Any]]:
    """What tells for the places of a window, asked in its map and in those of other buildings, by name."""
    building = {name: r.building for name, r in catalogue.recordings.items()}
    row = {
        "log": building[window.pair.query],
        "map": building[window.pair.map],
        "start": f"{window.pair.query} {window.span.start_s:.1f}",
        "travel_m": window.whole.path_m,
        "place": "in the map" if window.truth else "elsewhere",
    }
    yield row | _asked(index, window.whole, window.truth)
    for name, elsewhere in others.items():
        yield row | {"map": building[name], "place": "elsewhere"} | _asked(elsewhere, window.whole, {})
    if window.covered:
        yield row | {"travel_m": 0.0} | _asked(index, window.standing, window.truth)
        yield row | {"place": "blanked"} | _asked(_blanked(index, window), window.whole, window.truth)


def _asked(index: MapIndex, query: QueryMap, truth: dict[str, SE2]) -> dict[str, Any]:
    found = index.search_whole_maps(query, index.look_up(query))
    errors = []
    for h in found:
        expected = truth.get(index.sessions[h.session_index])
        at = h.fit.T_map_query @ query.T_odom_base
        errors.append((math.inf, math.pi) if expected is None else apart(expected, at))
    return {"evidence": evidence_list(index, query, found), "errors": errors}


def evidence_list(index: MapIndex, query: QueryMap, found: tuple[Hypothesis, ...]) -> list[dict[str, Any]]:
    """What tells for each hypothesis, and for the best one, what its last scans tell."""
    evidence = list(evidence_of([h.fit for h in found], query))
    if found:
        walls = index.maps[found[0].session_index].walls
        tail = tail_of(query, found[0].fit, walls, index.config.step_m)
        evidence[0] = replace(evidence[0], tail=tail)
    return [asdict(one) for one in evidence]


def _blanked(index: MapIndex, window: Window) -> MapIndex:
    """The index with all that the window sees made unknown."""
    query, grids = window.whole, dict(zip(index.sessions, index.grids, strict=True))
    blank: dict[str, OccupancyGrid] = {
        name: unseen_by(query, grid, window.truth[name] @ query.T_odom_base.inverse())
        if name in window.truth
        else grid
        for name, grid in grids.items()
    }
    config = Config(relocalize=index.config)
    return MapIndex(blank, index.places.table, index.made_with, config)


def main() -> None:
    """Collect the evidence."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", help="of these recordings, buildings or kinds of pairs only, a pattern")
    parser.add_argument("--everywhere", action="store_true", help="ask in all other buildings, not in one")
    options = parser.parse_args()
    folder = Folder(options.data.resolve(), options.work.resolve())
    catalogue = Catalogue.of(only=options.only)
    opened: dict[str, tuple[SubmapDatabase, MapIndex]] = {}

    def index_of(name: str) -> MapIndex:
        if name not in opened:
            database = open_database(folder.map(name))
            opened[name] = database, MapIndex.of(database, database.config())
        return opened[name][1]

    collected: list[dict[str, Any]] = []
    for number, window in enumerate(windows(catalogue, folder)):
        of = {catalogue.recordings[name].building for name in (window.pair.query, window.pair.map)}
        others = [n for n in OTHERS if catalogue.recordings[n].building not in of and folder.map(n).exists()]
        if not others:
            raise SystemExit(f"{folder.work}: holds no map of another building")
        chosen = others if options.everywhere else [others[number % len(others)]]
        indices = {name: index_of(name) for name in chosen}
        collected.extend(rows(window, index_of(window.pair.map_name), indices, catalogue))
        options.out.write_text(json.dumps(collected))
        print(window.pair.query, "in", window.pair.map_name, f"{window.span.start_s:.1f} s", flush=True)
    for database, _ in opened.values():
        database.close()


if __name__ == "__main__":
    main()
