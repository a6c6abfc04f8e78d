"""A folder as a user's: recordings, maps and databases by the names that README and docstrings use."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from pc2grid.io import open_log
from pc2grid.io.nav2_map import load_map, save_map
from pc2grid.model import OccupancyGrid, SessionMap, Trajectory
from pc2grid.partition import partition
from pc2grid.pipeline import build_map
from pc2grid.simulate import SimulationConfig, simulate_session
from signature.build import add_sessions, provenance
from signature.config import Config
from tests.drives import office
from tests.test_map_query import cut


def furnish(folder: Path) -> None:
    """monday.mcap and tuesday.mcap (a laser in the office), map.yaml and part.yaml (of it),
    building.submaps (of monday.mcap) and plan.submaps (of map.yaml)."""
    save_map(office(), folder / "map")
    save_map(cut(office(), 4.0, 3.0, 15.0, 12.0), folder / "part")
    for name, seed, length_m in (("monday", 4, 14.0), ("tuesday", 7, 4.0)):
        config = SimulationConfig(length_m=length_m, seed=seed, clutter=0, start_m=(10.0, 7.0))
        simulate_session(folder / f"{name}.mcap", sensor="laser", grid=office(), config=config)
    config = Config()
    with open_log(folder / "monday.mcap") as log:
        monday = build_map(log, config, session="monday")
        origin = provenance(folder / "monday.mcap", log.digest(), config)
    add_sessions(folder / "building.submaps", [(monday, origin)], config, keep=False)
    grid = load_map(folder / "map.yaml")
    entry = (_of_map("map", grid, config), provenance(folder / "map.yaml", "0" * 64, config))
    add_sessions(folder / "plan.submaps", [entry], config, keep=False)


def _of_map(name: str, grid: OccupancyGrid, config: Config) -> SessionMap:
    none = Trajectory(stamps_ns=[], T_map_base=np.empty((0, 4, 4)))
    submaps = partition(grid, config.partition)
    return SessionMap(session=name, sensor="map", grid=grid, submaps=submaps, trajectory=none)


def copy(workplace: Path, folder: Path) -> Path:
    """A copy of a furnished folder to work in."""
    return Path(shutil.copytree(workplace, folder, dirs_exist_ok=True))
