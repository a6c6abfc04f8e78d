"""Try the program in your building: a simulated robot maps your floor plan, others are located in that map.

The others start at other places, and among furniture that the map does not contain.

python examples/own_floor_plan.py map.yaml
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import typer

import pc2grid


def main(map_yaml: str, visitors: int = 5, map_length_m: float = 60.0, query_length_m: float = 5.0) -> None:
    """Map the plan, locate the visitors, and print the error of each answer."""
    plan = pc2grid.load_map(map_yaml)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mapper = pc2grid.SimulationConfig(length_m=map_length_m, seed=1, clutter=5)
        made = pc2grid.simulate_session(folder / "map.mcap", sensor="laser", grid=plan, config=mapper)
        pc2grid.convert(made.path, folder / "map.submaps")
        # The origin of the map is the place where the robot started.
        T_plan_map = next(pc2grid.read_tum(made.truth_path).poses())

        for number in range(visitors):
            visit = pc2grid.SimulationConfig(length_m=query_length_m, seed=100 + number, clutter=5)
            path = folder / f"visit{number}.mcap"
            made = pc2grid.simulate_session(path, sensor="laser", grid=plan, config=visit)
            answer = pc2grid.relocalize(path, folder / "map.submaps")
            truth = list(pc2grid.read_tum(made.truth_path).poses())[-1]
            if answer.T_map_base is None:
                print(f"visitor {number}: {answer.status}, confidence {answer.confidence:.2f}")
                continue
            found = T_plan_map @ answer.T_map_base
            off_m = math.hypot(found.x - truth.x, found.y - truth.y)
            print(f"visitor {number}: located, {off_m:.2f} m off, confidence {answer.confidence:.2f}")


if __name__ == "__main__":
    typer.run(main)
