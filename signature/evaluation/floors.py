"""Are the floors of a house told apart, and is a query located on the right one?

A house is simulated whose floors have the same plan, with the same or with other furniture. It becomes one
database: of one recording that goes up by stairs or by a lift, or of a recording of each floor whose label
the user gives. Queries drive other routes on each floor.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pc2grid.arrays import F64
from pc2grid.model import SensorKind, Trajectory
from pc2grid.simulate import HouseConfig, SimulationConfig, prepare_house_session, simulate_session
from pc2grid.simulate.config import DepthConfig, LidarConfig
from pc2grid.simulate.session import EPOCH_NS
from signature.config import Config
from signature.database import Label, open_database
from signature.files import convert, relocalize

Way = Literal["stairs", "lift", "logs"]

WAYS: tuple[Way, ...] = ("stairs", "lift", "logs")
"""How a house becomes a database: a recording by stairs, one by a lift, or a recording of each floor."""

_LIDAR = LidarConfig(columns=450, rate_hz=5.0)
"""Half the points and half the scans of the default, which halves the time twice."""
_DEPTH = DepthConfig(rate_hz=5.0)
_MOSTLY = 0.98
"""A session shows a floor if so much of its travel is there: a landing of stairs may count to either. Time
in the shut cabin of a lift shows no floor, and is no travel. Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorTask:
    """One house and the queries in it.

    seed : of the plan, the furniture and the routes. alike : the same furniture in the same places on every
    floor. visits : floors in the order in which the map's recording reaches them. length_m, query_m : travel
    on each visit, of the map and of a query. queries : on each floor.
    """

    seed: int
    way: Way
    alike: bool
    sensor: SensorKind = "lidar"
    visits: tuple[int, ...] = (0, 1, 2)
    length_m: float = 15.0
    query_m: float = 8.0
    queries: int = 2

    @property
    def floors(self) -> tuple[int, ...]:
        """The floors that are visited, from the lowest one."""
        return tuple(sorted(set(self.visits)))


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorResult:
    """What became of a house.

    told_apart : every session is on one floor, every floor has one, no two floors have the same name, and no
    floor has two, if it was visited twice.
    named : the names are the numbers of the floors, which a lift does not show.
    right, wrong : queries located on the right floor, and on a wrong one. ambiguous, not_found : the others.
    misplaced : of the right ones, those that are off by more than half a metre.
    """

    told_apart: bool
    named: bool
    right: int
    wrong: int
    ambiguous: int
    not_found: int
    misplaced: int


@dataclass(frozen=True, slots=True)
class _Part:
    """A session of the database.

    floor : the true one of most of its travel. purity : the share of that. name : of the floor in the label.
    T_house_map : (4, 4), by its first scan.
    """

    session: str
    floor: int
    purity: float
    name: str | None
    T_house_map: F64


def run_floors(task: FloorTask, config: Config = Config()) -> FloorResult:
    """Simulate the house, make its database and ask it."""
    with tempfile.TemporaryDirectory() as folder:
        parts = _build(task, Path(folder), config)
        by_name = {part.session: part for part in parts}
        names = {part.floor: part.name for part in parts}
        counts: Counter[str] = Counter()
        for floor in task.floors:
            for number in range(task.queries):
                status, session, error_m = _ask(task, Path(folder), floor, number, by_name, config)
                if status == "located":
                    assert session is not None
                    status = "right" if by_name[session].floor == floor else "wrong"
                    counts["misplaced"] += status == "right" and error_m > 0.5
                counts[status] += 1
    pure = all(part.purity >= _MOSTLY for part in parts)
    same_floor_same_name = all(names[part.floor] == part.name for part in parts)
    return FloorResult(
        told_apart=pure
        and same_floor_same_name
        and len(set(names.values())) == len(task.floors) == len(names),
        named=all(name == str(floor) for floor, name in names.items()),
        right=counts["right"],
        wrong=counts["wrong"],
        ambiguous=counts["ambiguous"],
        not_found=counts["not_found"],
        misplaced=counts["misplaced"],
    )


def _simulation(task: FloorTask, seed: int, length_m: float) -> SimulationConfig:
    return SimulationConfig(
        length_m=length_m, seed=seed, building_seed=task.seed, clutter=20, lidar=_LIDAR, depth=_DEPTH
    )


def _house(task: FloorTask, visits: tuple[int, ...]) -> HouseConfig:
    ride: Literal["stairs", "lift"] = "lift" if task.way == "lift" else "stairs"
    return HouseConfig(
        visits=visits,
        floors=max(task.visits) + 1,
        ride=ride,
        alike=task.alike,
        furniture_seed=task.seed,
    )


def _build(task: FloorTask, folder: Path, config: Config) -> list[_Part]:
    """Record the house and convert it; the sessions that this makes."""
    database = folder / "house.submaps"
    parts: list[_Part] = []
    for number, visits in enumerate([(k,) for k in task.visits] if task.way == "logs" else [task.visits]):
        house, simulation = _house(task, visits), _simulation(task, 100 + number, task.length_m)
        log = folder / f"log{number}.mcap"
        simulate_session(log, sensor=task.sensor, house=house, config=simulation)
        floor = str(visits[0]) if task.way == "logs" else None
        label = Label(building="house", floor=floor)
        convert(log, database, config, label=label, add=bool(number))
        truth = prepare_house_session(sensor=task.sensor, house=house, config=simulation)
        with open_database(database) as opened:
            for info in opened.sessions():
                if info.name.split("#")[0] != log.stem:
                    continue
                trajectory: Trajectory = opened.trajectory(info.name)
                seconds = (trajectory.stamps_ns - EPOCH_NS) * 1e-9
                on = np.array([truth.floor_at(float(s)) for s in seconds])
                steps_m = np.diff(trajectory.path_m(), prepend=0.0)
                travel_m = np.bincount(on, steps_m)
                most = int(travel_m.argmax())
                T_house_map = truth.pose(float(seconds[0])) @ np.linalg.inv(trajectory.T_session_base[0])
                parts.append(
                    _Part(
                        info.name,
                        most,
                        float(travel_m[most] / travel_m.sum()),
                        info.provenance.label.floor,
                        T_house_map,
                    )
                )
    return parts


def _ask(
    task: FloorTask, folder: Path, floor: int, number: int, parts: dict[str, _Part], config: Config
) -> tuple[str, str | None, float]:
    """The status of the answer to one query, its session, and by how much its place is wrong."""
    simulation = _simulation(task, 1000 + 10 * floor + number, task.query_m)
    house = _house(task, (floor,))
    query = folder / "query.mcap"
    simulate_session(query, sensor=task.sensor, house=house, config=simulation, force=True)
    answer = relocalize(query, folder / "house.submaps", config)
    if answer.T_map_base is None or answer.session is None:
        return answer.status, None, 0.0
    truth = prepare_house_session(sensor=task.sensor, house=house, config=simulation)
    true = truth.pose((answer.stamp_ns - EPOCH_NS) * 1e-9)
    found = parts[answer.session].T_house_map @ answer.T_map_base.lift()
    return answer.status, answer.session, float(np.hypot(*(found - true)[:2, 3]))
