"""The posterior in space: where map and query both have points, they are a factor of each place.

    mass(h)  =  m_h exp(u_h) / (1 - sum_g m_g + sum_g m_g exp(u_g + p n_gh))
    u_h      =  d_h (a on_h + b through_h + c before_h)

- m_h, the mass in the plane (`signature.localization.decision`); what is missing to 1 is "not in this
  map".
- on_h, through_h, before_h, the shares of the rays of the query that end there on a surface of the map,
  behind one, or before one, once ICP has brought the query onto them. a, b and c are what each kind tells:
  what has been taken away since (through) contradicts less than what stands where the map shows nothing
  (before). This is independent of the occupancy grids.
- d_h, 0..1, how well the surfaces hold the query (`SpatialFit.held`): walls of a corridor fit all along it.
- Where ICP leaves the planar pose, u_h is what that tells, `left`. Where a side shows nothing, u_h = 0.
- Among places that agree (u >= 0), u is that of the best one: in each of two rooms alike the things may have
  been moved since. They are told apart by n_gh, the patches of the building that only g explains, less
  those that only h does (`pc2grid.matching.icp_in_space.Rays.patches_over`).

The place that is likeliest is the answer, and its pose that of ICP, in six degrees of freedom.

`pc2grid_lab.fit.posterior` fits a, b, c and `left`, and judges them on buildings that were left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import permutations

import numpy as np

from pc2grid.geometry import F64, SE2
from pc2grid.matching.icp_in_space import MapSurface, SpatialFit, Unfit, register_in_space
from pc2grid.matching.score import Fit
from signature.database import SubmapDatabase
from signature.localization.answer import Answer, PoseInSpace, SpaceStatus, Status
from signature.localization.hypotheses import HYPOTHESES
from signature.localization.query import QueryInSpace


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceParameters:
    """What the equation above is made of.

    on, through, before, left : a, b, c, and u of a place that ICP leaves. Fitted to the hall, the e1r office,
        the corridor, the room, the kitchen and fr079 of the catalogue of recordings, with windows twice as
        dense. By those of the catalogue alone `before` is twice as much, and the same is located; but then a
        cupboard that was brought since, a tenth of the rays, would contradict a room.
    patch : p. Two maps of one simulated office, with other things in it, differ by 0 to 4 patches, by 7 where
        a map is bent; offices whose ceilings differ by 1 m, by 30 where they are seen. By hand.
    places : so many places are compared, those with the most mass. By hand.
    """

    on: float = 13.4
    through: float = -18.6
    before: float = -106.1
    left: float = -4.3
    patch: float = 0.2
    places: int = 12


SPACE = SpaceParameters()

SurfaceOf = Callable[[str], MapSurface | None]
"""The points of a session in space by its name; None if it has none."""


def surface_reader(database: SubmapDatabase) -> SurfaceOf | None:
    """Return what reads the points of the sessions of a database, and keeps the latest; None if no session
    has any."""
    if not any(info.points for info in database.sessions()):
        return None

    def surface_of(session: str) -> MapSurface | None:
        points = database.points(session)
        return None if points is None else MapSurface(points)

    return lru_cache(maxsize=SPACE.places)(surface_of)


def settle_in_space(
    answer: Answer, query: QueryInSpace, surface_of: Callable[[int], MapSurface | None], accept: float
) -> Answer:
    """Return the answer with the points as a factor, and the pose in space of the place that is located, or
    of the one that was located and is rejected now. Return it unchanged where no place can be compared.

    surface_of : the points of a session, by its index. accept : least confidence to be located.
    """
    if not query.views or query.T_odom_base is None:
        return answer
    fits, masses, best = _compared(answer, query, surface_of, accept)
    if not fits:
        return answer
    poses = {k: _pose(fit, query.T_odom_base) for k, fit in fits.items() if isinstance(fit, SpatialFit)}
    settled = _settled(answer, best, masses, poses.get(best), query.T_odom_base, accept)
    if settled.located:
        return replace(settled, in_space=poses.get(best))
    return replace(settled, in_space=poses.get(0) if answer.located else None)


def _compared(
    answer: Answer, query: QueryInSpace, surface_of: Callable[[int], MapSurface | None], accept: float
) -> tuple[dict[int, SpatialFit | Unfit], F64, int]:
    """Return the fits of places by number, without those of which nothing is known; the masses with them, and
    the likeliest place. The places with the most mass are compared, until no other one can change what is
    certain."""
    fits: dict[int, SpatialFit | Unfit] = {}
    planar = [place.mass for place in answer.places]
    best, masses = 0, np.array(planar)
    for number, place in enumerate(answer.places[: SPACE.places]):
        fit = fit_in_space(query, surface_of(place.fits[0].session_index), place.fits[0])
        if log_odds_in_space(fit):
            fits[number] = fit
            masses, best = masses_of(planar, fits)
        # The places that are left can agree as well as the best one: is that certain all the same?
        left = sum(planar[number + 1 :]) / max(planar[best], np.finfo(float).tiny)
        if best in fits and masses[best] >= accept * (1.0 + masses[best] * left):
            break
    return fits, masses, best


def fit_in_space(query: QueryInSpace, surface: MapSurface | None, place: Fit) -> SpatialFit | Unfit:
    """Return the fit of a query at a place. surface : the points of its map; None: there are none."""
    return "unknown" if surface is None else register_in_space(query.views, surface, place.T_map_query)


def masses_of(masses: Sequence[float], fits: Mapping[int, SpatialFit | Unfit]) -> tuple[F64, int]:
    """Return `masses_in_space` of places, by the fits of those that are compared, by number."""
    u, patches = np.full(len(masses), np.nan), np.zeros((len(masses), len(masses)))
    for place, fit in fits.items():
        u[place] = log_odds_in_space(fit)
    for (h, fit), (g, other) in permutations(fits.items(), 2):
        if isinstance(fit, SpatialFit) and isinstance(other, SpatialFit):
            patches[h, g] = other.compared.patches_over(fit.compared)
    return masses_in_space(np.asarray(masses), u, SPACE.patch * patches)


def masses_in_space(masses: F64, u: F64, other: F64 | float = 0.0) -> tuple[F64, int]:
    """Return the masses (P,) of places with the points as a factor, and the number of the likeliest.

    masses : (P,) in the plane. u : (P,), NaN of a place that is not compared. other : (P, P), by how much the
    log odds of the second place are higher beside the first one.
    """
    compared, agrees = np.isfinite(u), u >= 0.0
    shared = np.where(agrees, np.max(u, initial=0.0, where=compared), np.where(compared, u, 0.0))
    odds = masses * np.exp(shared)
    # Each row: the odds of all places beside that of one of them.
    every = odds * np.exp(np.broadcast_to(other, (len(odds), len(odds))))
    rows = 1.0 - masses.sum() + every.sum(axis=1)
    likeliest = int((odds / rows).argmax())
    return np.asarray(every[likeliest] / rows[likeliest]), likeliest


def log_odds_in_space(fit: SpatialFit | Unfit, p: SpaceParameters = SPACE) -> float:
    """Return u of a place: below 0 its surfaces agree with the rays less than those of wrong places."""
    return float(np.dot(terms_in_space(fit), (p.on, p.through, p.before, p.left)))


def terms_in_space(fit: SpatialFit | Unfit) -> tuple[float, float, float, float]:
    """Return the factors of a, b, c and `left`."""
    if isinstance(fit, SpatialFit):
        return fit.held * fit.on, fit.held * fit.through, fit.held * fit.before, 0.0
    return 0.0, 0.0, 0.0, float(fit == "left")


def _pose(fit: SpatialFit, T_odom_base: F64) -> PoseInSpace:
    u = log_odds_in_space(fit)
    of_map = np.repeat((HYPOTHESES.map_m, HYPOTHESES.map_rad), 3)
    status: SpaceStatus = "agrees" if u >= 0.0 else "unsure"
    return PoseInSpace(
        # Like one that ICP leaves.
        status="contradicts" if u <= SPACE.left else status,
        T_map_base=fit.T_map_query @ T_odom_base,
        covariance=fit.covariance_at(T_odom_base) + np.diag(np.square(of_map)),
        rmse_m=fit.rmse_m,
        rays=fit.rays,
        on=fit.on,
        through=fit.through,
        before=fit.before,
    )


def _settled(
    answer: Answer, best: int, masses: F64, in_space: PoseInSpace | None, T_odom_base: F64, accept: float
) -> Answer:
    """Return the answer with new masses (P,) of its places, `best` first, at the pose that its points
    give."""
    located = masses[best] >= accept
    order = sorted(range(len(masses)), key=lambda k: (k != best, -masses[k]))
    places = [replace(answer.places[k], mass=float(masses[k])) for k in order]
    if located and in_space is not None:
        planar = np.ix_((0, 1, 5), (0, 1, 5))
        T_map_query = SE2.from_matrix(in_space.T_map_base) @ SE2.from_matrix(T_odom_base).inverse()
        first, *others = places[0].fits
        first = replace(first, T_map_query=T_map_query, covariance=in_space.covariance[planar])
        places[0] = replace(places[0], fits=(first, *others))
    likely: Status = "ambiguous" if masses[best] >= 1.0 - masses.sum() else "not_found"
    return replace(
        answer,
        status="located" if located else likely,
        confidence=float(masses[best]),
        places=tuple(places),
    )
