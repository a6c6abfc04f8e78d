"""Sensors compared on real data: the transform that the answers agree with, the cells, one small run."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.geometry import SE2
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid.simulate.scene import extrude
from pc2grid_cli.json_schemas import schema
from pc2grid_cli.main import app
from pc2grid_lab.experiments.real_sensors import (
    FrameAgreement,
    RealQuery,
    frame_of,
    real_cells,
    share_interval,
)
from pc2grid_lab.experiments.sensor_map import SensorMap
from tests.helpers.json_schema import closed
from tests.helpers.simulated_drives import office
from tests.helpers.trials import trial

T_FLOOR_LOG = SE2(3.0, -2.0, 0.7)


def answer(T_map_base: SE2) -> Any:
    """As much of an answer as the transform is fitted to."""
    hypothesis = SimpleNamespace(fit=SimpleNamespace(T_map_query=T_map_base))
    return SimpleNamespace(hypotheses=(hypothesis,), T_odom_base=SE2())


def maps() -> dict[str, SensorMap]:
    index = cast(Any, None)
    lidar = SensorMap(name="floor", sensor="lidar", T_plan_map=SE2(1.0, 0.5, -0.2), index=index)
    return {"lidar": lidar, "laser": replace(lidar, sensor="laser", T_plan_map=SE2(0.1, 0.0, 0.05))}


def real_query(sensor: Any, seed: int, true: SE2, found_in_frame: SE2) -> RealQuery:
    """A query and its answer across the frames. found_in_frame : in the frame of the other map."""
    name = "lidar" if sensor == "laser" else "laser"
    T_map_base = maps()[name].T_plan_map.inverse() @ found_in_frame
    return RealQuery(
        sensor=sensor,
        seed=seed,
        T_frame_base=true,
        query=cast(Any, None),
        answers={name: answer(T_map_base)},
        look_up_ms={name: 1.0},
    )


def queries(right: int, wrong: int) -> list[RealQuery]:
    """Right answers, within some centimetres, and wrong ones that agree with nothing."""
    rng = np.random.default_rng(2)
    made = []
    for k in range(right + wrong):
        true = SE2(*rng.uniform(-15, 15, 2), rng.uniform(-3, 3))
        sensor = "laser" if k % 2 else "lidar"
        there = T_FLOOR_LOG if sensor == "laser" else T_FLOOR_LOG.inverse()
        noise = SE2(*rng.normal(0, 0.03, 2), rng.normal(0, 0.005))
        found = there @ true @ noise if k < right else SE2(*rng.uniform(-15, 15, 2), rng.uniform(-3, 3))
        made.append(real_query(sensor, k, true, found))
    return made


def test_transform_is_the_one_that_most_answers_agree_with() -> None:
    agreement = FrameAgreement.of(queries(8, 12), maps())
    assert agreement.agreeing == 8 and len(agreement.clues) == 20
    found = agreement.T_floor_log
    assert found is not None
    assert math.hypot(found.x - T_FLOOR_LOG.x, found.y - T_FLOOR_LOG.y) < 0.05
    assert found.yaw == pytest.approx(T_FLOOR_LOG.yaw, abs=0.005)


def test_no_answer_is_judged_by_itself() -> None:
    made = queries(3, 0)
    agreement = FrameAgreement.of(made, maps())
    alone = FrameAgreement.of(made[1:], maps())
    assert agreement.without(0) == alone.T_floor_log
    assert FrameAgreement.of(made[:1], maps()).without(0) is None
    assert FrameAgreement.of([], maps()).T_floor_log is None


def test_only_the_laser_is_in_the_frame_of_the_log() -> None:
    assert [frame_of(s) for s in ("lidar", "depth", "scan", "laser")] == ["floor", "floor", "floor", "log"]


def test_cells_keep_what_the_map_does_not_cover_apart() -> None:
    trials = [
        trial(seed=0),
        trial(seed=1, error_m=0.15),
        trial(seed=2, right=False, error_m=9.0),
        trial(seed=3, status="ambiguous", right=False),
        trial(seed=4, status="not_found", mapped=0.1, right=False, error_m=None),
        trial(seed=5, mapped=0.1, right=False, error_m=7.0),
        trial(query_sensor="laser"),
    ]
    cell, other = real_cells(trials)
    assert (cell.query_sensor, other.query_sensor) == ("depth", "laser")
    assert (cell.queries, cell.in_map, cell.right, cell.wrong, cell.ambiguous) == (6, 4, 2, 1, 1)
    assert (cell.refused_outside, cell.wrong_outside, cell.not_found) == (1, 1, 0)
    assert (cell.right_first, cell.located_right) == (2, 2)
    assert cell.median_error_m == pytest.approx(0.10)
    assert cell.low is not None and cell.high is not None and 0 <= cell.low < 0.5 < cell.high <= 1


def test_interval_resamples_whole_sessions() -> None:
    apart = [trial(seed=k, right=k % 2 == 0) for k in range(20)]
    # The same answers, but in two sessions that are right or wrong as a whole.
    together = [trial(seed=k % 2, right=k % 2 == 0) for k in range(20)]
    low, high = share_interval(apart)
    assert low is not None and high is not None and 0.2 < low < 0.5 < high < 0.8
    assert share_interval(together) == (0.0, 1.0)
    assert share_interval([]) == (None, None)
    assert share_interval([trial()]) == (1.0, 1.0)


@pytest.mark.slow
def test_small_run(tmp_path: Path) -> None:
    """The mesh of an office is the 3D scan; a simulated laser in the same office writes the log."""
    import open3d as o3d

    mesh = extrude(office(), 2.2)
    made = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices_m.astype(float)),
        o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32)),
    )
    o3d.io.write_triangle_mesh(str(tmp_path / "floor.obj"), made)
    slow: dict[str, Any] = {"laser": {"rate_hz": 4.0}, "length_m": 30.0, "seed": 3, "clutter": 2}
    simulate_session(
        tmp_path / "log.mcap",
        sensor="laser",
        grid=office(),
        config=SimulationConfig.model_validate(slow),
    )
    command = (
        f"compare real {tmp_path / 'floor.obj'} {tmp_path / 'log.mcap'} --out {tmp_path / 'out'} --json"
        " --queries 1 --query-time 8 --window 12 --every 25 --map-length 18 --clutter 0 --rate 2 --jobs 1"
    )
    done = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    document = json.loads(done.stdout)
    jsonschema.validate(document, closed(schema("compare-real")))
    assert document["agreeing"] >= 2
    assert {(c["map_sensor"], c["query_sensor"]) for c in document["cells"]} >= {
        ("lidar", "laser"),
        ("laser", "lidar"),
        ("lidar", "lidar"),
        ("depth", "laser"),
        ("scan", "lidar"),
        ("scan", "depth"),
        ("scan", "laser"),
    }
    assert sum(c["wrong"] + c["wrong_outside"] for c in document["cells"]) == 0
    assert sum(c["right"] for c in document["cells"]) >= 3
    assert (tmp_path / "out" / "real.png").stat().st_size > 10_000


def test_files_that_do_not_fit(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_bytes(b"")
    done = CliRunner().invoke(app, ["compare", "real", "gone.ply", str(tmp_path / "log.mcap")])
    assert done.exit_code != 0
