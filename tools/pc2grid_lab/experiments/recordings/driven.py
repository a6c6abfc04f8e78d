"""Recordings that are made: simulated drives through the real 3D scan of a building, with their true poses.

Nobody has recorded one building with a lidar, a depth camera and a laser. A scan of its walls and furniture
lets the first two be driven through it; a laser has recorded it in another year.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

from pc2grid import simulate
from pc2grid.errors import MapFileError
from pc2grid.simulate import Building, SimulationConfig, load_building, simulate_session
from pc2grid_lab.experiments.program import digest_of_sources
from pc2grid_lab.experiments.recordings.catalogue import Drive

_CLUTTER, _RATE_HZ, _COLUMNS = 15, 5.0, 720
"""Things that are in the way, others in each drive; scans a second; columns in a turn of the lidar, as one at
10 Hz sends them: fewer scans save time, not detail. Chosen by hand."""


def write_drive(scan: Path, target: Path, drive: Drive) -> None:
    """Drive through a 3D scan: write the MCAP file `target`, and its true poses beside it as `.tum`.

    Raises MapFileError if the scan cannot be read or is a plan, ConfigError if there is no room in it.
    """
    building = load_building(scan)
    if not isinstance(building, Building):
        raise MapFileError(f"{scan}: a plan, not a 3D scan", hint="a drive needs a cloud or a mesh")
    config = drive_config(drive.length_m, drive.seed)
    target.parent.mkdir(parents=True, exist_ok=True)
    simulate_session(target, sensor=drive.sensor, grid=building, config=config, overwrite=True)


def drive_config(length_m: float, seed: int, start_m: tuple[float, float] | None = None) -> SimulationConfig:
    """Of one drive."""
    return SimulationConfig.model_validate(
        {
            "length_m": length_m,
            "seed": seed,
            "clutter": _CLUTTER,
            "start_m": start_m,
            "lidar": {"rate_hz": _RATE_HZ, "columns": _COLUMNS},
            "depth": {"rate_hz": _RATE_HZ},
        }
    )


@cache
def digest_of_drive(scan: Path, drive: Drive) -> str:
    """Twelve hexadecimal digits that change with the scan, the drive and the simulation."""
    sources = digest_of_sources((Path(simulate.__file__).parent, Path(__file__)))
    shown = hashlib.sha256(f"{sources} {drive}".encode() + scan.read_bytes())
    return shown.hexdigest()[:12]
