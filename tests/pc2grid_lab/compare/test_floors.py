"""`compare floors` shows stored results without computing them again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.geometry import SE2
from pc2grid_cli.json_schemas import schema
from pc2grid_cli.main import app
from pc2grid_lab.compare.floors_report import example_answer, example_of, mapped
from pc2grid_lab.experiments import floors
from pc2grid_lab.experiments.floors import FloorAnswer, FloorResult, FloorStatus, FloorTask, database_file
from signature.config import Config
from signature.database import Label
from signature.sessions import add_sessions, provenance
from tests.helpers.session_maps import session, way
from tests.helpers.simulated_drives import office

NAMES = ("house", "house#2")


def answer(status: FloorStatus) -> FloorAnswer:
    """A query in a room of floor 0 that fits on both floors."""
    located = {"right": NAMES[0], "wrong": NAMES[1]}.get(status)
    return FloorAnswer(
        floor=0,
        status=status,
        confidence=0.5,
        session=located,
        error_m=0.75 if status == "right" else None,
        poses=dict.fromkeys(NAMES, SE2(4.0, 4.0, 0.0)),
        T_house_query=SE2(4.0, 4.0, 0.0),
        walls_m=np.array([(0.0, 1.0), (1.0, 1.0)], np.float32),
    )


def result(*statuses: FloorStatus) -> FloorResult:
    return FloorResult(
        told_apart=True,
        named=False,
        floors=dict(zip(NAMES, (0, 1), strict=True)),
        names=dict(zip(NAMES, ("0", "lift 1"), strict=True)),
        frames=dict.fromkeys(NAMES, SE2()),
        answers=tuple(map(answer, statuses)),
    )


def store(folder: Path, task: FloorTask, made: FloorResult) -> None:
    """As a run of this version of the program leaves it, with a small database."""
    floor = session("house", office(), way())
    origin = provenance("house.mcap", "a" * 64, Config(), label=Label(building="house"))
    maps = [(replace(floor, session=name), origin) for name in NAMES]
    add_sessions(database_file(task, folder), maps, Config(), keep=False)
    digest = database_file(task, folder).name.split(".")[-2]
    made.save(folder / f"{task.house_name}.8m.3.{digest}.json")


def test_stored_results_are_shown(tmp_path: Path) -> None:
    for alike, statuses in (
        (True, ("right", "ambiguous", "wrong")),
        (False, ("right", "right", "not_found")),
    ):
        task = FloorTask(seed=1, way="lift", alike=alike, sensor="laser", visits=(0, 1), queries=3)
        store(tmp_path, task, result(*statuses))
    arguments = ["compare", "floors", "--ways", "lift", "--seeds", "1", "--visits", "0,1", "--queries", "3"]
    arguments += ["-o", str(tmp_path)]
    done = CliRunner().invoke(app, [*arguments, "--json"], catch_exceptions=False)
    document = json.loads(done.stdout)
    jsonschema.validate(document, schema("compare-floors"))
    assert [(row["right"], row["wrong"], row["misplaced"]) for row in document["rows"]] == [
        (1, 1, 1),
        (2, 0, 2),
    ]
    table = CliRunner().invoke(app, arguments, catch_exceptions=False).stdout
    rows = [line.split() for line in table.splitlines()]
    assert ["lift", "alike", *"11011011", "79.2%", "3", "0.667", "[0.667,", "0.667]"] in rows
    assert [row["not_found_in_the_map"] for row in document["rows"]] == [0, 1]
    assert str(tmp_path / "floors.png") in table
    picture = cv2.imread(str(tmp_path / "floors.png"))
    assert picture is not None and picture.std() > 10.0


def test_results_of_another_version_are_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = FloorTask(seed=1, way="lift", alike=True)
    asked: list[Path] = []

    def run(_: FloorTask, database: Path) -> FloorResult:
        asked.append(database)
        return result("ambiguous")

    monkeypatch.setattr(floors, "run_floors", run)
    for digest in ("a" * 12, "a" * 12, "b" * 12):
        monkeypatch.setattr(floors, "program_digest", lambda digest=digest: digest)
        assert floors.stored_floors(task, tmp_path).count("ambiguous") == 1
    assert [database.name.split(".")[-2] for database in asked] == ["a" * 12, "b" * 12]


def test_a_query_from_beyond_the_map_cannot_be_found() -> None:
    made = result("not_found")
    there = made.answers[0].T_house_query.apply(made.answers[0].walls_m)
    grid = office()
    assert np.all(grid.cells[tuple(grid.to_cell(there).T)] >= 0)
    assert len(mapped(made, dict.fromkeys(NAMES, grid)).answers) == 1
    beyond = replace(made, frames=dict.fromkeys(NAMES, SE2(100.0, 0.0, 0.0)))
    assert not mapped(beyond, dict.fromkeys(NAMES, grid)).answers


def test_the_picture_shows_what_went_wrong() -> None:
    task = FloorTask(seed=1, way="lift", alike=True)
    good, bad = result("right", "ambiguous"), result("ambiguous", "wrong")
    assert example_of([(task, good), (task, bad)])[1] is bad
    assert example_of([(task, result("right")), (task, good)])[1] is good
    assert example_answer(bad).status == "wrong"


def test_an_unknown_way_is_named(tmp_path: Path) -> None:
    arguments = ["compare", "floors", "--ways", "ladder", "-o", str(tmp_path)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code != 0
    assert "ladder" in str(done.exception)
