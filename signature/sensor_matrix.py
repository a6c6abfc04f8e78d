"""How far do the sensors agree? Maps by one sensor, queries by another, in one simulated building.

The same experiment for all nine pairs: a session of each kind maps the building, other sessions of each
kind, with other clutter, start and direction, are located in each of the maps after some metres of
travel. Registration is done as a user would get it; true poses only judge.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.alignment import assess
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.model import OccupancyGrid, Scan, SensorKind, SessionMap
from pc2grid.partition import partition
from pc2grid.pipeline import map_scans
from signature.config import Config
from signature.driven import Driven
from signature.query import QueryMap
from signature.relocalize import Answer, Building, Relocalizer
from signature.retrieve import retrieve

if TYPE_CHECKING:
    from pc2grid.simulate import SimulationConfig

SENSORS: tuple[SensorKind, ...] = ("lidar", "laser", "depth")
DISTANCES_M = (1.0, 3.0, 5.0, 8.0, 10.0, 15.0)
RIGHT_M, RIGHT_RAD = 0.25, math.radians(3.0)
MAPPED = 0.5
"""A query counts as lying in the map if at least this share of its walls lies on ground the map knows; no
answer could be right where the mapping robot has never been."""
RETRIEVED_M = 1.0
"""A retrieved place is right within this of where the view that retrieved it truly lies."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One answer, with the truth beside it.

    in_building : False if the query comes from another building, where nothing is right.
    mapped : share of the query's walls, truly placed, that lie on ground the map knows, 0..1.
    status, confidence, error_m, error_rad : of the answer's best hypothesis (errors NaN if there is none).
    right : the best hypothesis is within 0.25 m (real logs: 0.3 m) and 3 degrees.
    rank : of the first right place among those retrieved, -1 if there is none.
    scores, walls : `signature.confidence.Evidence` of the decision.
    """

    building: str
    map_sensor: str
    query_sensor: str
    seed: int
    travel_m: float
    in_building: bool
    mapped: float
    status: str
    confidence: float
    right: bool
    error_m: float
    error_rad: float
    rank: int
    scores: tuple[float, ...]
    walls: float
    look_up_ms: float

    def to_json(self) -> dict[str, Any]:
        """Plain types only."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One cell of the matrix after some metres: shares of its trials, 0..1, and errors of the right ones.

    located_right : answered located, and it was. wrong : of those answered located, how many were not.
    recall : of the first right place among the first 1, 5 and 20 retrieved.
    """

    map_sensor: str
    query_sensor: str
    travel_m: float
    trials: int
    located_right: float
    wrong: float
    ambiguous: float
    not_found: float
    recall: dict[int, float]
    median_error_m: float
    p95_error_m: float
    look_up_ms: float


def matrix(trials: Sequence[Trial]) -> list[Cell]:
    """The trials in mapped parts of their own building, by map sensor, query sensor and travel."""
    groups: dict[tuple[str, str, float], list[Trial]] = {}
    for trial in trials:
        if trial.in_building and trial.mapped >= MAPPED:
            groups.setdefault((trial.map_sensor, trial.query_sensor, trial.travel_m), []).append(trial)
    cells = []
    for (map_sensor, query_sensor, travel_m), members in sorted(groups.items()):
        located = [t for t in members if t.status == "located"]
        errors = np.array([t.error_m for t in located if t.right]) if located else np.empty(0)
        ranks = np.array([t.rank if t.rank >= 0 else 10**6 for t in members])
        cells.append(
            Cell(
                map_sensor=map_sensor,
                query_sensor=query_sensor,
                travel_m=travel_m,
                trials=len(members),
                located_right=sum(t.right for t in located) / len(members),
                wrong=sum(not t.right for t in located) / max(len(located), 1),
                ambiguous=sum(t.status == "ambiguous" for t in members) / len(members),
                not_found=sum(t.status == "not_found" for t in members) / len(members),
                recall={k: float(np.mean(ranks < k)) for k in (1, 5, 20)},
                median_error_m=float(np.median(errors)) if len(errors) else math.nan,
                p95_error_m=float(np.percentile(errors, 95)) if len(errors) else math.nan,
                look_up_ms=float(np.median([t.look_up_ms for t in members])),
            )
        )
    return cells


def reliability(trials: Sequence[Trial], bins: int = 10) -> list[tuple[float, float, int]]:
    """For each band of confidence with trials in it: mean confidence, share that was right, how many."""
    rows = []
    for k in range(bins):
        members = [
            t
            for t in trials
            if k / bins <= t.confidence < (k + 1) / bins or (k + 1 == bins and t.confidence == 1)
        ]
        if members:
            rows.append(
                (
                    float(np.mean([t.confidence for t in members])),
                    sum(t.right for t in members) / len(members),
                    len(members),
                )
            )
    return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Mapped:
    """A building as one sensor mapped it. T_plan_map : where the map's frame lies in the true plan."""

    name: str
    sensor: SensorKind
    T_plan_map: SE2
    building: Building


def map_building(
    name: str, plan: OccupancyGrid, sensor: SensorKind, simulation: SimulationConfig, config: Config
) -> tuple[SessionMap, SE2]:
    """Drive through the plan with a sensor: the session's map, and where its frame lies in the plan.

    The frame is fitted over the whole trajectory, as for an absolute trajectory error: the heading of the
    first scan alone would carry a small error far.
    """
    from pc2grid.simulate import iter_session

    truths: list[tuple[float, float]] = []

    def scans() -> Iterator[Scan]:
        for scan, truth in iter_session(sensor=sensor, grid=plan, config=simulation):
            truths.append((truth.x, truth.y))
            yield scan

    grid, trajectory, loops = map_scans(scans(), config)
    session_map = SessionMap(
        session=f"{name}-{sensor}",
        sensor=sensor,
        grid=grid,
        submaps=partition(grid, config.partition),
        trajectory=trajectory,
        loops=loops,
    )
    return session_map, SE2.fit(trajectory.planar()[:, :2], np.array(truths))


def start_of(plan: OccupancyGrid, mapping: SimulationConfig, seed: int) -> tuple[float, float]:
    """Where query session `seed` starts: (x, y) in the plan, anywhere on the way of the session that maps it.

    A query from where the mapping robot has never been has no right answer.
    """
    from pc2grid.simulate import prepare_session

    way = prepare_session(sensor="laser", grid=plan, config=mapping).drive
    rng = np.random.default_rng([seed, mapping.seed])
    x, y, _ = way.at(np.array([rng.uniform(0.0, way.duration_s)]))[0]
    return float(x), float(y)


def query_trials(
    name: str, seed: int, driven: Driven, maps: Sequence[Mapped], distances_m: Sequence[float] = DISTANCES_M
) -> list[Trial]:
    """One query session against all `maps`, asked after each of `distances_m` that it has driven.

    Maps of another building than `name` have no right answer; only the longest distance is asked there.
    """
    relocalizer = Relocalizer(*(m.building for m in maps))
    trials: list[Trial] = []
    path_m = driven.path_m()
    left = sorted(d for d in distances_m if d <= path_m[-1])
    for driven_m, (registered, sweep, truth) in zip(path_m, driven.scans(), strict=True):
        relocalizer.add(registered, sweep)
        if not left or driven_m < left[0]:
            continue
        travel_m = left.pop(0)
        begin = time.perf_counter()
        query = relocalizer.query()
        describe_ms = 1000.0 * (time.perf_counter() - begin)
        for mapped, search in zip(maps, relocalizer.searches, strict=True):
            if mapped.name == name or not left:
                begin = time.perf_counter()
                answer = search.answer(query)
                elapsed_ms = describe_ms + 1000.0 * (time.perf_counter() - begin)
                trials.append(
                    judge(
                        mapped,
                        query,
                        answer,
                        truth,
                        building=name,
                        query_sensor=driven.sensor,
                        seed=seed,
                        travel_m=travel_m,
                        look_up_ms=elapsed_ms,
                    )
                )
    return trials


def judge(
    mapped: Mapped,
    query: QueryMap,
    answer: Answer,
    T_plan_base: SE2,
    *,
    building: str,
    query_sensor: SensorKind,
    seed: int,
    travel_m: float,
    look_up_ms: float,
    right_m: float = RIGHT_M,
) -> Trial:
    """An answer beside the truth: the base's pose at the query's last scan, in the world of `T_plan_map`."""
    inside = mapped.name == building
    T_map_base = mapped.T_plan_map.inverse() @ T_plan_base
    truly = T_map_base @ answer.T_odom_base.inverse()
    known = assess(mapped.building.fields[0], query.aligned, truly, np.eye(3)).overlap
    error_m = error_rad = math.nan
    if answer.hypotheses:
        error = T_map_base.inverse() @ (answer.hypotheses[0].fit.T_map_query @ answer.T_odom_base)
        error_m, error_rad = math.hypot(error.x, error.y), abs(wrap_angle(error.yaw))
    return Trial(
        building=mapped.name,
        map_sensor=mapped.sensor,
        query_sensor=query_sensor,
        seed=seed,
        travel_m=travel_m,
        in_building=inside,
        mapped=known if inside else 0.0,
        status=answer.status,
        confidence=answer.confidence,
        right=inside and error_m <= right_m and error_rad <= RIGHT_RAD,
        error_m=error_m,
        error_rad=error_rad,
        rank=_rank(mapped, query, truly) if inside else -1,
        scores=answer.evidence.scores,
        walls=answer.evidence.walls,
        look_up_ms=look_up_ms,
    )


def _rank(mapped: Mapped, query: QueryMap, T_map_query: SE2) -> int:
    """Rank of the first place that signatures and isovists retrieve where one of the views truly lies."""
    building = mapped.building
    proposals = retrieve(
        query, building.places, signature=building.made_with.signature, config=building.config, top_k=50
    )
    for rank, proposal in enumerate(proposals):
        true = T_map_query.apply(np.array([query.views[proposal.view].center_m]))[0]
        if math.dist(true, building.places.table.center_m[proposal.row]) <= RETRIEVED_M:
            return rank
    return -1
