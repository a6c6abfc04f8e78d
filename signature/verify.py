"""Is the query really there? Alignment of its walls on the map around each proposed place, both ways."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pc2grid.alignment import Fit, LikelihoodField, assess, refine, search, thin_evenly
from pc2grid.geometry import F64, SE2, wrap_angle
from pc2grid.model import F32
from pc2grid.windows import search_windows
from signature.config import RelocalizeConfig
from signature.places import Places
from signature.query import QueryMap
from signature.retrieve import Proposal

_HALF_T_M = 0.4
_HALF_A_RAD = math.radians(8.0)
_EVERY_RAD = math.radians(7.5)
_FEW_POINTS = 128
"""Enough to rank poses coarsely; all points are used in the refinement."""
_NEAR_M = 8.0
"""Walls farther than this from where the query rotates are left out of the coarse search: a small error
of yaw would move them by more than a wall's width."""
SAME_M, SAME_RAD = 0.5, math.radians(10.0)
"""Two hypotheses nearer than this are one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypothesis:
    """The query lies in `session` (index into the database's sessions) as `fit` says.

    row : the place that proposed it, -1 if the whole map was searched or it was carried along.
    supported_m : metres of travel over which it has been seen to fit.
    """

    session_index: int
    row: int
    fit: Fit
    supported_m: float = 0.0


def verify(
    query: QueryMap,
    proposals: Sequence[Proposal],
    places: Places,
    fields: Sequence[LikelihoodField],
    config: RelocalizeConfig,
) -> tuple[Hypothesis, ...]:
    """Align the query at every proposed place; what fits comes back, best first, no two alike.

    fields : likelihood field of each session, by session_index.
    """
    coarse: list[tuple[float, int, int, SE2]] = []
    best = 0.0
    groups: dict[tuple[int, int], list[Proposal]] = {}
    for proposal in proposals:
        session = int(places.table.session_index[proposal.row])
        groups.setdefault((proposal.view, session), []).append(proposal)
    for (view, session), members in groups.items():
        center = query.views[view].center_m
        points = coarse_points(query, center)
        rows = np.array([p.row for p in members])
        starts = np.array([(*p.at_m, p.yaw_rad) for p in members])
        poses = search_windows(
            fields[session],
            points,
            starts,
            half_t_m=_HALF_T_M,
            half_a_rad=_HALF_A_RAD,
            floor=max(config.coarse_floor, config.coarse_keep * best),
            keep=config.coarse_keep,
            most=config.hypotheses,
        )
        for x, y, yaw, score in poses:
            best = max(best, float(score))
            T_map_query = SE2(float(x), float(y), float(yaw)) @ SE2(-center[0], -center[1], 0.0)
            nearest = int(rows[np.argmin(np.hypot(*(places.table.center_m[rows] - (x, y)).T))])
            coarse.append((float(score), session, nearest, T_map_query))
    coarse.sort(key=lambda c: -c[0])
    found = [
        _fitted(query, session, row, fields[session], T_map_query)
        for _, session, row, T_map_query in coarse[: 2 * config.hypotheses]
    ]
    return distinct(found, query.T_odom_base)


def search_everywhere(
    query: QueryMap, session_index: int, field: LikelihoodField, free_xy_m: F64, config: RelocalizeConfig
) -> tuple[Hypothesis, ...]:
    """Align the query on the whole map of a session: slower than by its signatures, but misses nothing.

    free_xy_m : (K, 2) centres of squares of 2 x 0.4 m that hold free space; the base must be in one.
    """
    center = (query.T_odom_base.x, query.T_odom_base.y)
    half_t = 0.4
    yaws = np.arange(-math.pi, math.pi, 2 * _EVERY_RAD) + _EVERY_RAD
    starts = np.column_stack((np.repeat(free_xy_m, len(yaws), axis=0), np.tile(yaws, len(free_xy_m))))
    poses = search(
        field,
        coarse_points(query, center),
        starts,
        half_t_m=half_t,
        half_a_rad=_EVERY_RAD,
        floor=config.coarse_floor,
        keep=config.coarse_keep,
        most=config.hypotheses,
    )
    found = [
        _fitted(
            query,
            session_index,
            -1,
            field,
            SE2(float(x), float(y), float(yaw)) @ SE2(-center[0], -center[1], 0.0),
        )
        for x, y, yaw, _ in poses
    ]
    return distinct(found, query.T_odom_base)


def carry_on(query: QueryMap, hypothesis: Hypothesis, field: LikelihoodField, driven_m: float) -> Hypothesis:
    """The same hypothesis after more travel: refined on what has been seen since."""
    fitted = _fitted(query, hypothesis.session_index, hypothesis.row, field, hypothesis.fit.T_map_query)
    return replace(fitted, supported_m=hypothesis.supported_m + driven_m)


def distinct(hypotheses: Sequence[Hypothesis], at: SE2) -> tuple[Hypothesis, ...]:
    """Best first; of those at the same place only the best, with the longest support among them."""
    kept: list[Hypothesis] = []
    bases: list[SE2] = []
    for candidate in sorted(hypotheses, key=lambda h: -h.fit.score):
        base = candidate.fit.T_map_query @ at
        twin = next(
            (
                i
                for i, other in enumerate(bases)
                if candidate.session_index == kept[i].session_index
                and math.hypot(base.x - other.x, base.y - other.y) < SAME_M
                and abs(wrap_angle(base.yaw - other.yaw)) < SAME_RAD
            ),
            None,
        )
        if twin is None:
            kept.append(candidate)
            bases.append(base)
        elif candidate.supported_m > kept[twin].supported_m:
            old = kept[twin]
            row = old.row if old.row >= 0 else candidate.row
            kept[twin] = replace(old, row=row, supported_m=candidate.supported_m)
    return tuple(kept)


def coarse_points(query: QueryMap, center_m: tuple[float, float]) -> F32:
    """(M, 2) float32: a few walls spread evenly around `center_m`, relative to it."""
    local = query.aligned.walls_m - np.asarray(center_m, np.float32)
    local = local[np.hypot(local[:, 0], local[:, 1]) < _NEAR_M]
    if not len(local):
        return local
    local = local[thin_evenly(local, 0.25)]
    if len(local) > _FEW_POINTS:
        local = local[np.linspace(0, len(local) - 1, _FEW_POINTS).astype(int)]
    return local


def _fitted(
    query: QueryMap, session_index: int, row: int, field: LikelihoodField, T_map_query: SE2
) -> Hypothesis:
    pose, covariance = refine(field, query.aligned, T_map_query)
    return Hypothesis(
        session_index=session_index, row=row, fit=assess(field, query.aligned, pose, covariance)
    )
