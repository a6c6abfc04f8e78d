"""How far do the sensors agree? Maps by one sensor, queries by another, in one simulated building.

The same experiment for all nine pairs: a session of each kind maps the building, other sessions of each
kind, with other clutter, start and direction, are located in each of the maps after some metres of
travel. Registration is done as a user would get it; true poses only judge.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid, Scan, SensorKind, SessionMap
from pc2grid.partition import partition
from pc2grid.pipeline import map_scans
from signature.config import Config
from signature.evaluation.driven import Driven
from signature.evaluation.mapped import Mapped
from signature.evaluation.trial import Trial, judge
from signature.relocalize import Relocalizer, Search

if TYPE_CHECKING:
    from pc2grid.simulate import SimulationConfig

SENSORS: tuple[SensorKind, ...] = ("lidar", "laser", "depth")
DISTANCES_M = (1.0, 3.0, 5.0, 8.0, 10.0, 15.0)


def map_building(
    name: str, plan: OccupancyGrid, sensor: SensorKind, simulation: SimulationConfig, config: Config
) -> tuple[SessionMap, SE2]:
    """Drive through the plan with a sensor: the session's map, and where its frame lies in the plan.

    The frame is fitted over the whole trajectory, as for an absolute trajectory error: the heading of the
    first scan alone would carry a small error far.
    """
    from pc2grid.simulate import iter_session

    truths: list[tuple[float, float]] = []

    def scans() -> Iterator[Scan]:
        for scan, truth in iter_session(sensor=sensor, grid=plan, config=simulation):
            truths.append((truth.x, truth.y))
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
    return session_map, SE2.fit(trajectory.planar()[:, :2], np.array(truths))


def start_of(plan: OccupancyGrid, mapping: SimulationConfig, seed: int) -> tuple[float, float]:
    """Where query session `seed` starts: (x, y) in the plan, anywhere on the way of the session that maps it.

    A query from where the mapping robot has never been has no right answer.
    """
    from pc2grid.simulate import prepare_session

    way = prepare_session(sensor="laser", grid=plan, config=mapping).drive
    rng = np.random.default_rng([seed, mapping.seed])
    x, y, _ = way.at(np.array([rng.uniform(0.0, way.duration_s)]))[0]
    return float(x), float(y)


def query_trials(
    name: str, seed: int, driven: Driven, maps: Sequence[Mapped], distances_m: Sequence[float] = DISTANCES_M
) -> list[Trial]:
    """One query session against all `maps`, asked after each of `distances_m` that it has driven.

    Maps of another building than `name` have no right answer; only the longest distance is asked there.
    """
    own = [m for m in maps if m.name == name]
    relocalizer = Relocalizer(*(m.building for m in own))
    trials: list[Trial] = []
    path_m = driven.path_m()
    left = sorted(d for d in distances_m if d <= path_m[-1])
    for driven_m, (registered, sweep, truth) in zip(path_m, driven.scans(), strict=True):
        relocalizer.add(registered, sweep)
        if not left or driven_m < left[0]:
            continue
        travel_m = left.pop(0)
        begin = time.perf_counter()
        query = relocalizer.query()
        describe_ms = 1000.0 * (time.perf_counter() - begin)
        searches = list(zip(own, relocalizer.searches, strict=True))
        if not left:
            searches += [(m, Search(m.building)) for m in maps if m.name != name]
        for mapped, search in searches:
            begin = time.perf_counter()
            answer = search.answer(query)
            elapsed_ms = describe_ms + 1000.0 * (time.perf_counter() - begin)
            trials.append(
                judge(
                    mapped,
                    query,
                    answer,
                    truth,
                    building=name,
                    query_sensor=driven.sensor,
                    seed=seed,
                    travel_m=travel_m,
                    look_up_ms=elapsed_ms,
                )
            )
    return trials
