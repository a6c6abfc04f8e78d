"""Why a place: the three signatures of what the query shows there, beside those of the map.

For each view of a query, and where a hypothesis puts it in a map, the histograms that can be drawn on top of
each other, and the log-likelihood ratio that `signature.retrieval.place_index` adds up. Nothing here decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64, BoolGrid
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import look_around
from signature.boundary import PAIR_BINS, RANGE_BINS, boundary_seen
from signature.freespace import PATH_BINS, freespace_seen
from signature.retrieval.place_index import POSES
from signature.seen import seen_signatures
from signature.seen_likelihood import seen_spread, seen_weights
from signature.seen_places import PROFILE_BEARINGS
from signature.symmetry import mirror_agreement


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnSignatures:
    """What is seen from one point, as shares that a person can read.

    boundary : (Nb + 2,) of pairs of wall points by their distance, in equal bins up to twice the limit of
        sight; then of pairs of which one ray, and of which both, meet no wall within sight.
    freespace : (Nf,) of pairs of free places by the length of the shortest path, in equal bins up to twice
        the limit of sight.
    symmetry : (B,) agreement of the walls with their mirror image, 0..1, at axes pi k / B from the map's x.
    """

    boundary: F64
    freespace: F64
    symmetry: F64


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedView:
    """One view of a query where a hypothesis puts it.

    at_m : (x, y) in the query's frame. log_ratio : natural logarithm of the ratio of the likelihoods that
    both show one place, and that they show two, no less than `PoseParameters.least`; None where the map has
    no free floor, which counts as 0.
    """

    at_m: tuple[float, float]
    query: DrawnSignatures
    map: DrawnSignatures
    log_ratio: float | None


def compare_views(
    query: OccupancyGrid,
    views_m: Sequence[tuple[float, float]],
    grid: OccupancyGrid,
    T_map_query: SE2,
    sight_m: float,
) -> tuple[ComparedView, ...]:
    """The signatures of each view of a query beside those of the map at the same point, in the map's frame.

    query : what was seen, in the query's frame. grid : the map. sight_m : as the places of the map were
    described.
    """
    if not views_m:
        return ()
    points_m = np.array(views_m, np.float64)
    turned = round(T_map_query.yaw * PROFILE_BEARINGS / math.pi)
    there_m = T_map_query.apply(points_m)
    own, at_own = _described(query, points_m, sight_m, turned)
    theirs, at_theirs = _described(grid, there_m, sight_m, 0)
    weights = seen_weights()
    squared = ((weights.of_queries(at_own) - weights.of_places(at_theirs)) ** 2).sum(axis=1)
    ratios = seen_spread().log_ratio(squared, 2.0 - at_own[:, -1] - at_theirs[:, -1])
    counted = np.maximum(ratios, POSES.least).tolist()
    return tuple(
        ComparedView(at_m=view, query=mine, map=other, log_ratio=ratio if free else None)
        for view, mine, other, ratio, free in zip(
            views_m, own, theirs, counted, _free_at(grid, there_m), strict=True
        )
    )


def _free_at(grid: OccupancyGrid, points_m: F64) -> list[bool]:
    """Whether the cells at points (N, 2) are free."""
    cells = grid.to_cell(points_m)
    inside: BoolGrid = np.asarray(((cells >= 0) & (cells < grid.cells.shape)).all(axis=1))
    inside[inside] = grid.free[tuple(cells[inside].T)]
    return [bool(free) for free in inside]


def _described(
    grid: OccupancyGrid, points_m: F64, sight_m: float, turned: int
) -> tuple[list[DrawnSignatures], F32]:
    """What is seen from points (N, 2), and the signatures (N, K); the axes of symmetry are counted on by
    `turned`."""
    ranges_m, ends = look_around(grid, points_m, sight_m, bearings=PROFILE_BEARINGS)
    boundary = boundary_seen(ranges_m, ends, sight_m)[:, RANGE_BINS + 1 :][:, : PAIR_BINS + 2] ** 2
    freespace = freespace_seen(ranges_m, ends, sight_m)[:, :PATH_BINS] ** 2
    symmetry = np.roll(mirror_agreement(ranges_m, ends), turned, axis=1)
    drawn = [
        DrawnSignatures(boundary=one, freespace=two, symmetry=three)
        for one, two, three in zip(boundary, freespace, symmetry, strict=True)
    ]
    return drawn, seen_signatures(ranges_m, ends, sight_m)
