"""The posterior in space: where map and query both have points, they are a factor of each place.

    mass(h)  =  m_h exp(s u_h) / (1 - sum_g m_g + sum_g m_g exp(s u_g + p n_gh))
    u_h      =  l(on_h) d_h r_h / (r_h + few),    l(a) = ln a - ln(1.7 - a)

- m_h, the mass in the plane (`signature.localization.posterior`); what is missing to 1 is "not in this map".
- on_h, the share of the r_h rays of the query that end on surfaces of the map there, once ICP has brought the
  query onto them. After that, wrong places reach up to 0.85 where surfaces face all ways, so there l is 0.
  This is independent of the occupancy grids. A place that is not compared, as ICP leaves it or a side has no
  points there, has u = 0.
- d_h, 0..1, three times the share of the information about the position that is along its least known
  direction: surfaces that all face one way fit onto any wall.
- Among places that agree (l >= 0), u is that of the best one: in each of two rooms alike the things may have
  been moved since. They are told apart by n_gh, the patches of the building that only g explains, less
  those that only h does (`pc2grid.matching.icp_in_space.Rays.patches_over`).

The place that is likeliest is the answer, and its pose that of ICP, in six degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import permutations

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.matching.icp_in_space import MapSurface, SpatialFit, register_in_space
from signature.database import SubmapDatabase
from signature.localization.answer import PoseInSpace, SpaceStatus, Status, Verdict
from signature.localization.posterior import POSTERIOR
from signature.localization.query import QueryInSpace


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceParameters:
    """What the equation above is made of.

    weight : s. neutral : agreement at which l is 0, half of 1.7. few : rays, as `PosteriorParameters.few`. By
        hand, on 23 windows of four real buildings in their own map, and in those of the others: located and
        right 17, in another building 0 of 80 (in the plane 12 and 1); with 20 to 60 of it 16 to 18 and 0.
    patch : p. Two maps of one simulated office, with other things in it, differ by 0 to 4 patches, by 7 where
        a map is bent; offices whose ceilings differ by 1 m, by 30 where they are seen. By hand.
    places : so many places are compared, those with the most mass. By hand.
    contradicts : a place whose odds become less than this share of what they were is contradicted. By hand.
    """

    weight: float = 30.0
    neutral: float = 0.85
    few: float = 500.0
    patch: float = 0.2
    places: int = 5
    contradicts: float = 0.01


SPACE = SpaceParameters()

SurfaceOf = Callable[[str], MapSurface | None]
"""The points of a session in space by its name; None if it has none."""


def surface_reader(database: SubmapDatabase) -> SurfaceOf | None:
    """Reads the points of the sessions of a database, and keeps the latest; None if none has any."""
    if not any(info.points for info in database.sessions()):
        return None

    def surface_of(session: str) -> MapSurface | None:
        points = database.points(session)
        return None if points is None else MapSurface(points)

    return lru_cache(maxsize=SPACE.places)(surface_of)


def settle_in_space(
    verdict: Verdict, query: QueryInSpace, surface_of: Callable[[int], MapSurface | None], accept: float
) -> tuple[Verdict, PoseInSpace | None]:
    """The verdict with the points as a factor, and the pose in space of the place that is located, or was and
    is turned down; else None. As it was, where no place can be compared.

    surface_of : the points of a session, by its index. accept : least confidence to be located.
    """
    if not query.views or query.T_odom_base is None:
        return verdict, None
    fits, masses, best = _compared(verdict, query, surface_of, accept)
    if not fits:
        return verdict, None
    poses = {place: _pose(fit, query.T_odom_base) for place, fit in fits.items()}
    settled = _settled(verdict, best, masses, poses.get(best), query.T_odom_base, accept)
    if settled.status == "located":
        return settled, poses.get(best)
    return settled, poses.get(0) if verdict.status == "located" else None


def _compared(
    verdict: Verdict, query: QueryInSpace, surface_of: Callable[[int], MapSurface | None], accept: float
) -> tuple[dict[int, SpatialFit], F64, int]:
    """The fits of places by number, the masses with them, and the likeliest place: those with the most mass
    are compared, until no other one can change what is certain."""
    fits: dict[int, SpatialFit] = {}
    best, masses = 0, np.array(verdict.masses)
    for place in range(min(len(masses), SPACE.places)):
        h = verdict.hypotheses[verdict.places.index(place)]
        surface = surface_of(h.session_index)
        fit = None if surface is None else register_in_space(query.views, surface, h.fit.T_map_query)
        if fit is not None and fit.rays:
            fits[place] = fit
            masses, best = masses_in_space(verdict.masses, fits)
        # The places that are left can agree as well as the best one: is that certain all the same?
        left = sum(verdict.masses[place + 1 :]) / max(verdict.masses[best], np.finfo(float).tiny)
        if best in fits and masses[best] >= accept * (1.0 + masses[best] * left):
            break
    return fits, masses, best


def masses_in_space(masses: Sequence[float], fits: Mapping[int, SpatialFit]) -> tuple[F64, int]:
    """(P,) the masses of places with the points as a factor, and the number of the likeliest.

    fits : of the places that are compared, by number.
    """
    agreement = {place: agreement_in_space(fit) for place, fit in fits.items()}
    best = max(agreement.values(), default=0.0)
    shared = np.zeros(len(masses))
    for place, u in agreement.items():
        shared[place] = best if u >= 0.0 else u
    patches = np.zeros((len(masses), len(masses)))
    for (h, fit), (g, other) in permutations(fits.items(), 2):
        patches[h, g] = other.compared.patches_over(fit.compared)
    odds = np.asarray(masses) * np.exp(SPACE.weight * shared)
    # Each row: the odds of all places beside that of one of them.
    every = odds * np.exp(SPACE.patch * patches)
    rows = 1.0 - sum(masses) + every.sum(axis=1)
    likeliest = int((odds / rows).argmax())
    return np.asarray(every[likeliest] / rows[likeliest]), likeliest


def agreement_in_space(fit: SpatialFit) -> float:
    """u of a place: below 0 its surfaces agree with the rays less than those of wrong places."""
    on = max(fit.on, POSTERIOR.least_agreement)
    position = fit.information[:3, :3]
    known = 3.0 * float(np.linalg.eigvalsh(position)[0] / np.trace(position))
    return known * (math.log(on) - math.log(2.0 * SPACE.neutral - on)) * fit.rays / (fit.rays + SPACE.few)


def _pose(fit: SpatialFit, T_odom_base: F64) -> PoseInSpace:
    u = agreement_in_space(fit)
    status: SpaceStatus = "agrees" if u >= 0.0 else "unsure"
    return PoseInSpace(
        status="contradicts" if SPACE.weight * u <= math.log(SPACE.contradicts) else status,
        T_map_base=fit.T_map_query @ T_odom_base,
        covariance=fit.covariance_at(T_odom_base),
        rmse_m=fit.rmse_m,
        rays=fit.rays,
        on=fit.on,
        through=fit.through,
        before=fit.before,
    )


def _settled(
    verdict: Verdict, best: int, masses: F64, in_space: PoseInSpace | None, T_odom_base: F64, accept: float
) -> Verdict:
    """The verdict with new masses (P,) of its places, `best` first, at the pose that its points give."""
    located = masses[best] >= accept
    order = sorted(
        range(len(verdict.places)), key=lambda k: (verdict.places[k] != best, -masses[verdict.places[k]])
    )
    hypotheses = [verdict.hypotheses[k] for k in order]
    if located and in_space is not None:
        planar = np.ix_((0, 1, 5), (0, 1, 5))
        T_map_query = SE2.from_matrix(in_space.T_map_base) @ SE2.from_matrix(T_odom_base).inverse()
        refined = replace(hypotheses[0].fit, T_map_query=T_map_query, covariance=in_space.covariance[planar])
        hypotheses[0] = replace(hypotheses[0], fit=refined)
    numbers = {k: n for n, k in enumerate(dict.fromkeys(verdict.places[k] for k in order))}
    likely: Status = "ambiguous" if masses[best] >= 1.0 - masses.sum() else "not_found"
    return replace(
        verdict,
        status="located" if located else likely,
        confidence=float(masses[best]),
        hypotheses=tuple(hypotheses),
        places=tuple(numbers[verdict.places[k]] for k in order),
        masses=tuple(masses[list(numbers)].tolist()),
    )
