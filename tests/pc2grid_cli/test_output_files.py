"""What options name for writing is checked before any work; the answer is printed before files are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from pc2grid.errors import OutputError
from pc2grid_cli import relocalize
from pc2grid_cli.main import app

EXPORT, LOCATE = "export none.submaps", "relocalize none.mcap -d none.submaps"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (f"{EXPORT} --trajectory way.csv", "way.csv: --trajectory does not write the format .csv"),
        (f"{EXPORT} --mcap map.bag", "map.bag: --mcap does not write the format .bag"),
        (f"{EXPORT} --map plan.png", "plan.png: --map writes STEM.yaml and STEM.pgm"),
        (f"{EXPORT} --cloud walls.las", "walls.las: --cloud"),
        (f"{EXPORT} --cloud walls", "(no suffix)"),
        (f"{EXPORT} --graph ways.dot", "ways.dot: --graph"),
        (f"{EXPORT} --plot a.pdf", "a.pdf: --plot"),
        (f"{EXPORT} --report a.pdf", "a.pdf: --report"),
        (f"{EXPORT} --g2o nowhere/a.g2o", "a.g2o: cannot write: no folder nowhere"),
        (f"{EXPORT} --map nowhere/a", "a.yaml: cannot write: no folder nowhere"),
        (f"{EXPORT} --plot taken.png", "taken.png: exists already"),
        (f"{EXPORT} --plot folder", "folder: is a folder"),
        (f"{LOCATE} --trajectory way.csv", "way.csv: --trajectory"),
        (f"{LOCATE} --csv answers.json", "answers.json: --csv does not write the format .json"),
        (f"{LOCATE} -o answer.bag", "answer.bag: --output"),
        (f"{LOCATE} --initialpose pose.png", "pose.png: --initialpose"),
        (f"{LOCATE} --plot nowhere/a.png", "a.png: cannot write: no folder nowhere"),
        ("convert none.mcap -o x.mcap", "x.mcap: a submap database is not written as .mcap"),
        ("convert none.mcap -o nowhere/x.submaps", "cannot write: no folder nowhere"),
        ("convert none.mcap -o /proc/x.submaps", "/proc/x.submaps: cannot write: "),
        ("simulate nowhere/x.mcap --sensor laser", "x.mcap: cannot write: no folder nowhere"),
        ("simulate taken.mcap --sensor laser", "taken.tum: exists already"),
        ("demo -o /proc/demo", "/proc/demo: cannot make this folder: "),
        ("compare sensors part.yaml -o /proc/out", "/proc/out: cannot make this folder: "),
    ],
)
def test_what_cannot_be_written_is_refused_before_any_work(
    command: str, words: str, office_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("taken.png", "taken.tum"):
        (tmp_path / name).touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "part.yaml").write_bytes((office_folder / "part.yaml").read_bytes())
    before = sorted(tmp_path.iterdir())
    # The recordings and databases do not exist: whoever looked at them first would say so.
    error = CliRunner().invoke(app, command.split()).exception
    assert isinstance(error, OutputError), error
    assert words in error.message
    assert error.hint
    assert sorted(tmp_path.iterdir()) == before


def test_the_file_of_a_map_may_be_named_instead_of_its_stem(office_folder: Path, tmp_path: Path) -> None:
    for name in ("a.yaml", "b.pgm", "c", "d.5"):
        export = ["export", str(office_folder / "b.submaps"), "--map", str(tmp_path / name)]
        assert CliRunner().invoke(app, export, catch_exceptions=False).exit_code == 0
    stems = ("a", "b", "c", "d.5")
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{s}{e}" for s in stems for e in (".pgm", ".yaml")]


def test_the_answer_is_printed_although_a_picture_cannot_be_written(
    office_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def disk_full(*_: Any) -> None:
        raise OutputError("a.png: cannot write: No space left on device")

    monkeypatch.setattr(relocalize, "_write", disk_full)
    locate = ["relocalize", str(office_folder / "part.yaml"), "-d", str(office_folder / "b.submaps")]
    done = CliRunner().invoke(app, [*locate, "--plot", str(tmp_path / "a.png")])
    assert isinstance(done.exception, OutputError)
    assert done.stdout.startswith("located in office: x ")


def test_the_output_of_a_command_has_the_same_option_everywhere() -> None:
    group: Any = get_command(app)
    folders = [group.commands["demo"]]
    folders += [group.commands["compare"].commands[name] for name in ("paper", "sensors", "recordings")]
    for command in folders:
        (option,) = [param for param in command.command.params if "--output" in param.opts]
        assert {"-o", "--output", "--out"} <= set(option.opts), command.name
    databases = [group.commands["convert"], group.commands["relocalize"]]
    databases += [group.commands["db"].commands[name] for name in ("copy", "merge")]
    for command in databases:
        (option,) = [param for param in command.command.params if "--output" in param.opts]
        assert "-o" in option.opts, command.name
