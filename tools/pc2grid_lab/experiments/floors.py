"""Are the floors of a house told apart, and is a query located on the right one?

A house is simulated whose floors have the same plan, with the same or with other furniture. It becomes one
database: of one recording that goes up by stairs or by a lift, or of a recording of each floor whose label
the user gives. On each floor one long drive on another route is cut into queries, each of which is a
recording of its own to the program. So a query costs its scans and its answer, and no house of its own.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pc2grid.arrays import F32, F64, freeze
from pc2grid.geometry import SE2
from pc2grid.io.atomic import replace_file
from pc2grid.model import Scan, SensorKind, Trajectory
from pc2grid.pipeline import follow
from pc2grid.simulate import SimulationConfig
from pc2grid.simulate.config import DepthConfig, LaserConfig, LidarConfig
from pc2grid.simulate.session import EPOCH_NS
from pc2grid_lab.experiments.answers import localize
from pc2grid_lab.experiments.calibration import share_by_session
from pc2grid_lab.experiments.program import program_digest
from pc2grid_lab.experiments.stored import write_text
from pc2grid_lab.worlds import HouseConfig, HouseSession, prepare_house_session, simulate_session
from signature.config import Config
from signature.database import Label, open_database
from signature.files import convert, query_config
from signature.localization.answer import Answer
from signature.localization.map_index import MapIndex

Way = Literal["stairs", "lift", "logs"]
FloorStatus = Literal["right", "ambiguous", "not_found", "wrong"]

WAYS: tuple[Way, ...] = ("stairs", "lift", "logs")
"""How a house becomes a database: a recording by stairs, one by a lift, or a recording of each floor."""
STATUSES: tuple[FloorStatus, ...] = ("right", "ambiguous", "not_found", "wrong")

_LIDAR = LidarConfig(columns=450, rate_hz=5.0)
"""Half the points and half the scans of the default, which halves the time twice."""
_DEPTH = DepthConfig(rate_hz=5.0)
_LASER = LaserConfig(rate_hz=5.0)
_MOSTLY = 0.98
"""A session shows a floor if so much of its travel is there: a landing of stairs may count to either. Time
in the shut cabin of a lift shows no floor, and is no travel. Chosen by hand."""
_BETWEEN_M = 1.0
"""Travel from the end of a query to the begin of the next one. By hand."""
_MISPLACED_M = 0.5
"""An answer on the right floor that is off by more is at a wrong place. By hand: half the width of a door."""


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
    queries: int = 6

    @property
    def floors(self) -> tuple[int, ...]:
        """The floors that are visited, from the lowest one."""
        return tuple(sorted(set(self.visits)))

    @property
    def house_name(self) -> str:
        """A name for the house and its database, whatever the queries are."""
        visits, furniture = "".join(map(str, self.visits)), "alike" if self.alike else "differs"
        return f"{self.sensor}.{self.way}.{visits}.{furniture}.{self.seed}.{self.length_m:g}m"


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorAnswer:
    """What became of a query.

    floor : the true one. status : right and wrong are said of the floor it was located on. error_m : of the
    place of an answer on the right floor. poses : T_map_query, for each session with a hypothesis the best
    one. T_house_query : the true one. walls_m : (N, 2) what the query saw of walls, in its own frame.
    """

    floor: int
    status: FloorStatus
    confidence: float
    session: str | None
    error_m: float | None
    poses: dict[str, SE2]
    T_house_query: SE2
    walls_m: F32

    def __post_init__(self) -> None:
        freeze(self, "walls_m", np.float32, (None, 2))

    @property
    def misplaced(self) -> bool:
        """Located on the right floor, at a wrong place there."""
        return self.error_m is not None and self.error_m > _MISPLACED_M


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorResult:
    """What became of a house.

    told_apart : every session is on one floor, every floor has one, no two floors have the same name, and no
    floor has two, if it was visited twice.
    named : the names are the numbers of the floors, which a lift does not show.
    floors : the true floor of each session. names : what the database calls it. frames : T_house_map.
    """

    told_apart: bool
    named: bool
    floors: dict[str, int]
    names: dict[str, str | None]
    frames: dict[str, SE2]
    answers: tuple[FloorAnswer, ...]

    def count(self, status: FloorStatus) -> int:
        """How many queries were answered so."""
        return sum(answer.status == status for answer in self.answers)

    @property
    def misplaced(self) -> int:
        """How many of the right answers are at a wrong place."""
        return sum(answer.misplaced for answer in self.answers)

    def save(self, path: Path) -> None:
        """Write the result to a JSON file, completely or not at all."""
        document = {
            "told_apart": self.told_apart,
            "named": self.named,
            "floors": self.floors,
            "names": self.names,
            "frames": _rows(self.frames),
            "answers": [
                {
                    "floor": answer.floor,
                    "status": answer.status,
                    "confidence": answer.confidence,
                    "session": answer.session,
                    "error_m": answer.error_m,
                    "poses": _rows(answer.poses),
                    "T_house_query": _row(answer.T_house_query),
                    "walls_m": np.round(answer.walls_m.astype(np.float64), 2).tolist(),
                }
                for answer in self.answers
            ],
        }
        write_text(path, json.dumps(document))

    @staticmethod
    def load(path: Path) -> FloorResult:
        """Read a file that `save` has written."""
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        answers = tuple(
            FloorAnswer(
                **{
                    **answer,
                    "poses": _poses(answer["poses"]),
                    "T_house_query": SE2(*answer["T_house_query"]),
                    "walls_m": np.array(answer["walls_m"], np.float32).reshape(-1, 2),
                }
            )
            for answer in document["answers"]
        )
        return FloorResult(**{**document, "frames": _poses(document["frames"]), "answers": answers})


def _row(pose: SE2) -> list[float]:
    return [pose.x, pose.y, pose.yaw]


def _rows(poses: dict[str, SE2]) -> dict[str, list[float]]:
    return {name: _row(pose) for name, pose in poses.items()}


def _poses(rows: dict[str, list[float]]) -> dict[str, SE2]:
    return {name: SE2(*row) for name, row in rows.items()}


@dataclass(frozen=True, slots=True)
class _Part:
    """A session of the database.

    floor : the true one of most of its travel. purity : the share of that. name : of the floor in the label.
    T_house_map : fitted over its trajectory.
    """

    floor: int
    purity: float
    name: str | None
    T_house_map: SE2


def database_file(task: FloorTask, folder: Path) -> Path:
    """The database of a house, as this version of the program makes it."""
    return folder / f"{task.house_name}.{program_digest()}.submaps"


def stored_floors(task: FloorTask, folder: Path) -> FloorResult:
    """What became of a house; computed unless this version of the program has stored it in the folder."""
    queries = f"{task.query_m:g}m.{task.queries}"
    file = folder / f"{task.house_name}.{queries}.{program_digest()}.json"
    if not file.exists():
        run_floors(task, database_file(task, folder)).save(file)
    return FloorResult.load(file)


def run_floors(task: FloorTask, database: Path, config: Config = Config()) -> FloorResult:
    """Ask the database of a house; simulate and convert the house first if the file does not exist."""
    if not database.exists():
        _build(task, database, config)
    parts = _parts(task, database)
    answers = tuple(answer for floor in task.floors for answer in _ask(task, database, floor, parts, config))
    names = {part.floor: part.name for part in parts.values()}
    return FloorResult(
        told_apart=_told_apart(task, parts.values()),
        named=all(name == str(floor) for floor, name in names.items()),
        floors={name: part.floor for name, part in parts.items()},
        names={name: part.name for name, part in parts.items()},
        frames={name: part.T_house_map for name, part in parts.items()},
        answers=answers,
    )


def _told_apart(task: FloorTask, parts: Collection[_Part]) -> bool:
    pairs = {(part.floor, part.name) for part in parts}
    floors, names = {floor for floor, _ in pairs}, {name for _, name in pairs}
    one_to_one = len(pairs) == len(floors) == len(names) == len(task.floors)
    return one_to_one and all(part.purity >= _MOSTLY for part in parts)


def share_of(
    results: Sequence[tuple[FloorTask, FloorResult]], statuses: Iterable[FloorStatus]
) -> tuple[float, float, float]:
    """The share of the queries that were answered so, and its 5th and 95th percentile when whole plans are
    drawn anew: houses with one plan, and queries in a house, are not independent."""
    queries = [(str(task.seed), answer) for task, result in results for answer in result.answers]
    counted = set(statuses)
    yes = np.array([answer.status in counted for _, answer in queries])
    return share_by_session([plan for plan, _ in queries], yes)


def _simulation(task: FloorTask, seed: int, length_m: float) -> SimulationConfig:
    return SimulationConfig(
        length_m=length_m,
        seed=seed,
        building_seed=task.seed,
        clutter=20,
        lidar=_LIDAR,
        depth=_DEPTH,
        laser=_LASER,
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


def _recordings(task: FloorTask) -> Iterator[tuple[str, HouseConfig, SimulationConfig]]:
    """The name of each recording that becomes the database, and what is recorded."""
    for number, visits in enumerate([(k,) for k in task.visits] if task.way == "logs" else [task.visits]):
        yield f"log{number}", _house(task, visits), _simulation(task, 100 + number, task.length_m)


def _build(task: FloorTask, database: Path, config: Config) -> None:
    """Record the house and convert it."""
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "house.submaps"
        for name, house, simulation in _recordings(task):
            log = Path(folder) / f"{name}.mcap"
            simulate_session(log, sensor=task.sensor, house=house, config=simulation)
            floor = str(house.visits[0]) if task.way == "logs" else None
            convert(log, made, config, label=Label(building="house", floor=floor), add=made.exists())
            log.unlink()
        with replace_file(database) as draft:
            shutil.copyfile(made, draft)


def _parts(task: FloorTask, database: Path) -> dict[str, _Part]:
    """The sessions of a database by name, with what is true of them."""
    truths = {
        name: prepare_house_session(sensor=task.sensor, house=house, config=simulation)
        for name, house, simulation in _recordings(task)
    }
    with open_database(database) as opened:
        return {
            info.name: _part(
                opened.trajectory(info.name),
                info.provenance.label.floor,
                truths[info.name.split("#")[0]],
            )
            for info in opened.sessions()
        }


def _part(trajectory: Trajectory, name: str | None, truth: HouseSession) -> _Part:
    seconds = ((trajectory.stamps_ns - EPOCH_NS) * 1e-9).tolist()
    steps_m = np.diff(trajectory.path_m(), prepend=0.0)
    travel_m = np.bincount([truth.floor_at(s) for s in seconds], steps_m)
    true_m: F64 = np.array([truth.pose(s)[:2, 3] for s in seconds])
    most = int(travel_m.argmax())
    return _Part(
        most,
        float(travel_m[most] / travel_m.sum()),
        name,
        SE2.fit(trajectory.planar()[:, :2], true_m),
    )


def _ask(
    task: FloorTask, database: Path, floor: int, parts: dict[str, _Part], config: Config
) -> Iterator[FloorAnswer]:
    """The answers to the queries on a floor, which are cut from one drive there."""
    drive_m = task.queries * (task.query_m + _BETWEEN_M)
    session = prepare_house_session(
        sensor=task.sensor, house=_house(task, (floor,)), config=_simulation(task, 1000 + floor, drive_m)
    )
    with open_database(database) as opened:
        settings = query_config(opened, config)
        index = MapIndex.of(opened, settings)
        for scans in cut_queries(session, task):
            (found,) = localize(follow(scans, settings), [index])
            (answer,) = found.answers
            true = SE2.from_matrix(session.pose((answer.stamp_ns - EPOCH_NS) * 1e-9))
            yield _judged(answer, found.query.walls.points_m.astype(np.float32), floor, true, parts)


def cut_queries(session: HouseSession, task: FloorTask) -> Iterator[list[Scan]]:
    """The scans of one query after the other, cut from a drive; only these are in memory."""
    scans: list[Scan] = []
    travel_m, number, last = 0.0, 0, None
    for scan, T_house_base in session.scans():
        here = T_house_base[:2, 3]
        travel_m += 0.0 if last is None else float(np.hypot(*(here - last)))
        last = here
        begin_m = number * (task.query_m + _BETWEEN_M)
        if begin_m <= travel_m < begin_m + task.query_m:
            scans.append(scan)
        elif scans:
            yield scans
            scans, number = [], number + 1
            if number == task.queries:
                return
    if scans:
        yield scans


def _judged(answer: Answer, walls_m: F32, floor: int, true: SE2, parts: dict[str, _Part]) -> FloorAnswer:
    """An answer beside the truth. true : T_house_base at the query's last scan."""
    poses: dict[str, SE2] = {}
    for hypothesis in answer.hypotheses:
        poses.setdefault(answer.sessions[hypothesis.session_index], hypothesis.fit.T_map_query)
    judged = FloorAnswer(
        floor=floor,
        status="ambiguous" if answer.status == "ambiguous" else "not_found",
        confidence=answer.confidence,
        session=answer.session,
        error_m=None,
        poses=poses,
        T_house_query=true @ answer.T_odom_base.inverse(),
        walls_m=walls_m,
    )
    if answer.session is None or answer.T_map_base is None:
        return judged
    part = parts[answer.session]
    if part.floor != floor:
        return replace(judged, status="wrong")
    found = part.T_house_map @ answer.T_map_base
    return replace(judged, status="right", error_m=float(np.hypot(found.x - true.x, found.y - true.y)))
