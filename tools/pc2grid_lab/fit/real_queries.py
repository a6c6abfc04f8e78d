"""Real laser logs asked in maps of their own earlier part and of other buildings.

The map of a building is drawn from the first part of its log at the poses of the ground truth, so that only
the decision is measured, not mapping. Later parts of every log, registered as a user would, are the queries.
Each is asked in its own map once more with all that it sees there made unknown ("blanked"): a place that the
map lacks, in a building that it knows.

    python -m pc2grid_lab.fit.real_queries DATA OUT.json [--logs fr079,intel] [--queries 24]

DATA holds `laser/NAME.mcap` and `laser/NAME_corrected.tum`; the registered queries are kept beside OUT.
`real_answers` counts what is answered, `posterior` fits the posterior.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.estimation.tracker import Tracker
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.io import Log, open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.matching.two_way_score import score_fit
from pc2grid.model import OccupancyGrid, Trajectory
from pc2grid.submaps.partition import partition
from pc2grid_lab.experiments.answers import unseen_by
from pc2grid_lab.experiments.frames import number_at
from pc2grid_lab.experiments.registered_session import RegisteredSession, register
from signature.config import Config
from signature.describe import describe
from signature.localization.hypotheses import Hypothesis
from signature.localization.map_index import MapIndex
from signature.localization.posterior import evidence_of, tail_of
from signature.localization.query import Query, QueryMap
from signature.similarity import SignatureTable

MAPPED_S = {"fr079": 600.0, "intel": 900.0, "csail": 250.0, "killian": 900.0}
"""Seconds of each log that become the map."""
DISTANCES_M = (0.0, 1.0, 3.0, 5.0, 8.0, 10.0)
STANDING_SCANS = 6
WINDOWS_M = (15.0, 8.0, 4.0)


Drawn = tuple[OccupancyGrid, list[RegisteredSession]]
"""The map of the first part of a log, and its later parts as registered queries."""


def read(data: Path, name: str, queries: int, kept: Path, config: Config) -> Drawn:
    """The map of the first part of a log, and its later parts as registered queries."""
    with open_log(data / "laser" / f"{name}.mcap") as log:
        true_pose = of_base(log, read_tum(data / "laser" / f"{name}_corrected.tum"))
        builder, last = GridBuilder(config.projection), None
        for scan in log.scans(0.0, MAPPED_S[name]):
            pose = true_pose(scan.stamp_ns)
            if pose is None:
                continue
            step = pose if last is None else last.inverse() @ pose
            if last is None or math.hypot(step.x, step.y) > 0.15 or abs(step.yaw) > 0.1:
                tracker = Tracker(config.registration, config.projection)
                builder.add(tracker.start(scan).planar_scan, pose)
                last = pose
        end_s = (log.info.end_ns - log.info.start_ns) * 1e-9
        driven = []
        for start_s in np.linspace(MAPPED_S[name] + 2.0, end_s - 60.0, queries).tolist():
            file = kept / f"{name}.{start_s:.1f}.npz"
            if not file.exists():
                scans = ((scan, true_pose(scan.stamp_ns)) for scan in log.scans(start_s, 60.0))
                register(scans, config, sensor="laser", until_m=DISTANCES_M[-1] + 0.5).save(file)
            driven.append(RegisteredSession.load(file))
    return builder.grid(), driven


def of_base(log: Log, truth: Trajectory) -> Callable[[int], SE2 | None]:
    """The true pose of the base at a stamp, None if there is none. truth : poses of the sensor."""
    T_sensor_base = SE2.from_matrix(next(iter(log.scans())).T_base_sensor).inverse()
    poses = [pose @ T_sensor_base for pose in truth.poses()]

    def true_pose(stamp_ns: int) -> SE2 | None:
        number = number_at(truth.stamps_ns, stamp_ns)
        return None if number is None else poses[number]

    return true_pose


def index_of(name: str, grid: OccupancyGrid, config: Config) -> MapIndex:
    """A database of one map."""
    submaps = partition(grid, config.partition)
    table = SignatureTable.of([describe(s, config.signature) for s in submaps], [s.center_m for s in submaps])
    return MapIndex({name: grid}, table, config, config)


def moments(
    driven: RegisteredSession, config: Config
) -> Iterator[tuple[float, dict[float, QueryMap], SE2 | None]]:
    """The query after each of `DISTANCES_M`: one map for each of `WINDOWS_M`, and the true pose."""
    windows = {m: Query(config, config.relocalize.model_copy(update={"window_m": m})) for m in WINDOWS_M}
    want = list(DISTANCES_M)
    for i, (registered, planar_scan, _) in enumerate(driven.scans()):
        if driven.lost[i]:
            return
        for window in windows.values():
            window.add(registered, planar_scan)
        if i + 1 < STANDING_SCANS or not want or windows[WINDOWS_M[0]].path_m < want[0]:
            continue
        truth = driven.true_pose(i)
        travel_m = want.pop(0)
        maps = {m: w.map() for m, w in windows.items() if m == WINDOWS_M[0] or m < travel_m}
        yield travel_m, maps, truth


def evidence_rows(
    name: str, start: int, driven: RegisteredSession, indexes: dict[str, MapIndex], config: Config
) -> Iterator[dict[str, Any]]:
    """The evidence for one query in each map, after each distance and for each window, and all errors."""
    for travel_m, maps, truth in moments(driven, config):
        for map_name, index in indexes.items():
            own = map_name == name
            for window_m, query in maps.items():
                row = {
                    "log": name,
                    "map": map_name,
                    "start": start,
                    "travel_m": travel_m,
                    "window_m": window_m,
                    "covered": 0.0,
                }
                if not own or truth is None:
                    yield from _looks(
                        index, query, None, row | {"place": "in the map" if own else "elsewhere"}
                    )
                    continue
                T_map_query = truth @ query.T_odom_base.inverse()
                row["covered"] = score_fit(index.maps[0].walls, query.walls, T_map_query, np.eye(3)).overlap
                yield from _looks(index, query, truth, row | {"place": "in the map"})
                blanked = unseen_by(query, index.grids[0], T_map_query)
                without = MapIndex({name: blanked}, index.places.table, config, config)
                yield from _looks(without, query, truth, row | {"place": "blanked"})


def _looks(
    index: MapIndex, query: QueryMap, truth: SE2 | None, row: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """As `signature.localization.decision`, two answers: by what is proposed, and by a search of the whole
    map."""
    proposed = index.look_up(query)
    for stage, found in (("proposed", proposed), ("everywhere", index.search_whole_maps(query, proposed))):
        poses = [h.fit.T_map_query @ query.T_odom_base for h in found]
        yield row | {
            "stage": stage,
            "evidence": evidence_list(index, query, found),
            "errors": [_error(pose, truth) for pose in poses],
        }


def evidence_list(index: MapIndex, query: QueryMap, found: tuple[Hypothesis, ...]) -> list[dict[str, Any]]:
    """What tells for each hypothesis, and for the best one, what its last scans tell."""
    evidence = list(evidence_of([h.fit for h in found], query))
    if found:
        walls = index.maps[found[0].session_index].walls
        evidence[0] = replace(evidence[0], tail=tail_of(query, found[0].fit, walls, index.config.step_m))
    return [asdict(one) for one in evidence]


def _error(pose: SE2, truth: SE2 | None) -> tuple[float, float]:
    """Metres and radians from the true pose; without one, as in another building, nothing is near it."""
    if truth is None:
        return math.inf, math.pi
    e = truth.inverse() @ pose
    return math.hypot(e.x, e.y), abs(wrap_angle(e.yaw))


def parser_of(description: str | None, out: str, logs: str) -> argparse.ArgumentParser:
    """Of the arguments DATA, `out`, --logs and --queries."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=description, formatter_class=raw)
    parser.add_argument("data", type=Path)
    parser.add_argument(out, type=Path)
    parser.add_argument("--logs", default=logs)
    parser.add_argument("--queries", type=int, default=24)
    return parser


def read_all(options: argparse.Namespace, folder: Path) -> tuple[dict[str, Drawn], dict[str, MapIndex]]:
    """The map and queries of each log, and its map as an index; registered queries are kept in the folder."""
    kept, config = folder / "drives", Config()
    kept.mkdir(parents=True, exist_ok=True)
    names = options.logs.split(",")
    logs = {name: read(options.data, name, options.queries, kept, config) for name in names}
    return logs, {name: index_of(name, grid, config) for name, (grid, _) in logs.items()}


def main() -> None:
    """Collect the evidence."""
    options = parser_of(__doc__, "out", ",".join(MAPPED_S)).parse_args()
    config = Config()
    logs, indexes = read_all(options, options.out.parent)
    rows: list[dict[str, Any]] = []
    for name, (_, driven) in logs.items():
        for start, d in enumerate(driven):
            rows.extend(evidence_rows(name, start, d, indexes, config))
            options.out.write_text(json.dumps(rows))
            print(name, start, len(rows), flush=True)


if __name__ == "__main__":
    main()
