"""Queries of which the true place is known, and floors of other buildings.

The map of a real log is drawn at the poses of the ground truth, so that mapping has no part in it; the
queries are its later parts, registered as a user's would be. DATA holds `laser/NAME.mcap` and
`laser/NAME_corrected.tum`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.io.nav2_map import load_map
from pc2grid.model import OCCUPIED, OccupancyGrid
from pc2grid.simulate import office_floorplan
from pc2grid.simulate.clutter import covered, place_clutter
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.peers.site import recorded_site
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


def queries_of(session: RegisteredSession, config: Config) -> Iterator[tuple[QueryMap, SE2]]:
    """The query after each of `TRAVELS_M`: what has been seen, and its true frame in the plan.

    Without those whose true pose is not known.
    """
    query, path_m = Query(config, config.relocalize), session.path_m()
    asked_after = np.array([np.argmax(path_m >= d) for d in TRAVELS_M if d <= path_m.max(initial=0.0)])
    for number, (registered, planar_scan, _) in enumerate(session.scans()):
        if not session.lost[number]:
            query.add(registered, planar_scan)
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
