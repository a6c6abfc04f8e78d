"""evo reads what export writes. It is GPL and no dependency: the test runs its programs if they are there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.io.trajectory import write_tum
from pc2grid.model import SessionMap, Trajectory
from pc2grid.submaps.partition import partition
from pc2grid_cli.export import export_command
from signature.config import Config
from signature.sessions import add_sessions, provenance
from tests.helpers.simulated_drives import plan

needs_evo = pytest.mark.skipif(
    not (shutil.which("evo_ape") and shutil.which("evo_traj")), reason="evo is not installed"
)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with room.yaml, room.pgm, room.tum as exported, and a truth that jumps 0.1 m to and fro."""
    folder = tmp_path_factory.mktemp("evo")
    config, grid = Config(), plan(12, 9, [(4, 0, 4, 5)])
    poses = [SE2(1.0 + 0.2 * k, 2.0 + 0.01 * k * k, 0.1 * k) for k in range(20)]
    stamps = 1_700_000_000_000_000_000 + np.arange(20) * 100_000_000
    way = Trajectory(stamps_ns=stamps, T_session_base=np.array([p.lift() for p in poses]))
    room = SessionMap(
        session="room", sensor="laser", grid=grid, submaps=partition(grid, config.partition), trajectory=way
    )
    database = folder / "room.submaps"
    add_sessions(database, [(room, provenance(Path("room.mcap"), "a" * 64, config))], config, keep=False)
    export_command(str(database), map_=folder / "room", trajectory=folder / "room.tum")
    beside = [SE2(p.x, p.y + 0.1 * (k % 2), p.yaw).lift() for k, p in enumerate(poses)]
    write_tum(folder / "truth.tum", Trajectory(stamps_ns=stamps, T_session_base=np.array(beside)))
    return folder


def run(folder: Path, *command: str) -> str:
    # A home of its own: evo keeps settings there.
    environment = {**os.environ, "HOME": str(folder), "MPLBACKEND": "Agg"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@needs_evo
def test_evo_ape_measures_an_exported_trajectory(exported: Path) -> None:
    said = run(exported, "evo_ape", "tum", "truth.tum", "room.tum", "--align")
    rmse = re.search(r"rmse\s+([0-9.]+)", said)
    assert rmse is not None and 0.04 < float(rmse.group(1)) < 0.055


@needs_evo
def test_evo_traj_draws_an_exported_trajectory_on_its_map(exported: Path) -> None:
    said = run(
        exported,
        "evo_traj",
        "tum",
        "room.tum",
        "--ref",
        "truth.tum",
        "--ros_map_yaml",
        "room.yaml",
        "--plot_mode",
        "xy",
        "--save_plot",
        "plot.png",
    )
    assert "20 poses" in said
    assert any(path.stat().st_size > 1000 for path in exported.glob("plot*.png"))
