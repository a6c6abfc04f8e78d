"""Same input, configuration and version: the same bytes."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pc2grid.io.maps import save_map
from pc2grid.model import SensorKind
from pc2grid.simulate import SimulationConfig, simulate_session
from tests.helpers.rooms import small_house

ROOT = Path(__file__).resolve().parent.parent


THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")


def convert(*inputs: Path, output: Path, hash_seed: int, threads: int | None = None) -> bytes:
    """A fresh process, as sets and dictionaries must not leave their order in the result either.

    threads : what the user says of all libraries; None: nothing.
    """
    environment = {name: value for name, value in os.environ.items() if name not in THREADS}
    if threads is not None:
        environment |= dict.fromkeys(THREADS, str(threads))
    done = subprocess.run(
        [sys.executable, "-c", "from pc2grid_cli.main import main; main()", "convert", *inputs,
         "-o", output],
        cwd=output.parent, capture_output=True, text=True, timeout=240,
        env={
            **environment, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}", "PC2GRID_CONFIG": "",
            "PYTHONHASHSEED": str(hash_seed),
        },
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return output.read_bytes()


def test_recordings_of_each_sensor_give_the_same_database_again(tmp_path: Path) -> None:
    lengths_m: dict[SensorKind, float] = {"laser": 1.5, "lidar": 0.4, "depth": 0.8}
    for sensor, length_m in lengths_m.items():
        config = SimulationConfig(length_m=length_m, seed=3, clutter=2)
        simulate_session(tmp_path / f"{sensor}.mcap", sensor=sensor, grid=small_house(), config=config)
    logs = [tmp_path / f"{sensor}.mcap" for sensor in lengths_m]
    first = convert(*logs, output=tmp_path / "a.submaps", threads=1, hash_seed=1)
    again = convert(*logs, output=tmp_path / "b.submaps", hash_seed=2)
    assert first == again


def test_two_processes_at_once_give_the_same_database(tmp_path: Path) -> None:
    """Each is slowed down by the other, at another place each time."""
    config = SimulationConfig(length_m=1.0, seed=3, clutter=2)
    simulate_session(tmp_path / "drive.mcap", sensor="lidar", grid=small_house(), config=config)
    with ThreadPoolExecutor(2) as pool:
        outputs = [tmp_path / "a.submaps", tmp_path / "b.submaps"]
        first, second = pool.map(
            lambda output: convert(tmp_path / "drive.mcap", output=output, hash_seed=1), outputs
        )
    assert first == second
    assert sorted(path.name for path in tmp_path.glob(".*")) == []


def test_a_map_gives_the_same_database_wherever_it_lies(tmp_path: Path) -> None:
    """Two folders, two working directories: no path, clock or process number is in the bytes."""
    results = []
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        yaml, _ = save_map(small_house(), folder / "house")
        os.utime(yaml, (number * 1000, number * 1000))
        results.append(convert(yaml, output=folder / "x.submaps", hash_seed=number))
    assert results[0] == results[1]


def test_a_simulated_recording_is_the_same_again(tmp_path: Path) -> None:
    config = SimulationConfig(length_m=0.6, seed=3, clutter=2)
    for name in ("a", "b"):
        simulate_session(tmp_path / f"{name}.mcap", sensor="laser", grid=small_house(), config=config)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
