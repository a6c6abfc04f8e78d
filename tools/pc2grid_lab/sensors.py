"""`pc2grid compare sensors`: maps made by one sensor, queries by another, in simulated buildings.

The experiment is the same for all nine pairs of sensors: a session of each sensor maps the building; other
sessions of each sensor, with other clutter, start and direction, are located in each of the maps after some
metres of travel. The sessions are registered as a user would do it; true poses are only used to judge.

Registering a session takes far longer than locating it. It is registered once and kept, however many maps it
is located in and however many programs are compared on it.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.estimation.tracker import follow
from pc2grid.geometry import F64, SE2
from pc2grid.io.maps import load_map
from pc2grid.matching.score import score_fit
from pc2grid.model import Health, OccupancyGrid, RegisteredScan, Scan, SensorKind, Trajectory
from pc2grid.simulate import SimulationConfig, prepare_session
from pc2grid.simulate.drive import Drive
from pc2grid.submaps.submaps import partition
from pc2grid_cli.console import Console, json_text
from pc2grid_cli.output import make_folder
from pc2grid_lab.commands import CompareSensors
from pc2grid_lab.pages import Cell, print_cells
from pc2grid_lab.recordings.catalogue import MAP_DRIVE
from pc2grid_lab.recordings.table import QueryRow, counts_of
from pc2grid_lab.runner import grouped, in_processes, names_of, once, write_text
from pc2grid_lab.truth import AHEAD_M, JUDGEMENT, apart, fit_frame, is_right
from signature.config import Config
from signature.localization.localizer import Localizer
from signature.paper import SignatureTable, describe
from signature.places.map_index import MapIndex
from signature.places.query import QueryMap
from signature.session.build import map_scans

SENSORS: tuple[SensorKind, ...] = ("lidar", "laser", "depth")
TRAVELS_M = (1.0, 3.0, 5.0, 8.0, 10.0, 15.0)
"""Metres of travel after which a query is answered."""
RECALL_AT = (1, 5, 20)
"""Numbers of retrieved places for which the recall is given."""
RETRIEVED_M = 1.0
"""A retrieved place is right within this of the true position of the view that retrieved it; by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredSession:
    """N scans of one session.

    planar_scans : one for each scan. trajectory : as registered, in the plane; a scan is fine or lost.
    T_world_base : (N, 3) true x, y, yaw, in the frame of the floor plan or of the ground truth; NaN where the
    truth is not known.
    """

    sensor: SensorKind
    planar_scans: tuple[PlanarScan, ...]
    trajectory: Trajectory
    T_world_base: F64

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Return (N,) whether registration was lost."""
        return np.array([health is Health.LOST for health in self.trajectory.health], bool)

    def T_world_odom(self, count: int | None = None) -> SE2:
        """Return the true pose of the session's frame, by the end of the session, or of its first scans.

        It is fitted over the scans of the last `AHEAD_M` whose true pose is known, because the heading of a
        single scan, taken while the robot turns, may be wrong by some degrees. Scans from before registration
        was lost are left out: the motion since is not known. (Unless no other pose is known.)
        """
        path_m, poses = self.trajectory.path_m(), list(self.trajectory.poses())[:count]
        known = np.flatnonzero(~np.isnan(self.T_world_base[:count, 0]))
        lost = np.flatnonzero(self.lost[:count])
        first = (
            min(lost[-1] + 1, len(poses) - 1) if len(lost) else 0
        )  # a lost last scan is a query of its own
        if known[-1] >= first:
            known = known[known >= first]
        known = known[path_m[known] >= path_m[known[-1]] - AHEAD_M]
        return fit_frame([(poses[k], SE2(*self.T_world_base[k].tolist())) for k in known], AHEAD_M)

    def scans(self) -> Iterator[tuple[RegisteredScan, PlanarScan]]:
        """Yield each scan (without its points) and its planar scan, in order of time."""
        no_points, own = np.empty((0, 3), np.float32), self.trajectory
        for planar_scan, T, health in zip(self.planar_scans, own.T_session_base, own.health, strict=True):
            scan = Scan(
                stamp_ns=planar_scan.stamp_ns, points_m=no_points, T_base_sensor=np.eye(4), sensor=self.sensor
            )
            yield RegisteredScan(scan=scan, T_session_base=T, health=health), planar_scan


def register(
    scans: Iterable[tuple[Scan, SE2 | None]],
    config: Config,
    *,
    sensor: SensorKind,
    until_m: float = math.inf,
    see: Callable[[RegisteredScan], object] = lambda registered: None,
) -> RegisteredSession:
    """Register scans with the settings of a user, and stop after `until_m` of travel.

    scans : each with its true pose, None where it is not known; registration does not get it.
    see : called with each scan, whose points are not kept here.
    """
    truths: list[tuple[float, float, float]] = []

    def without_truth() -> Iterator[Scan]:
        for scan, truth in scans:
            truths.append((truth.x, truth.y, truth.yaw) if truth else (math.nan,) * 3)
            yield scan

    planar_scans: list[PlanarScan] = []
    poses: list[SE2] = []
    health: list[Health] = []
    travel_m = 0.0
    for registered, planar_scan in follow(without_truth(), config):
        planar_scans.append(planar_scan)
        poses.append(SE2.from_matrix(registered.T_session_base))
        health.append(Health.LOST if registered.health is Health.LOST else Health.FINE)
        see(registered)
        travel_m += apart(*poses[-2:])[0] if len(poses) > 1 else 0.0
        if travel_m >= until_m:
            break
    trajectory = Trajectory(
        stamps_ns=np.array([planar_scan.stamp_ns for planar_scan in planar_scans], np.int64),
        T_session_base=np.array([pose.lift() for pose in poses]).reshape(-1, 4, 4),
        health=tuple(health),
    )
    return RegisteredSession(
        sensor=sensor,
        planar_scans=tuple(planar_scans),
        trajectory=trajectory,
        T_world_base=np.array(truths[: len(poses)], np.float64).reshape(-1, 3),
    )


def index_of(name: str, grid: OccupancyGrid, config: Config) -> MapIndex:
    """Return a database of one map."""
    submaps = partition(grid, config.partition)
    signatures = [describe(submap, config.signature) for submap in submaps]
    centers_m = [submap.center_m for submap in submaps]
    return MapIndex([name], lambda _: grid, SignatureTable.of(signatures, centers_m), config, config)


PlanMap = tuple[OccupancyGrid, SE2]
"""A map, and T_plan_map: its frame in the floor plan."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanDrives:
    """Maps and drives in floor plans that are made unless they exist.

    map_length : metres driven to make a map. rate : scans a second. travel : metres that a query is
        registered at most.
    """

    out: Path
    clutter: int
    map_length: float
    rate: float
    travel: float

    def file(self, kind: str, *names: object) -> Path:
        """Return a file of the folder `kind`, named after its building, sensor and so on, and the setting."""
        tag = (f"{key}{getattr(self, key):g}" for key in ("clutter", "map_length", "rate", "travel"))
        return self.out / kind / ".".join([*map(str, names), *tag, "pickle"])

    def simulation(
        self, length_m: float, seed: int, start_m: tuple[float, float] | None = None
    ) -> SimulationConfig:
        """Return the configuration of one drive."""
        one = {"length_m": length_m, "seed": seed, "clutter": self.clutter, "start_m": start_m}
        return SimulationConfig.model_validate(one | {sensor: {"rate_hz": self.rate} for sensor in SENSORS})

    @property
    def mapping(self) -> SimulationConfig:
        """Return the configuration of the drive that makes a map."""
        return self.simulation(self.map_length, MAP_DRIVE.seed)

    def map(self, plan: Path, sensor: SensorKind) -> PlanMap:
        """Return the map of a plan by one sensor."""
        file = self.file("maps", plan.stem, sensor)
        return once(file, lambda: map_building(load_map(plan), sensor, self.mapping))

    def drive(self, plan: Path, sensor: SensorKind, seed: int) -> RegisteredSession:
        """Return a registered query session, which starts somewhere on the path of the mapping one: a query
        from where the mapping robot has never been has no right answer."""

        def registered() -> RegisteredSession:
            grid = load_map(plan)
            way = prepare_session(sensor="laser", grid=grid, config=self.mapping).drive
            config = self.simulation(self.travel + 3.0, seed, start_on(way, seed))
            scans = prepare_session(sensor=sensor, grid=grid, config=config).scans()
            return register(scans, Config(), sensor=sensor, until_m=self.travel)

        return once(self.file("drives", plan.stem, sensor, seed), registered)


def start_on(way: Drive, seed: int) -> tuple[float, float]:
    """Return a random place on a drive, x and y in metres."""
    at_s = np.random.default_rng([seed, MAP_DRIVE.seed]).uniform(0.0, way.duration_s)
    x, y, _ = way.at(np.array([at_s]))[0].tolist()
    return x, y


def map_building(plan: OccupancyGrid, sensor: SensorKind, simulation: SimulationConfig) -> PlanMap:
    """Return the map of a simulated session in a floor plan.

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


@dataclass(frozen=True, slots=True)
class Trial:
    """The judged answer to a query of one sensor in the map of another, or in that of another plan.

    row.rank is that of the first right place among those that the signatures retrieve.
    """

    map_sensor: SensorKind
    query_sensor: SensorKind
    in_building: bool
    row: QueryRow


@cache
def _mapped(drives: PlanDrives, plan: Path, sensor: SensorKind) -> tuple[MapIndex, SE2]:
    """Return the map of a plan as a database, and T_plan_map."""
    grid, T_plan_map = drives.map(plan, sensor)
    return index_of(f"{plan.stem}-{sensor}", grid, Config()), T_plan_map


def _locate(
    drives: PlanDrives, seed: int, plan: Path, sensor: SensorKind, plans: Sequence[Path]
) -> list[Trial]:
    """Locate one query session in the maps of its own plan, and at its end in those of one other."""

    def located() -> list[Trial]:
        others = [p for p in plans if p != plan]
        session = drives.drive(plan, sensor, seed)
        asked = [(plan, True), *((p, False) for p in others[seed % max(len(others), 1) :][:1])]
        return [
            Trial(map_sensor, sensor, own, row)
            for where, own in asked
            for map_sensor in SENSORS
            for row in located_rows(session, *_mapped(drives, where, map_sensor), own)
        ]

    return once(drives.file("trials", plan.stem, sensor, seed), located)


def located_rows(
    session: RegisteredSession, index: MapIndex, T_plan_map: SE2, own: bool
) -> Iterator[QueryRow]:
    """Locate a session after each of `TRAVELS_M` that it has travelled, in another plan after the last one,
    and judge the answers. own : whether the map is of its plan; if not, no answer is right."""
    path_m = session.trajectory.path_m()
    travels_m = [d for d in TRAVELS_M if d <= path_m[-1]]
    # The number of scans after which each distance is reached, made distinct.
    after = np.searchsorted(path_m, travels_m) + 1 - np.arange(len(travels_m))
    after = np.maximum.accumulate(after) + np.arange(len(travels_m))
    due = dict(zip(after.tolist(), travels_m, strict=True))
    localizer = Localizer(index)
    for count, scan in enumerate(session.scans(), start=1):
        begin = time.perf_counter()
        localizer.add(*scan)  # after every metre this is a search, which is then the answer
        if count not in due or not (own or count == after[-1]):
            continue
        answer, query = localizer.answer(), localizer.query.map()
        seconds = time.perf_counter() - begin
        T_map_base = T_plan_map.inverse() @ SE2(*session.T_world_base[count - 1].tolist())
        T_map_query = T_map_base @ answer.T_odom_base.inverse()
        right, error_m = False, None
        if answer.best is not None:
            pose = answer.best.T_map_query @ answer.T_odom_base
            right, error_m = is_right(pose, T_map_base, JUDGEMENT.right_m)
        mapped = own and score_fit(index.map_of(0).walls, query.walls, T_map_query, np.eye(3)).overlap
        yield QueryRow(
            window=count,
            start_s=0.0,
            status=answer.status,
            confidence=answer.confidence,
            travel_m=due[count],
            cpu_s=seconds,
            covered=mapped >= JUDGEMENT.mapped,
            right=own and right,
            error_m=error_m,
            rank=_retrieved_rank(index, query, T_map_query) if own else None,
        )


def _retrieved_rank(index: MapIndex, query: QueryMap, T_map_query: SE2) -> int | None:
    """Return the rank of the first place, selected by the signatures, that the robot truly stood next to."""
    rows = index.places.order(query.views, query.center_m, index.config).rows
    off_m = index.places.table.center_m[rows] - T_map_query.apply(np.array([query.center_m]))
    right = np.flatnonzero(np.hypot(*off_m.T) <= RETRIEVED_M)
    return int(right[0]) if len(right) else None


def matrix(trials: Sequence[Trial]) -> list[Cell]:
    """Return the figures of the trials that lie in the map of their own building, by map sensor, query sensor
    and travel: shares of all, of the located ones (wrong), of the first right place among the first
    `RECALL_AT` retrieved ones; errors of those that are located and right, metres."""
    groups = grouped(
        ((trial.map_sensor, trial.query_sensor, trial.row.travel_m), trial.row)
        for trial in trials
        if trial.in_building and trial.row.covered and trial.row.travel_m is not None
    )
    names = ("map_sensor", "query_sensor", "travel_m")
    return [{**dict(zip(names, key, strict=True)), **_figures(groups[key])} for key in sorted(groups)]


def _figures(rows: Sequence[QueryRow]) -> Cell:
    counts, statuses, count = counts_of(rows), Counter(row.status for row in rows), len(rows)
    errors_m = [r.error_m for r in rows if r.outcome == "right" and r.error_m is not None]
    median_m, p95_m = np.percentile(errors_m, (50, 95)).tolist() if errors_m else (None, None)
    ranks = [math.inf if row.rank is None else row.rank for row in rows]
    return {
        "trials": count,
        "located_right": counts["right"] / count,
        "wrong": counts["wrong"] / max(counts["located"], 1),
        "ambiguous": statuses["ambiguous"] / count,
        "not_found": statuses["not_found"] / count,
        "recall": [sum(rank < k for rank in ranks) / count for k in RECALL_AT],
        "median_error_m": median_m,
        "p95_error_m": p95_m,
        "look_up_ms": 1000.0 * float(np.median([row.cpu_s for row in rows])),
    }


def compare_sensors(given: CompareSensors, terminal: Console) -> None:
    """Map the plans, locate the sessions, and write the table."""
    plans, out = given.plans, given.out
    setting = {name: getattr(given, name) for name in ("map_length", "clutter", "rate", "travel")}
    names = names_of(plans)
    make_folder(out)
    drives = PlanDrives(out=out, **setting)
    mapped = [(drives, *one) for one in product(plans, SENSORS)]
    in_processes(PlanDrives.map, mapped, jobs=given.jobs, progress=terminal.progress("map"))
    seeds = range(given.seed, given.seed + given.queries)
    asked = [(drives, *one, plans) for one in product(seeds, plans, SENSORS)]
    found = in_processes(_locate, asked, jobs=given.jobs, progress=terminal.progress("locate"))
    trials = [trial for some in found for trial in some]
    cells, elsewhere = matrix(trials), Counter(t.row.status for t in trials if not t.in_building)
    document = {
        "plans": names,
        "queries": given.queries,
        "setting": {**setting, "seed": given.seed},
        "cells": cells,
        "outside_the_map": sum(t.in_building and not t.row.covered for t in trials),
        "elsewhere": dict(sorted(elsewhere.items())),
    }
    write_text(out / "matrix.json", json_text(document) + "\n")
    print_cells("queries that lie in the map, by metres driven", 2, cells)
    if elsewhere:
        refused = elsewhere["not_found"]
        print(f"queries from another building: {refused} of {elsewhere.total()} answered not_found")
    print(out / "matrix.json")
