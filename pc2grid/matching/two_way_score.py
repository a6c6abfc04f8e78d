"""Scores a pose both ways: the query's walls against the map, and the map's walls against the query.

One way alone is not enough. The walls of a small query fit into many places; but at the wrong ones the map
has walls where the query has seen free space.

What each side must have seen of the other's walls is told by `pc2grid.matching.walls.Walls.facing`. A laser
passes under tables: what stands at some heights only explains what the laser sees, and does not contradict
its free space.

A wall that the map has seen from its other side only, as it does not know the ground in front of it, may be
the right one: walls are thin. But a query along the outer wall of a building fits the rooms behind it, too.
So such a wall counts in the score, by which places are ranked, and not as evidence of a place (`compared`).
Not the other way round: what a single scan knows of the ground are thin rays. Within a session, and between
two of one building, both sides are of one wall: there `Walls.before_m` are the walls.

Two lasers at different heights are compared on what both can see. The walls of the higher one stand on the
floor; what the lower one has seen need not reach up, so it counts as on unknown ground where the higher one
sees free space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.matching.likelihood_field import LIKELIHOOD, LikelihoodField
from pc2grid.matching.walls import Walls


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """How well a query agrees with a map at one pose. Means and shares are weighted by `walls.steadiness`.

    T_map_query : pose of the query's frame in the map.
    forward : 0..1, mean likelihood of the query's walls; neutral where the map is unknown.
    backward : 0..1, mean likelihood of the map's walls on ground that the query knows.
    overlap : 0..1, share of the query's walls on ground that the map knows.
    compared : number of the query's wall points on ground that the map knows, as it does the ground in front
        of them, by weight.
    looked_at : number of the map's wall points on ground that the query knows, by weight.
    score : 0..1, geometric mean of forward and backward; hypotheses are ranked by it.
    covariance : (3, 3) of x, y, yaw from the refinement: wide along a corridor, narrow across it.
    """

    T_map_query: SE2
    forward: float
    backward: float
    overlap: float
    compared: float
    looked_at: float
    score: float
    covariance: F64

    def __repr__(self) -> str:
        pose = self.T_map_query
        return (
            f"Fit(x {pose.x:.2f} m, y {pose.y:.2f} m, yaw {math.degrees(pose.yaw):.1f} deg,"
            f" score {self.score:.2f}, overlap {self.overlap:.2f})"
        )

    @property
    def known_agreement(self) -> float:
        """0..1, mean likelihood of the query's walls on ground that the map knows; 0 if it knows none."""
        if not self.overlap:
            return 0.0
        known = (self.forward - LIKELIHOOD.neutral * (1.0 - self.overlap)) / self.overlap
        return min(max(known, 0.0), 1.0)

    @property
    def known_agreement_both_ways(self) -> float:
        """0..1, the smaller of `known_agreement` and `backward`: how well each fits what the other knows."""
        return min(self.known_agreement, self.backward)


def score_fit(target: Walls, query: Walls, T_map_query: SE2, covariance: F64) -> Fit:
    """Score the query at a pose on the map `target`."""
    mine, theirs, T_query_map = query.facing(target), target.facing(query), T_map_query.inverse()
    seen, likelihood, behind = _sums(mine, target.field, T_map_query).tolist()
    looked_at, returned, _ = _sums(theirs, query.field, T_query_map).tolist()
    weight = mine.weight
    forward = (likelihood + LIKELIHOOD.neutral * (weight - seen)) / weight if weight else 0.0
    backward = scored = returned / looked_at if looked_at else 0.0
    if theirs.only_explain:
        observed = float(_sums(replace(theirs, only_explain=False), query.field, T_query_map)[0])
        scored = (returned + LIKELIHOOD.neutral * (observed - looked_at)) / observed if observed else 0.0
    return Fit(
        T_map_query=T_map_query,
        forward=forward,
        backward=backward,
        overlap=seen / weight if weight else 0.0,
        compared=seen - behind,
        looked_at=looked_at,
        score=math.sqrt(forward * scored),
        covariance=covariance,
    )


def _sums(walls: Walls, field: LikelihoodField, T_field_walls: SE2) -> F64:
    """(3,) what `_kernels.known_sums` says of walls on a field."""
    from pc2grid.matching._kernels import known_sums

    least = LIKELIHOOD.neutral_value + 1 if walls.only_explain else 0
    pose = T_field_walls.x, T_field_walls.y, T_field_walls.yaw
    on = field.values, field.known, field.resolution_m, field.origin_m
    return np.array(known_sums(*on, walls.points_m, walls.before_m, walls.weights, pose, least))
