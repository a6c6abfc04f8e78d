"""One answer with the truth beside it: what all measurements of relocalization are made of."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pc2grid.alignment import assess
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.model import SensorKind
from signature.evaluation.contribution import ranks
from signature.evaluation.mapped import Mapped
from signature.query import QueryMap
from signature.relocalize import Answer
from signature.retrieve import retrieve

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
    alone : the same rank by each of `signature.evaluation.contribution.COMBINATIONS`, without isovists.
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
    alone: dict[str, int]
    scores: tuple[float, ...]
    walls: float
    look_up_ms: float

    def to_json(self) -> dict[str, Any]:
        """Plain types only."""
        return asdict(self)


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
    inside, places = mapped.name == building, mapped.building.places
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
        alone=ranks(query, places, truly, mapped.building.made_with.signature, RETRIEVED_M) if inside else {},
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
