"""What a living map is worth in a building that changes, and what it costs.

python -m pc2grid_lab.bench.living FOLDER [--first SEED] [--buildings N] [-o OUT.json]
python -m pc2grid_lab.bench.living FOLDER --cost [--length M]

Offices, each driven through by a laser on four days and joined. Of sixty things ten never move; of the
others twenty are there on each day, drawn anew, and the doors are as each day found them. On a fifth day a
robot asks where it is, in the map of the first day and in the living map of all four. It asks only where the
map of the first day knows the ground around it, so more ground is no advantage.

With --cost: how large a database of ten sessions of one small office is, and how long an answer takes, with
one session, with ten, and with the living map of ten. They lie as they truly do: size and time are asked. A
drive of 50 m knows a third of the office, one of 150 m nearly all: what ten of these add is no more ground.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid, Scan
from pc2grid.pipeline import follow
from pc2grid.simulate import Session, office_floorplan
from pc2grid.simulate.clutter import place_clutter
from pc2grid.simulate.session import plan_session
from pc2grid_lab.bench.joined_fleet import building_of, drives, mapped
from pc2grid_lab.worlds import WorldConfig
from pc2grid_lab.worlds.change import change_building
from signature import living
from signature.config import Config
from signature.database import maintenance, open_database
from signature.database.protocol import BuildingFrame
from signature.localization.answer import Answer
from signature.localization.joining.building import join_sessions
from signature.localization.localizer import Localizer, MapIndex
from signature.sessions import add_sessions, provenance

_FIXED, _MOVED, _PRESENT, _DOORS = 10, 50, 20, 0.6
_DAYS = 4
_LENGTH_M, _QUERIED_M, _RATE_HZ = 180.0, 90.0, 3.0
_LOOKS = {1: 40, 4: 30}
"""Scans of a query, and how many of such queries are asked."""
_AROUND_M, _KNOWN = 1.5, 0.7
"""So much of what is so near to the robot must be known to the map of the first day."""
_RIGHT_M, _RIGHT_RAD = 0.5, math.radians(10.0)
_OLD, _LIVING = "the first day", "living"
_TEN, _COSTED, _ASKED = 10, 6, 12
"""Sessions; scans of a query whose answer is timed; and how many of these."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """A query. error_m, error_rad : of its best hypothesis."""

    building: int
    map: str
    scans: int
    start: int
    located: bool
    error_m: float
    error_rad: float

    @property
    def right(self) -> bool:
        """Whether it was located at the right place."""
        return self.located and self.error_m < _RIGHT_M and self.error_rad < _RIGHT_RAD


def days(building: int) -> Iterator[Session]:
    """The drives of all days; the last one is asked about."""
    plan, robot_m = office_floorplan(building), WorldConfig().drive.clearance_m
    things = place_clutter(plan, _FIXED + _MOVED, np.random.default_rng([building, 77]), robot_m=robot_m)
    for day in range(_DAYS + 1):
        world = WorldConfig.model_validate(
            {
                "length_m": _LENGTH_M if day < _DAYS else _QUERIED_M,
                "seed": 100 * building + day,
                "clutter": 0,
                "change": {"doors": _DOORS},
                "laser": {"rate_hz": _RATE_HZ},
            }
        )
        moved = np.random.default_rng([building, day, 5]).choice(
            len(things) - _FIXED, _PRESENT, replace=False
        )
        present = [*things[:_FIXED], *(things[_FIXED + k] for k in moved)]
        streams = (np.random.default_rng([world.seed, 6]), np.random.default_rng([building, 1]))
        _, _, doors = change_building(plan, None, world.change, *streams, robot_m=robot_m)
        yield plan_session("laser", plan, None, world, (*doors.added, *present))


def joined_days(folder: Path, building: int) -> tuple[Path, dict[str, SE2]]:
    """The joined database of the days that are mapped, and T_plan_map of each. Made once."""
    path, known = folder / f"{building}.submaps", folder / f"{building}.json"
    if not known.exists():
        config, made, truth = Config(), [], {}
        for day, session in zip(range(_DAYS), days(building), strict=False):
            one, T_plan_map = mapped(session, f"day{day}", config)
            truth[one.session] = (T_plan_map.x, T_plan_map.y, T_plan_map.yaw)
            made.append((one, provenance(one.session, f"{building}-{day}", config)))
        add_sessions(path, made, config, keep=False, force=True)
        with open_database(path) as database:
            frames = join_sessions(database).frames
        maintenance.place(path, frames)
        known.write_text(json.dumps(truth))
    return path, {name: SE2(*pose) for name, pose in json.loads(known.read_text()).items()}


def asked(folder: Path, building: int) -> Iterator[Asked]:
    """All queries of a building, in both maps; none if its first day was joined with no other."""
    path, truth = joined_days(folder, building)
    with open_database(path) as database:
        frames, first = database.frames(), database.grid("day0")
    if "day0" not in frames:
        return
    T_plan_frame = truth["day0"] @ frames["day0"].T_building_session.inverse()
    old, new = folder / "old.submaps", folder / "living.submaps"
    maintenance.split(path, ["day0"], old, force=True)
    shutil.copy(path, new)
    living.update(new)
    *_, last = days(building)
    drive = [(scan, SE2(at.x, at.y, at.yaw)) for scan, at in last.scans()]
    for name, place in ((_OLD, old), (_LIVING, new)):
        with open_database(place) as database:
            index = MapIndex.of(database, Config())
            at = database.frames()
            placed = [at[session] for session in index.sessions]
            for scans, count in _LOOKS.items():
                for start in np.linspace(0, len(drive) - scans, count).astype(int).tolist():
                    true = drive[start + scans - 1][1]
                    if knows_around(first, truth["day0"].inverse() @ true):
                        answer, _ = answer_to(index, [scan for scan, _ in drive[start : start + scans]])
                        error = error_of(answer, placed, T_plan_frame.inverse() @ true)
                        yield Asked(
                            building=building,
                            map=name,
                            scans=scans,
                            start=start,
                            located=answer.status == "located",
                            error_m=error[0],
                            error_rad=error[1],
                        )


def error_of(answer: Answer, frames: Sequence[BuildingFrame], T_frame_base: SE2) -> tuple[float, float]:
    """Distance and turn of the best hypothesis from the truth; infinite without one."""
    if not answer.hypotheses:
        return math.inf, math.inf
    best = answer.hypotheses[0]
    T_map_base = best.fit.T_map_query @ answer.T_odom_base
    off = T_frame_base.inverse() @ frames[best.session_index].placed(T_map_base)
    return math.hypot(off.x, off.y), abs(math.remainder(off.yaw, 2.0 * math.pi))


def knows_around(grid: OccupancyGrid, T_map_base: SE2) -> bool:
    """Whether a map knows the ground around a place."""
    steps = np.arange(-_AROUND_M, _AROUND_M + 1e-9, 0.1)
    around_m: F64 = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    around_m = around_m[np.hypot(*around_m.T) <= _AROUND_M]
    at = grid.to_cell(T_map_base.apply(around_m))
    known = ((at >= 0) & (at < grid.cells.shape)).all(axis=1)
    known[known] = grid.cells[tuple(at[known].T)] >= 0
    return bool(known.mean() >= _KNOWN)


def answer_to(index: MapIndex, scans: Sequence[Scan]) -> tuple[Answer, float]:
    """The answer to some scans, and the processor time that it took."""
    localizer, begin = Localizer(index), time.process_time()
    for registered, planar_scan in follow(scans, Config()):
        localizer.add(registered, planar_scan)
    answer = localizer.answer()
    return answer, time.process_time() - begin


def difference(rows: Sequence[Asked], scans: int, *, draws: int = 10_000) -> dict[str, object]:
    """Located and right in both maps, and the bootstrap interval (95 %) of the difference of the shares, over
    buildings."""
    buildings = sorted({row.building for row in rows})
    some = [row for row in rows if row.scans == scans]
    gained = np.array(
        [sum(r.right * (1 if r.map == _LIVING else -1) for r in some if r.building == b) for b in buildings]
    )
    asked_of = np.array([sum(r.map == _OLD for r in some if r.building == b) for b in buildings])
    drawn = np.random.default_rng(0).integers(0, len(buildings), (draws, len(buildings)))
    shares = gained[drawn].sum(axis=1) / np.maximum(asked_of[drawn].sum(axis=1), 1)
    return {
        "scans": scans,
        "buildings": len(buildings),
        "queries": int(asked_of.sum()),
        "right": {name: sum(r.right for r in some if r.map == name) for name in (_OLD, _LIVING)},
        "wrong": {
            name: sum(r.located and not r.right for r in some if r.map == name) for name in (_OLD, _LIVING)
        },
        "difference of the shares": round(float(gained.sum() / max(asked_of.sum(), 1)), 3),
        "interval": [round(float(v), 3) for v in np.percentile(shares, [2.5, 97.5])],
    }


def cost(folder: Path, length_m: float) -> dict[str, dict[str, float]]:
    """Size of the database (kB), free ground of its first session (m2, of the living map of all), and
    processor time of an answer (ms, median), by what it holds. length_m : of each drive."""
    path = building_of(folder, 0, _TEN, length_m)
    truth = json.loads(path.with_suffix(".json").read_text())
    exact = ((0.0, 0.0, 0.0),) * 3
    frames = {
        name: BuildingFrame(name="plan", T_building_session=SE2(*pose), covariance=exact)
        for name, pose in truth.items()
    }
    maintenance.place(path, frames)
    one, ten, lived = (folder / f"{name}.submaps" for name in ("one", "ten", "lived"))
    maintenance.split(path, ["0-0"], one, force=True)
    maintenance.split(path, list(frames), ten, force=True)
    maintenance.split(path, list(frames), lived, force=True)
    living.update(lived)
    *_, last = drives(0, _TEN + 1, length_m)
    scans = [scan for scan, _ in last.scans()]
    found = {}
    for name, place in (("one", one), (f"{len(frames)} joined", ten), (f"living, of {len(frames)}", lived)):
        with open_database(place) as database:
            index = MapIndex.of(database, Config())
            free_m2 = database.sessions(index.sessions[:1])[0].area_m2
            starts = np.linspace(0, len(scans) - _COSTED, _ASKED + 1).astype(int).tolist()
            # The first prepares the maps.
            times = [answer_to(index, scans[start : start + _COSTED])[1] for start in (starts[0], *starts)][
                1:
            ]
        found[name] = {
            "kB": place.stat().st_size / 1e3,
            "free, m2": free_m2,
            "answer, ms": 1e3 * float(np.median(times)),
        }
    return found


def main() -> None:
    """Ask in all buildings, print and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=41, help="seed of the first office")
    parser.add_argument("--buildings", type=int, default=8)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--cost", action="store_true", help="size and time of ten sessions instead")
    parser.add_argument("--length", type=float, default=50.0, help="metres of each of these")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    if arguments.cost:
        print(json.dumps(cost(arguments.folder, arguments.length), indent=1))
        return
    rows: list[Asked] = []
    for building in range(arguments.first, arguments.first + arguments.buildings):
        found = list(asked(arguments.folder, building))
        rows += found
        if not found:
            print(f"{building}: its days were not joined")
            continue
        print(f"{building}: {[difference(found, scans) for scans in _LOOKS]}", flush=True)
        if arguments.output is not None:
            arguments.output.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    for scans in _LOOKS:
        print(json.dumps(difference(rows, scans), indent=1))


if __name__ == "__main__":
    main()
