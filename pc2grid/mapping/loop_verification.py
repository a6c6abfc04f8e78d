"""Whether two local maps overlap, and how they lie to each other.

Correlative scan matching over a window proposes poses; those are accepted at which the free space and the
obstacles of both local maps agree.
"""

from __future__ import annotations

import numpy as np

from pc2grid.arrays import F64
from pc2grid.estimation.point_to_line import Match, evenly
from pc2grid.geometry import SE2
from pc2grid.mapping.local_maps import LocalMap, LocalMaps
from pc2grid.mapping.loop_parameters import LoopParameters
from pc2grid.mapping.pose_graph import Edge


class LoopVerification:
    """Compares local maps of a session with each other."""

    def __init__(self, local_maps: LocalMaps, parameters: LoopParameters) -> None:
        self._local_maps = local_maps
        self._parameters = parameters

    def edge(self, older: int, newer: int, guess: SE2, window_m: float, window_rad: float) -> Edge | None:
        """The measured relative pose of two local maps near a guess; None if they do not match."""
        match = fit(
            self._local_maps[older], self._local_maps[newer], guess, window_m, window_rad, self._parameters
        )
        if match is None:
            return None
        information = self._parameters.information_share * match.information
        return Edge(older, newer, match.pose, information, loop=True)

    def information(self, older: int, newer: int, step: SE2) -> F64:
        """Information (3, 3) on a tracked step by what both local maps show: none along a bare corridor."""
        chosen = evenly(len(self._local_maps[newer].points_m), self._parameters.search_points)
        points, normals = self._local_maps[newer].points_m[chosen], self._local_maps[newer].normal_rad[chosen]
        return self._local_maps[older].match(points, normals, step).information


def fit(
    older: LocalMap,
    newer: LocalMap,
    guess: SE2,
    window_m: float,
    window_rad: float,
    parameters: LoopParameters,
) -> Match | None:
    """The pose of the newer local map in the older one; None if they do not overlap or do not agree.

    Of two poses that agree the better one counts: a wrong one contradicts the other loops in the pose graph.
    """
    fits = _agreeing_poses(older, newer, guess, window_m, window_rad, parameters)
    agreement, best = max(fits, key=lambda fit: fit[0], default=(0.0, None))
    return best if agreement >= parameters.min_agreement else None


def _agreeing_poses(
    older: LocalMap,
    newer: LocalMap,
    guess: SE2,
    window_m: float,
    window_rad: float,
    parameters: LoopParameters,
) -> list[tuple[float, Match]]:
    """Refined poses at which enough of each local map lies on what the other observed, with the agreement.

    The agreement, 0..1, is the smaller of the two directions.
    """
    chosen = evenly(len(newer.points_m), parameters.search_points)
    points, normals = newer.points_m[chosen], newer.normal_rad[chosen]
    points_back = older.points_m[evenly(len(older.points_m), parameters.search_points)]
    fits = []
    for _, start in older.search(points, guess, window_m, window_rad):
        match = older.match(points, normals, start)
        observed, agreement = older.agreement(points, match.pose)
        observed_back, agreement_back = newer.agreement(points_back, match.pose.inverse())
        if max(observed, observed_back) > parameters.min_observed:
            fits.append((min(agreement, agreement_back), match))
    return fits


def spread_over_visits(distance_m: F64, near_m: float, count: int) -> list[int]:
    """Which older local maps, `distance_m` (N,) away from the newest, to compare it with; `count` at most.

    A robot that drives up and down sees a place dozens of times. The nearest local map of the first visit,
    of the last and of some in between are chosen, so that the newest is connected to all visits.
    """
    near = np.flatnonzero(distance_m < near_m)
    if not len(near):
        return []
    visits = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    chosen = [visits[k] for k in evenly(len(visits), count)]
    nearest = [int(visit[np.argmin(distance_m[visit])]) for visit in chosen]
    others = [int(k) for k in near[np.argsort(distance_m[near], kind="stable")] if k not in nearest]
    return nearest + others[: count - len(nearest)]
