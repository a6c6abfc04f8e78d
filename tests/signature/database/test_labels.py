"""Building and floor: given when converting, kept in the database, named in answers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pc2grid.io.maps import save_map
from pc2grid_cli.main import app
from pc2grid_cli.relocalize import as_text
from signature.config import Config
from signature.database import Label, open_database
from signature.localization.localizer import locate_map
from signature.localization.map_index import MapIndex
from tests.helpers.simulated_drives import plan

ROOM = plan(6, 4, [(2, 0, 2, 2), (4, 2, 6, 2)])


@pytest.mark.parametrize(
    ("a", "b", "contradict"),
    [
        (Label(), Label(), False),
        (Label(building="A", floor="1"), Label(building="A", floor="1"), False),
        (Label(building="A", floor="1"), Label(building="A"), False),
        (Label(building="A"), Label(), False),
        (Label(building="A", floor="1"), Label(building="A", floor="2"), True),
        (Label(building="A", floor="1"), Label(building="B", floor="1"), True),
    ],
)
def test_what_was_not_said_contradicts_nothing(a: Label, b: Label, contradict: bool) -> None:
    assert a.contradicts(b) is b.contradicts(a) is contradict


def test_convert_takes_labels_and_relocalize_names_them(tmp_path: Path) -> None:
    save_map(ROOM, tmp_path / "room")
    made = tmp_path / "d.submaps"
    arguments = [
        "convert",
        str(tmp_path / "room.yaml"),
        "-o",
        str(made),
        "--building",
        "hall",
        "--floor",
        "2",
    ]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    with open_database(made) as database:
        answer = locate_map(ROOM, MapIndex.of(database, Config()))
    assert answer.label == Label(building="hall", floor="2")
    assert answer.to_json()["floor"] == "2"
    assert "in room (hall, 2): x" in as_text(answer, is_map=True)
    shown = CliRunner().invoke(app, ["db", "info", str(made), "--json"])
    assert json.loads(shown.stdout)["sessions"][0]["building"] == "hall"
