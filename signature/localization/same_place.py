"""Whether hypotheses in the maps of different sessions are one place.

All sessions of one floor contain the right place, and must not make each other ambiguous. Two hypotheses are
one place if the surroundings in one map, placed on the other as the hypotheses say, fit there too. What the
query has seen fits in both, so only what lies beyond it counts. Labels that contradict each other rule it
out; labels that agree lower the probability that is needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pc2grid.arrays import BoolGrid
from pc2grid.geometry import SE2
from pc2grid.matching.refinement import refine
from pc2grid.matching.two_way_score import score_fit
from pc2grid.matching.walls import Walls
from pc2grid.matching.window_search import SearchMap
from pc2grid.model import UNKNOWN, OccupancyGrid
from signature.localization.hypotheses import Hypothesis, same_pose
from signature.localization.map_index import MapIndex
from signature.localization.posterior import log_likelihood_ratio
from signature.localization.query import QueryMap


@dataclass(frozen=True, slots=True, kw_only=True)
class SamePlace:
    """Whether two maps made by one sensor, or of one time, show the same place, rivals left aside.

    logit p = k min(1, W/100) (l(s) - l(s_0)), with s the two-way score or the lower agreement of the two
    directions, and l(a) = ln a - ln(1.2 - a).

    neutral : s_0. sharpness : k. Fitted to simulated sessions in the plans of fr079 and intel, as the former
    probability of an answer without rivals.
    needed, needed_labelled : least probability; the second if labels say that both are of one floor. By hand.
    around_m : maps are compared this far around the place: farther than a query has seen, so that two equal
    rooms are told apart by what lies around them. By hand.
    wall_m : what the query has seen is widened by this, so that the far side of a wall does not count as
    unseen. By hand.
    """

    neutral: float = 0.627
    sharpness: float = 16.2
    needed: float = 0.5
    needed_labelled: float = 0.1
    around_m: float = 10.0
    wall_m: float = 0.4

    def probability(self, agreement: float, walls: float) -> float:
        """Probability, 0..1, given the agreement and the wall points that it rests on."""
        k = self.sharpness * min(1.0, walls / 100.0)
        least = log_likelihood_ratio(self.neutral)
        return 1.0 / (1.0 + math.exp(-k * (log_likelihood_ratio(agreement) - least)))


SAME_PLACE = SamePlace()
_COMPARED = 5
"""Places that hypotheses of other sessions are compared with; further ones have no mass."""


def places_of(
    index: MapIndex, query: QueryMap, hypotheses: Iterable[Hypothesis]
) -> list[tuple[Hypothesis, ...]]:
    """The hypotheses by place, best first; a place has one hypothesis a session."""
    places: list[tuple[Hypothesis, ...]] = []
    for h in hypotheses:
        for number, place in enumerate(places[:_COMPARED]):
            if _belongs(index, query, h, place):
                places[number] = (*place, h)
                break
        else:
            places.append((h,))
    return places


def _belongs(index: MapIndex, query: QueryMap, h: Hypothesis, place: Sequence[Hypothesis]) -> bool:
    in_other_maps = h.session_index not in {other.session_index for other in place}
    return in_other_maps and any(_one_place(index, query, h, other) for other in place)


def _one_place(index: MapIndex, query: QueryMap, a: Hypothesis, b: Hypothesis) -> bool:
    """Whether two hypotheses in two maps are one place: by the frame of their building if the sessions are
    joined, or by what is around."""
    joined = index.joined(a.session_index, b.session_index)
    if joined is not None and same_pose(
        *(at.placed(h.fit.T_map_query @ query.T_odom_base) for at, h in zip(joined, (a, b), strict=True))
    ):
        return True
    label, other = index.labels[a.session_index], index.labels[b.session_index]
    if label.contradicts(other):
        return False
    labelled = label.agrees(other)
    on, grid = index.maps[a.session_index], index.grids[b.session_index]
    return surroundings_agree(query, a, on, b, grid, labelled=labelled)


def surroundings_agree(
    query: QueryMap, a: Hypothesis, on: SearchMap, b: Hypothesis, grid: OccupancyGrid, *, labelled: bool
) -> bool:
    """Whether two hypotheses in two maps are one place.

    on : map of `a`. grid : map of `b`. labelled : whether labels say that both maps are of one floor.
    """
    there = b.fit.T_map_query @ query.T_odom_base
    beyond = unseen_by(query, grid.crop((there.x, there.y), SAME_PLACE.around_m), b.fit.T_map_query)
    around = Walls.of(beyond)
    T_a_b = a.fit.T_map_query @ b.fit.T_map_query.inverse()
    refined, covariance = refine(on.field, around.points_m, T_a_b, (there.x, there.y))
    if not same_pose(T_a_b @ there, refined @ there):
        return False
    fit = score_fit(on.walls, around, refined, covariance)
    if not fit.overlap:  # nothing beyond is in both maps
        return labelled
    # Ground that only one of the maps knows does not count here, and neither map may contradict the other.
    needed = SAME_PLACE.needed_labelled if labelled else SAME_PLACE.needed
    return SAME_PLACE.probability(fit.known_agreement_both_ways, fit.compared) >= needed


def share_known(grid: OccupancyGrid, seen: OccupancyGrid, T_map_query: SE2) -> float:
    """The share of what a query has seen that a map knows, if the query lies at a pose."""
    cells = np.argwhere(seen.cells != UNKNOWN)
    at = grid.to_cell(T_map_query.apply(seen.to_point(cells)))
    inside: BoolGrid = np.all((at >= 0) & (at < grid.cells.shape), axis=1)
    inside[inside] = grid.cells[at[inside, 0], at[inside, 1]] != UNKNOWN
    return float(inside.mean()) if len(inside) else 0.0


def unseen_by(query: QueryMap, grid: OccupancyGrid, T_map_query: SE2) -> OccupancyGrid:
    """A map, or a part of one, in which all that the query has seen, placed at a pose, is made unknown.

    What it has seen is widened by `SamePlace.wall_m`.
    """
    import cv2

    known = query.grid.cells != UNKNOWN
    n = math.ceil(SAME_PLACE.wall_m / grid.resolution_m)
    known = cv2.dilate(known.astype(np.uint8), np.ones((2 * n + 1, 2 * n + 1), np.uint8)).astype(bool)
    cells = np.argwhere(grid.cells != UNKNOWN)
    at = query.grid.to_cell(T_map_query.inverse().apply(grid.to_point(cells)))
    inside: BoolGrid = np.all((at >= 0) & (at < query.grid.cells.shape), axis=1)
    inside[inside] = known[at[inside, 0], at[inside, 1]]
    left = grid.cells.copy()
    left[cells[inside, 0], cells[inside, 1]] = UNKNOWN
    return replace(grid, cells=left)
