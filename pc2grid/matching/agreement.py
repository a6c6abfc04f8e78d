"""What supports and what contradicts a query at a pose, wall point by wall point.

A `Fit` is a mean over wall points; a picture that shows why it is high or low needs the points themselves.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, U8
from pc2grid.geometry import SE2
from pc2grid.matching.likelihood_field import LIKELIHOOD
from pc2grid.matching.walls import Walls


class Support(enum.IntEnum):
    """What a map says about a wall point of a query.

    FITS : there is a wall of the map so near that the point raises the score. CONTRADICTED : the map knows
    free ground there. UNKNOWN : the map knows nothing there.
    """

    UNKNOWN = 0
    FITS = 1
    CONTRADICTED = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """The wall points behind a `two_way_score.Fit`.

    points_m : (K, 2) float32, the query's wall points, in the query's frame.
    support : (K,) uint8, the `Support` of each.
    weights : (K,) float32, 0..1, how much each counts, see `walls.steadiness`.
    missed_m : (M, 2) float32, wall points of the map, in the map frame, where the query saw free ground.
    """

    points_m: F32
    support: U8
    weights: F32
    missed_m: F32

    def share(self, kind: Support) -> float:
        """The share of the query's wall points of this kind, 0..1, by weight; 0 without points.

        The shares that fit and that are contradicted add up to `Fit.overlap`.
        """
        total = float(self.weights.sum(dtype=np.float64))
        of_these = float(self.weights[self.support == kind].sum(dtype=np.float64))
        return of_these / total if total else 0.0


def agreement(target: Walls, query: Walls, T_map_query: SE2) -> Agreement:
    """Compare a query with the map `target` at a pose.

    A point fits if its likelihood is not below `LikelihoodParameters.neutral`, the likelihood of a point on
    unknown ground: then it supports the pose, otherwise it speaks against it. With the usual numbers that is
    a wall of the map within 0.14 m.
    """
    query, target = query.facing(target), target.facing(query)
    fits, known = _fits(query, target, T_map_query)
    support = np.where(known, np.where(fits, Support.FITS, Support.CONTRADICTED), Support.UNKNOWN)
    met, looked_at = _fits(target, query, T_map_query.inverse())
    return Agreement(
        points_m=query.points_m,
        support=support.astype(np.uint8),
        weights=query.weights,
        missed_m=target.points_m[looked_at & ~met],
    )


def _fits(walls: Walls, other: Walls, T_other_walls: SE2) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which wall points (N,) have a wall of the other side near, and which lie on ground that it knows."""
    likelihood, known = other.field.at(T_other_walls.apply(walls.points_m), above=walls.only_explain)
    return likelihood >= LIKELIHOOD.neutral, known
