"""A folder with the recordings, maps and databases that README and docstrings name."""

import shutil
from pathlib import Path

from pc2grid.io.maps import save_map
from pc2grid.simulate import SimulationConfig, simulate_session
from signature.config import Config
from signature.sessions import add_sessions, build_session
from tests.helpers.simulated_drives import cut, office


def furnish(folder: Path) -> None:
    """monday.mcap and tuesday.mcap (a laser in the office), map.yaml and part.yaml (of it),
    building.submaps (of monday.mcap) and plan.submaps (of map.yaml)."""
    save_map(office(), folder / "map")
    save_map(cut(office(), 4.0, 3.0, 15.0, 12.0), folder / "part")
    for name, seed, length_m in (("monday", 4, 14.0), ("tuesday", 7, 4.0)):
        config = SimulationConfig(length_m=length_m, seed=seed, clutter=0, start_m=(10.0, 7.0))
        simulate_session(folder / f"{name}.mcap", sensor="laser", grid=office(), config=config)
    for database, source in (("building", "monday.mcap"), ("plan", "map.yaml")):
        session = build_session(folder / source, Path(source).stem, Config())
        add_sessions(folder / f"{database}.submaps", [session], Config(), keep=False)


def copy(desk: Path, folder: Path) -> Path:
    """A copy of a furnished folder to work in."""
    return Path(shutil.copytree(desk, folder, dirs_exist_ok=True))
