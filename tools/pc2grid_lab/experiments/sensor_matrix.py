"""Maps made by one sensor, queries by another, in simulated buildings.

The experiment is the same for all nine pairs of sensors: a session of each sensor maps the building; other
sessions of each sensor, with other clutter, start and direction, are located in each of the maps after some
metres of travel. The sessions are registered as a user would do it; true poses are only used to judge.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.matching.score import score_fit
from pc2grid.model import OccupancyGrid, Scan, SensorKind
from pc2grid.pipeline import map_scans
from pc2grid.simulate.drive import Drive
from pc2grid_lab.experiments.answers import Answers, localize
from pc2grid_lab.experiments.program import once
from pc2grid_lab.experiments.registered_session import RegisteredSession, register
from pc2grid_lab.experiments.trial import JUDGEMENT, Trial
from pc2grid_lab.experiments.truth import apart
from pc2grid_lab.worlds import WorldConfig, prepare_session
from signature.config import Config
from signature.localization.map_index import MapIndex
from signature.localization.query import QueryMap

SENSORS: tuple[SensorKind, ...] = ("lidar", "laser", "depth")
TRAVELS_M = (1.0, 3.0, 5.0, 8.0, 10.0, 15.0)
"""Metres of travel after which a query is answered."""
MAP_SEED = 1000
"""Map sessions and query sessions never share a seed: other clutter, start, direction and noise."""


PlanMap = tuple[OccupancyGrid, SE2]
"""A map, and T_plan_map: its frame in the floor plan."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorMap:
    """The map of a building by one sensor. T_plan_map : its frame in the floor plan."""

    name: str
    sensor: SensorKind
    T_plan_map: SE2
    index: MapIndex


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanDrives:
    """Maps and drives in floor plans that are made unless they exist.

    setting : what their files are named after: map_length (metres driven to make a map), clutter, rate (scans
        a second), change (share of doors and furniture that differ, 0 if left out). until_m, length_m : a
        query is registered so far, of a simulated drive that long.
    """

    out: Path
    setting: tuple[tuple[str, float], ...]
    until_m: float
    length_m: float

    def file(self, kind: str, *names: object) -> Path:
        """A file of the folder `kind`, named after its building, sensor and so on, and the setting."""
        tag = (f"{key}{value:g}" for key, value in sorted(self.setting))
        return self.out / kind / ".".join([*map(str, names), *tag, "pickle"])

    def simulation(
        self, length_m: float, seed: int, start_m: tuple[float, float] | None = None
    ) -> WorldConfig:
        """Of one drive."""
        setting = dict(self.setting)
        return WorldConfig.model_validate(
            {
                "length_m": length_m,
                "seed": seed,
                "clutter": int(setting["clutter"]),
                "start_m": start_m,
                "change": setting.get("change", 0.0),
                **{sensor: {"rate_hz": setting["rate"]} for sensor in SENSORS},
            }
        )

    @property
    def mapping(self) -> WorldConfig:
        """Of the drive that makes a map."""
        return self.simulation(dict(self.setting)["map_length"], MAP_SEED)

    def map(self, name: str, plan: OccupancyGrid, sensor: SensorKind) -> PlanMap:
        """The map of a plan by one sensor."""
        return once(self.file("maps", name, sensor), partial(map_building, plan, sensor, self.mapping))

    def drive(self, name: str, plan: OccupancyGrid, sensor: SensorKind, seed: int) -> RegisteredSession:
        """A registered query session, which starts somewhere on the path of the mapping one: a query from
        where the mapping robot has never been has no right answer."""

        def registered() -> RegisteredSession:
            way = prepare_session(sensor="laser", grid=plan, config=self.mapping).drive
            config = self.simulation(self.length_m, seed, start_on(way, seed))
            scans = prepare_session(sensor=sensor, grid=plan, config=config).scans()
            return register(scans, Config(), sensor=sensor, until_m=self.until_m)

        return once(self.file("drives", name, sensor, seed), registered)


def start_on(way: Drive, seed: int) -> tuple[float, float]:
    """A random place on a drive, x and y in metres."""
    at_s = np.random.default_rng([seed, MAP_SEED]).uniform(0.0, way.duration_s)
    x, y, _ = way.at(np.array([at_s]))[0].tolist()
    return x, y


def map_building(plan: OccupancyGrid, sensor: SensorKind, simulation: WorldConfig) -> PlanMap:
    """The map of a simulated session in a floor plan.

    Its frame is fitted over the whole trajectory, as for an absolute trajectory error: if it rested on the
    heading of the first scan alone, an error of that heading would move distant places by much.
    """
    true_m: list[tuple[float, float]] = []

    def scans() -> Iterator[Scan]:
        for scan, truth in prepare_session(sensor=sensor, grid=plan, config=simulation).scans():
            true_m.append((truth.x, truth.y))
            yield scan

    grid, trajectory, _ = map_scans(scans(), Config())
    return grid, SE2.fit(trajectory.planar()[:, :2], np.array(true_m))


def query_trials(name: str, seed: int, session: RegisteredSession, maps: Sequence[SensorMap]) -> list[Trial]:
    """One query session in each of `maps`, answered after each of `TRAVELS_M` that it has travelled.

    name : the building of the session. In maps of other buildings there is no right answer; they are located
    for the longest travel only.
    """
    path_m = session.path_m()
    travels_m = [d for d in TRAVELS_M if d <= path_m[-1]]
    # The number of scans after which each distance is reached, made distinct.
    after = np.searchsorted(path_m, travels_m) + 1 - np.arange(len(travels_m))
    after = np.maximum.accumulate(after) + np.arange(len(travels_m))
    trials: list[Trial] = []
    for in_building, first in ((True, 0), (False, len(travels_m) - 1)):
        searched = [m for m in maps if (m.name == name) is in_building]
        if not searched or not travels_m:
            continue
        answers = localize(session.scans(), [m.index for m in searched], after=set(after[first:].tolist()))
        for travel_m, found in zip(travels_m[first:], answers, strict=True):
            about: dict[str, Any] = {
                "query_sensor": session.sensor,
                "seed": seed,
                "travel_m": travel_m,
                "in_building": in_building,
            }
            T_plan_base = SE2(*session.T_world_base[found.scans - 1].tolist())
            trials += [
                Trial(**about, **_judged(sensor_map, found, k, T_plan_base, in_building))
                for k, sensor_map in enumerate(searched)
            ]
    return trials


def _judged(
    sensor_map: SensorMap, found: Answers, k: int, T_plan_base: SE2, in_building: bool
) -> dict[str, Any]:
    """The kth of the answers to a query, compared with the true pose of the base at its last scan."""
    query, answer = found.query, found.answers[k]
    T_map_base = sensor_map.T_plan_map.inverse() @ T_plan_base
    T_map_query = T_map_base @ answer.T_odom_base.inverse()
    mapped = score_fit(sensor_map.index.maps[0].walls, query.walls, T_map_query, np.eye(3)).overlap
    error_m, right = None, False
    if answer.hypotheses:
        error_m, error_rad = apart(T_map_base, answer.hypotheses[0].fit.T_map_query @ answer.T_odom_base)
        right = in_building and error_m <= JUDGEMENT.right_m and error_rad <= JUDGEMENT.right_rad
    return {
        "building": sensor_map.name,
        "map_sensor": sensor_map.sensor,
        "mapped": mapped if in_building else 0.0,
        "status": answer.status,
        "confidence": answer.confidence,
        "right": right,
        "error_m": error_m,
        "rank": _retrieved_rank(sensor_map.index, query, T_map_query) if in_building else -1,
        "look_up_ms": found.elapsed_ms[k],
    }


def _retrieved_rank(index: MapIndex, query: QueryMap, T_map_query: SE2) -> int:
    """Rank of the first place, selected by the signatures, that the robot truly stood next to."""
    rows = index.places.order(query.views, query.center_m, index.config).rows
    off_m = index.places.table.center_m[rows] - T_map_query.apply(np.array([query.center_m]))
    right = np.flatnonzero(np.hypot(*off_m.T) <= JUDGEMENT.retrieved_m)
    return int(right[0]) if len(right) else -1
