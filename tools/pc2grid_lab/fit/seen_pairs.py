"""Pairs of descriptions of one place by two sensors, from which the weights of the signatures are learned."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from pc2grid.arrays import F32, F64, BoolGrid
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import look_around
from pc2grid.submaps.partition import submap_centers
from pc2grid_lab.experiments.sensor_matrix import SensorMap
from signature.config import Config
from signature.localization.query import QueryMap, best_observed
from signature.seen import seen_signatures
from signature.seen_likelihood import Pairs
from signature.seen_places import PROFILE_BEARINGS, viewpoints_of

_VIEWS = 16
"""Views of each query, closer together than those that are looked up."""
_VIEW_SPACING_M = 0.6
_EVERY = 3
"""Viewpoints of other places: one of so many is as good as all."""
_BESIDE_M = 0.3
"""The place of the map lies up to so far from the view along each axis: places are a metre apart."""


def pairs_of(
    queries: Iterable[tuple[QueryMap, SE2, Sequence[SensorMap]]],
    floors: Sequence[OccupancyGrid],
    config: Config,
    *,
    seed: int = 0,
) -> Pairs:
    """Views of queries, and what the maps show at the same points.

    queries : each with its true frame in the plan, and the maps of that plan. floors : maps of other
    buildings, taken at their viewpoints.
    """
    rng = np.random.default_rng(seed)
    sight_m = config.partition.radius_m
    closer = config.relocalize.model_copy(update={"views": _VIEWS, "view_spacing_m": _VIEW_SPACING_M})

    def described(grid: OccupancyGrid, points_m: F64 | F32) -> F32:
        at_m = points_m.astype(np.float64)
        return seen_signatures(*look_around(grid, at_m, sight_m, bearings=PROFILE_BEARINGS), sight_m)

    found: list[F32] = []
    same: list[F32] = []
    for query, T_plan_query, maps in queries:
        if not query.views:
            continue
        path_m = np.array([view.center_m for view in query.views])
        views_m = np.array(best_observed(query.grid, path_m, sight_m, closer))
        views = described(query.grid, views_m)
        for sensor_map in maps:
            grid = sensor_map.index.grids[0]
            there = (sensor_map.T_plan_map.inverse() @ T_plan_query).apply(views_m)
            there = there + rng.uniform(-_BESIDE_M, _BESIDE_M, there.shape)
            cells = grid.to_cell(there)
            free: BoolGrid = np.all((cells >= 0) & (cells < grid.cells.shape), axis=1)
            free[free] = grid.free[cells[free, 0], cells[free, 1]]
            if free.any():
                found.append(views[free])
                same.append(described(grid, there[free]))
    other = [
        described(grid, viewpoints_of(grid, submap_centers(grid, config.partition))[0][::_EVERY])
        for grid in floors
    ]
    return Pairs(np.concatenate(found), np.concatenate(same), np.concatenate(other))
