"""Maps compared with the truth: the measures by hand, and a small house from end to end."""

import json
import re

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.config import ProjectionConfig
from pc2grid.geometry import SE2, pose_from_rotation_vector
from pc2grid.io.nav2_map import save_map
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, Health, OccupancyGrid, Trajectory
from pc2grid.simulate import SimulationConfig, office_floorplan, prepare_session
from pc2grid_cli.json_schemas import schema
from pc2grid_cli.main import app
from pc2grid_lab.experiments.map_quality import map_simulated
from pc2grid_lab.experiments.trajectory_error import trajectory_error
from pc2grid_lab.experiments.true_floor import TrueFloor
from signature.config import Config


def trajectory(poses, health=()):
    stamps = np.arange(len(poses)) * 100_000_000
    return Trajectory(stamps_ns=stamps, T_session_base=np.array(poses), health=health)


def bend(count=60):
    return [SE2(0.1 * k, 0.002 * k * k, 0.04 * k).lift() for k in range(count)]


def test_a_trajectory_anywhere_and_in_other_axes_has_no_error():
    moved = pose_from_rotation_vector((0.3, -0.2, 1.0), (5.0, 2.0, 1.0))
    optical = pose_from_rotation_vector((-1.2, 1.2, -1.2))
    error = trajectory_error(trajectory([moved @ T @ optical for T in bend()]), trajectory(bend()))
    assert error.poses == 60
    assert error.ate_m == pytest.approx(0, abs=1e-9) and error.rpe_m == pytest.approx(0, abs=1e-9)
    assert error.rpe_deg == pytest.approx(0, abs=1e-4)


def test_scale_is_an_error_by_hand():
    straight = [SE2(0.1 * k, 0.0, 0.0).lift() for k in range(41)]
    longer = [SE2(0.11 * k, 0.0, 0.0).lift() for k in range(41)]
    error = trajectory_error(trajectory(longer), trajectory(straight))
    assert error.rpe_m == pytest.approx(0.1) and error.rpe_deg == pytest.approx(0, abs=1e-5)
    assert error.ate_m == pytest.approx(0.01 * np.sqrt(np.mean((np.arange(41) - 20.0) ** 2)))


def test_lost_poses_are_not_judged_and_truth_is_interpolated_but_not_over_gaps():
    truth = trajectory(bend())
    wrong = bend()
    wrong[7] = SE2(9.0, 9.0, 0.0).lift()
    health = [Health.FINE] * 60
    health[7] = Health.LOST
    assert trajectory_error(trajectory(wrong, tuple(health)), truth).ate_m == pytest.approx(0, abs=1e-9)
    sparse = Trajectory(stamps_ns=truth.stamps_ns[::2], T_session_base=truth.T_session_base[::2])
    assert trajectory_error(truth, sparse).ate_m < 0.001
    assert trajectory_error(truth, sparse).poses == 59  # not past the end
    gap = Trajectory(stamps_ns=truth.stamps_ns[::20], T_session_base=truth.T_session_base[::20])
    assert trajectory_error(truth, gap).poses == 3
    with pytest.raises(ValueError, match="fewer than three"):
        trajectory_error(trajectory(bend(2)), truth)


@pytest.fixture(scope="module")
def house():
    plan = office_floorplan(3, 22.0, 20.0)
    config = SimulationConfig(length_m=6.0, seed=2, clutter=5)
    return prepare_session(sensor="laser", grid=plan, config=config)


@pytest.fixture(scope="module")
def floor(house):
    floor = TrueFloor(house, ProjectionConfig())
    for reading in house.readings():
        floor.add(reading)
    return floor


def drawn(house, cells):
    plan = house.grid
    return OccupancyGrid(cells=cells.astype(np.int8), resolution_m=plan.resolution_m, origin_m=plan.origin_m)


def test_the_true_plan_is_a_perfect_map_and_a_shifted_one_is_not(house, floor):
    truth = drawn(house, np.where(house.grid.occupied, OCCUPIED, UNKNOWN))
    perfect = floor.judge(truth, SE2())
    assert perfect.occupied_right == 1.0 and perfect.walls_found == 1.0
    neighbour = floor.judge(truth, SE2(house.grid.resolution_m, 0.0, 0.0))
    assert neighbour.occupied_right == 1.0 and neighbour.walls_found == 1.0
    shifted = floor.judge(truth, SE2(0.3, 0.3, 0.0))
    assert shifted.occupied_right < 0.8 and shifted.walls_found < 0.5


def test_free_cells_that_were_never_in_sight_are_counted(house, floor):
    everything = floor.judge(drawn(house, np.full(house.grid.cells.shape, FREE)), SE2())
    assert everything.unseen_free > 0.3 and everything.walls_found == 0.0
    solid = floor.judge(drawn(house, np.full(house.grid.cells.shape, OCCUPIED)), SE2())
    assert solid.free_wrong == 1.0 and solid.walls_found == 1.0


def test_a_small_house_is_mapped_beside_bare_kiss_icp(house):
    shares = []
    run, truth, quality = map_simulated(house, Config(), shares.append)
    assert len(run.trajectory) == len(run.bare) == len(truth) == house.scan_count
    assert trajectory_error(run.trajectory, truth).ate_m < 0.03
    assert run.share(Health.LOST) == 0.0 and run.bare_ms > 0 and run.map_ms > 0
    assert quality.occupied_right > 0.95 and quality.walls_found > 0.85
    assert quality.free_wrong < 0.002 and quality.unseen_free == 0.0
    assert shares == sorted(shares)


def test_command_maps_a_plan_once_and_prints_a_table(tmp_path):
    save_map(office_floorplan(3, 22.0, 20.0), tmp_path / "house")
    plan, out = str(tmp_path / "house.yaml"), tmp_path / "out"
    words = ["compare", "maps", plan, *f"--sensors laser --length 3 --jobs 1 --out {out}".split()]
    table = CliRunner().invoke(app, words, catch_exceptions=False).stdout
    assert re.search(r"house +laser +1 +yes", table) and "bare: ATE, m" in table
    (kept,) = out.glob("*.json")
    row = json.loads(kept.read_text())
    kept.write_text(json.dumps({**row, "loops": 77}))
    document = json.loads(CliRunner().invoke(app, [*words, "--json"], catch_exceptions=False).stdout)
    jsonschema.validate(document, schema("compare-maps"))
    assert [r["loops"] for r in document["rows"]] == [77]  # a stored result is not computed again
