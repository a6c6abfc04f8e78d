"""Locate a robot in a database while it drives, as a node on the robot would.

python examples/locate_a_robot.py tuesday.mcap building.submaps
"""

from __future__ import annotations

import math

import typer

import pc2grid


def main(recording: str, database: str) -> None:
    """Add scans until the answer is `located`, then print it."""
    with pc2grid.open_database(database) as opened, pc2grid.open_log(recording) as log:
        # The index is made once for many queries. It reads the maps of a large database when they are needed.
        # Queries are processed with the settings that made the maps.
        config = opened.config()
        localizer = pc2grid.Localizer(pc2grid.MapIndex.of(opened, config))
        for registered, planar_scan in pc2grid.follow(log.scans(), config):
            answer = localizer.add(registered, planar_scan)
            if answer is None:  # the database is searched after every metre of travel
                continue
            print(f"after {answer.path_m:.1f} m: {answer.status}, confidence {answer.confidence:.3f}")
            if answer.T_map_base is not None:
                x, y, yaw_deg = answer.T_map_base.x, answer.T_map_base.y, math.degrees(answer.T_map_base.yaw)
                print(f"in {answer.session} at x {x:.2f} m, y {y:.2f} m, {yaw_deg:.0f} deg")
                return
    print("the recording ended before the robot was located")


if __name__ == "__main__":
    typer.run(main)
