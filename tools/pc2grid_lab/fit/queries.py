"""Queries of which the true place is known, and pairs of descriptions of one place.

The weights of the signatures are learned from them.

The map of a real log is drawn at the poses of the ground truth, so that mapping has no part in it; the
queries are its later parts, registered as a user's would be. DATA holds `laser/NAME.mcap` and
`laser/NAME_corrected.tum`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pc2grid.arrays import F32, F64, BoolGrid
from pc2grid.geometry import SE2
from pc2grid.io.nav2_map import load_map
from pc2grid.model import OCCUPIED, OccupancyGrid
from pc2grid.simulate import office_floorplan
from pc2grid.simulate.clutter import covered, place_clutter
from pc2grid.submaps.isovist import look_around
from pc2grid.submaps.partition import submap_centers
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.experiments.sensor_matrix import PlanMap
from pc2grid_lab.peers.site import recorded_site
from signature.config import Config
from signature.localization.query import Query, QueryMap, best_observed
from signature.seen import seen_signatures
from signature.seen_likelihood import Pairs
from signature.seen_places import PROFILE_BEARINGS, viewpoints_of

TRAVELS_M = (1.0, 3.0, 8.0)
"""Metres of travel after which a query is asked."""
_VIEWS = 16
"""Views of each query, closer together than those that are looked up."""
_EVERY = 3
"""Viewpoints of other places: one of so many is as good as all."""
_BESIDE_M = 0.3
"""The place of the map lies up to so far from the view along each axis: places are a metre apart."""
_VIEW_SPACING_M = 2.0 * _BESIDE_M


def office_floor(seed: int, clutter: int = 30) -> OccupancyGrid:
    """An office floor of 36 x 26 to 59 x 39 m, with things standing about, as a map that knows everything."""
    rng = np.random.default_rng(seed)
    plan = office_floorplan(seed, float(rng.integers(36, 60)), float(rng.integers(26, 40)))
    things = place_clutter(plan, clutter, rng, robot_m=0.35)
    cells = plan.cells.copy()
    cells[covered(plan, things) & (plan.cells >= 0)] = OCCUPIED
    return replace(plan, cells=cells)


def queries_of(session: RegisteredSession, config: Config) -> Iterator[tuple[QueryMap, SE2]]:
    """The query after each of `TRAVELS_M`: what has been seen, and its true frame in the plan.

    Without those whose true pose is not known.
    """
    query, path_m = Query(config, config.relocalize), session.path_m()
    asked_after = np.array([np.argmax(path_m >= d) for d in TRAVELS_M if d <= path_m.max(initial=0.0)])
    for number, scan in enumerate(session.scans()):
        if not session.lost[number]:
            query.add(*scan)
        so_far = session.first(number + 1)
        for _ in np.flatnonzero(asked_after == number):
            if not so_far.lost.all() and not np.isnan(so_far.T_world_base).all():
                yield query.map(), so_far.T_world_odom()


MAPPED_S = {"fr079": 600.0, "intel": 900.0, "csail": 250.0, "killian": 900.0}
"""Seconds of each log that become the map."""

Drawn = tuple[OccupancyGrid, list[RegisteredSession]]
"""The map of the first part of a log, and its later parts as registered queries."""


def read(data: Path, name: str, queries: int, kept: Path, config: Config) -> Drawn:
    """The map of the first part of a log, and its later parts as registered queries; `kept` has them."""
    log = data / "laser" / f"{name}.mcap"
    travel_m, mapped_s = TRAVELS_M[-1] + 2.0, MAPPED_S[name]
    site = recorded_site(log, kept / name, config, queries=queries, travel_m=travel_m, mapped_s=mapped_s)
    sessions = [RegisteredSession.load(site.stem(number).with_suffix(".pickle")) for number in site.queries()]
    return load_map(site.map_stem.with_suffix(".yaml")), sessions


Asked = tuple[QueryMap, SE2, Sequence[PlanMap]]
"""A query, its true frame in the plan, and the maps of that plan."""


def pairs_of(
    queries: Iterable[Asked],
    floors: Sequence[OccupancyGrid],
    config: Config,
) -> Pairs:
    """Views of queries, and what the maps show at the same points.

    floors : maps of other buildings, taken at their viewpoints.
    """
    rng = np.random.default_rng(0)
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
        for grid, T_plan_map in maps:
            there = (T_plan_map.inverse() @ T_plan_query).apply(views_m)
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
