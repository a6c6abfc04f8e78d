"""How surely signatures tell one place from two on a real floor: 3D scan against the log of a 2D laser.

    pc2grid compare real fr079_floor.ply fr079.mcap --out real-sensors
    python tools/bench/real_signatures.py real-sensors

The maps and the transform between them are those that the first command has stored. Printed is the area under
the curve: the probability that one place, seen by both sensors, is nearer than two places of one map that are
3 m or more apart; with the 5th and 95th percentile when places are drawn anew (bootstrap).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from pc2grid.geometry import SE2
from signature.config import Config
from signature.evaluation.ablation import independence, seen_independence
from signature.evaluation.sensor_map import SensorMap, load_map

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
        made = load_map(path, name="floor", sensor=sensor, config=Config())  # type: ignore[arg-type]
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


def main() -> None:
    """Print the table for the folder that `compare real` has filled."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python tools/bench/real_signatures.py FOLDER")
    for row in rows_of(maps_of(Path(sys.argv[1]))):
        print(row, flush=True)


if __name__ == "__main__":
    main()
