"""How well places are selected for the comparison of isovists: by signatures, by some of them, or not at all.

In a city of many places not all can be compared closely. A selection is good if the right place is among
those it selects, and useful if more queries are located than with as many places drawn at random.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from pc2grid.arrays import I64
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.model import OCCUPIED, OccupancyGrid, SensorKind, SessionMap, Trajectory
from pc2grid.simulate import office_floorplan
from pc2grid.simulate.clutter import covered, place_clutter
from pc2grid.submaps.partition import partition, submap_centers
from pc2grid_lab.experiments.calibration import share_by_session
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.trial import JUDGEMENT
from signature.config import Config
from signature.database import open_database
from signature.localization.decision import judge
from signature.localization.map_index import MapIndex
from signature.localization.query import Query, QueryMap
from signature.retrieval.place_index import PlaceBlock, PlaceIndex
from signature.retrieval.vote import retrieve
from signature.seen_likelihood import COMBINATIONS, SeenWeights, Spread, seen_spread, seen_weights
from signature.seen_places import SeenPlaces
from signature.similarity import SignatureTable

ALL, SHUFFLED, PAPER, RANDOM = "all places", "shuffled signatures", "paper (Eq. 6)", "random"
"""SHUFFLED : every viewpoint has the signatures of another one, so that everything but they is the same."""
SEEN_SELECTORS = {"+".join(names): names for names in reversed(COMBINATIONS)}
"""The signatures of what was seen, all and some of them: name -> names of the signatures."""
SIGNATURES = next(iter(SEEN_SELECTORS))
"""What the program does."""
SELECTORS = (ALL, *SEEN_SELECTORS, SHUFFLED, PAPER, RANDOM)
LOCATED_BY = (ALL, SIGNATURES, SHUFFLED, PAPER, RANDOM)
"""The selectors for which queries are also located, which takes most of the time."""
MEASURED = ("selector", "looked_at", "found", "located", "right", "processor_ms")
"""The fields of `SelectionTrial` that `Selection.measure` yields."""
TRAVELS_M = (1.0, 3.0, 8.0)
"""Metres of travel after which a query is located."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectionTrial:
    """A query, and the places that were selected for it.

    plan, query_sensor, seed, travel_m : the query. scope : "building" or "city". places : how many there are.
    selector : one of `SELECTORS`. looked_at : places selected. found : whether one of them is within
    `JudgementParameters.retrieved_m` of where a view truly lies. located, right : whether the query was
    located by them, and whether the pose is right; None if that was not tried. processor_ms : of the
    selection and the comparison of isovists.
    """

    plan: str
    query_sensor: str
    seed: int
    travel_m: float
    scope: str
    places: int
    selector: str
    looked_at: int
    found: bool
    located: bool | None
    right: bool | None
    processor_ms: float

    @property
    def session(self) -> str:
        """The session that the query is a part of; queries of one session are not independent."""
        return f"{self.plan}.{self.query_sensor}.{self.seed}"


def office_floor(seed: int, clutter: int = 30) -> OccupancyGrid:
    """An office floor of 36 x 26 to 59 x 39 m, with things standing about, as a map that knows everything."""
    rng = np.random.default_rng(seed)
    plan = office_floorplan(seed, float(rng.integers(36, 60)), float(rng.integers(26, 40)))
    things = place_clutter(plan, clutter, rng, robot_m=0.35)
    cells = plan.cells.copy()
    cells[covered(plan, things) & (plan.cells >= 0)] = OCCUPIED
    return replace(plan, cells=cells)


def floor_session(seed: int, config: Config) -> SessionMap:
    """`office_floor` as a session, divided into submaps."""
    grid = office_floor(seed)
    return SessionMap(
        session=f"floor-{seed}",
        sensor="map",
        grid=grid,
        submaps=partition(grid, config.partition),
        trajectory=Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4))),
    )


def with_floors(own: SensorMap, floors: Path, config: Config) -> MapIndex:
    """The map of a building together with those of the database `floors`, as one index."""
    index = own.index
    with open_database(floors) as database:
        table = database.signatures()
        grids = {info.name: database.grid(info.name) for info in database.sessions()}
    moved = replace(table, session_index=table.session_index + np.int32(1))
    return MapIndex(
        {index.sessions[0]: index.grids[0], **grids},
        SignatureTable.concatenated((index.places.table, moved)),
        index.made_with,
        config,
    )


def queries_of(
    session: RegisteredSession, config: Config, travels_m: Sequence[float] = TRAVELS_M
) -> Iterator[tuple[float, QueryMap, SE2]]:
    """The query after each of `travels_m`: metres, what has been seen, and its true frame in the plan."""
    query = Query(config, config.relocalize)
    path_m = session.path_m()
    due = sorted(d for d in travels_m if len(path_m) and d <= path_m[-1])
    for number, (registered, planar_scan, _) in enumerate(session.scans()):
        if not session.lost[number]:
            query.add(registered, planar_scan)
        while due and path_m[number] >= due[0]:
            if not np.all(session.lost[: number + 1]):
                so_far = dataclasses.replace(
                    session,
                    planar_scans=session.planar_scans[: number + 1],
                    T_odom_base=session.T_odom_base[: number + 1],
                    lost=session.lost[: number + 1],
                    T_world_base=session.T_world_base[: number + 1],
                )
                yield due[0], query.map(), so_far.T_world_odom()
            del due[0]


class Selection:
    """The places of an index, selected for queries in each of the ways that are compared."""

    def __init__(self, index: MapIndex, scope: str, share: float, seed: int = 0) -> None:
        """scope : what the index is called in the results. share : of the places, 0..1, that is selected."""
        self.index, self.scope, self.share = index, scope, share
        self._rng = np.random.default_rng(seed)
        blocks = list(index.places.blocks())
        self._seen = {
            name: PlaceIndex.of(blocks, seen_weights(*names), seen_spread(*names))
            for name, names in SEEN_SELECTORS.items()
        }
        self._seen[SHUFFLED] = shuffled(self._seen[SIGNATURES], self._rng)

    def measure(
        self,
        query: QueryMap,
        T_map_query: SE2,
        selectors: Sequence[str] = SELECTORS,
        *,
        locate: bool = True,
    ) -> Iterator[tuple[str, int, bool, bool | None, bool | None, float]]:
        """For each selector what `MEASURED` names.

        locate : whether the query is also located, by the selectors of `LOCATED_BY`.
        """
        table = self.index.places.table
        views_m = T_map_query.apply(np.array([view.center_m for view in query.views]).reshape(-1, 2))
        own = table.session_index == 0
        right = np.zeros(len(table), bool)
        apart = cdist(views_m, table.center_m[own])
        right[own] = (apart <= JUDGEMENT.retrieved_m).any(axis=0)
        if not right.any():
            return
        for selector in selectors:
            begin = time.process_time()
            rows = self._rows(query, selector)
            processor_ms = 1000.0 * (time.process_time() - begin)
            found, located, well = bool(right[rows].any()), None, None
            if locate and selector in LOCATED_BY:
                self.index.places.around(rows)  # so that building the block is not timed
                begin = time.process_time()
                base_m = (query.T_odom_base.x, query.T_odom_base.y)
                retrieve(
                    query.views,
                    base_m,
                    self.index.places,
                    signature=self.index.made_with.signature,
                    config=self.index.config,
                    rows=rows,
                )
                processor_ms += 1000.0 * (time.process_time() - begin)
                verdict = judge(self.index, query, self.index.look_up(query, rows=rows))
                located = verdict.status == "located"
                well = False
                if located:
                    best = verdict.hypotheses[0]
                    error = (T_map_query @ query.T_odom_base).inverse() @ (
                        best.fit.T_map_query @ query.T_odom_base
                    )
                    well = (
                        best.session_index == 0
                        and math.hypot(error.x, error.y) <= JUDGEMENT.right_m
                        and abs(float(wrap_angle(error.yaw))) <= JUDGEMENT.right_rad
                    )
            yield selector, len(rows), found, located, well, processor_ms

    def _rows(self, query: QueryMap, selector: str) -> I64:
        places = self.index.places
        count = len(places.table)
        most = max(1, round(self.share * count))
        if selector == ALL or most >= count:
            return np.arange(count)
        if selector == RANDOM:
            return np.sort(self._rng.choice(count, most, replace=False))
        if selector == PAPER:
            each = max(1, most // len(query.views))
            near = places.nearest_by_paper(query.views, each, self.index.made_with.signature)
            return np.unique(np.concatenate([found.rows for found in near]))
        among = places.likely(query.views, most) if selector in (SIGNATURES, SHUFFLED) else None
        if among is not None and selector == SHUFFLED:
            among = self._rng.permutation(among)
        return np.sort(self._seen[selector].select(query.views, most, among))


def shuffled(index: PlaceIndex, rng: np.random.Generator) -> PlaceIndex:
    """The same viewpoints, each with the signatures of another one."""
    order = rng.permutation(len(index))
    return replace(index, vectors=index.vectors[order], hidden=index.hidden[order])


SHARES = (0.05, 0.01, 0.002)
"""Of very many places, the shares that are selected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recalled:
    """A query among very many places.

    plan, query_sensor, seed, travel_m : the query. places : how many there are. selector : SIGNATURES,
    SHUFFLED or RANDOM. share : of the places, selected. found : whether the right one is among those.
    processor_ms : of the selection.
    """

    plan: str
    query_sensor: str
    seed: int
    travel_m: float
    places: int
    selector: str
    share: float
    found: bool
    processor_ms: float

    @property
    def session(self) -> str:
        """As of `SelectionTrial`."""
        return f"{self.plan}.{self.query_sensor}.{self.seed}"


PlacedQuery = tuple[SensorKind, int, float, QueryMap, SE2]
"""A query: sensor and seed of its session, metres of travel, what has been seen, its true frame in the
plan."""


def recall_at_scale(
    own: SensorMap,
    others: Iterable[SeenPlaces],
    queries: Iterable[PlacedQuery],
    least_mapped: float = 0.0,
    *,
    weights: SeenWeights | None = None,
    spread: Spread | None = None,
) -> Iterator[Recalled]:
    """Whether the right places of queries are selected among those of the map and `others`, by what was seen.

    others : what is seen from the places of other maps. Queries from where the map has no place are left out,
    and those of which less than the share `least_mapped` of the views has one. weights, spread : as of
    `PlaceIndex.of`.
    """
    places, rng = own.index.places, np.random.default_rng(0)
    index = PlaceIndex.of(_blocks_of(own, others), weights, spread)
    indexes = {SIGNATURES: index, SHUFFLED: shuffled(index, rng)}
    count = int(index.row.max()) + 1
    for sensor, seed, travel_m, query, T_plan_query in queries:
        views_m = (own.T_plan_map.inverse() @ T_plan_query).apply(
            np.array([view.center_m for view in query.views]).reshape(-1, 2)
        )
        near = cdist(views_m, places.table.center_m) <= JUDGEMENT.retrieved_m
        right = np.flatnonzero(near.any(axis=0))
        if not len(right) or near.any(axis=1).mean() < least_mapped:
            continue
        for selector in (SIGNATURES, SHUFFLED, RANDOM):
            begin = time.process_time()
            most = max(1, round(max(SHARES) * count))
            if selector == RANDOM:
                rows = rng.choice(count, most, replace=False)
            else:
                rows = indexes[selector].select(query.views, most)
            processor_ms = 1000.0 * (time.process_time() - begin)
            for share in SHARES:
                yield Recalled(
                    plan=own.name,
                    query_sensor=sensor,
                    seed=seed,
                    travel_m=travel_m,
                    places=count,
                    selector=selector,
                    share=share,
                    found=bool(np.isin(rows[: max(1, round(share * count))], right).any()),
                    processor_ms=processor_ms,
                )


def _blocks_of(own: SensorMap, others: Iterable[SeenPlaces]) -> Iterator[PlaceBlock]:
    """The places of the map first, then those of the others."""
    yield from own.index.places.blocks()
    row = len(own.index.places.table)
    for seen in others:
        yield PlaceBlock(seen, row)
        row += int(seen.place.max(initial=-1)) + 1


def described_floor(seed: int, config: Config) -> SeenPlaces:
    """What is seen from the places of `office_floor`."""
    grid = office_floor(seed)
    return SeenPlaces.of(grid, submap_centers(grid, config.partition), config.partition.radius_m)


def stored_floors(arrays: Mapping[str, NDArray[Any]]) -> Iterator[SeenPlaces]:
    """The floors of a file that `pc2grid compare signatures --scale` has written."""
    columns = {name: np.asarray(arrays[name]) for name in ("at_m", "place", "signatures", "floor")}
    floor = columns.pop("floor")
    for number in range(int(floor[-1]) + 1):
        yield SeenPlaces(**{name: column[floor == number] for name, column in columns.items()})


def tally_at_scale(trials: Sequence[Recalled], *, draws: int = 1000) -> list[Mapping[str, object]]:
    """By number of places, selector, share, travel and sensor (and "all"): share found with its 5th and 95th
    percentile over sessions drawn anew (bootstrap), and median time."""
    groups: dict[tuple[int, str, float, float, str], list[Recalled]] = {}
    for trial in trials:
        for sensor in ("all", trial.query_sensor):
            # Maps differ in size; the other places do not.
            places = round(trial.places, -3)
            key = (places, trial.selector, trial.share, trial.travel_m, sensor)
            groups.setdefault(key, []).append(trial)
    return [
        {
            "places": places,
            "selector": selector,
            "share": share,
            "travel_m": travel_m,
            "query_sensor": sensor,
            "queries": len(members),
            "found": _share(members, "found", draws),
            "processor_ms": float(np.median([m.processor_ms for m in members])),
        }
        for (places, selector, share, travel_m, sensor), members in sorted(groups.items())
    ]


def tally(trials: Sequence[SelectionTrial], *, draws: int = 1000) -> list[Mapping[str, object]]:
    """For each scope, selector and travel: shares found and located rightly, with their 5th and 95th
    percentiles over sessions drawn anew (bootstrap), the share located wrongly, and the median time."""
    groups: dict[tuple[str, str, float], list[SelectionTrial]] = {}
    for trial in trials:
        groups.setdefault((trial.scope, trial.selector, trial.travel_m), []).append(trial)
    return [
        {
            "scope": scope,
            "selector": selector,
            "travel_m": travel_m,
            "queries": len(members),
            "sessions": len({m.session for m in members}),
            "places": round(float(np.median([m.places for m in members]))),
            "looked_at": round(float(np.median([m.looked_at for m in members]))),
            "found": _share(members, "found", draws),
            **_located(members, draws),
            "processor_ms": float(np.median([m.processor_ms for m in members])),
        }
        for (scope, selector, travel_m), members in groups.items()
    ]


def _share(
    members: Sequence[SelectionTrial | Recalled], field: str, draws: int
) -> tuple[float, float, float]:
    yes = np.array([bool(getattr(m, field)) for m in members])
    return share_by_session([m.session for m in members], yes, draws=draws)


def _located(members: Sequence[SelectionTrial], draws: int) -> dict[str, object]:
    """Shares located rightly and wrongly of those that were tried; None if none was."""
    tried = [m for m in members if m.right is not None]
    if not tried:
        return {"right": None, "wrong": None}
    wrong = sum(bool(m.located) and not m.right for m in tried)
    return {"right": _share(tried, "right", draws), "wrong": wrong / len(tried)}
