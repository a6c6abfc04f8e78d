"""Try the program in your building: a simulated robot maps your floor plan, others are located in that map.

The others start at other places, and among furniture that the map does not contain.

python examples/own_floor_plan.py map.yaml
"""

from __future__ import annotations

import math
import sys
import tempfile
from pathlib import Path

import pc2grid
import signature


def main(map_yaml: str, visitors: str = "5", map_length_m: str = "60", query_length_m: str = "5") -> None:
    """Map the plan, locate the visitors, and print the error of each answer."""
    plan, config = pc2grid.load_map(map_yaml), signature.Config()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mapper = pc2grid.SimulationConfig(length_m=float(map_length_m), seed=1, clutter=5)
        made = pc2grid.simulate_session(folder / "map.mcap", sensor="laser", grid=plan, config=mapper)
        session, origin = signature.build_session(made.path, "map", config)
        signature.add_session(folder / "map.submaps", session, config, origin)
        # The origin of the map is the place where the robot started.
        T_plan_map = next(pc2grid.read_tum(made.truth_path).poses())

        with signature.open_database(folder / "map.submaps") as database:
            for number in range(int(visitors)):
                visit = pc2grid.SimulationConfig(length_m=float(query_length_m), seed=100 + number, clutter=5)
                path = folder / f"visit{number}.mcap"
                made = pc2grid.simulate_session(path, sensor="laser", grid=plan, config=visit)
                with pc2grid.open_log(path) as log:
                    answer = signature.locate(pc2grid.follow(log.scans(), config), database, config)
                truth = list(pc2grid.read_tum(made.truth_path).poses())[-1]
                if answer.T_map_base is None:
                    print(f"visitor {number}: {answer.status}, confidence {answer.confidence:.2f}")
                    continue
                found = T_plan_map @ answer.T_map_base
                off_m = math.hypot(found.x - truth.x, found.y - truth.y)
                print(f"visitor {number}: located, {off_m:.2f} m off, confidence {answer.confidence:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
