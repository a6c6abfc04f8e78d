"""Compares an answer with the truth."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.matching.two_way_score import score_fit
from pc2grid.model import SensorKind
from pc2grid_lab.experiments.ablation import ranks
from pc2grid_lab.experiments.frames import apart
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.trial import JUDGEMENT, Trial
from signature.localization.localizer import Answer
from signature.localization.query import QueryMap
from signature.retrieval.vote import retrieve


def judge(
    sensor_map: SensorMap,
    query: QueryMap,
    answer: Answer,
    T_plan_base: SE2,
    *,
    building: str,
    query_sensor: SensorKind,
    seed: int,
    travel_m: float,
    look_up_ms: float,
) -> Trial:
    """The answer to a query, compared with the truth.

    T_plan_base : true pose of the base at the query's last scan, in the frame that `SensorMap.T_plan_map`
        maps to.
    building : the one that the query comes from.
    """
    in_building, index = sensor_map.name == building, sensor_map.index
    T_map_base = sensor_map.T_plan_map.inverse() @ T_plan_base
    T_map_query = T_map_base @ answer.T_odom_base.inverse()
    mapped = score_fit(index.maps[0].walls, query.walls, T_map_query, np.eye(3)).overlap
    error_m = error_rad = None
    right = False
    if answer.hypotheses:
        error_m, error_rad = apart(T_map_base, answer.hypotheses[0].fit.T_map_query @ answer.T_odom_base)
        right = in_building and error_m <= JUDGEMENT.right_m and error_rad <= JUDGEMENT.right_rad
    signature = index.made_with.signature
    return Trial(
        building=sensor_map.name,
        map_sensor=sensor_map.sensor,
        query_sensor=query_sensor,
        seed=seed,
        travel_m=travel_m,
        in_building=in_building,
        mapped=mapped if in_building else 0.0,
        status=answer.status,
        confidence=answer.confidence,
        right=right,
        error_m=error_m,
        error_rad=error_rad,
        rank=_retrieved_rank(sensor_map, query, T_map_query) if in_building else -1,
        alone=ranks(query, index.places, T_map_query, signature, JUDGEMENT.retrieved_m)
        if in_building
        else {},
        agreement=answer.evidence.agreement,
        walls=answer.evidence.walls,
        lead=answer.evidence.lead,
        look_up_ms=look_up_ms,
        forward=answer.evidence.forward,
        backward=answer.evidence.backward,
        looked_at=answer.evidence.looked_at,
        likeness=answer.evidence.likeness,
        query_building=building,
    )


def _retrieved_rank(sensor_map: SensorMap, query: QueryMap, T_map_query: SE2) -> int:
    """Rank of the first place, retrieved by signatures and isovists, at the true position of one of the
    views.
    """
    index = sensor_map.index
    proposals = retrieve(
        query.views,
        (query.T_odom_base.x, query.T_odom_base.y),
        index.places,
        signature=index.made_with.signature,
        config=index.config,
        top_k=50,
    )
    for rank, proposal in enumerate(proposals):
        true_m = T_map_query.apply(np.array([query.views[proposal.view].center_m]))[0]
        if math.dist(true_m, index.places.table.center_m[proposal.row]) <= JUDGEMENT.retrieved_m:
            return rank
    return -1
