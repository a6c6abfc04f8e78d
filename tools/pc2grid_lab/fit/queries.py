"""Queries of which the true place is known: the evidence for their places, and the weights of the signatures.

    python -m pc2grid_lab.fit.queries evidence DATA WORK OUT.json [--only PATTERN] [--everywhere]

asks the windows of `pc2grid compare recordings` once more. DATA is the folder of recordings, WORK the one in
which `compare recordings` has kept its maps and answers. Each window is asked in its map and in that of
another building, with --everywhere in all of these; where the map knows its place, also with all that it sees
there made unknown ("blanked"), and standing, by its last scan alone. Where both have points, the likeliest
places are compared in space, too. `posterior` is fitted to them.

    python -m pc2grid_lab.fit.queries weights DATA WORK OUT.npz [--without BUILDING]

learns the weights of the signatures. Pairs of views and of the same points of a map are of two kinds: later
parts of a log in the map of its first part, and the windows of `compare recordings` in the map of another
day, whose places WORK knows. The map of a log is drawn at its true poses, so that mapping has no part in it;
its later parts are registered as a user's would be (`laser/NAME.mcap`, `laser/NAME_corrected.tum` of DATA).
Other places are those of these maps, of drawn maps (`maps/NAME.yaml`), and of office floors. --without leaves
a building out, so that what has been learned can be judged there.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from pc2grid.errors import Pc2GridError
from pc2grid.estimation.tracker import follow
from pc2grid.geometry import F32, F64, SE2
from pc2grid.io.maps import load_map
from pc2grid.io.recording import open_log
from pc2grid.matching.evidence import evidence_of
from pc2grid.matching.score import Fit
from pc2grid.model import OCCUPIED, UNKNOWN, OccupancyGrid
from pc2grid.observer import TimeSpan
from pc2grid.simulate import office_floorplan
from pc2grid.simulate.scene import covered, place_clutter
from pc2grid.submaps.submaps import look_around, submap_centers
from pc2grid_lab.fit.weights import Pairs, learned_from, save
from pc2grid_lab.peers.programs import recorded_site
from pc2grid_lab.recordings.catalogue import UNTIL_S, Catalogue, Pair
from pc2grid_lab.recordings.judging import Judge, config_of
from pc2grid_lab.recordings.run import Folder
from pc2grid_lab.runner import kept
from pc2grid_lab.sensors import RegisteredSession
from pc2grid_lab.truth import apart
from signature.config import Config
from signature.database import open_database
from signature.join.join import JOIN
from signature.localization.posterior import fit_in_space, terms_in_space
from signature.places.map_index import MapIndex
from signature.places.query import Query, QueryInSpace, QueryMap, best_observed
from signature.visible import PROFILE_BEARINGS, seen_signatures, viewpoints_of

ASKED_AFTER_M = (1.0, 3.0, 8.0)
"""Metres of travel after which a query is asked."""
_VIEWS = 16
"""Views of each query, closer together than those that are looked up."""
_EVERY = 3
"""Viewpoints of other places: one of so many is as good as all."""
_BESIDE_M = 0.3
"""The place of the map lies up to so far from the view along each axis: places are a metre apart."""
_VIEW_SPACING_M = 2.0 * _BESIDE_M


def office_floor(seed: int, clutter: int = 30) -> OccupancyGrid:
    """Return an office floor of 36 x 26 to 59 x 39 m, with things standing about, as a map that knows
    everything."""
    rng = np.random.default_rng(seed)
    plan = office_floorplan(seed, float(rng.integers(36, 60)), float(rng.integers(26, 40)))
    things = place_clutter(plan, clutter, rng, robot_m=0.35)
    cells = plan.cells.copy()
    cells[covered(plan, things) & (plan.cells >= 0)] = OCCUPIED
    return replace(plan, cells=cells)


def queries_of(session: RegisteredSession, config: Config) -> Iterator[tuple[QueryMap, SE2]]:
    """Yield the query after each of `ASKED_AFTER_M`: what has been seen, and its true frame in the plan.

    Without those whose true pose is not known.
    """
    query, path_m = Query(config, config.relocalize), session.trajectory.path_m()
    asked_after = np.array([np.argmax(path_m >= d) for d in ASKED_AFTER_M if d <= path_m.max(initial=0.0)])
    for number, scan in enumerate(session.scans()):
        if not session.lost[number]:
            query.add(*scan)
        so_far = slice(number + 1)
        for _ in np.flatnonzero(asked_after == number):
            if not session.lost[so_far].all() and not np.isnan(session.T_world_base[so_far]).all():
                yield query.map(), session.T_world_odom(number + 1)


LOGS = ("fr079", "intel", "csail", "killian")
"""Logs with true poses, of which the beginning becomes the map."""
_LOG_QUERIES = 24
"""Later parts of each of them."""
DRAWN_MAPS = ("aces.yaml", "workshop_1.yaml")
"""Maps that have other places."""

Drawn = tuple[OccupancyGrid, list[RegisteredSession]]
"""The map of the first part of a log, and its later parts as registered queries."""


def read(data: Path, name: str, folder: Path, config: Config) -> Drawn:
    """Read the map of the first part of a log, and its later parts as queries, kept in a folder."""
    site = recorded_site(
        data / "laser" / f"{name}.mcap",
        folder / name,
        config,
        queries=_LOG_QUERIES,
        travel_m=ASKED_AFTER_M[-1] + 2.0,
        mapped_s=UNTIL_S[name],
    )
    sessions = [kept(site.stem(number).with_suffix(".pickle")) for number in site.queries()]
    return load_map(site.map_stem.with_suffix(".yaml")), sessions


Asked = tuple[QueryMap, SE2, OccupancyGrid]
"""A query, its true frame in a map, and this map."""


def pairs_of(queries: Iterable[Asked], floors: Sequence[OccupancyGrid], config: Config) -> Pairs:
    """Return views of queries, and what the maps show at the same points.

    floors : maps of other buildings, taken at their viewpoints.
    """
    rng = np.random.default_rng(0)
    sight_m = config.partition.radius_m
    closer = config.relocalize.model_copy(update={"views": _VIEWS, "view_spacing_m": _VIEW_SPACING_M})

    def described(grid: OccupancyGrid, points_m: F64 | F32) -> F32:
        at_m = points_m.astype(np.float64)
        return seen_signatures(*look_around(grid, at_m, sight_m, bearings=PROFILE_BEARINGS), sight_m)

    found: list[F32] = []
    same: list[F32] = []
    for query, T_map_query, grid in queries:
        if not query.views:
            continue
        path_m = np.array([view.center_m for view in query.views])
        views_m = np.array(best_observed(query.grid, path_m, config.partition, closer))
        there = T_map_query.apply(views_m) + rng.uniform(-_BESIDE_M, _BESIDE_M, views_m.shape)
        free = grid.look_up(grid.free, there, outside=False)
        if free.any():
            found.append(described(query.grid, views_m)[free])
            same.append(described(grid, there[free]))
    other = [
        described(grid, viewpoints_of(grid, submap_centers(grid, config.partition))[0][::_EVERY])
        for grid in floors
    ]
    return Pairs(np.concatenate(found), np.concatenate(same), np.concatenate(other))


OTHERS = (
    *("fr079", "wean 2", "kidnap dec13 before", "workshop_1", "birmingham", "csail", "jarvis nav"),
    *("hall", "e1r_office_a", "kitchen", "room_a", "corridor", "fr079 lidar"),
)
"""Maps that the queries of other buildings are asked in, in turn or all."""


@dataclass(frozen=True, slots=True)
class KnownWindow:
    """A window with its query, whole, in space, and standing, and where its base is in each session of its
    map."""

    pair: Pair
    span: TimeSpan
    whole: QueryMap
    in_space: QueryInSpace | None
    standing: QueryMap
    truth: dict[str, SE2]
    covered: bool


def windows(catalogue: Catalogue, folder: Folder) -> Iterator[KnownWindow]:
    """Yield every window whose place is known, or that is of another building."""
    judge = Judge(catalogue, folder)
    for pair in catalogue.pairs:
        recording = catalogue.recordings[pair.query]
        if folder.missing(recording) or not folder.map(pair.map_name).exists():
            continue
        config = config_of(recording)
        for span, truth, seen in judge.truths(pair):
            query, last = (Query(config, config.relocalize, in_space=whole) for whole in (True, False))
            try:
                with open_log(folder.source(recording), config.read) as log:
                    for scan in follow(log.scans(span.start_s, span.duration_s), config):
                        query.add(*scan)
            except Pc2GridError:
                continue
            last.add(*scan)
            yield KnownWindow(pair, span, query.map(), query.in_space, last.map(), truth, seen)


def rows(
    window: KnownWindow, index: MapIndex, others: Mapping[str, MapIndex], catalogue: Catalogue
) -> Iterator[dict[str, Any]]:
    """Yield the evidence of the places of a window, in its map and in those of other buildings, by name."""
    row = {
        "log": catalogue.building(window.pair.query),
        "map": catalogue.building(window.pair.map),
        "start": f"{window.pair.query} {window.span.start_s:.1f}",
        "travel_m": window.whole.path_m,
        "place": "in the map" if window.truth else "elsewhere",
    }
    yield row | _asked(index, window.whole, window.truth, window.in_space)
    for name, elsewhere in others.items():
        asked = _asked(elsewhere, window.whole, {}, window.in_space)
        yield row | {"map": catalogue.building(name), "place": "elsewhere"} | asked
    if window.covered:
        yield row | {"travel_m": 0.0} | _asked(index, window.standing, window.truth)
        yield row | {"place": "blanked"} | _asked(_blanked(index, window), window.whole, window.truth)


def _asked(
    index: MapIndex, query: QueryMap, truth: Mapping[str, SE2], in_space: QueryInSpace | None = None
) -> dict[str, Any]:
    """Return the evidence of each place that is found, and how far it is from the truth."""
    *_, (found, _) = index.search(query)
    evidence = evidence_of(found, query.likeness)
    bases = [h.T_map_query @ query.T_odom_base for h in found]
    errors = [_error(index, h.session_index, T, truth) for h, T in zip(found, bases, strict=True)]
    row = {"evidence": list(map(asdict, evidence)), "errors": errors}
    if in_space is None or not in_space.views or index.surface_of is None:
        return row
    compared = {k: _in_space(index, in_space, fit, truth) for k, fit in enumerate(found)}
    return row | {"in_space": {k: told for k, told in compared.items() if told is not None}}


def _in_space(
    index: MapIndex, query: QueryInSpace, place: Fit, truth: Mapping[str, SE2]
) -> dict[str, Any] | None:
    """Return the evidence of the points for a place, and how far it is then from the truth; None: nothing."""
    assert query.T_odom_base is not None and index.surface_of is not None
    fit = fit_in_space(query, index.surface_of(place.session_index), place)
    if fit == "unknown":
        return None
    T_map_query = place.T_map_query if fit == "left" else SE2.from_matrix(fit.T_map_query)
    T_map_base = T_map_query @ SE2.from_matrix(query.T_odom_base)
    return {"terms": terms_in_space(fit), "error": _error(index, place.session_index, T_map_base, truth)}


def _error(
    index: MapIndex, session_index: int, T_map_base: SE2, truth: Mapping[str, SE2]
) -> tuple[float, float]:
    """Return metres and radians of a base from the truth, of which there is none in the sessions without a
    pose."""
    expected = truth.get(index.sessions[session_index])
    return (math.inf, math.pi) if expected is None else apart(expected, T_map_base)


def _blanked(index: MapIndex, window: KnownWindow) -> MapIndex:
    """Return the index with all that the window sees made unknown."""
    query, grids = window.whole, {name: index.grid_of(k) for k, name in enumerate(index.sessions)}
    for name, T_map_base in window.truth.items():
        grids[name] = unseen_by(query, grids[name], T_map_base @ query.T_odom_base.inverse())
    made = index.places.table, index.made_with, Config(relocalize=index.config)
    return MapIndex(grids, grids.__getitem__, *made)


def unseen_by(query: QueryMap, grid: OccupancyGrid, T_map_query: SE2) -> OccupancyGrid:
    """Return a map in which all that a query has seen, placed at a pose, is made unknown."""
    n = math.ceil(JOIN.wall_m / grid.resolution_m)  # the far side of a wall does not count as unseen
    known = (query.grid.cells != UNKNOWN).astype(np.uint8)
    known = cv2.dilate(known, np.ones((2 * n + 1, 2 * n + 1), np.uint8))
    cells = np.argwhere(grid.cells != UNKNOWN)
    at_m = T_map_query.inverse().apply(grid.to_point(cells))
    seen = cells[query.grid.look_up(known, at_m, outside=0) > 0]
    left = grid.cells.copy()
    left[tuple(seen.T)] = UNKNOWN
    return replace(grid, cells=left)


@functools.cache
def index_of_database(database: Path) -> MapIndex:
    """Return the maps of a database, which stays open: they are read when they are first used."""
    opened = open_database(database)
    return MapIndex.of(opened, opened.config())


Only = Annotated[str | None, typer.Option(help="of recordings, buildings or kinds of pairs, such as 'wean*'")]


_FIRST_FLOOR, _FLOORS = 30_010, 10
"""Office floors that are other places, besides the maps of other buildings."""


def in_logs(logs: Mapping[str, Drawn], config: Config) -> Iterator[Asked]:
    """Yield the later parts of logs in the maps of their first parts."""
    for grid, driven in logs.values():
        for session in driven:
            for query, T_map_query in queries_of(session, config):
                yield query, T_map_query, grid


def in_maps(known: Iterable[KnownWindow], folder: Folder) -> Iterator[Asked]:
    """Yield windows of recordings, each in the session of its map that shows its place; one is in memory at a
    time, as those of a lidar hold its points."""
    for window in known:
        if window.covered:
            index = index_of_database(folder.map(window.pair.map_name))
            session, T_map_base = next(iter(window.truth.items()))
            grid = index.grid_of(index.sessions.index(session))
            yield window.whole, T_map_base @ window.whole.T_odom_base.inverse(), grid


app = typer.Typer(add_completion=False)


@app.command()
def evidence(
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
    collected: list[dict[str, Any]] = []
    for number, window in enumerate(windows(catalogue, folder)):
        own = {catalogue.building(name) for name in (window.pair.query, window.pair.map)}
        others = [n for n in OTHERS if catalogue.building(n) not in own and folder.map(n).exists()]
        if not others:
            raise SystemExit(f"{folder.work}: holds no map of another building")
        chosen = others if everywhere else [others[number % len(others)]]
        elsewhere = {name: index_of_database(folder.map(name)) for name in chosen}
        collected.extend(
            rows(window, index_of_database(folder.map(window.pair.map_name)), elsewhere, catalogue)
        )
        out.write_text(json.dumps(collected))
        print(window.pair.query, "in", window.pair.map_name, f"{window.span.start_s:.1f} s", flush=True)


@app.command()
def weights(
    data: Path,
    work: Path,
    out: Path,
    without: Annotated[str, typer.Option(help="building that is left out")] = "",
) -> None:
    """Learn and store the statistics."""
    config, catalogue, folder = Config(), Catalogue.of(), Folder(data.resolve(), work.resolve())
    # Beside what this version of the program has made: another one would not read it.
    made = folder.work / "logs"
    made.mkdir(exist_ok=True)
    drawn = {name: read(data, name, made, config) for name in LOGS if name != without}
    asked = [
        pair
        for pair in catalogue.pairs
        if pair.kind != "elsewhere"
        and catalogue.building(pair.map) != without
        and folder.map(pair.map_name).exists()
    ]
    floors = [load_map(data / "maps" / name) for name in DRAWN_MAPS if catalogue.building(name) != without]
    floors += [office_floor(_FIRST_FLOOR + number) for number in range(_FLOORS)]
    floors += [grid for grid, _ in drawn.values()]
    floors += [
        index_of_database(folder.map(name)).grid_of(0) for name in sorted({pair.map_name for pair in asked})
    ]
    known = windows(replace(catalogue, pairs=tuple(asked)), folder)
    pairs = pairs_of(chain(in_logs(drawn, config), in_maps(known, folder)), floors, config)
    save(learned_from(pairs), out)
    print(f"{out}: learned from {len(pairs.queries):,} pairs and {len(pairs.other):,} other places")


if __name__ == "__main__":
    app()
