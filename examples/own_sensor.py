"""Map a sensor that pc2grid does not know, and locate it: your reader makes Scans, the rest does not change.

Here the sensor is a text file with one scan in each line: a time in seconds, then distances in metres at
equally spaced bearings from -135 to 135 degrees, from a scanner 0.2 m in front of the robot's base. `nan`: no
return.

python examples/own_sensor.py monday.txt tuesday.txt own.submaps
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import typer

import pc2grid
import signature

T_BASE_SENSOR = pc2grid.SE2(0.2, 0.0, 0.0).lift()


def read_scans(path: Path) -> Iterator[pc2grid.Scan]:
    """Yield the scans one by one: finite points in the base frame (x forward, y left, z up), in metres."""
    with path.open() as lines:
        for line in lines:
            seconds, *words = line.split()
            ranges_m = np.array([float(word) for word in words])
            bearings = np.radians(np.linspace(-135.0, 135.0, len(ranges_m)))
            points = ranges_m[:, None] * np.column_stack((np.cos(bearings), np.sin(bearings)))
            seen = np.isfinite(ranges_m)
            in_sensor = np.column_stack((points[seen], np.zeros(seen.sum())))
            in_base = in_sensor @ T_BASE_SENSOR[:3, :3].T + T_BASE_SENSOR[:3, 3]
            yield pc2grid.Scan(
                stamp_ns=round(float(seconds) * 1e9),
                points_m=in_base,
                T_base_sensor=T_BASE_SENSOR,
                sensor="laser",  # the most similar of the three kinds
                dropped=int((~seen).sum()),
            )


def main(recording: str, query: str, database: str) -> None:
    """Map the scans of a recording, store the map, and find in it where another recording was made."""
    config = signature.Config()
    path = Path(recording)
    grid, trajectory, loops = pc2grid.map_scans(read_scans(path), config)
    session = pc2grid.SessionMap(
        session=path.stem,
        sensor="laser",
        grid=grid,
        submaps=pc2grid.submaps_of(grid, config.partition),
        trajectory=trajectory,
        loops=loops,
    )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    signature.add_session(database, session, config, signature.provenance(path, digest, config))
    print(f"{len(trajectory)} scans, {len(session.submaps)} submaps, {len(loops)} loops closed")
    with pc2grid.open_database(database) as opened:
        localizer = pc2grid.Localizer(pc2grid.MapIndex.of(opened, config))
        for registered, planar_scan in pc2grid.follow(read_scans(Path(query)), config):
            localizer.add(registered, planar_scan)
        print(localizer.answer())


if __name__ == "__main__":
    typer.run(main)
