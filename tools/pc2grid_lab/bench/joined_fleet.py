"""A fleet's sessions joined: how long it takes, what is joined, and whether it goes on after it was killed.

python -m pc2grid_lab.bench.joined_fleet FOLDER [--buildings N] [--sessions N] [--jobs N] [-o OUT.json]

Small offices, each driven through several times by a laser, its doors and furniture different each time, are
mapped as a user's recordings are and stored without labels, all in one database. What is there already in the
folder is not made again.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import networkx as nx
import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import Scan, SessionMap
from pc2grid.pipeline import map_scans
from pc2grid.simulate import Session, office_floorplan
from pc2grid.simulate.session import plan_session
from pc2grid.submaps.partition import divide
from pc2grid_cli.comparing import comparing
from pc2grid_lab.worlds import WorldConfig
from pc2grid_lab.worlds.change import change_building
from signature.config import Config
from signature.database import maintenance, open_database
from signature.database.protocol import BuildingFrame
from signature.localization.joining.building import Joined, join_sessions
from signature.localization.joining.journal import JoinJournal
from signature.sessions import add_sessions, provenance

_SIDES_M = (26.0, 22.0)
_LENGTH_M, _RATE_HZ = 50.0, 3.0
_THINGS, _DOORS = 20, 0.6


def fleet(folder: Path, buildings: int, sessions: int) -> Path:
    """The database of all sessions, `building-number`, and their truth in `truth.json`: T_plan_map."""
    truth: dict[str, list[float]] = {}
    parts = []
    for building in range(buildings):
        parts.append(building_of(folder, building, sessions))
        truth |= json.loads(parts[-1].with_suffix(".json").read_text())
    path = folder / "fleet.submaps"
    maintenance.merge(parts, path, force=True)
    (folder / "truth.json").write_text(json.dumps(truth))
    return path


def building_of(folder: Path, building: int, sessions: int, length_m: float = _LENGTH_M) -> Path:
    """The database of a building, a session for each drive, and its truth beside it, ending in `.json`."""
    path = folder / f"{building}.submaps"
    known = path.with_suffix(".json")
    if not known.exists():
        config, made, truth = Config(), [], {}
        for number, drive in enumerate(drives(building, sessions, length_m)):
            session, T_plan_map = mapped(drive, f"{building}-{number}", config)
            made.append((session, provenance(session.session, f"{building}-{number}", config)))
            truth[session.session] = [T_plan_map.x, T_plan_map.y, T_plan_map.yaw]
        add_sessions(path, made, config, keep=False, force=True)
        known.write_text(json.dumps(truth))
    return path


def drives(building: int, count: int, length_m: float = _LENGTH_M) -> Iterator[Session]:
    """So many drives through a building, whose doors and furniture are different each time."""
    plan = office_floorplan(1000 + building, *_SIDES_M)
    for number in range(count):
        world = WorldConfig.model_validate(
            {
                "length_m": length_m,
                "seed": 1000 * building + number,
                "clutter": _THINGS,
                "change": {"doors": _DOORS},
                "laser": {"rate_hz": _RATE_HZ},
            }
        )
        streams = (np.random.default_rng([world.seed, 6]), np.random.default_rng([building, 1]))
        robot_m = world.drive.clearance_m
        _, _, doors = change_building(plan, None, world.change, *streams, robot_m=robot_m)
        yield plan_session("laser", plan, None, world, doors.added)


def mapped(drive: Session, name: str, config: Config) -> tuple[SessionMap, SE2]:
    """A drive mapped as a user's recording is, and T_plan_map."""
    true_m: list[tuple[float, float]] = []

    def scans() -> Iterator[Scan]:
        for scan, truth in drive.scans():
            true_m.append((truth.x, truth.y))
            yield scan

    grid, trajectory, loops = map_scans(scans(), config)
    graph, submaps = divide(grid, config.partition)
    made = SessionMap(
        session=name,
        sensor="laser",
        grid=grid,
        submaps=submaps,
        trajectory=trajectory,
        loops=loops,
        graph=graph,
    )
    return made, SE2.fit(trajectory.planar()[:, :2], np.array(true_m))


def summary(found: Joined, truth: Mapping[str, Sequence[float]]) -> dict[str, object]:
    """What was compared and joined, and how far joined sessions lie from the truth."""
    T_plan = {name: SE2(*pose) for name, pose in truth.items()}
    frames_off = [_off_m(T_plan, at.name, name, at.T_building_session) for name, at in found.frames.items()]
    true = [pair for pair in found.pairs if _building(pair.target) == _building(pair.source)]
    joined = [pair for pair in found.pairs if pair.accepted]
    errors = [
        _off_m(T_plan, *pair.names, pair.join.T_target_source)
        for pair in joined
        if _building(pair.target) == _building(pair.source)
    ]
    groups = nx.Graph(pair.names for pair in joined)
    sizes = sorted(map(len, nx.connected_components(groups)), reverse=True)
    return {
        "sessions": len(truth),
        "buildings": len({_building(name) for name in truth}),
        "pairs compared": len(found.pairs),
        "of these of one building": len(true),
        "joined": len(joined),
        "joined, though different": len(joined) - len(errors),
        "error, median and largest, m": _median_and_largest(errors),
        "sessions in a frame": len(found.frames),
        "frames": len({at.name for at in found.frames.values()}),
        "error of where they lie, median and largest, m": _median_and_largest(frames_off),
        "sizes of what hangs together": sizes,
    }


def _off_m(T_plan: Mapping[str, SE2], target: str, source: str, T_target_source: SE2) -> float:
    """Distance of a transform of two sessions from the truth; infinite for those of different buildings."""
    if _building(target) != _building(source):
        return math.inf
    off = (T_plan[target].inverse() @ T_plan[source]).inverse() @ T_target_source
    return math.hypot(off.x, off.y)


def _median_and_largest(errors_m: Sequence[float]) -> list[float]:
    return [round(float(f(errors_m)), 3) for f in (np.median, np.max)] if errors_m else []


def _building(name: str) -> str:
    return name.partition("-")[0]


def measured(
    path: Path, truth: Mapping[str, Sequence[float]], jobs: int
) -> tuple[dict[str, object], dict[str, BuildingFrame]]:
    """Join all sessions of a database, and say what it took, the processes that compare included."""
    wall, cpu = time.perf_counter(), _cpu_s()
    with comparing(str(path), None, jobs) as compare, open_database(path) as database:
        found = join_sessions(database, compare=compare)
    took = {"wall, s": round(time.perf_counter() - wall), "cpu, s": round(_cpu_s() - cpu)}
    return summary(found, truth) | took, dict(found.frames)


def _cpu_s() -> float:
    """Processor time of this process and of those that it has waited for."""
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def resumed(path: Path, folder: Path, jobs: int) -> tuple[int, dict[str, BuildingFrame]]:
    """Kill `db join` when it has compared some pairs, and begin again: how many it knew, and the frames."""
    again = folder / "killed.submaps"
    shutil.copy(path, again)
    journal = again.with_name(again.name + ".joining")
    journal.unlink(missing_ok=True)
    command = [sys.executable, "-c", "from pc2grid_cli.main import main; main()", "db", "join", str(again)]
    command += ["--jobs", str(jobs)]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while running.poll() is None and (not journal.exists() or journal.read_bytes().count(b"\n") < 10):
        time.sleep(0.05)
    running.send_signal(signal.SIGKILL)
    running.wait()
    known = len(JoinJournal(journal))
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    with open_database(again) as database:
        return known, database.frames()


def main() -> None:
    """Make the fleet, join it, kill and resume it, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--buildings", type=int, default=20)
    parser.add_argument("--sessions", type=int, default=15, help="of each building")
    parser.add_argument("--jobs", type=int, default=1, help="processes that compare")
    parser.add_argument("--kill", action="store_true", help="also kill and resume: takes as long again")
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    path = fleet(arguments.folder, arguments.buildings, arguments.sessions)
    truth = json.loads((arguments.folder / "truth.json").read_text())
    found, frames = measured(path, truth, arguments.jobs)
    if arguments.kill:
        known, again = resumed(path, arguments.folder, arguments.jobs)
        found |= {"compared when killed": known, "the same after that": again == frames}
    text = json.dumps(found, indent=1)
    print(text)
    if arguments.output is not None:
        arguments.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
