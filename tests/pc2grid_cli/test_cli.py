"""The program as a user meets it: exit codes, one-line errors, nothing left behind, a quick --help."""

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.io.maps import save_map
from pc2grid.model import OccupancyGrid
from pc2grid_cli.console import Console
from pc2grid_cli.main import app

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder, and no settings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PC2GRID_CONFIG", "")


def python(code: str, *arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    about = {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}", "PC2GRID_DEBUG": "", "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd, capture_output=True, text=True, timeout=240, env={**os.environ, **about},
    )  # fmt: skip


def test_a_map_without_free_space_is_stored_with_a_warning() -> None:
    cells = np.full((40, 40), 100, np.int8)
    save_map(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0)), Path("rock"))
    made = CliRunner().invoke(app, ["convert", "rock.yaml", "-o", "rock.submaps"])
    assert made.exit_code == 0, made.stderr
    assert "0 submaps" in made.stdout
    assert "warning: rock: no free space" in made.stderr


def test_config_dump_reads_back_and_flags_win(monkeypatch: pytest.MonkeyPatch) -> None:
    def dump(words: str) -> str:
        return CliRunner().invoke(app, ["config", "dump", *words.split()], catch_exceptions=False).stdout

    dumped = dump("--set partition.radius_m=5.5")
    Path("mine.toml").write_text(dumped)
    assert "radius_m = 5.5" in dumped and dump("--config mine.toml") == dumped
    assert "radius_m = 6.5" in dump("--config mine.toml --set partition.radius_m=6.5")
    monkeypatch.setenv("PC2GRID_CONFIG", "mine.toml")
    assert dump("") == dumped


def test_debug_shows_the_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    terminal, words = Console(), ["--debug", "db", "info", "none.submaps"]
    code = terminal.run(lambda: app(words, prog_name="pc2grid", standalone_mode=False, obj=terminal))
    assert code == 1 and "Traceback" in capsys.readouterr().err


def test_help_loads_nothing_heavy(tmp_path: Path) -> None:
    """Of the program and of each command, one after the other; typer itself loads pydantic."""
    code = """
import contextlib, io, sys
from typer.main import get_command
from pc2grid_cli.main import app
heavy = {"numpy", "scipy", "cv2", "open3d", "kiss_icp", "matplotlib", "numba", "networkx", "rosbags", "mcap",
         "google", "apsw", "rich", "pc2grid.settings", "signature.database"}
def said(group, words):
    before = heavy & {*sys.modules}
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        app([*words, "--help"], prog_name="pc2grid")
    assert "--help" in out.getvalue(), words
    print(" ".join(words) or "pc2grid", *sorted(heavy & {*sys.modules} - before), sep=",")
    for name, command in getattr(group, "commands", {}).items():
        said(command, [*words, name])
said(get_command(app), [])
"""
    lines = python(code, cwd=tmp_path).stdout.splitlines()
    assert {"pc2grid", "relocalize", "db join", "config dump", "compare paper"} <= {*lines}, lines
    assert [line for line in lines if "," in line] == []


def after(code: str, *arguments: object, cwd: Path) -> list[str]:
    """What `code` is at the end of a command, and then at the end of `main`, in a process of its own."""
    script = (
        "import gc, sys\nfrom pc2grid_cli import console\nfrom pc2grid_cli.main import main\n"
        "usual, run = gc.get_threshold(), console.Console.run\n"
        "def run_and_tell(terminal, action):\n"
        " try: return run(terminal, action)\n"
        f" finally: print({code}, file=sys.stderr)\n"
        "console.Console.run = run_and_tell\n"
        f"try: main()\nfinally: print({code}, file=sys.stderr)"
    )
    return python(script, "-q", *arguments, cwd=cwd).stderr.splitlines()[-2:]


# A test of a whole command each: importing a library takes up to a tenth of its time.
_FOR_PICTURES = ("matplotlib", "PIL", "rich", "plotly", "dash")
_OF_OTHER_SENSORS = ("open3d",)
_NOT_IN_USE = ("scipy.fft", "scipy.optimize", "scipy.signal", "skimage", "sklearn", "pandas")
_OF_OTHER_COMMANDS = ("pc2grid.simulate", "pc2grid_lab", "signature.join", "dask", "psycopg")


def test_a_laser_is_located_without_libraries_for_other_things(office_folder: Path) -> None:
    others = (*_FOR_PICTURES, *_OF_OTHER_SENSORS, *_NOT_IN_USE, *_OF_OTHER_COMMANDS)
    loaded = f"[name for name in {others} if name in sys.modules]"
    question = ("relocalize", "drive.mcap", "-d", "b.submaps", "--duration", "3")
    assert after(loaded, *question, cwd=office_folder) == ["[]", "[]"]


def test_info_of_a_recording_loads_nothing_that_computes(office_folder: Path) -> None:
    others = ("scipy.spatial", "scipy.linalg", "networkx", "kiss_icp", "open3d", "matplotlib")
    loaded = f"[name for name in {others} if name in sys.modules]"
    assert after(loaded, "info", "drive.mcap", cwd=office_folder) == ["[]", "[]"]


def test_help_takes_little_longer_than_typer_itself(tmp_path: Path) -> None:
    """A ratio, because machines differ: against Python that starts and loads typer, interleaved."""

    def seconds(code: str) -> float:
        begin = time.perf_counter()
        subprocess.run(
            [sys.executable, "-c", code, "--help"], capture_output=True, check=True,
            env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}"},
        )  # fmt: skip
        return time.perf_counter() - begin

    pairs = [
        (seconds("from pc2grid_cli.main import main; main()"), seconds("import typer, typer.main"))
        for _ in range(3)
    ]
    assert statistics.median(ours / bare for ours, bare in pairs) < 4.0
