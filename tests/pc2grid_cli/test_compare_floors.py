"""`compare floors` shows stored results without computing them again."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import jsonschema
from typer.testing import CliRunner

from pc2grid_cli.json_schemas import schema
from pc2grid_cli.main import app
from signature.evaluation.floors import FloorResult, FloorTask


def test_stored_results_are_shown(tmp_path: Path) -> None:
    for alike, right in ((True, 2), (False, 5)):
        task = FloorTask(seed=1, way="lift", alike=alike)
        result = FloorResult(
            told_apart=True, named=False, right=right, wrong=0, ambiguous=6 - right, not_found=0, misplaced=1
        )
        name = f"lidar.lift.012.{'alike' if alike else 'differs'}.1.15m.8m.2.json"
        (tmp_path / name).write_text(json.dumps({**asdict(task), **asdict(result)}))
    arguments = ["compare", "floors", "--ways", "lift", "--seeds", "1", "-o", str(tmp_path)]
    done = CliRunner().invoke(app, [*arguments, "--json"], catch_exceptions=False)
    document = json.loads(done.stdout)
    jsonschema.validate(document, schema("compare-floors"))
    assert [row["right"] for row in document["rows"]] == [2, 5]
    table = CliRunner().invoke(app, arguments, catch_exceptions=False).stdout
    assert ["lift", "alike", *"11024001", "39.0%"] in [line.split() for line in table.splitlines()]


def test_an_unknown_way_is_named(tmp_path: Path) -> None:
    arguments = ["compare", "floors", "--ways", "ladder", "-o", str(tmp_path)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code != 0
    assert "ladder" in str(done.exception)
