"""The answer in space: where map and query both have points, the planar answer is refined and checked.

The check is independent of the occupancy grids. A located place whose surfaces the rays of the query do not
meet is turned down. Of several places that look alike in the plane, the one is taken that alone agrees in
space, for example of two rooms that differ in height only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.matching.icp_in_space import RAYS, SpatialFit, register_in_space
from pc2grid.model import PointMap
from signature.database import SubmapDatabase
from signature.localization.answer import PoseInSpace, SpaceStatus, Verdict
from signature.localization.posterior import POSTERIOR
from signature.localization.query import QueryInSpace


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceParameters:
    """When an answer is compared in space, and what follows from it. Chosen by hand; in a simulated drive
    through a real 3D scan right places have 0.90 to 0.97 of the rays on surfaces, random ones 0.17 to 0.78.

    agrees, contradicts : from the first share of rays on surfaces a place agrees, below the second it
        contradicts.
    patch_log_odds : of one place against another, for each patch of the building that only it explains
        (`Rays.patches_over`). Two maps of one simulated office, with other things in it, differ by 0 to 4 of
        them, by 7 where a map is bent; offices whose ceilings differ by 1 m, by 30 where they are seen.
    places : of more places than this, none is chosen.
    """

    agrees: float = 0.75
    contradicts: float = 0.55
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


def settle_in_space(
    verdict: Verdict, query: QueryInSpace, points_of: Callable[[int], PointMap | None], accept: float
) -> tuple[Verdict, PoseInSpace | None]:
    """The verdict, refined and checked in space, and the pose there; as it was, and None, where the query or
    a map has no points.

    points_of : the points of a session, by its index. accept : least confidence to be located.
    """
    views, T_odom_base = query.views, query.T_odom_base
    rivals = _rivals(verdict)
    if not views or T_odom_base is None or not 1 <= len(rivals) <= SPACE.places:
        return verdict, None
    fits = []
    for row in rivals:
        h = verdict.hypotheses[row]
        points = points_of(h.session_index)
        fit = None if points is None else register_in_space(views, points, h.fit.T_map_query)
        if fit is None or fit.rays < RAYS.least:
            return verdict, None
        fits.append(fit)
    first, share = likeliest(fits, [verdict.masses[verdict.places[row]] for row in rivals])
    in_space = _pose(fits[first], T_odom_base)
    if verdict.status == "located" and in_space.status == "contradicts":
        return _refused(verdict, in_space.on), in_space
    if verdict.status == "located":
        return _located(verdict, rivals[first], in_space, T_odom_base, verdict.confidence), in_space
    if share < accept or in_space.status != "agrees":
        return verdict, None
    return _located(verdict, rivals[first], in_space, T_odom_base, share), in_space


def _rivals(verdict: Verdict) -> list[int]:
    """Numbers of the hypotheses that are compared: of a located verdict the best one, of an ambiguous one the
    best of each place, without those that lie so far behind that they do not lessen its mass."""
    if verdict.status != "ambiguous":
        return [0] if verdict.status == "located" else []
    scores = [h.fit.score for h in verdict.hypotheses]
    least = (1.0 - POSTERIOR.longest_lead) * max(scores)
    first = [verdict.places.index(place) for place in dict.fromkeys(verdict.places)]
    return [row for row in first if scores[row] >= least]


def likeliest(fits: Sequence[SpatialFit], masses: Sequence[float]) -> tuple[int, float]:
    """Number of the place that is likeliest by its mass in the plane and its points, and its share of the
    masses of all."""
    patches = np.array([[other.compared.patches_over(fit.compared) for other in fits] for fit in fits])
    # Each row: the masses of the places beside that of one of them, which only the points of both change.
    odds = np.exp(SPACE.patch_log_odds * patches) * np.asarray(masses)
    shares = np.asarray(masses) / odds.sum(axis=1)
    first = int(shares.argmax())
    return first, float(shares[first])


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


def _refused(verdict: Verdict, on: float) -> Verdict:
    """A located verdict that the points contradict: nothing was found."""
    confidence, masses = min(verdict.confidence, on), (0.0,) * len(verdict.masses)
    return replace(verdict, status="not_found", confidence=confidence, masses=masses)


def _located(
    verdict: Verdict, row: int, in_space: PoseInSpace, T_odom_base: F64, confidence: float
) -> Verdict:
    """The verdict at one of its hypotheses, with the pose that its points give."""
    planar = np.ix_((0, 1, 5), (0, 1, 5))
    chosen = verdict.hypotheses[row]
    T_map_query = SE2.from_matrix(in_space.T_map_base) @ SE2.from_matrix(T_odom_base).inverse()
    refined = replace(chosen.fit, T_map_query=T_map_query, covariance=in_space.covariance[planar])
    order = sorted(range(len(verdict.hypotheses)), key=lambda k: k != row)
    numbers = {k: n for n, k in enumerate(dict.fromkeys(verdict.places[k] for k in order))}
    return replace(
        verdict,
        status="located",
        confidence=confidence,
        hypotheses=(replace(chosen, fit=refined), *(verdict.hypotheses[k] for k in order[1:])),
        places=tuple(numbers[verdict.places[k]] for k in order),
        masses=(confidence, *[0.0] * (len(numbers) - 1)),
    )
