"""The windows of `pc2grid compare recordings`, asked once more: what tells for each place that is found.

    python -m pc2grid_lab.fit.recorded_queries DATA WORK OUT.json [--only PATTERN] [--everywhere]

DATA is the folder of recordings, WORK the one in which `compare recordings` has kept its maps and answers.
Each window is asked in its map and in that of another building, with --everywhere in all of these;
where the map knows its place, also with all that it sees there made unknown ("blanked"), and standing, by its
last scan alone. Where both have points, the likeliest places are compared in space, too. `posterior` and
`in_space` fit the posterior to them.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from pc2grid.errors import Pc2GridError
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.pipeline import follow
from pc2grid.time_span import TimeSpan
from pc2grid_lab.experiments.answers import unseen_by
from pc2grid_lab.experiments.frames import apart
from pc2grid_lab.experiments.recordings.catalogue import Catalogue, Pair
from pc2grid_lab.experiments.recordings.drive import config_of
from pc2grid_lab.experiments.recordings.judging import Judge
from pc2grid_lab.experiments.recordings.run import Folder
from signature.config import Config
from signature.database import open_database
from signature.localization.hypotheses import Hypothesis
from signature.localization.in_space import SPACE, fit_in_space, terms_in_space
from signature.localization.map_index import MapIndex
from signature.localization.posterior import evidence_of, tail_of
from signature.localization.query import Query, QueryInSpace, QueryMap

OTHERS = (
    *("fr079", "wean 2", "kidnap dec13 before", "workshop_1", "birmingham", "csail", "jarvis nav"),
    *("hall", "e1r_office_a", "kitchen", "room_a", "corridor", "fr079 lidar"),
)
"""Maps that the queries of other buildings are asked in, in turn or all."""


@dataclass(frozen=True, slots=True)
class Window:
    """A window with its query, whole, in space, and standing, and where its base is in each session of its
    map."""

    pair: Pair
    span: TimeSpan
    whole: QueryMap
    in_space: QueryInSpace | None
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
            query = Query(config, config.relocalize, in_space=True)
            last = Query(config, config.relocalize)
            try:
                with open_log(folder.source(recording), config.read) as log:
                    for scan in follow(log.scans(span.start_s, span.duration_s), config):
                        query.add(*scan)
            except Pc2GridError:
                continue
            last.add(*scan)
            yield Window(pair, span, query.map(), query.in_space, last.map(), truth, covered)


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
    yield row | _asked(index, window.whole, window.truth, window.in_space)
    for name, elsewhere in others.items():
        asked = _asked(elsewhere, window.whole, {}, window.in_space)
        yield row | {"map": building[name], "place": "elsewhere"} | asked
    if window.covered:
        yield row | {"travel_m": 0.0} | _asked(index, window.standing, window.truth)
        yield row | {"place": "blanked"} | _asked(_blanked(index, window), window.whole, window.truth)


def _asked(
    index: MapIndex, query: QueryMap, truth: Mapping[str, SE2], in_space: QueryInSpace | None = None
) -> dict[str, Any]:
    """What tells for each place that is found, for the best one with what its last scans tell, and how far it
    is from the truth."""
    *_, (found, _) = index.search(query)
    evidence = list(evidence_of([h.fit for h in found], query))
    if found:
        walls = index.maps[found[0].session_index].walls
        tail = tail_of(query, found[0].fit, walls, index.config.step_m)
        evidence[0] = replace(evidence[0], tail=tail)
    errors = [error_of(index, query, h, truth) for h in found]
    row = {"evidence": list(map(asdict, evidence)), "errors": errors}
    if in_space is None or not in_space.views or index.surface_of is None:
        return row
    odds = [e.log_odds() for e in evidence]
    likeliest = np.argsort(odds)[::-1][: SPACE.places].tolist()
    compared = {k: _in_space(index, in_space, found[k], truth) for k in likeliest}
    return row | {"in_space": {k: told for k, told in compared.items() if told is not None}}


def _in_space(
    index: MapIndex, query: QueryInSpace, place: Hypothesis, truth: Mapping[str, SE2]
) -> dict[str, Any] | None:
    """What the points tell for a place, and how far it is then from the truth; None: nothing."""
    assert query.T_odom_base is not None
    fit = fit_in_space(query, index.surface(place.session_index), place)
    if fit == "unknown":
        return None
    T_map_query = place.fit.T_map_query if fit == "left" else SE2.from_matrix(fit.T_map_query)
    T_map_base = T_map_query @ SE2.from_matrix(query.T_odom_base)
    return {"terms": terms_in_space(fit), "error": _error(index, place.session_index, T_map_base, truth)}


def error_of(
    index: MapIndex, query: QueryMap, place: Hypothesis, truth: Mapping[str, SE2]
) -> tuple[float, float]:
    """Metres and radians of a place from the truth, of which there is none in the sessions without a pose."""
    return _error(index, place.session_index, place.fit.T_map_query @ query.T_odom_base, truth)


def _error(
    index: MapIndex, session_index: int, T_map_base: SE2, truth: Mapping[str, SE2]
) -> tuple[float, float]:
    expected = truth.get(index.sessions[session_index])
    return (math.inf, math.pi) if expected is None else apart(expected, T_map_base)


def _blanked(index: MapIndex, window: Window) -> MapIndex:
    """The index with all that the window sees made unknown."""
    query, grids = window.whole, dict(zip(index.sessions, index.grids, strict=True))
    for name, T_map_base in window.truth.items():
        grids[name] = unseen_by(query, grids[name], T_map_base @ query.T_odom_base.inverse())
    return MapIndex(grids, index.places.table, index.made_with, Config(relocalize=index.config))


@functools.cache
def index_of(database: Path) -> MapIndex:
    """The maps of a database, which stays open: they are read when they are first used."""
    opened = open_database(database)
    return MapIndex.of(opened, opened.config())


Only = Annotated[str | None, typer.Option(help="of recordings, buildings or kinds of pairs, such as 'wean*'")]


def main(
    data: Path,
    work: Path,
    out: Path,
    only: Only = None,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="in all other buildings, not in one")
    ] = False,
) -> None:
    """Collect the evidence of the windows of `compare recordings`, whose DATA and WORK these are."""
    folder, catalogue = Folder(data.resolve(), work.resolve()), Catalogue.of(only=only)
    building = {name: r.building for name, r in catalogue.recordings.items()}
    collected: list[dict[str, Any]] = []
    for number, window in enumerate(windows(catalogue, folder)):
        of = (building[window.pair.query], building[window.pair.map])
        others = [name for name in OTHERS if building[name] not in of and folder.map(name).exists()]
        if not others:
            raise SystemExit(f"{folder.work}: holds no map of another building")
        chosen = others if everywhere else [others[number % len(others)]]
        elsewhere = {name: index_of(folder.map(name)) for name in chosen}
        collected.extend(rows(window, index_of(folder.map(window.pair.map_name)), elsewhere, catalogue))
        out.write_text(json.dumps(collected))
        print(window.pair.query, "in", window.pair.map_name, f"{window.span.start_s:.1f} s", flush=True)


if __name__ == "__main__":
    typer.run(main)
