"""The local maps that a scan is matched with: the last metres of travel, as grids of point moments."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.arrays import F64
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.estimation.parameters import (
    MATCHING_PARAMETERS,
    TRACKING_PARAMETERS,
    MatchingParameters,
    TrackingParameters,
)
from pc2grid.estimation.point_to_line import Match, PointGrid, best_placements, evenly
from pc2grid.geometry import SE2


class MatchingMaps:
    """Two overlapping local maps: scans are matched with the older one, and the younger replaces it in time.

    reach_m : range of the hits of a scan. matching : numbers of the matching, which depend on the sensor.
    """

    def __init__(
        self,
        reach_m: float,
        parameters: TrackingParameters = TRACKING_PARAMETERS,
        matching: MatchingParameters = MATCHING_PARAMETERS,
    ) -> None:
        self._half_m = reach_m + 2.0 * parameters.map_travel_m
        self._parameters = parameters
        self._matching = matching
        self._maps: list[tuple[PointGrid, float]] = []  # each with the travel at which it was begun
        self._last: SE2 | None = None  # where a scan was added last
        self._travel_m = 0.0

    def __bool__(self) -> bool:
        return bool(self._maps)

    def search(self, planar_scan: PlanarScan, guess: SE2, window_m: float, window_rad: float) -> list[SE2]:
        """Return the best placements of a planar scan around a guess T_session_base, to be refined."""
        p, grid = self._parameters, self._maps[0][0]
        hits = planar_scan.hits_m[evenly(len(planar_scan.hits_m), p.matched_hits)].astype(np.float64)
        field = grid.likelihood(p.search_sigma_m)
        found = best_placements(field, grid.low_m, grid.cell_m, hits, guess, window_m, window_rad)
        return [pose for _, pose in found]

    def match(self, planar_scan: PlanarScan, near: SE2, prior: SE2, information: F64) -> Match:
        """Match a planar scan that has been brought near where it fits, T_session_base.

        prior, information : pose that the result is held to, and its information (3, 3) of x, y, yaw.
        """
        grid = self._maps[0][0]
        chosen = evenly(len(planar_scan.hits_m), self._parameters.matched_hits)
        hits, normals = planar_scan.hits_m[chosen], planar_scan.normal_rad[chosen]
        guess = grid.weighed(hits, normals, near, prior, information)
        return grid.match(hits, normals, guess, prior, information)

    def extend(self, planar_scan: PlanarScan, pose: SE2) -> None:
        """Add a planar scan at its final pose T_session_base."""
        if self._last is not None:
            step = self._last.inverse() @ pose
            self._travel_m += math.hypot(step.x, step.y)
        self._last = pose
        if not self._maps or self._travel_m - self._maps[-1][1] > self._parameters.map_travel_m:
            middle = np.array([pose.x, pose.y])
            low_m, high_m = middle - self._half_m, middle + self._half_m
            self._maps.append((PointGrid(low_m, high_m, parameters=self._matching), self._travel_m))
        if len(self._maps) > 2:
            del self._maps[0]
        for grid, _ in self._maps:
            grid.add(pose.apply(planar_scan.hits_m), planar_scan.normal_rad + pose.yaw)
            grid.clear(pose.apply(planar_scan.free_polygon()))

    def restart(self) -> None:
        """Forget the maps: the next scan begins new ones."""
        self._maps, self._last = [], None
