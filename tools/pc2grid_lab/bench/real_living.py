"""What a living map is worth on real recordings of one building, whose sessions have been joined.

python -m pc2grid_lab.bench.real_living JOINED.submaps LOGS [-o OUT.json]

Each session from the third on, in the order in which they were stored, asks where it was, in windows of its
recording LOGS/SESSION.mcap: in the map of each session before it (old), in the living map of all before it,
and in what this says of the ground that the old one knows. It asks only where the old map knows the ground
around it. Where the session itself lies in the building is the truth.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from pc2grid import open_log
from pc2grid.geometry import SE2
from pc2grid.model import UNKNOWN, OccupancyGrid, Scan
from pc2grid_lab.bench.living import Asked, answer_to, error_of, knows_around
from signature import living
from signature.config import Config
from signature.database import maintenance, open_database
from signature.database.protocol import BuildingFrame
from signature.database.stored import completed
from signature.localization.localizer import MapIndex

_WINDOW_S, _EACH_S = 3.0, 4.0
"""Length of a query, and the time from one to the next."""
_OFF_NS = 200_000_000
"""A pose of the session is the truth of a query that ends so near to it."""
OLD, LIVING, SAME_GROUND = "old", "living", "living, of the ground of the old one"


@dataclass(frozen=True, slots=True)
class Query:
    """Some scans, and where the sensor was at the last one, in the building."""

    scans: tuple[Scan, ...]
    T_building_base: SE2


def queries(path: Path, session: str, log: Path) -> list[Query]:
    """The windows of the recording of a session whose truth is known."""
    with open_database(path) as database:
        trajectory, frame = database.trajectory(session), database.frames()[session]
    with open_log(log) as opened:
        scans = list(opened.scans())
    found, begin = [], scans[0].stamp_ns
    while begin + _WINDOW_S * 1e9 <= scans[-1].stamp_ns:
        window = tuple(scan for scan in scans if begin <= scan.stamp_ns <= begin + _WINDOW_S * 1e9)
        begin += round(_EACH_S * 1e9)
        off_ns = np.abs(trajectory.stamps_ns - window[-1].stamp_ns) if window else np.array([_OFF_NS])
        if off_ns.min() < _OFF_NS:
            pose = SE2(*trajectory.planar()[int(np.argmin(off_ns))].tolist())
            found.append(Query(window, frame.placed(pose)))
    return found


def on_known_ground(grid: OccupancyGrid, old: OccupancyGrid, frame: BuildingFrame) -> OccupancyGrid:
    """A map in the building's frame without what an old one, which lies at `frame`, does not know."""
    at = np.argwhere(grid.cells != UNKNOWN)
    there = old.to_cell(frame.as_drawn(grid.to_point(at)))
    known = ((there >= 0) & (there < old.cells.shape)).all(axis=1)
    known[known] = old.cells[tuple(there[known].T)] != UNKNOWN
    cells = grid.cells.copy()
    cells[tuple(at[~known].T)] = UNKNOWN
    return replace(grid, cells=cells)


def maps_before(path: Path, before: Sequence[str], old: str, folder: Path) -> dict[str, Path]:
    """The databases that are asked: of one of some sessions, and of all."""
    found = {name: folder / f"{k}.submaps" for k, name in enumerate((OLD, LIVING, SAME_GROUND))}
    with open_database(path) as database:
        frames, grid = database.frames(), database.grid(old)
    maintenance.split(path, [old], found[OLD], force=True)
    maintenance.split(path, before, found[LIVING], force=True)
    (made,) = living.update(found[LIVING])
    shutil.copy(found[LIVING], found[SAME_GROUND])
    with open_database(found[SAME_GROUND]) as database:
        stored = database.stored(made.name)
    masked = on_known_ground(stored.grid, grid, frames[old])
    kept = {"info": stored.info, "trajectory": stored.trajectory, "loops": stored.loops}
    known = replace(completed({**kept, "grid": masked}), frame=stored.frame)
    maintenance.replace_sessions(found[SAME_GROUND], [known])
    return found


def asked(
    path: Path, number: int, before: Sequence[str], old: str, those: Sequence[Query]
) -> Iterator[Asked]:
    """The queries of a session, by its number, in the three maps."""
    with open_database(path) as database:
        grid, frame = database.grid(old), database.frames()[old]
    with tempfile.TemporaryDirectory() as folder:
        for name, place in maps_before(path, before, old, Path(folder)).items():
            with open_database(place) as database:
                index, at = MapIndex.of(database, Config()), database.frames()
                for start, query in enumerate(those):
                    x, y = query.T_building_base.x, query.T_building_base.y
                    if knows_around(grid, SE2(*frame.as_drawn(np.array([(x, y)]))[0].tolist())):
                        answer, _ = answer_to(index, query.scans)
                        placed = [at[session] for session in index.sessions]
                        error_m, error_rad = error_of(answer, placed, query.T_building_base)
                        yield Asked(
                            building=number,
                            map=name,
                            scans=len(query.scans),
                            start=start,
                            located=answer.status == "located",
                            error_m=error_m,
                            error_rad=error_rad,
                        )


def summary(rows: Sequence[Asked], name: str, draws: int = 10_000) -> dict[str, object]:
    """Right and wrong in a map, and what it gains over the old one, with the bootstrap interval (95 %, over
    the sessions that asked)."""
    sessions = sorted({row.building for row in rows})

    def of_each(map_name: str) -> list[int]:
        return [sum(r.right for r in rows if r.map == map_name and r.building == b) for b in sessions]

    gained = np.array(of_each(name)) - np.array(of_each(OLD))
    counts = np.array([sum(r.map == OLD for r in rows if r.building == b) for b in sessions])
    drawn = np.random.default_rng(0).integers(0, len(sessions), (draws, len(sessions)))
    shares = gained[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    return {
        "map": name,
        "queries": int(counts.sum()),
        "right": sum(of_each(name)),
        "wrong": sum(r.located and not r.right for r in rows if r.map == name),
        "gain": round(float(gained.sum() / counts.sum()), 3),
        "interval": [round(float(v), 3) for v in np.percentile(shares, [2.5, 97.5])],
    }


def main() -> None:
    """Ask in all maps, print and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("database", type=Path)
    parser.add_argument("logs", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    with open_database(arguments.database) as database:
        frames = database.frames()
    rows: list[Asked] = []
    for number, session in enumerate(frames):
        before = [name for name in list(frames)[:number] if frames[name].name == frames[session].name]
        if len(before) > 1:
            those = queries(arguments.database, session, arguments.logs / f"{session}.mcap")
            for old in before:
                rows += asked(arguments.database, number, before, old, those)
    for name in (OLD, LIVING, SAME_GROUND):
        print(json.dumps(summary(rows, name)))
    if arguments.output is not None:
        arguments.output.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
