"""The sensor matrix: its measures over given trials, its JSON document, and one small run."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from pc2grid.simulate import SimulationConfig, office_floorplan
from pc2grid_cli.console import json_text
from pc2grid_cli.json_schemas import schema
from pc2grid_lab.compare import matrix_report
from pc2grid_lab.compare.sensors import _document
from pc2grid_lab.experiments.ablation import Independence
from pc2grid_lab.experiments.metrics import matrix, reliability
from pc2grid_lab.experiments.registered_session import RegisteredSession, simulate_and_register
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.sensor_matrix import map_building, query_trials
from signature.config import Config
from signature.describe import describe
from signature.localization.localizer import MapIndex
from signature.similarity import SignatureTable
from tests.helpers.json_schema import closed
from tests.helpers.trials import trial


def test_a_trial_consists_of_plain_json_types() -> None:
    stored = json.loads(json.dumps(asdict(trial(error_m=None))))
    assert trial(**stored) == trial(error_m=None)


def test_all_nine_cells_of_the_matrix_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    matrix_report.tables([], [])
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    sensors = ("lidar", "laser", "depth")
    assert [row[:2] for row in rows if row[-1:] == ["0"]] == [[m, q] for m in sensors for q in sensors]


def test_a_cell_counts_the_trials_in_the_map_of_their_own_building() -> None:
    trials = [
        trial(),
        trial(error_m=0.15, rank=7),
        trial(right=False, error_m=5.0, rank=-1),
        trial(status="ambiguous", right=True, rank=30),
        trial(status="not_found", right=False, error_m=None, rank=3),
        trial(building="b", in_building=False, mapped=0.0, right=False),
        trial(mapped=0.2, status="not_found", right=False),
    ]
    (cell,) = matrix(trials)
    assert cell.trials == 5
    assert cell.located_right == pytest.approx(2 / 5)
    assert cell.wrong == pytest.approx(1 / 3)
    assert cell.ambiguous == cell.not_found == pytest.approx(1 / 5)
    assert cell.recall == {1: pytest.approx(1 / 5), 5: pytest.approx(2 / 5), 20: pytest.approx(3 / 5)}
    assert cell.median_error_m == pytest.approx(0.10)


def test_unknown_numbers_are_null_in_the_document() -> None:
    """No trial is located rightly, no plan was used for tuning, and no signatures are compared."""
    trials = [
        trial(status="not_found", right=False, error_m=None, rank=-1),
        trial(building="b", in_building=False, mapped=0.0, status="not_found", right=False),
    ]
    nothing = Independence(combination="boundary", same=np.empty(0), other=np.empty(0))
    about = {"plans": ["a", "b"], "queries": 1, "setting": {"rate": 10.0, "seed": 1}, "change": {}}
    text = json_text({**_document(trials, {"boundary": nothing}, 8.0), **about})
    document = json.loads(text, parse_constant=pytest.fail)
    jsonschema.validate(document, closed(schema("compare-sensors")))
    (cell,) = document["cells"]
    assert (cell["trials"], cell["median_error_m"], cell["recall"]["20"]) == (1, None, 0.0)
    assert document["confidence"]["tuned on"]["brier"] is None
    assert document["confidence"]["other plans"]["reliability"] == [[0.95, 0.0, 2]]
    assert document["elsewhere"] == {"trials": 1, "not_found": 1, "located": 0}
    assert document["independence"]["boundary"] == {"auc": None, "same": 0, "other": 0}
    assert document["ablation"]["recall"]["all"]["with isovists"]["1"] is None  # nobody drove 8 m


def test_reliability_compares_confidence_with_truth() -> None:
    rows = reliability([trial(confidence=0.95), trial(confidence=0.91, right=False), trial(confidence=1.0)])
    assert rows == [(pytest.approx((0.95 + 0.91 + 1.0) / 3), pytest.approx(2 / 3), 3)]


def test_a_laser_finds_itself_in_a_map_made_by_another_session(tmp_path: Path) -> None:
    plan = office_floorplan(3, 22.0, 20.0)
    config = Config()
    session, T_plan_map = map_building(
        "office", plan, "laser", SimulationConfig(length_m=40, seed=1000, clutter=8), config
    )
    table = SignatureTable.of(
        [describe(s, config.signature) for s in session.submaps], [s.center_m for s in session.submaps]
    )
    index = MapIndex({session.session: session.grid}, table, config, config)
    sensor_map = SensorMap(name="office", sensor="laser", T_plan_map=T_plan_map, index=index)
    queries = SimulationConfig(length_m=8, seed=4, clutter=8)
    query = simulate_and_register(plan, "laser", queries, config, until_m=6.0)
    query.save(tmp_path / "query.npz")
    loaded = RegisteredSession.load(tmp_path / "query.npz")
    trials = query_trials("office", 4, loaded, [sensor_map], (2.0, 6.0))
    assert [t.travel_m for t in trials] == [2.0, 6.0]
    assert trials[-1].status == "located" and trials[-1].right
    assert trials[-1].error_m is not None and trials[-1].error_m < 0.15
    elsewhere = replace(sensor_map, name="another building")
    (last,) = query_trials("office", 4, loaded, [elsewhere], (2.0, 6.0))
    assert last.travel_m == 6.0 and not last.in_building and not last.right and last.mapped == 0.0
