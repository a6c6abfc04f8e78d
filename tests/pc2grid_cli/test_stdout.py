"""Standard output is the result of a command: the same bytes whether somebody watches the progress or not."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from pc2grid.io.maps import save_map
from pc2grid_cli import demo, main
from pc2grid_cli.console import Console
from pc2grid_cli.view import ViewServer
from pc2grid_lab import sensors
from pc2grid_lab.paper import scale
from tests.helpers.rooms import grid_of, rectangle

COMMANDS = (
    "info drive.mcap",
    "info office.yaml --json",
    "convert drive.mcap -o out.submaps",
    "convert drive.mcap office.yaml -o out.submaps --jobs 2",
    "convert office.yaml part.yaml -o out.submaps --join --json",
    "relocalize drive.mcap -d b.submaps",
    "relocalize drive.mcap -d b.submaps --check 99 99 0 --json",
    "relocalize drive.mcap -d b.submaps --every 0.5",
    "relocalize drive.mcap -d b.submaps --every 0.5 --json",
    "relocalize drive.mcap office.yaml -d b.submaps --json",
    "watch drive.mcap -d b.submaps",
    "watch drive.mcap -d b.submaps --json",
    "export two.submaps --session part --map out --json",
    "simulate office.yaml out.mcap --sensor laser --length 0.5 --clutter 0",
    "db info two.submaps",
    "db check b.submaps",
    "db join two.submaps",
    "db merge b.submaps -o out.submaps",
    "db copy b.submaps -o out.submaps",
    "db split two.submaps part -o out.submaps",
    "db rename b.submaps office plan",
    "db remove two.submaps part",
    "view b.submaps --port 0 --no-browser",
    "config dump",
    "config schema relocalize",
)
MEASURING = {
    "demo": b"page to look into it: demo_out/report.html",
    "compare paper --maps room.yaml --queries 1 --methods proposed --jobs 1": b"Table III",
    "compare sensors office.yaml --queries 1 --map-length 3 --travel 1 --clutter 0 --rate 2 --jobs 1": (
        b"matrix.json"
    ),
    "compare peers drive.mcap --of-base --queries 1 --travel 1": b"peers.json",
    "compare scale --maps . --queries 1 --jobs 1": b"scale.png",
    "compare recordings own": b"drive.mcap",
}
"""Print how long it took, so their bytes differ from run to run; with some of these bytes."""
_NIGHTLY = [command for command in MEASURING if {"paper", "scale", "recordings"} & {*command.split()}]


@pytest.fixture(scope="module")
def folder(office_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The office, a laser's metre in it, also in a folder of its own, and a database of two sessions."""
    folder = shutil.copytree(office_folder, tmp_path_factory.mktemp("stdout"), dirs_exist_ok=True)
    laser = ("--sensor", "laser", "--length", "1.5", "--seed", "4", "--clutter", "0", "--force")
    for arguments in (
        ("simulate", folder / "office.yaml", folder / "drive.mcap", *laser),
        ("convert", folder / "office.yaml", folder / "part.yaml", "-o", folder / "two.submaps"),
    ):
        assert CliRunner().invoke(main.app, [*map(str, arguments)], catch_exceptions=False).exit_code == 0
    save_map(grid_of(rectangle(8.0, 5.0)), folder / "room")
    (folder / "own").mkdir()
    shutil.copy(folder / "drive.mcap", folder / "own")
    return folder


@contextlib.contextmanager
def terminal() -> Iterator[TextIO]:
    """A terminal that somebody looks at."""
    ours, theirs = pty.openpty()

    over = threading.Event()

    def look() -> None:
        while not over.is_set():
            if select.select([ours], [], [], 0.05)[0]:
                os.read(ours, 65536)

    looker = threading.Thread(target=look)
    looker.start()
    with os.fdopen(theirs, "w") as stream:
        yield stream
        over.set()
        looker.join()
    os.close(ours)


def stdout_of(command: str, stderr: TextIO, folder: Path) -> bytes:
    """What the program writes to a file as its stdout, run in this process in a copy of a folder."""
    with pytest.MonkeyPatch.context() as patch, (folder.parent / f"{folder.name}.out").open("w+b") as out:
        patch.chdir(folder)
        patch.setattr("sys.stderr", stderr)
        patch.setattr("sys.stdout", open(out.fileno(), "w", closefd=False))  # noqa: SIM115
        console = Console()
        code = console.run(
            lambda: main.app(command.split(), prog_name="pc2grid", standalone_mode=False, obj=console)
        )
        assert code in (0, 4)
        out.seek(0)
        return out.read()


@pytest.fixture
def work(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the folder; there, commands do not take long, and tell no times."""
    for name, value in {"TERM": "xterm-256color", "COLUMNS": "60", "PC2GRID_CONFIG": ""}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(time, "perf_counter", lambda: 0.0)
    monkeypatch.setattr(demo, "MAP_LENGTH_M", 2.0)
    monkeypatch.setattr(demo, "QUERY_LENGTH_M", 1.0)
    monkeypatch.setattr(ViewServer, "serve_forever", lambda server: None)
    monkeypatch.setattr(ViewServer, "url", "http://localhost/")
    monkeypatch.setattr(scale, "FLOORS", 0)
    monkeypatch.setattr(sensors, "SENSORS", ("laser",))
    return shutil.copytree(folder, tmp_path / "work")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_terminal_changes_nothing(command: str, work: Path, tmp_path: Path) -> None:
    again = shutil.copytree(work, tmp_path / "again")
    with terminal() as stderr:
        seen = stdout_of(command, stderr, work)
    with (tmp_path / "err").open("w") as stderr:
        assert seen == stdout_of(command, stderr, again) != b""


@pytest.mark.parametrize(
    "command", [pytest.param(c, marks=[pytest.mark.nightly] if c in _NIGHTLY else []) for c in MEASURING]
)
def test_a_terminal_takes_nothing_away(command: str, work: Path) -> None:
    with terminal() as stderr:
        assert MEASURING[command] in stdout_of(command, stderr, work)


def test_no_command_is_left_out() -> None:
    app = get_command(main.app)
    groups = {name: getattr(command, "commands", {}) for name, command in app.commands.items()}
    names = {" ".join((name, *inner)) for name, of in groups.items() for inner in ([n] for n in of or [""])}
    tried = [command.split() for command in (*COMMANDS, *MEASURING)]
    assert {name.strip() for name in names} == {
        " ".join(words[: 1 + bool(groups[words[0]])]) for words in tried
    }
