"""The program as a user meets it: exit codes, one-line errors, nothing left behind, a quick --help."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from pc2grid.io.maps import save_map
from pc2grid.model import OccupancyGrid
from pc2grid_cli.console import Console
from pc2grid_cli.main import app
from tests.helpers.interruptible import interruptible
from tests.helpers.shared_folders import shared_folder

ROOT = Path(__file__).resolve().parents[2]


def pc2grid(*arguments: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """The program as its entry point runs it, but in this process: starting one takes a second."""
    out, err, before, terminal = io.StringIO(), io.StringIO(), Path.cwd(), Console()
    words = [*map(str, arguments)]
    os.chdir(cwd)
    try:
        with (
            mock.patch.dict(os.environ, {"PC2GRID_CONFIG": "", "COLUMNS": "200", **environment}),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            code = terminal.run(lambda: app(words, prog_name="pc2grid", standalone_mode=False, obj=terminal))
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        os.chdir(before)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def python(code: str, *arguments: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=240,
        env={
            **os.environ,
            "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}",
            "PC2GRID_CONFIG": "",
            "PC2GRID_DEBUG": "",
            "COLUMNS": "200",
            **environment,
        },
    )


@shared_folder()
def house(folder: Path) -> None:
    """A folder with the map of a small house and a laser recording made in it."""
    cells = np.full((180, 240), 0, np.int8)
    cells[:3], cells[-3:], cells[:, :3], cells[:, -3:] = 100, 100, 100, 100
    cells[88:91, :100], cells[88:91, 120:], cells[:60, 150:153], cells[120:, 80:83] = 100, 100, 100, 100
    cells[30:40, 30:50], cells[140:150, 180:186] = 100, 100
    save_map(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-2.0, -3.0)), folder / "house")
    words = "simulate house.yaml drive.mcap --sensor laser --length 8 --seed 5 --clutter 0"
    made = pc2grid(*words.split(), cwd=folder)
    assert made.returncode == 0, made.stderr


def assert_says(result: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """One line of error, perhaps one of advice, nothing on stdout, no traceback."""
    assert result.returncode == code, result.stderr
    assert result.stdout == ""
    lines = [line for line in result.stderr.splitlines() if not line.startswith("pc2grid: warning")]
    assert lines[0].startswith("pc2grid: error: "), result.stderr
    assert len(lines) <= 2
    assert all(line.startswith("hint: ") for line in lines[1:])
    for word in words:
        assert word in result.stderr, result.stderr


def test_map_and_recording_become_databases_and_the_recording_is_found(house: Path, tmp_path: Path) -> None:
    database = tmp_path / "b.submaps"
    made = pc2grid("convert", house / "house.yaml", "-o", database, "--json", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    document = json.loads(made.stdout)
    assert document["sessions"][0]["sensor"] == "map"
    assert document["sessions"][0]["submaps"] > 0

    before = database.read_bytes()
    found = pc2grid(
        "relocalize", house / "drive.mcap", "--database", database, "--json",
        "--trajectory", "q.tum", "--output", "q.mcap", "--plot", "q.png", cwd=tmp_path,
    )  # fmt: skip
    assert found.returncode in (0, 4), found.stderr
    answer = json.loads(found.stdout)
    assert set(answer) >= {
        "schema_version", "status", "pose", "T_map_odom", "confidence", "hypotheses", "history",
        "query", "database", "timing_ms",
    }  # fmt: skip
    assert (answer["status"] == "located") == (found.returncode == 0) == (answer["pose"] is not None)
    assert (tmp_path / "q.png").read_bytes().startswith(b"\x89PNG")
    truth = np.loadtxt(house / "drive.tum")[-1]
    best = answer["pose"] or answer["hypotheses"][0]
    assert np.hypot(best["x"] - truth[1], best["y"] - truth[2]) < 0.5
    if answer["status"] == "located":
        poses = np.loadtxt(tmp_path / "q.tum")
        assert np.hypot(*(poses[-1, 1:3] - [best["x"], best["y"]])) < 1e-6
        assert (tmp_path / "q.mcap").stat().st_size > 0
    assert database.read_bytes() == before
    assert_says(pc2grid("convert", house / "house.yaml", "-o", database, cwd=tmp_path), 1, "--force", "--add")
    assert database.read_bytes() == before


def test_convert_export_add_and_check(house: Path, tmp_path: Path) -> None:
    made = pc2grid("convert", house / "drive.mcap", "-o", "d.submaps", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    assert "drive: " in made.stdout
    again = pc2grid("convert", house / "drive.mcap", "-o", "e.submaps", cwd=tmp_path)
    assert again.returncode == 0
    assert (tmp_path / "d.submaps").read_bytes() == (tmp_path / "e.submaps").read_bytes()

    assert pc2grid("db", "check", "d.submaps", cwd=tmp_path).stdout == "d.submaps: sound\n"
    info = json.loads(pc2grid("db", "info", "d.submaps", "--json", cwd=tmp_path).stdout)
    assert info["sessions"][0]["sensor"] == "laser"
    words = "export d.submaps --map m --trajectory t.tum --mcap o.mcap --plot p.png"
    out = pc2grid(*words.split(), cwd=tmp_path)
    assert out.returncode == 0, out.stderr
    assert {p.name for p in tmp_path.iterdir()} >= {"m.yaml", "m.pgm", "t.tum", "o.mcap", "p.png"}
    assert len(np.loadtxt(tmp_path / "t.tum")) == info["sessions"][0]["scans"]
    assert_says(pc2grid("export", "d.submaps", "--map", "m", cwd=tmp_path), 1, "m.yaml", "--force")

    added = pc2grid("convert", tmp_path / "m.yaml", "-o", "d.submaps", "--add", cwd=tmp_path)
    assert added.returncode == 0, added.stderr
    assert pc2grid("db", "info", "d.submaps", cwd=tmp_path).stdout.startswith("d.submaps: 2 sessions")
    assert_says(pc2grid("export", "d.submaps", "--map", "n", cwd=tmp_path), 1, "drive, m", "--session")

    data = bytearray((tmp_path / "e.submaps").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "e.submaps").write_bytes(data)
    checked = pc2grid("db", "check", "e.submaps", cwd=tmp_path)
    assert checked.returncode == 1
    assert "checksum" in checked.stdout or "malformed" in checked.stdout


def test_a_map_without_free_space_is_stored_with_a_warning(tmp_path: Path) -> None:
    cells = np.full((40, 40), 100, np.int8)
    save_map(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0)), tmp_path / "rock")
    made = pc2grid("convert", "rock.yaml", "-o", "rock.submaps", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    assert "0 submaps" in made.stdout
    assert "warning: rock: no free space" in made.stderr


def test_config_dump_reads_back_and_flags_win(house: Path, tmp_path: Path) -> None:
    dumped = pc2grid("config", "dump", "--set", "partition.radius_m=5.5", cwd=tmp_path)
    assert dumped.returncode == 0
    (tmp_path / "mine.toml").write_text(dumped.stdout)
    again = pc2grid("config", "dump", "--config", "mine.toml", cwd=tmp_path)
    assert again.stdout == dumped.stdout
    assert "radius_m = 5.5" in again.stdout
    from_environment = pc2grid("config", "dump", cwd=tmp_path, PC2GRID_CONFIG="mine.toml")
    assert from_environment.stdout == dumped.stdout
    flags = pc2grid(
        "config", "dump", "--config", "mine.toml", "--set", "partition.radius_m=6.5", cwd=tmp_path
    )
    assert "radius_m = 6.5" in flags.stdout


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    shown = pc2grid("--debug", "db", "info", "none.submaps", cwd=tmp_path)
    assert shown.returncode == 1
    assert "Traceback" in shown.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_convert_leaves_nothing(house: Path, tmp_path: Path, number: int, code: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", "from pc2grid_cli.main import main; print('loaded', flush=True); main()",
         "convert", str(house / "drive.mcap"), "-o", "x.submaps"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=interruptible,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}"},
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.readline()  # from here on it is the program that is interrupted, however slow the machine
    time.sleep(1.0)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == code, said
    assert "Traceback" not in said
    assert ("interrupted: each file is complete, or as it was before" in said) == (number == signal.SIGINT)
    assert list(tmp_path.iterdir()) == []


def test_closed_pipe_is_quiet(tmp_path: Path) -> None:
    command = f'"{sys.executable}" -c "from pc2grid_cli.main import main; main()" config dump | true'
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}", "PC2GRID_CONFIG": ""}
    done = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.stderr == ""


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
_OF_OTHER_COMMANDS = ("pc2grid.simulate", "pc2grid_lab", "signature.localization.joining", "dask", "psycopg")


def test_a_laser_is_located_without_libraries_for_other_things(house: Path, tmp_path: Path) -> None:
    assert pc2grid("convert", house / "house.yaml", "-o", "h.submaps", cwd=tmp_path).returncode == 0
    others = (*_FOR_PICTURES, *_OF_OTHER_SENSORS, *_NOT_IN_USE, *_OF_OTHER_COMMANDS)
    loaded = f"[name for name in {others} if name in sys.modules]"
    question = ("relocalize", house / "drive.mcap", "-d", "h.submaps", "--duration", "3")
    assert after(loaded, *question, cwd=tmp_path) == ["[]", "[]"]


def test_info_of_a_recording_loads_nothing_that_computes(house: Path) -> None:
    others = ("scipy.spatial", "scipy.linalg", "networkx", "kiss_icp", "open3d", "matplotlib")
    loaded = f"[name for name in {others} if name in sys.modules]"
    assert after(loaded, "info", house / "drive.mcap", cwd=house) == ["[]", "[]"]


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
        for _ in range(5)
    ]
    assert statistics.median(ours / bare for ours, bare in pairs) < 4.0
