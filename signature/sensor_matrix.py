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

from pc2grid.geometry import SE2, wrap_angle
from pc2grid.model import OccupancyGrid, SensorKind
from pc2grid.partition import partition
from pc2grid.pipeline import follow, map_scans
from signature.config import Config
from signature.describe import describe
from signature.relocalize import Answer, Building, Relocalizer
from signature.retrieve import retrieve
from signature.similarity import SignatureTable

if TYPE_CHECKING:
    from pc2grid.simulate import SimulationConfig

SENSORS: tuple[SensorKind, ...] = ("lidar", "laser", "depth")
DISTANCES_M = (1.0, 3.0, 5.0, 8.0, 10.0, 15.0)
RIGHT_M, RIGHT_RAD = 0.25, math.radians(3.0)
RETRIEVED_M = 1.0
"""A retrieved place is right within this of where the view that retrieved it truly lies."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One answer, with the truth beside it.

    in_building : False if the query comes from another building, where nothing is right.
    status, confidence, error_m, error_rad : of the answer's best hypothesis (errors NaN if there is none).
    right : the best hypothesis is within 0.25 m and 3 degrees. rank : of the first right place, -1 if none.
    scores, walls : `signature.confidence.Evidence` of the decision.
    """

    building: str
    map_sensor: str
    query_sensor: str
    seed: int
    travel_m: float
    in_building: bool
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
class Mapped:
    """A building as one sensor mapped it. T_plan_map : where the map's frame lies in the true plan."""

    name: str
    sensor: SensorKind
    grid: OccupancyGrid
    T_plan_map: SE2
    building: Building


def map_building(
    name: str, plan: OccupancyGrid, sensor: SensorKind, simulation: SimulationConfig, config: Config
) -> Mapped:
    """Drive through the plan with a sensor and make its map ready for queries."""
    from pc2grid.simulate import iter_session

    first: list[SE2] = []

    def scans() -> Iterator[Any]:
        for scan, truth in iter_session(sensor=sensor, grid=plan, config=simulation):
            if not first:
                first.append(truth)
            yield scan

    grid, _ = map_scans(scans(), config)
    submaps = partition(grid, config.partition)
    table = SignatureTable.of(
        [describe(s, config.signature) for s in submaps],
        [s.center_m for s in submaps],
        submap_id=[s.submap_id for s in submaps],
    )
    return Mapped(
        name=name,
        sensor=sensor,
        grid=grid,
        T_plan_map=first[0],
        building=Building({f"{name}-{sensor}": grid}, table, config, config),
    )


def query_trials(
    name: str,
    plan: OccupancyGrid,
    sensor: SensorKind,
    simulation: SimulationConfig,
    maps: Sequence[Mapped],
    config: Config,
    distances_m: Sequence[float] = DISTANCES_M,
) -> list[Trial]:
    """One query session against all `maps`, asked after each of `distances_m` of travel.

    Maps of another building than `name` have no right answer; only the longest distance is asked there.
    """
    from pc2grid.simulate import iter_session

    truths: list[SE2] = []

    def scans() -> Iterator[Any]:
        for scan, truth in iter_session(sensor=sensor, grid=plan, config=simulation):
            truths.append(truth)
            yield scan

    relocalizers = [Relocalizer(m.building) for m in maps]
    trials: list[Trial] = []
    left = sorted(distances_m)
    driven_m, last = 0.0, None
    for registered, sweep in follow(scans(), config):
        pose = SE2.flatten(registered.T_map_base)
        if last is not None:
            driven_m += math.hypot(pose.x - last.x, pose.y - last.y)
        last = pose
        for relocalizer in relocalizers:
            relocalizer.add(registered, sweep)
        if left and driven_m >= left[0]:
            travel_m = left.pop(0)
            for mapped, relocalizer in zip(maps, relocalizers, strict=True):
                if mapped.name == name or not left:
                    trials.append(
                        _trial(mapped, relocalizer, name, sensor, simulation.seed, travel_m, truths[-1])
                    )
        if not left:
            break
    return trials


def _trial(
    mapped: Mapped,
    relocalizer: Relocalizer,
    name: str,
    sensor: SensorKind,
    seed: int,
    travel_m: float,
    T_plan_base: SE2,
) -> Trial:
    begin = time.perf_counter()
    answer = relocalizer.answer()
    elapsed_ms = 1000.0 * (time.perf_counter() - begin)
    inside = mapped.name == name
    T_map_base = mapped.T_plan_map.inverse() @ T_plan_base
    error_m = error_rad = math.nan
    if answer.hypotheses:
        error = T_map_base.inverse() @ (answer.hypotheses[0].fit.T_map_query @ answer.T_odom_base)
        error_m, error_rad = math.hypot(error.x, error.y), abs(wrap_angle(error.yaw))
    return Trial(
        building=mapped.name,
        map_sensor=mapped.sensor,
        query_sensor=sensor,
        seed=seed,
        travel_m=travel_m,
        in_building=inside,
        status=answer.status,
        confidence=answer.confidence,
        right=inside and error_m <= RIGHT_M and error_rad <= RIGHT_RAD,
        error_m=error_m,
        error_rad=error_rad,
        rank=_rank(mapped, relocalizer, answer, T_map_base) if inside else -1,
        scores=answer.evidence.scores,
        walls=answer.evidence.walls,
        look_up_ms=elapsed_ms,
    )


def _rank(mapped: Mapped, relocalizer: Relocalizer, answer: Answer, T_map_base: SE2) -> int:
    """Rank of the first place that signatures and isovists retrieve where one of the views truly lies."""
    building = mapped.building
    query = relocalizer.query()
    proposals = retrieve(
        query, building.places, signature=building.made_with.signature, config=building.config, top_k=50
    )
    T_map_query = T_map_base @ answer.T_odom_base.inverse()
    for rank, proposal in enumerate(proposals):
        true = T_map_query.apply(np.array([query.views[proposal.view].center_m]))[0]
        if math.dist(true, building.places.table.center_m[proposal.row]) <= RETRIEVED_M:
            return rank
    return -1
