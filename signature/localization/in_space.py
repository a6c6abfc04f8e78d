"""The answer in space: where map and query both have points, the planar answer is refined and checked.

The check is independent of the occupancy grids. A located place whose surfaces the rays of the query do not
meet is turned down. Of several places that look alike in the plane, the one is taken that alone agrees in
space, for example of two rooms that differ in height only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.matching.icp_in_space import RAYS, SpatialFit, SpatialView, register_in_space
from pc2grid.model import PointMap
from signature.database import SubmapDatabase
from signature.localization.answer import Answer, Moment, PoseInSpace, SpaceStatus
from signature.localization.hypotheses import Hypothesis
from signature.localization.posterior import POSTERIOR
from signature.localization.query import QueryInSpace


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceParameters:
    """When an answer is compared in space, and what follows from it. Chosen by hand; in a simulated drive
    through a real 3D scan right places have 0.90 to 0.97 of the rays on surfaces, random ones 0.17 to 0.78.

    agrees, contradicts : from the first share of rays on surfaces a place agrees, below the second it
        contradicts.
    sure : of several places one is chosen only from this share on.
    patch_log_odds : of one place against another, for each patch of the building that only it explains
        (`Rays.patches_over`). Two maps of one simulated office, with other things in it, differ by 0 to 4 of
        them, by 7 where a map is bent; offices whose ceilings differ by 1 m, by 30 where they are seen.
    places : of more places than this, none is chosen.
    """

    agrees: float = 0.75
    contradicts: float = 0.55
    sure: float = 0.85
    patch_log_odds: float = 0.2
    places: int = 5


SPACE = SpaceParameters()

PointsOf = Callable[[str], PointMap | None]
"""The points of a session by its name; None if it has none."""


def points_reader(database: SubmapDatabase) -> PointsOf | None:
    """Reads the points of the sessions of a database, and keeps the latest; None if none has any."""
    if not any(info.provenance.config.projection.points_voxel_m for info in database.sessions()):
        return None
    return lru_cache(maxsize=SPACE.places)(database.points)


def settle_in_space(answer: Answer, query: QueryInSpace, points_of: PointsOf, accept: float) -> Answer:
    """The answer, refined and checked in space; as it was where the query or the map has no points.

    points_of : the points of a session. accept : least confidence to be located.
    """
    views, T_odom_base = query.views, query.T_odom_base
    if not views or T_odom_base is None or not answer.hypotheses or answer.status == "not_found":
        return answer
    rivals = _rivals(answer)
    if answer.status == "located":
        (best,) = _fits(answer, rivals[:1], views, points_of)
        if best is None:
            return answer
        in_space = _pose(best, T_odom_base)
        if in_space.status == "contradicts":
            return _refused(answer, in_space)
        return _located(answer, rivals[0], best, T_odom_base, answer.confidence)
    if not 2 <= len(rivals) <= SPACE.places:
        return answer
    # Ambiguous: one place must agree, and every other place must have been compared and agree less.
    compared = [fit for fit in _fits(answer, rivals, views, points_of) if fit is not None]
    if len(compared) < len(rivals):
        return answer
    best_of = winner(compared, accept)
    if best_of is None:
        return answer
    first, confidence = best_of
    return _located(answer, rivals[first], compared[first], T_odom_base, confidence)


def winner(fits: Sequence[SpatialFit], accept: float) -> tuple[int, float] | None:
    """Number and confidence of the one of several places that alone agrees in space; None if none does.

    accept : least confidence to be chosen.
    """
    odds = np.array([[other.compared.patches_over(fit.compared) for other in fits] for fit in fits])
    # Each row: how much more likely the other places are than this one; 0 for the place itself.
    probabilities = 1.0 / np.exp(SPACE.patch_log_odds * odds).sum(axis=1)
    first = int(probabilities.argmax())
    confidence = float(probabilities[first])
    return (first, confidence) if fits[first].on >= SPACE.sure and confidence >= accept else None


def _fits(
    answer: Answer, wanted: list[Hypothesis], views: tuple[SpatialView, ...], points_of: PointsOf
) -> list[SpatialFit | None]:
    """A fit for each of these hypotheses of the answer; None for one that cannot be compared."""
    compared: list[SpatialFit | None] = []
    maps: dict[str, PointMap | None] = {}
    for hypothesis in wanted:
        session = answer.sessions[hypothesis.session_index]
        if session not in maps:
            maps[session] = points_of(session)
        points = maps[session]
        fit = None if points is None else register_in_space(views, points, hypothesis.fit.T_map_query)
        compared.append(fit if fit is not None and fit.rays >= RAYS.least else None)
    return compared


def _rivals(answer: Answer) -> list[Hypothesis]:
    """The best hypothesis of each place, best first, without those that lie so far behind the best one that
    they do not lessen its confidence."""
    first: dict[int, Hypothesis] = {}
    for hypothesis, place in zip(answer.hypotheses, answer.places, strict=True):
        first.setdefault(place, hypothesis)
    least = (1.0 - POSTERIOR.longest_lead) * max(hypothesis.fit.score for hypothesis in first.values())
    return [hypothesis for hypothesis in first.values() if hypothesis.fit.score >= least]


def _pose(fit: SpatialFit, T_odom_base: F64) -> PoseInSpace:
    status: SpaceStatus = "unsure"
    if fit.on >= SPACE.agrees:
        status = "agrees"
    elif fit.on < SPACE.contradicts:
        status = "contradicts"
    return PoseInSpace(
        status=status,
        T_map_base=fit.T_map_query @ T_odom_base,
        covariance=fit.covariance_at(T_odom_base),
        rmse_m=fit.rmse_m,
        rays=fit.rays,
        on=fit.on,
        through=fit.through,
        before=fit.before,
    )


def _refused(answer: Answer, in_space: PoseInSpace) -> Answer:
    """A located answer that the points contradict: nothing was found."""
    confidence = min(answer.confidence, in_space.on)
    return replace(
        answer,
        status="not_found",
        session=None,
        T_map_base=None,
        covariance=None,
        T_map_odom=None,
        confidence=confidence,
        masses=tuple(0.0 for _ in answer.masses),
        history=_ending(answer.history, status="not_found", confidence=confidence),
        in_space=in_space,
    )


def _ending(history: tuple[Moment, ...], **changed: Any) -> tuple[Moment, ...]:
    """A history whose last moment, that of the answer, is changed."""
    return (*history[:-1], *(replace(moment, **changed) for moment in history[-1:]))


def _located(
    answer: Answer, hypothesis: Hypothesis, fit: SpatialFit, T_odom_base: F64, confidence: float
) -> Answer:
    """The answer at one of its hypotheses, with the pose that its points give."""
    in_space = _pose(fit, T_odom_base)
    T_map_odom = SE2.from_matrix(in_space.T_map_base) @ answer.T_odom_base.inverse()
    T_map_base = T_map_odom @ answer.T_odom_base
    planar = np.ix_((0, 1, 5), (0, 1, 5))
    refined = replace(
        hypothesis,
        fit=replace(hypothesis.fit, T_map_query=T_map_odom, covariance=in_space.covariance[planar]),
    )
    row = next(k for k, other in enumerate(answer.hypotheses) if other is hypothesis)
    order = [row, *(k for k in range(len(answer.hypotheses)) if k != row)]
    places = [answer.places[k] for k in order]
    numbers = {known: number for number, known in enumerate(dict.fromkeys(places))}
    session = answer.sessions[hypothesis.session_index]
    hypotheses = tuple(refined if k == row else answer.hypotheses[k] for k in order)
    return replace(
        answer,
        status="located",
        session=session,
        T_map_base=T_map_base,
        covariance=in_space.covariance[planar],
        T_map_odom=T_map_odom,
        confidence=confidence,
        hypotheses=hypotheses,
        history=_ending(
            answer.history, status="located", session=session, pose=T_map_base, confidence=confidence
        ),
        places=tuple(numbers[known] for known in places),
        masses=(confidence, *(0.0 for _ in range(1, len(numbers)))),
        submap_ids=tuple(answer.submap_ids[k] for k in order),
        in_space=in_space,
    )
