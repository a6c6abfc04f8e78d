"""How surely signatures tell one place from two on a real floor: 3D scan against the log of a 2D laser.

    pc2grid compare real fr079_floor.ply fr079.mcap --out real-sensors
    python -m pc2grid_lab.bench.real_signatures real-sensors

The maps and the transform between them are those that the first command has stored. Printed is the area under
the curve: the probability that one place, seen by both sensors, is nearer than two places of one map that are
3 m or more apart; with the 5th and 95th percentile when places are drawn anew (bootstrap).

    python -m pc2grid_lab.bench.real_signatures real-sensors signatures/floors

prints instead how often the right place of a stretch of the log is selected in the lidar's map among the
places of the office floors that `pc2grid compare signatures ... --scale 500000 --out signatures` has
described; of all stretches, and of those of which half of the views lie on the map.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from pc2grid.geometry import SE2
from pc2grid_lab.experiments.ablation import independence, seen_independence
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.experiments.selection import (
    SIGNATURES,
    TRAVELS_M,
    PlacedQuery,
    queries_of,
    recall_at_scale,
    stored_floors,
    tally_at_scale,
)
from pc2grid_lab.experiments.sensor_map import SensorMap
from signature.config import Config
from signature.seen_places import SeenPlaces

PAIRS = (("lidar", "laser"), ("depth", "laser"), ("lidar", "depth"))


def maps_of(folder: Path) -> dict[str, SensorMap]:
    """The maps by lidar and depth camera, driven through the scan, and by the laser, all in its frame."""
    document = json.loads((folder / "real.json").read_text())
    if document["T_floor_log"] is None:
        raise SystemExit(f"{folder / 'real.json'}: the two recordings were not aligned: no T_floor_log")
    T_floor_log = SE2(*document["T_floor_log"])
    patterns = {"lidar": "*.lidar.*.submaps", "depth": "*.depth.*.submaps", "laser": "*.laser.*.submaps"}
    maps: dict[str, SensorMap] = {}
    for sensor, pattern in patterns.items():
        (path,) = (folder / "maps").glob(pattern)
        made = SensorMap.load(path, name="floor", sensor=sensor, config=Config())  # type: ignore[arg-type]
        if sensor == "laser":
            made = replace(made, T_plan_map=T_floor_log @ made.T_plan_map)
        maps[sensor] = made
    return maps


def rows_of(maps: dict[str, SensorMap]) -> Iterator[str]:
    """The rows of a table in Markdown."""
    yield "| sensors | signatures | what was seen | Eq. 6 | pairs |"
    yield "|---|---|---|---|---|"
    for pair in PAIRS:
        chosen = [maps[sensor] for sensor in pair]
        paper = {found.combination: found.auc for found in independence(chosen)}
        for names, (auc, low, high, same, other) in seen_independence([chosen]).items():
            whole = f"{auc:.3f} ({low:.3f}-{high:.3f})"
            yield f"| {' and '.join(pair)} | {names} | {whole} | {paper[names]:.3f} | {same:,} / {other:,} |"


def floors_of(folder: Path) -> Iterator[SeenPlaces]:
    """What is seen from the places of office floors, a file at a time."""
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as stored:
            yield from stored_floors(stored)


def stretches_of(folder: Path) -> Iterator[PlacedQuery]:
    """The stretches of the log after each of `TRAVELS_M`, in the frame of the scan."""
    T_floor_log = SE2(*json.loads((folder / "real.json").read_text())["T_floor_log"])
    for number, path in enumerate(sorted((folder / "sessions").glob("*.own.npz"))):
        for travel_m, query, T_log_query in queries_of(RegisteredSession.load(path), Config(), TRAVELS_M):
            yield "laser", number, travel_m, query, T_floor_log @ T_log_query


def selected_rows(folder: Path, floors: Path) -> Iterator[str]:
    """The rows of a table in Markdown: how often the right place of a stretch is selected."""
    yield "| views on the map | travelled, m | queries | share looked at | right one selected |"
    yield "|---|---|---|---|---|"
    own, stretches = maps_of(folder)["lidar"], list(stretches_of(folder))
    for least in (0.0, 0.5):
        found = [
            r for r in recall_at_scale(own, floors_of(floors), stretches, least) if r.selector == SIGNATURES
        ]
        for row in tally_at_scale(found):
            if row["query_sensor"] == "all":
                share, low, high = row["found"]  # type: ignore[misc]
                which = "half or more" if least else "any"
                counts = f"| {which} | {row['travel_m']:g} | {row['queries']} | {row['share']:.1%} "
                yield f"{counts}| {share:.2f} ({low:.2f}-{high:.2f}) |"


def main() -> None:
    """Print the tables for the folder that `compare real` has filled."""
    if len(sys.argv) not in (2, 3):
        raise SystemExit("usage: python -m pc2grid_lab.bench.real_signatures FOLDER [FLOORS]")
    folder = Path(sys.argv[1])
    rows = rows_of(maps_of(folder)) if len(sys.argv) == 2 else selected_rows(folder, Path(sys.argv[2]))
    for row in rows:
        print(row, flush=True)


if __name__ == "__main__":
    main()
