"""An office, made once for all tests of commands."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from pc2grid.io.maps import save_map
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app
from tests.helpers.simulated_drives import cut, office


@pytest.fixture(scope="session")
def office_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """office.yaml, part.yaml of it, its database b.submaps, and drive.mcap, a laser's 8 m in it."""
    folder = tmp_path_factory.mktemp("office")
    save_map(office(), folder / "office")
    save_map(cut(office(), 4.0, 3.0, 15.0, 12.0), folder / "part")
    convert = ["convert", str(folder / "office.yaml"), "-o", str(folder / "b.submaps")]
    assert CliRunner().invoke(app, convert, catch_exceptions=False).exit_code == 0
    drive = SimulationConfig(length_m=8.0, seed=4, clutter=0)
    simulate_session(folder / "drive.mcap", sensor="laser", grid=office(), config=drive)
    return folder
