"""What a terminal sees, and what a pipe sees."""

import contextlib
import os
import pty
import re
import select
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO

import pytest
from rich.progress import Progress
from typer.main import get_command

import pc2grid
from pc2grid.io.maps import save_map
from pc2grid.observer import Observer, ProgressBars
from pc2grid_cli import console, demo, main
from pc2grid_cli.console import Console
from pc2grid_cli.output import show, table
from pc2grid_cli.view import ViewServer
from pc2grid_lab import sensors
from pc2grid_lab.paper import tables
from tests.helpers.interruptible import interruptible
from tests.helpers.rooms import grid_of, rectangle
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import office

ROOT = Path(__file__).resolve().parents[2]


def on_a_terminal(code: str, *arguments: str, **environment: str) -> str:
    """What a program writes to a terminal that is its stdout and stderr."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdin=theirs, stdout=theirs, stderr=theirs,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}", "TERM": "xterm-256color",
             "COLUMNS": "100", **environment},
    )  # fmt: skip
    os.close(theirs)
    seen = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # Linux: the other end is closed
            break
        if not part:
            break
        seen += part
    assert process.wait(timeout=60) == 0, seen
    os.close(ours)
    return seen.decode()


PROGRAM = "from pc2grid_cli.main import main; main()"
WORKING = """
import time, types
from pc2grid import observer
from pc2grid_cli import console
begin, real = time.monotonic(), time.monotonic
observer.time = types.SimpleNamespace(monotonic=lambda: 20 * (real() - begin))  # a clock in a hurry
with console.Console().progress("work", 100.0) as update:
    for tenth in range(11):
        time.sleep(0.06)
        update(tenth / 10)
"""
COLOUR = re.compile(r"\x1b\[[0-9;]*(?:3[0-7]|38;|9[0-7])[0-9;]*m")


def test_a_terminal_gets_colours_unless_no_color_is_set() -> None:
    assert "\x1b[" in on_a_terminal(PROGRAM, "--help", NO_COLOR="")
    assert "\x1b[" not in on_a_terminal(PROGRAM, "--help", NO_COLOR="1")


def test_a_terminal_gets_a_bar_with_rate_and_time_left() -> None:
    seen = on_a_terminal(WORKING, NO_COLOR="")
    assert COLOUR.search(seen)
    assert re.search(r"\d+%", seen) and "x real time" in seen and re.search(r"0:00:\d\d left", seen)
    plain = on_a_terminal(WORKING, NO_COLOR="1")
    assert not COLOUR.search(plain) and "x real time" in plain


@pytest.mark.parametrize(
    ("shares", "lines"),
    [
        # A line every ten seconds.
        (
            {s: s / 50 for s in range(26)},
            ["20%, 6.0x real time, 0:00:40 left", "40%, 6.0x real time, 0:00:30 left"],
        ),
        # The pace is measured from the first share: what has to be made ready before is no part of it.
        ({40: 0.2, 41: 0.21, 50: 0.4}, ["20%", "40%, 6.0x real time, 0:00:30 left"]),
        # It is that of the last half minute, so the time left goes up where the work becomes slower.
        (
            {0: 0.01, 10: 0.41, 20: 0.42, 30: 0.43, 40: 0.44},
            [
                "41%, 12.0x real time, 0:00:15 left",
                "42%, 6.1x real time, 0:00:29 left",
                "43%, 4.2x real time, 0:00:41 left",
                "44%, 0.3x real time, 0:09:20 left",
            ],
        ),
    ],
)
def test_a_pipe_gets_lines_with_the_pace_and_the_time_left(
    shares: dict[int, float],
    lines: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """If at these seconds so much is done."""
    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    with console.Console().progress("map", 300.0) as update:
        for second, share in shares.items():
            clock[0] = second
            update(share)
    assert capsys.readouterr().err.splitlines() == [f"pc2grid: map: {line}" for line in lines]


def terminal_of(monkeypatch: pytest.MonkeyPatch, *words: str) -> console.Console:
    """The console of a run of the program with these words."""
    ran: list[console.Console] = []
    plain = console.Console.run

    def run(self: console.Console, command: Callable[[], Any]) -> int:
        ran.append(self)
        return plain(self, command)

    monkeypatch.setattr(sys, "argv", ["pc2grid", *words])
    monkeypatch.setattr(console.Console, "run", run)
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 0
    return ran[-1]


@pytest.mark.parametrize(
    "words", [["-q", "config", "schema"], ["config", "-q", "schema"], ["config", "schema", "--quiet"]]
)
def test_global_options_may_stand_behind_the_command(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = terminal_of(monkeypatch, *words)
    assert terminal.quiet
    with terminal.progress("quiet") as update:
        update(0.5)
    terminal.note("nothing")
    assert capsys.readouterr().err == ""


def test_global_options_add_up(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    terminal = terminal_of(monkeypatch, "-v", "config", "-vv", "schema", "--verbose", "--debug")
    assert (terminal.verbose, terminal.quiet, terminal.debug) == (4, False, True)
    assert terminal_of(monkeypatch, "-vvv", "config", "schema").verbose == 3


@pytest.mark.parametrize("name", ["-q", "--debug", "--json", "-v"])
def test_a_value_that_looks_like_an_option_stays_a_value(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_map(office(), tmp_path / "office")
    monkeypatch.chdir(tmp_path)
    terminal = terminal_of(monkeypatch, "convert", "office.yaml", "--name", name, "-o", "office.submaps")
    assert (terminal.verbose, terminal.quiet, terminal.debug) == (0, False, False)
    assert capsys.readouterr().out.startswith(f"{name}: ")


def test_words_behind_two_dashes_are_no_options(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pc2grid", "info", "--", "-q"])
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 1
    assert "-q: no such file" in capsys.readouterr().err


def test_compiling_is_noted_once(capsys: pytest.CaptureFixture[str]) -> None:
    import numba

    terminal = console.Console()
    for _ in range(2):
        with terminal.step("work"):
            assert numba.njit(lambda x: x + 1)(1) == 2
            assert numba.njit(lambda x: x + 2)(1) == 3
    assert capsys.readouterr().err.count("compiling what") == 1


@pytest.mark.parametrize("observer", [console.Console(), ProgressBars()])
def test_progress_is_updated_ten_times_a_second(observer: Observer, monkeypatch: pytest.MonkeyPatch) -> None:
    """However often it is reported: for a laser that is converted, at each scan."""
    clock, updated = [0.0], []
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(Progress, "update", lambda bars, task, **what: updated.append(what))
    with observer.step("work"):
        for number in range(2000):
            clock[0] = number * 0.001
            observer.on_progress(number / 2000)
    assert 15 <= sum("completed" in what for what in updated) <= 21


def test_the_version_needs_no_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pc2grid", "--version"])
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 0
    assert capsys.readouterr() == (f"pc2grid {pc2grid.__version__}\n", "")


@pytest.mark.parametrize("words", [[], ["config"], ["db"]])
def test_a_group_alone_shows_its_help(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pc2grid", *words])
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 2
    out, err = capsys.readouterr()
    assert out == "" and "pc2grid: error" not in err
    assert f"Usage: {' '.join(['pc2grid', *words])} [OPTIONS] COMMAND" in err and "Commands:" in err


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion(shell: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    environment = {
        "_PC2GRID_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_ARGS": "pc2grid reloc",
        "_TYPER_COMPLETE_FISH_ACTION": "get-args", "COMP_WORDS": "pc2grid reloc", "COMP_CWORD": "1",
    }  # fmt: skip
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "argv", ["pc2grid"])
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 0 and "relocalize" in capsys.readouterr().out


def run_until_stopped(command: str) -> subprocess.CompletedProcess[str]:
    """A program of this one command, in a process that signals may stop."""
    program = (
        "import ctypes, os, signal, sys, time\nfrom pc2grid_cli.console import Console\n"
        f"{command}\nsys.exit(Console().run(command))"
    )
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}"}
    return subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        env=environment,
        preexec_fn=interruptible,
    )


STOPPED = pytest.mark.parametrize(("number", "code"), [("SIGINT", 130), ("SIGTERM", 143)])


@STOPPED
@pytest.mark.parametrize("becomes", ["SystemError('a result with an exception set')", "SystemExit(1)"])
def test_signal_that_arrives_as_something_else_is_no_bug(number: str, code: int, becomes: str) -> None:
    done = run_until_stopped(
        f"""
def command():
    try:
        os.kill(os.getpid(), signal.{number})
    except BaseException as stop:
        raise {becomes} from stop
"""
    )
    assert done.returncode == code, done.stderr
    assert "internal error" not in done.stderr


@STOPPED
def test_signal_during_a_callback_of_an_extension_ends_the_program(number: str, code: int) -> None:
    """Python drops what is raised there: without a second signal the program would sleep to its end."""
    done = run_until_stopped(
        f"""
def command():
    ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.{number}))()
    time.sleep(20.0)
"""
    )
    assert done.returncode == code, done.stderr
    assert "Exception ignored" not in done.stderr


def test_a_stopped_program_waits_for_nothing_that_still_runs() -> None:
    """Python's own end would wait for the thread, and has crashed where an extension was half imported."""
    done = run_until_stopped(
        """
def command():
    import threading
    threading.Thread(target=time.sleep, args=(3600.0,)).start()
    os.kill(os.getpid(), signal.SIGTERM)
"""
    )
    assert done.returncode == 143, done.stderr


# --- Tables of all commands look alike, and nothing in them is cut off ---


def test_a_narrow_terminal_cuts_nothing_off(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    made = table("wide", ["map"], [f"number {k}" for k in range(30)])
    made.add_row("lidar", *(f"{k}.000" for k in range(30)))
    show(made)
    out = capsys.readouterr().out
    assert "…" not in out
    assert all(f"number {k}" in out and f"{k}.000" in out for k in range(30))


# --- Standard output is the result of a command: the same bytes whether somebody watches the progress or
# not ---


COMMANDS = (
    "info drive.mcap",
    "info office.yaml --json",
    "convert drive.mcap -o out.submaps",
    "convert office.yaml part.yaml -o out.submaps --jobs 2",
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


@shared_folder("metre_folder")
def folder(folder: Path) -> None:
    """Also a small room, and a folder with the recording alone."""
    save_map(grid_of(rectangle(8.0, 5.0)), folder / "room")
    (folder / "own").mkdir()
    shutil.copy(folder / "drive.mcap", folder / "own")


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
    monkeypatch.setattr(tables, "FLOORS", 0)
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
    "command", [pytest.param(c, marks=[pytest.mark.nightly] if c != "demo" else []) for c in MEASURING]
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
