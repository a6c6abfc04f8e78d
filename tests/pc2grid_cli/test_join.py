"""`db join`, and what is in the frame of a building afterwards."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid import load_map
from pc2grid.errors import ConfigError, DatabaseError
from pc2grid.io.maps import save_map
from pc2grid.io.trajectory import read_tum
from pc2grid_cli.main import app
from tests.helpers.joined_maps import EAST, T_OFFICE_EAST, WEST, in_frame, part
from tests.helpers.shared_folders import shared_folder


def run(command: str, code: int = 0) -> str:
    done = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    assert done.exit_code == code, done.stderr
    return done.stdout


def document(command: str, code: int = 0) -> Any:
    return json.loads(run(f"{command} --json", code))


@shared_folder()
def folder(folder: Path) -> None:
    """west.yaml, east.yaml, both in b.submaps; joined.submaps, the same joined; drive.mcap in the east."""
    save_map(part(WEST), folder / "west")
    save_map(in_frame(part(EAST), T_OFFICE_EAST), folder / "east")
    run(f"convert {folder}/west.yaml {folder}/east.yaml -o {folder}/b.submaps")
    shutil.copy(folder / "b.submaps", folder / "joined.submaps")
    run(f"db join {folder}/joined.submaps")
    run(f"simulate {folder}/east.yaml {folder}/drive.mcap --sensor laser --length 3 --seed 1 --clutter 0")


@pytest.fixture(autouse=True)
def work(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(shutil.copytree(folder, tmp_path, dirs_exist_ok=True))


def test_the_table_says_what_was_joined_and_a_dry_run_stores_nothing() -> None:
    before = Path("b.submaps").read_bytes()
    said = run("db join b.submaps --dry-run --plot joined.png")
    assert "joined" in said and "in the frame of west:" in said and "nothing was stored" in said
    assert Path("b.submaps").read_bytes() == before
    image = cv2.imread("joined.png")
    assert image is not None and image.std() > 5.0


def test_json_holds_the_pairs_and_where_the_sessions_lie() -> None:
    found = document("db join b.submaps --frame east")
    assert found["stored"] and found["alone"] == []
    (pair,) = found["pairs"]
    assert pair["status"] == "joined" and pair["accepted"] and pair["common_m2"] > 80.0
    assert [(s["session"], s["frame"]) for s in found["sessions"]] == [("west", "east"), ("east", "east")]
    assert "in the frame of" not in run("relocalize drive.mcap -d b.submaps --frame session")


def test_a_single_session_is_refused_and_says_what_to_do() -> None:
    run("db split b.submaps west -o one.submaps")
    with pytest.raises(ConfigError, match="holds 1 session") as refused:
        run("db join one.submaps")
    assert "convert LOG --add" in str(refused.value.hint)


def test_answers_are_in_the_frame_of_the_building_unless_that_of_the_session_is_asked_for() -> None:
    """The drive is in the east; its end in the frame of the west follows from where the east was cut out."""
    run("db split b.submaps east -o alone.submaps")
    poses = read_tum(Path("drive.tum")).planar()
    T = T_OFFICE_EAST
    for database, frame, named, expected in (
        ("joined.submaps", "building", "west", T.apply(poses[-1:, :2])[0]),
        ("joined.submaps", "session", None, poses[-1, :2]),
        ("alone.submaps", "building", None, poses[-1, :2]),
    ):
        answer = document(f"relocalize drive.mcap -d {database} --frame {frame} --trajectory out.tum --force")
        assert answer["frame"] == named
        if answer["session"] == "west":
            pytest.fail("the drive is in the east")
        at = answer["pose"]["x"], answer["pose"]["y"]
        # An answer is good to a cell or two, and so is the join; the sensor sits beside the base.
        assert np.hypot(*np.subtract(at, expected)) < 0.25
        assert np.hypot(*(read_tum(Path("out.tum")).planar()[-1, :2] - at)) < 1e-3


def test_one_map_of_the_building_is_exported() -> None:
    run("export joined.submaps --map whole --cloud whole.ply --plot whole.png")
    image = cv2.imread("whole.png")
    assert image is not None and image.std() > 5.0
    whole = load_map(Path("whole.yaml"))
    assert whole.free_m2 > 1.3 * load_map(Path("west.yaml")).free_m2
    assert whole.is_free(19.0, 7.0) and whole.is_free(1.0, 7.0)
    run("export joined.submaps --map alone --session east --frame session")
    assert np.array_equal(load_map(Path("alone.yaml")).cells, load_map(Path("east.yaml")).cells)
    with pytest.raises(DatabaseError, match="holds 2 sessions: west, east") as refused:
        run("export b.submaps --map no")
    assert "db join" in str(refused.value.hint)
    with pytest.raises(DatabaseError, match="--g2o is of one session") as refused:
        run("export joined.submaps --map no --g2o no.g2o")
    assert "db join" not in str(refused.value.hint)


def test_info_says_what_is_joined_and_in_which_frame() -> None:
    assert document("db info b.submaps")["joined"] == [] and "joined" not in run("info b.submaps")
    told = document("db info joined.submaps")["joined"]
    assert [(s["session"], s["frame"]) for s in told] == [("west", "west"), ("east", "west")]
    for command in ("info", "db info"):
        assert run(f"{command} joined.submaps").endswith("  joined, in the frame of west: west, east\n")


def test_what_is_added_to_a_joined_database_is_joined() -> None:
    run("db split joined.submaps west -o x.submaps")
    added = document("convert east.yaml -o x.submaps --add")
    assert [(s["session"], s["frame"]) for s in added["joined"]] == [("east", "west")]
    assert document("convert east.yaml -o x.submaps --add --name again --no-join")["joined"] == []
    run("db split b.submaps west -o y.submaps")
    assert document("convert east.yaml -o y.submaps --add")["joined"] == []
    assert document("convert east.yaml -o y.submaps --add --name too --join")["joined"] != []


def test_one_place_in_two_sessions_is_ambiguous_until_they_are_joined() -> None:
    run("convert east.yaml -o twice.submaps --name monday")
    run("convert east.yaml -o twice.submaps --add --name tuesday")
    asked = CliRunner().invoke(app, ["relocalize", "drive.mcap", "-d", "twice.submaps"])
    assert asked.exit_code == 4 and "ambiguous: 2 places fit" in asked.stdout
    assert "monday and tuesday are not joined" in asked.stderr and "`pc2grid db join twice" in asked.stderr
    run("db join twice.submaps")
    assert "located in" in run("relocalize drive.mcap -d twice.submaps")
