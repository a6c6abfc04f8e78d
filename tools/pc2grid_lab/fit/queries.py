"""Queries of which the true place is known, and floors of other buildings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import OCCUPIED, OccupancyGrid
from pc2grid.simulate import office_floorplan
from pc2grid.simulate.clutter import covered, place_clutter
from pc2grid_lab.experiments.registered_session import RegisteredSession
from signature.config import Config
from signature.localization.query import Query, QueryMap

TRAVELS_M = (1.0, 3.0, 8.0)
"""Metres of travel after which a query is asked."""


def office_floor(seed: int, clutter: int = 30) -> OccupancyGrid:
    """An office floor of 36 x 26 to 59 x 39 m, with things standing about, as a map that knows everything."""
    rng = np.random.default_rng(seed)
    plan = office_floorplan(seed, float(rng.integers(36, 60)), float(rng.integers(26, 40)))
    things = place_clutter(plan, clutter, rng, robot_m=0.35)
    cells = plan.cells.copy()
    cells[covered(plan, things) & (plan.cells >= 0)] = OCCUPIED
    return replace(plan, cells=cells)


def queries_of(
    session: RegisteredSession, config: Config, travels_m: Sequence[float] = TRAVELS_M
) -> Iterator[tuple[float, QueryMap, SE2]]:
    """The query after each of `travels_m`: metres, what has been seen, and its true frame in the plan."""
    query = Query(config, config.relocalize)
    path_m = session.path_m()
    due = sorted(d for d in travels_m if len(path_m) and d <= path_m[-1])
    for number, (registered, planar_scan, _) in enumerate(session.scans()):
        if not session.lost[number]:
            query.add(registered, planar_scan)
        while due and path_m[number] >= due[0]:
            if not np.all(session.lost[: number + 1]):
                so_far = replace(
                    session,
                    planar_scans=session.planar_scans[: number + 1],
                    T_odom_base=session.T_odom_base[: number + 1],
                    lost=session.lost[: number + 1],
                    T_world_base=session.T_world_base[: number + 1],
                )
                yield due[0], query.map(), so_far.T_world_odom()
            del due[0]
