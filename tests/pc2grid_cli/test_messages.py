"""What a user reads who mistook one thing for another: the error, and what to type next."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.errors import (
    ConfigError,
    DatabaseError,
    LogNotFound,
    MapFileError,
    NoScans,
    NotADatabase,
    NotALog,
    OutputError,
    Pc2GridError,
)
from pc2grid.io.maps import save_map
from pc2grid_cli import console
from pc2grid_cli.main import REMOVED, app
from signature.database.maintenance import store
from tests.helpers.databases import make_entry
from tests.helpers.recordings import STEP, T0, drive, ros, write_mcap
from tests.helpers.simulated_drives import office


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_mcap(tmp_path / "a.mcap", drive())
    store(tmp_path / "b.submaps", [make_entry("monday")], keep=False)
    save_map(office(), tmp_path / "office")
    (tmp_path / "lost.yaml").write_text((tmp_path / "office.yaml").read_text().replace("office.pgm", "x.pgm"))
    return tmp_path


@pytest.mark.parametrize(
    ("command", "kind", "words", "hint"),
    [
        (
            "relocalize b.submaps -d a.mcap",
            NotALog,
            "b.submaps: a submap database, where a recording or a map is expected",
            "are they swapped? pc2grid relocalize a.mcap -d b.submaps",
        ),
        (
            "convert b.submaps -o c.submaps",
            NotALog,
            "b.submaps: a submap database, not a recording",
            "`pc2grid info b.submaps` shows what is in it",
        ),
        (
            "convert lost.yaml -o c.submaps",
            MapFileError,
            "/x.pgm: cannot read the map's image: No such file or directory",
            "copy it to that place",
        ),
        ("convert office.pgm -o c.submaps", NotALog, "looks like a PGM image", "give the .yaml"),
        ("relocalize ws://localhost:8765 -d b.submaps", LogNotFound, "no such file", "pc2grid watch"),
        ("relocalize - -d b.submaps", LogNotFound, "-: no such file", "pc2grid watch"),
        ("relocalize /dev/null -d b.submaps", LogNotFound, "not a regular file", "pc2grid watch"),
        ("relocalize none.mcap -d b.submaps", LogNotFound, "none.mcap: no such file", "check the path"),
    ],
)
def test_the_error_says_what_to_do(
    command: str, kind: type[Pc2GridError], words: str, hint: str, folder: Path
) -> None:
    error = CliRunner().invoke(app, command.split()).exception
    assert isinstance(error, kind), error
    assert words in error.message
    assert error.hint is not None and hint in error.hint


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What is said of words that are no command."""
    terminal = console.Console()
    code = terminal.run(lambda: app(words, prog_name="pc2grid", standalone_mode=False, obj=terminal))
    assert code == console.USAGE
    return capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(("removed", "instead"), REMOVED.items())
def test_what_was_removed_says_what_to_use(
    removed: str, instead: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(removed.split()[1:], capsys)
    assert said[0].startswith("pc2grid: error: No such ")
    assert said[1:] == [f"hint: {instead}"]


def test_a_recording_in_place_of_a_database_says_how_to_make_one(folder: Path) -> None:
    error = CliRunner().invoke(app, ["relocalize", "a.mcap", "-d", "a.mcap"]).exception
    assert isinstance(error, NotADatabase) and error.message == "a.mcap: not a pc2grid database"
    assert error.hint == "make one of it: pc2grid convert a.mcap -o a.submaps"
    other = CliRunner().invoke(app, ["relocalize", "a.mcap", "-d", "office.pgm"]).exception
    assert isinstance(other, NotADatabase) and other.hint is not None and "convert LOG -o" in other.hint


def test_depth_images_without_their_camera_info_say_so(folder: Path) -> None:
    to, pixels = ros(), np.full((4, 6), 1000, np.uint16)
    images = [to.image("/camera/depth/image", T0 + i * STEP, pixels, "16UC1") for i in range(3)]
    write_mcap(folder / "d.mcap", images)
    for topic in ((), ("--topic", "/camera/depth/image")):
        error = CliRunner().invoke(app, ["convert", "d.mcap", "-o", "x.submaps", *topic]).exception
        assert isinstance(error, NoScans)
        assert error.message == "d.mcap: /camera/depth/image: a depth image without a CameraInfo topic"
        assert error.hint == "record the camera_info topic next to the image"


def test_scans_out_of_order_get_a_hint(folder: Path) -> None:
    """Their headers count down, while the log is in order; more than wait to be sorted."""
    to = ros()
    scans = [
        to.laser("/scan", T0 - i * STEP, [1.0] * 10)._replace(log_time_ns=T0 + i * STEP) for i in range(400)
    ]
    write_mcap(folder / "s.mcap", scans)
    error = CliRunner().invoke(app, ["convert", "s.mcap", "-o", "x.submaps"]).exception
    assert isinstance(error, Pc2GridError) and "stamp goes back in time" in error.message
    assert error.hint is not None and "must increase" in error.hint and "--start" in error.hint


@pytest.mark.parametrize(
    ("assignment", "hint"),
    [
        ("grid.x=1", "`pc2grid config dump` lists all settings"),
        ("grid.resolution_m=1", "did you mean projection.resolution_m?"),
        ("red.topic=/a", "did you mean read.topic?"),
        ("partition.radius=5", "did you mean partition.radius_m?"),
    ],
)
def test_a_setting_that_is_not_known(assignment: str, hint: str) -> None:
    words = ["convert", "a.mcap", "-o", "b.submaps", "--set", assignment]
    error = CliRunner().invoke(app, words).exception
    assert isinstance(error, ConfigError) and error.hint == hint
    assert error.message == f"--set: unknown setting {assignment.partition('=')[0]}"


def test_the_last_session_is_not_removed_unasked(folder: Path) -> None:
    store(folder / "b.submaps", [make_entry("tuesday", 2)], keep=True)
    remove = ["db", "remove", "b.submaps"]
    before = (folder / "b.submaps").read_bytes()
    for names in (["monday", "tuesday"], ["tuesday", "monday", "monday"]):
        error = CliRunner().invoke(app, [*remove, *names]).exception
        assert isinstance(error, DatabaseError) and "no session would be left" in error.message
        assert error.hint is not None and "--force" in error.hint
        assert (folder / "b.submaps").read_bytes() == before
    assert CliRunner().invoke(app, [*remove, "monday"]).exit_code == 0
    left = (folder / "b.submaps").read_bytes()
    assert isinstance(CliRunner().invoke(app, [*remove, "tuesday"]).exception, DatabaseError)
    assert isinstance(CliRunner().invoke(app, [*remove, "monday"]).exception, DatabaseError)  # is not there
    assert (folder / "b.submaps").read_bytes() == left
    done = CliRunner().invoke(app, [*remove, "tuesday", "--force"])
    assert done.exit_code == 0 and "0 sessions left" in done.stdout


def test_the_help_of_a_group_names_all_its_commands() -> None:
    from typer.main import get_command

    group = get_command(app).commands["compare"]  # type: ignore[attr-defined]
    for name in group.commands:
        assert re.search(rf"\b{name}\b", group.help) or (name == "paper" and "the paper's" in group.help)


def test_another_label_is_named(folder: Path) -> None:
    convert = ["convert", "office.yaml", "-o", "labelled.submaps"]
    assert CliRunner().invoke(app, [*convert, "--building", "fr079", "--floor", "0"]).exit_code == 0
    error = CliRunner().invoke(app, convert).exception
    assert isinstance(error, OutputError)
    assert "exists already, 'office' made with building = 'fr079', not None" in error.message


def test_a_usage_error_is_one_readable_line(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = console.Console()
    code = terminal.run(lambda: app(["simulate", "a.mcap"], standalone_mode=False, obj=terminal))
    assert code == console.USAGE
    line = capsys.readouterr().err.splitlines()[0]
    assert "Choose from: lidar, laser, depth" in line and "\\n" not in line


def test_text_is_calm_and_json_exact(folder: Path) -> None:
    assert CliRunner().invoke(app, ["convert", "office.yaml", "-o", "c.submaps"]).exit_code == 0
    locate = ["relocalize", "office.yaml", "-d", "c.submaps"]
    assert "confidence > 0.99" in CliRunner().invoke(app, locate).stdout
    document = json.loads(CliRunner().invoke(app, [*locate, "--json"]).stdout)
    assert 0.99 < document["confidence"] <= 1.0
