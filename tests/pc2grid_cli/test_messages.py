"""What a user reads who mistook one thing for another: the error, and what to type next."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pc2grid.display import probability
from pc2grid.errors import LogNotFound, MapFileError, NotALog, OutputError, Pc2GridError
from pc2grid.io.nav2_map import save_map
from pc2grid_cli import console
from pc2grid_cli.main import app
from signature.database.protocol import APPLICATION_ID
from signature.database.sqlite.database import store
from tests.helpers.databases import make_entry
from tests.helpers.recordings import drive, write_mcap
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


def test_the_mark_of_a_database_is_the_one_that_is_written(folder: Path) -> None:
    assert (folder / "b.submaps").read_bytes()[68:72] == APPLICATION_ID.to_bytes(4, "big") == b"pc2g"


def test_another_label_is_named(folder: Path) -> None:
    convert = ["convert", "office.yaml", "-o", "labelled.submaps"]
    assert CliRunner().invoke(app, [*convert, "--building", "fr079", "--floor", "0"]).exit_code == 0
    error = CliRunner().invoke(app, convert).exception
    assert isinstance(error, OutputError)
    assert (
        "exists already; its session 'office' has the label 'fr079, 0', this one would have 'no label'"
        in error.message
    )


def test_a_usage_error_is_one_readable_line(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = console.Console()
    code = terminal.run(lambda: app(["simulate", "a.mcap"], standalone_mode=False, obj=terminal))
    assert code == console.USAGE
    line = capsys.readouterr().err.splitlines()[0]
    assert "Choose from: lidar, depth, laser" in line and "\\n" not in line


def test_a_probability_is_never_shown_as_certain() -> None:
    values = (0.0, 0.009, 0.01, 0.5, 0.99, 0.991, 1.0)
    shown = ["< 0.01", "< 0.01", "0.01", "0.50", "0.99", "> 0.99", "> 0.99"]
    assert [probability(value) for value in values] == shown


def test_text_is_calm_and_json_exact(folder: Path) -> None:
    assert CliRunner().invoke(app, ["convert", "office.yaml", "-o", "c.submaps"]).exit_code == 0
    locate = ["relocalize", "office.yaml", "-d", "c.submaps"]
    assert "confidence > 0.99" in CliRunner().invoke(app, locate).stdout
    document = json.loads(CliRunner().invoke(app, [*locate, "--json"]).stdout)
    assert 0.99 < document["confidence"] <= 1.0
