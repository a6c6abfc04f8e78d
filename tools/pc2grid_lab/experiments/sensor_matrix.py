"""Maps made by one sensor, queries by another, in simulated buildings.

The experiment is the same for all nine pairs of sensors: a session of each sensor maps the building; other
sessions of each sensor, with other clutter, start and direction, are located in each of the maps after some
metres of travel. The sessions are registered as a user would do it; true poses are only used to judge.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid, Scan, SensorKind, SessionMap
from pc2grid.pipeline import map_scans
from pc2grid.simulate import Building
from pc2grid.submaps.partition import partition
from pc2grid_lab.experiments.answers import Answers, localize
from pc2grid_lab.experiments.judgement import judge
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.trial import Trial
from pc2grid_lab.worlds import WorldConfig, iter_session, prepare_session
from signature.config import Config

SENSORS: tuple[SensorKind, ...] = ("lidar", "laser", "depth")
TRAVELS_M = (1.0, 3.0, 5.0, 8.0, 10.0, 15.0)
"""Metres of travel after which a query is answered."""


def map_building(
    name: str,
    plan: OccupancyGrid | Building,
    sensor: SensorKind,
    simulation: WorldConfig,
    config: Config,
) -> tuple[SessionMap, SE2]:
    """The map of a simulated session in a floor plan, and T_plan_map, the frame of the map in the plan.

    The frame is fitted over the whole trajectory, as for an absolute trajectory error: if it rested on the
    heading of the first scan alone, an error of that heading would move distant places by much.
    """
    true_m: list[tuple[float, float]] = []

    def scans() -> Iterator[Scan]:
        for scan, truth in iter_session(sensor=sensor, grid=plan, config=simulation):
            true_m.append((truth.x, truth.y))
            yield scan

    grid, trajectory, loops = map_scans(scans(), config)
    session_map = SessionMap(
        session=f"{name}-{sensor}",
        sensor=sensor,
        grid=grid,
        submaps=partition(grid, config.partition),
        trajectory=trajectory,
        loops=loops,
    )
    return session_map, SE2.fit(trajectory.planar()[:, :2], np.array(true_m))


def query_start(plan: OccupancyGrid | Building, mapping: WorldConfig, seed: int) -> tuple[float, float]:
    """(x, y) in the plan where query session `seed` starts, drawn from the path of the mapping session.

    A query from where the mapping robot has never been has no right answer.
    """
    path = prepare_session(sensor="laser", grid=plan, config=mapping).drive
    rng = np.random.default_rng([seed, mapping.seed])
    x, y, _ = path.at(np.array([rng.uniform(0.0, path.duration_s)]))[0]
    return float(x), float(y)


def query_trials(
    name: str,
    seed: int,
    session: RegisteredSession,
    maps: Sequence[SensorMap],
    travels_m: Sequence[float] = TRAVELS_M,
) -> list[Trial]:
    """One query session in each of `maps`, answered after each of `travels_m` that it has travelled.

    name : the building of the session. In maps of other buildings there is no right answer; they are located
    for the longest travel only.
    """
    own = [m for m in maps if m.name == name]
    others = [m for m in maps if m.name != name]
    path_m = session.path_m()
    travels_m = sorted(d for d in travels_m if d <= path_m[-1])
    # The number of scans after which each distance is reached, made distinct.
    after = np.searchsorted(path_m, travels_m) + 1 - np.arange(len(travels_m))
    after = np.maximum.accumulate(after) + np.arange(len(travels_m))
    truths = [truth for _, _, truth in session.scans()]
    trials: list[Trial] = []
    for searched_maps, first in ((own, 0), (others, len(travels_m) - 1)):
        if not searched_maps or not travels_m:
            continue
        answers = _localize(session, searched_maps, set(after[first:].tolist()))
        for travel_m, found in zip(travels_m[first:], answers, strict=True):
            for sensor_map, answer, elapsed_ms in zip(
                searched_maps, found.answers, found.elapsed_ms, strict=True
            ):
                trials.append(
                    judge(
                        sensor_map,
                        found.query,
                        answer,
                        truths[found.scans - 1],
                        building=name,
                        query_sensor=session.sensor,
                        seed=seed,
                        travel_m=travel_m,
                        look_up_ms=elapsed_ms,
                    )
                )
    return trials


def _localize(
    session: RegisteredSession, maps: Sequence[SensorMap], after: Collection[int]
) -> Iterator[Answers]:
    scans = ((registered, planar_scan) for registered, planar_scan, _ in session.scans())
    return localize(scans, [m.index for m in maps], after=after)
