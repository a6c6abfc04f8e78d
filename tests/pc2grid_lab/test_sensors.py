"""The sensor matrix: its measures over given trials, and one small run."""

import json
import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.io.maps import save_map
from pc2grid.model import Health, Trajectory
from pc2grid_cli.main import app
from pc2grid_lab import sensors
from pc2grid_lab.recordings.table import QueryRow
from pc2grid_lab.sensors import RegisteredSession, Trial, matrix
from tests.helpers.simulated_drives import office, plan


def trial(*, in_building: bool = True, **changes: Any) -> Trial:
    """A depth camera located rightly in a lidar's map after 10 m, with some fields changed."""
    row = QueryRow(
        window=0,
        start_s=0.0,
        travel_m=10.0,
        status="located",
        confidence=0.95,
        covered=True,
        right=True,
        error_m=0.05,
        rank=0,
        cpu_s=0.01,
    )
    return Trial("lidar", "depth", in_building, replace(row, **changes))


def test_a_cell_counts_the_trials_in_the_map_of_their_own_building() -> None:
    trials = [
        trial(),
        trial(error_m=0.15, rank=7),
        trial(right=False, error_m=5.0, rank=None),
        trial(status="ambiguous", right=True, rank=30),
        trial(status="not_found", right=False, error_m=None, rank=3),
        trial(in_building=False, covered=False, right=False),
        trial(covered=False, status="not_found", right=False),
    ]
    (cell,) = matrix(trials)
    assert cell["trials"] == 5
    assert cell["located_right"] == pytest.approx(2 / 5)
    assert cell["wrong"] == pytest.approx(1 / 3)
    assert cell["ambiguous"] == cell["not_found"] == pytest.approx(1 / 5)
    assert cell["recall"] == pytest.approx((1 / 5, 2 / 5, 3 / 5))
    assert cell["median_error_m"] == pytest.approx(0.10) and cell["look_up_ms"] == pytest.approx(10.0)
    (nothing,) = matrix([trial(status="not_found", right=False, error_m=None)])
    assert nothing["median_error_m"] is None and nothing["wrong"] == 0.0


def test_a_laser_finds_itself_in_its_own_building_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensors, "SENSORS", ("laser",))
    save_map(office(), tmp_path / "office")
    save_map(plan(12.0, 9.0, [(0, 4, 7, 4), (7, 6, 7, 9), (3, 6, 3, 9)]), tmp_path / "hall")
    words = [
        "compare",
        "sensors",
        tmp_path / "office.yaml",
        tmp_path / "hall.yaml",
        "--out",
        tmp_path / "out",
    ]
    words += ["--queries", 1, "--map-length", 30, "--clutter", 0, "--rate", 5, "--travel", 5, "--jobs", 1]
    done = CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)
    assert done.exit_code == 0 and "queries from another building: " in done.stdout
    document = json.loads((tmp_path / "out" / "matrix.json").read_text())
    assert sum(document["elsewhere"].values()) == 2 and "located" not in document["elsewhere"]
    last = next(cell for cell in document["cells"] if cell["travel_m"] == 5.0)
    assert last["trials"] == 2 and last["located_right"] > 0.0 and last["median_error_m"] < 0.15
    kept = [pickle.loads(file.read_bytes()) for file in (tmp_path / "out" / "trials").iterdir()]
    trials = [trial for found in kept for trial in found]
    assert all(not t.row.right and not t.row.covered for t in trials if not t.in_building)
    assert all(0.0 < t.row.cpu_s < math.inf for t in trials)


# --- The truth of a registered session is that of its last part ---


T_WORLD_ODOM = SE2(5.0, -3.0, math.radians(40.0))


def driven(lost_at: int | None, jump: SE2) -> RegisteredSession:
    """Twenty scans, 0.1 m apart; from the lost one on, registered poses are wrong by `jump`."""
    T_odom_base = [SE2(0.1 * k, 0.0, 0.0) for k in range(20)]
    registered = [jump @ T if lost_at is not None and k >= lost_at else T for k, T in enumerate(T_odom_base)]
    truth = [T_WORLD_ODOM @ T for T in T_odom_base]
    health = tuple(Health.LOST if k == lost_at else Health.FINE for k in range(20))
    nothing = {
        "hits_m": np.empty((0, 2), np.float32),
        "origin_m": np.zeros(2),
        "free_m": np.zeros(8, np.float32),
    }
    return RegisteredSession(
        sensor="laser",
        planar_scans=tuple(
            PlanarScan(stamp_ns=k, normal_rad=np.empty(0, np.float32), **nothing) for k in range(20)
        ),
        trajectory=Trajectory(
            stamps_ns=np.arange(20), T_session_base=np.array([T.lift() for T in registered]), health=health
        ),
        T_world_base=np.array([(T.x, T.y, T.yaw) for T in truth]),
    )


@pytest.mark.parametrize("lost_at", [None, 3, 12, 19])
def test_scans_from_before_registration_was_lost_do_not_count(lost_at: int | None) -> None:
    jump = SE2(0.2, 0.1, math.radians(30.0)) if lost_at is not None else SE2()
    error = T_WORLD_ODOM.inverse() @ driven(lost_at, jump).T_world_odom() @ jump
    assert math.hypot(error.x, error.y) < 1e-6 and abs(error.yaw) < 1e-6
