"""Where in the database is this robot? Asked as it drives, as a node on a robot would.

python examples/locate_a_robot.py tuesday.mcap building.submaps
"""

from __future__ import annotations

import math
import sys

import pc2grid
import signature


def main(recording: str, database: str) -> None:
    """Feed scans until the answer is `located`, then print it."""
    with signature.open_database(database) as opened, pc2grid.open_log(recording) as log:
        # Made once, to be asked again and again; of a large database it reads what it needs when it needs it.
        # Queries are treated as the maps were.
        config = opened.config()
        relocalizer = signature.Relocalizer(signature.Building.of(opened, config))
        asked_m = 0.0
        for registered, sweep in pc2grid.follow(log.scans(), config):
            relocalizer.add(registered, sweep)
            if relocalizer.path_m - asked_m < 1.0:
                continue
            asked_m = relocalizer.path_m
            answer = relocalizer.answer()
            print(f"after {asked_m:.1f} m: {answer.status}, confidence {answer.confidence:.3f}")
            if answer.T_map_base is not None:
                x, y, yaw_deg = answer.T_map_base.x, answer.T_map_base.y, math.degrees(answer.T_map_base.yaw)
                print(f"in {answer.session} at x {x:.2f} m, y {y:.2f} m, {yaw_deg:.0f} deg")
                return
    print("the recording ended before that was clear")


if __name__ == "__main__":
    main(*sys.argv[1:])
