"""Which real sessions are joined: those of one building, and none of different ones.

`python -m pc2grid_lab.bench.real_joins FOLDER -o joins.json` reads all databases of a folder, whose sessions
have the label of their building (`convert --building`), and compares every two sessions, without looking at
the labels, and each with its own mirror image; `--by map_merge` and `--by grid_matching` do it as rivals do.
Where two sessions are parts of one recording, or a third session contains both, the stamps that they share
tell how they lie to each other, and how far their poses lie from those of the third one, as they were drawn
and straightened.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import Loop, Precision, Trajectory
from pc2grid.submaps.junction_graph import junction_graph
from pc2grid_lab.baselines.grid_matching import match_grids
from pc2grid_lab.baselines.map_merge import CONFIDENT, merge
from signature.database import open_database
from signature.database.protocol import BuildingFrame
from signature.localization.joining.join import JoinableMap, join_maps
from signature.localization.joining.pieces import Link
from signature.localization.joining.straightening import body_of, straighten

_LEAST_STAMPS = 50
"""Poses that two trajectories share, to say how their frames lie to each other."""
_KEPT = 12
"""Prepared maps in memory."""
MIRRORED = "mirror image"


@dataclass(frozen=True, slots=True)
class Session:
    """A session of a database file."""

    path: Path
    name: str
    building: str
    trajectory: Trajectory
    loops: tuple[Loop, ...]
    precision: Precision | None


@dataclass(frozen=True, slots=True)
class Row:
    """Two sessions. same : of one building. error_m, error_deg : at the middle of the source, if known.
    drawn_m, straight_m : see `poses_off`, as the sessions were drawn and joined, and straightened."""

    target: str
    source: str
    same: bool
    status: str
    probability: float | None
    agreement: float | None
    common_m2: float | None
    nodes: int | None
    error_m: float | None
    error_deg: float | None
    drawn_m: tuple[float, ...] | None
    straight_m: tuple[float, ...] | None
    cpu_s: float


def sessions_of(folder: Path) -> list[Session]:
    """The sessions of all databases of a folder, as `building/name`."""
    found = []
    for path in sorted(folder.glob("*.submaps")):
        with open_database(path) as database:
            found += [
                Session(
                    path,
                    info.name,
                    info.provenance.label.building or path.stem,
                    database.trajectory(info.name),
                    database.loops(info.name),
                    info.precision,
                )
                for info in database.sessions()
            ]
    return found


@lru_cache(_KEPT)
def map_of(path: Path, name: str, mirrored: bool = False) -> JoinableMap:
    """The map of a session, or its mirror image."""
    with open_database(path) as database:
        grid, graph, config = database.grid(name), database.graph(name), database.config()
    if mirrored:
        grid = replace(grid, cells=grid.cells[:, ::-1].copy())
        graph = junction_graph(grid, config.partition)
    return JoinableMap(grid=grid, graph=graph, sight_m=config.partition.radius_m)


def truth(a: Session, b: Session, others: Sequence[Session]) -> SE2 | None:
    """T_a_b by the stamps that both share, or that both share with a third one; None if there are none."""
    direct = by_stamps(a, b)
    if direct is not None:
        return direct
    for third in others:
        T_third_a, T_third_b = by_stamps(third, a), by_stamps(third, b)
        if T_third_a is not None and T_third_b is not None:
            return T_third_a.inverse() @ T_third_b
    return None


def by_stamps(a: Session, b: Session) -> SE2 | None:
    """T_a_b of two sessions of one recording; None if they share too few stamps."""
    if a.building != b.building:
        return None
    _, i, j = np.intersect1d(a.trajectory.stamps_ns, b.trajectory.stamps_ns, return_indices=True)
    if len(i) < _LEAST_STAMPS:
        return None
    return SE2.fit(b.trajectory.planar()[j, :2], a.trajectory.planar()[i, :2])


def poses_off(
    whole: Session, parts: Sequence[Session], frames: Mapping[str, BuildingFrame]
) -> tuple[float, ...]:
    """RMS distance, m, of the poses of each of the parts from those of the whole, best aligned; the last one
    is of all together, where they lie in the building."""
    at_m, true_m = [], []
    for part in parts:
        _, i, j = np.intersect1d(part.trajectory.stamps_ns, whole.trajectory.stamps_ns, return_indices=True)
        at_m.append(frames[part.name].apply(part.trajectory.planar()[i, :2]))
        true_m.append(whole.trajectory.planar()[j, :2])
    at_m.append(np.concatenate(at_m))
    true_m.append(np.concatenate(true_m))
    off_m = (SE2.fit(at, true).apply(at) - true for at, true in zip(at_m, true_m, strict=True))
    return tuple(round(float(np.sqrt((off**2).sum(axis=1).mean())), 4) for off in off_m)


def _frame(T: SE2) -> BuildingFrame:
    exact = ((0.0, 0.0, 0.0),) * 3
    return BuildingFrame(name="", T_building_session=T, covariance=exact)


@dataclass(frozen=True, slots=True)
class Found:
    """What was found of two maps. T_target_source : None if they are said to be of different buildings."""

    status: str
    T_target_source: SE2 | None
    probability: float | None = None
    agreement: float | None = None
    common_m2: float | None = None
    nodes: int | None = None
    links: tuple[Link, ...] = ()


def _both_off(
    a: Session, b: Session, found: Found, known: Sequence[Session]
) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """`poses_off` of two joined sessions, as they were drawn and straightened; None if no third session
    contains both."""
    whole = next((c for c in known if by_stamps(c, a) and by_stamps(c, b)), None)
    if whole is None or found.T_target_source is None:
        return None, None
    frames = {a.name: _frame(SE2()), b.name: _frame(found.T_target_source)}
    bodies = {one.name: body_of(one.trajectory, one.loops, one.precision) for one in (a, b)}
    straight = straighten(bodies, frames, {(a.name, b.name): found.links})
    return poses_off(whole, (a, b), frames), poses_off(whole, (a, b), straight)


def by_pc2grid(target: JoinableMap, source: JoinableMap) -> Found:
    """As `pc2grid db join` does it."""
    join = join_maps(target, source)
    return Found(
        status=join.status,
        T_target_source=None if join.status == "different" else join.T_target_source,
        probability=join.probability,
        agreement=join.agreement,
        common_m2=join.common_m2,
        nodes=join.nodes,
        links=join.links,
    )


def by_map_merge(target: JoinableMap, source: JoinableMap) -> Found:
    """As the ROS package map_merge does it."""
    found = merge(target.grid, source.grid)
    joined = found.confidence >= CONFIDENT and found.T_target_source is not None
    return Found("joined" if joined else "different", found.T_target_source if joined else None)


def by_grid_matching(target: JoinableMap, source: JoinableMap) -> Found:
    """As MRPT's program does it."""
    found = match_grids((target.grid, target.graph), (source.grid, source.graph))
    return Found("joined", found[0].T_target_source) if found else Found("different", None)


METHODS = {"pc2grid": by_pc2grid, "map_merge": by_map_merge, "grid_matching": by_grid_matching}


def rows(compared: Sequence[Session], known: Sequence[Session], method: str) -> Iterator[Row]:
    """All pairs, and each session with its mirror image. known : also those that only tell the truth."""
    for a, b in itertools.combinations(compared, 2):
        yield _row(a, b, known, method)
    for one in compared:
        yield _row(one, replace(one, name=MIRRORED), (), method)


def _row(a: Session, b: Session, known: Sequence[Session], method: str) -> Row:
    mirrored = b.name == MIRRORED
    T_a_b = truth(a, b, known) if known else None
    target = map_of(a.path, a.name)
    source = map_of(b.path, a.name if mirrored else b.name, mirrored)
    begin = time.process_time()
    found = METHODS[method](target, source)
    cpu_s = time.process_time() - begin
    off = None
    if T_a_b is not None and found.T_target_source is not None:
        x, y = source.grid.to_point(np.argwhere(source.grid.free)).mean(axis=0).tolist()
        at = SE2(x, y)
        off = (T_a_b @ at).inverse() @ found.T_target_source @ at
    drawn_m, straight_m = _both_off(a, b, found, known)
    return Row(
        target=a.name,
        source=b.name,
        same=a.building == b.building and not mirrored,
        status=found.status,
        probability=found.probability,
        agreement=found.agreement,
        common_m2=found.common_m2,
        nodes=found.nodes,
        error_m=None if off is None else math.hypot(off.x, off.y),
        error_deg=None if off is None else abs(math.degrees(off.yaw)),
        drawn_m=drawn_m,
        straight_m=straight_m,
        cpu_s=cpu_s,
    )


def summary(found: Sequence[Row]) -> Mapping[str, object]:
    """How many true and false pairs were joined."""
    true, false = [r for r in found if r.same], [r for r in found if not r.same]
    joined = [r for r in true if r.status == "joined"]
    errors = [r.error_m for r in joined if r.error_m is not None]
    return {
        "pairs of one building": len(true),
        "joined": len(joined),
        "errors, m": [round(error, 3) for error in sorted(errors)],
        "pairs of different buildings": len(false),
        "joined, though different": sum(r.status == "joined" for r in false),
        "highest probability of these": round(max((r.probability or 0.0 for r in false), default=0.0), 4),
        "cpu_s, median": round(float(np.median([r.cpu_s for r in found])), 2) if found else None,
    }


def main() -> None:
    """Compare, print each pair, and write all to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--by", choices=METHODS, default="pc2grid")
    parser.add_argument("--only", nargs="*", help="names of the sessions that are compared")
    arguments = parser.parse_args()
    known = sessions_of(arguments.folder)
    compared = [s for s in known if not arguments.only or s.name in arguments.only]
    found = []
    for row in rows(compared, known, arguments.by):
        found.append(row)
        print(json.dumps(asdict(row)), file=sys.stderr, flush=True)
        arguments.output.write_text(json.dumps([asdict(row) for row in found], indent=1) + "\n")
    print(json.dumps(summary(found), indent=1))


if __name__ == "__main__":
    main()
