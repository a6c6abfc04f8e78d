"""Learn the weights of the signatures of viewpoints from simulated sessions of all three sensors.

    python -m pc2grid_lab.fit.simulated FOLDER PLAN... [--queries 6]

A PLAN is a MAP.yaml, or office:SEED. In each, a session of each sensor makes a map, and others are asked
in all three after 1, 3 and 8 m; viewpoints of office floors are other places. Maps and sessions are kept
in FOLDER, and what is learned is FOLDER/simulated.npz. Its numbers in use were made of office:1, fr079
and intel; `signatures` takes a fifth of the variation within one place from them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer

from pc2grid.geometry import SE2
from pc2grid.io.nav2_map import load_map
from pc2grid.model import OccupancyGrid
from pc2grid.simulate import office_floorplan
from pc2grid_lab.experiments.sensor_matrix import SENSORS, PlanDrives, PlanMap
from pc2grid_lab.fit.queries import TRAVELS_M, office_floor, pairs_of, queries_of
from signature.config import Config
from signature.localization.query import QueryMap
from signature.seen_likelihood import SeenStatistics

_OFFICE = "office:"
_FIRST_FLOOR, _FLOORS = 30_000, 30
"""Office floors that are other places."""
_SETTING = {"map_length": 150.0, "clutter": 30.0, "change": 0.2, "rate": 4.0}
"""Metres driven for a map, things in the way, share of doors and furniture that differ, scans a second."""


def plan_of(name: str) -> OccupancyGrid:
    """The floor plan that is named."""
    if name.startswith(_OFFICE):
        return office_floorplan(int(name.removeprefix(_OFFICE)))
    return load_map(Path(name))


def asked(
    plans: Mapping[str, OccupancyGrid], drives: PlanDrives, queries: int, config: Config
) -> Iterator[tuple[QueryMap, SE2, list[PlanMap]]]:
    """Each query with its true frame in the plan, and the maps of that plan."""
    for name, plan in plans.items():
        maps = [drives.map(name, plan, sensor) for sensor in SENSORS]
        for sensor, seed in itertools.product(SENSORS, range(1, queries + 1)):
            session = drives.drive(name, plan, sensor, seed)
            for query, T_plan_query in queries_of(session, config):
                yield query, T_plan_query, maps
            print(f"{name}, {sensor}, {seed}", flush=True)


def main(
    folder: Path,
    plan: Annotated[list[str], typer.Argument(help="MAP.yaml or office:SEED")],
    queries: int = 6,
) -> None:
    """Learn and store the statistics, in FOLDER/simulated.npz."""
    drives = PlanDrives(
        out=folder,
        setting=tuple(_SETTING.items()),
        until_m=TRAVELS_M[-1] + 0.5,
        length_m=TRAVELS_M[-1] + 3.0,
    )
    plans = {Path(name.replace(":", "")).stem: plan_of(name) for name in plan}
    floors = [office_floor(_FIRST_FLOOR + number) for number in range(_FLOORS)]
    pairs = pairs_of(asked(plans, drives, queries, Config()), floors, Config())
    out = folder / "simulated.npz"
    SeenStatistics.save(out, viewpoints=SeenStatistics.of(pairs))
    print(f"{out}: learned from {len(pairs.queries):,} pairs")


if __name__ == "__main__":
    typer.run(main)
