"""`--rerun`: where it streams to, what it refuses before any work, and what a viewer gets to see, live."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.errors import ConfigError, OutputError
from pc2grid.model import OccupancyGrid
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli import rerun_stream, rerun_target
from pc2grid_cli.main import app
from tests.helpers.interruptible import interruptible
from tests.helpers.simulated_drives import office


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A laser's few metres in the office, and a database of them."""
    folder = tmp_path_factory.mktemp("rerun")
    drive = SimulationConfig(length_m=4.0, seed=4, clutter=0)
    simulate_session(folder / "drive.mcap", sensor="laser", grid=office(), config=drive)
    run("convert", folder / "drive.mcap", "-o", folder / "b.submaps")
    return folder


def run(*words: object) -> str:
    done = CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    return done.stderr


@pytest.mark.parametrize(
    ("target", "url"),
    [
        ("viewer", "rerun+http://127.0.0.1:9876/proxy"),
        ("robot.local:9000", "rerun+http://robot.local:9000/proxy"),
        ("rerun+https://there/proxy", "rerun+https://there/proxy"),
        ("out.rrd", None),
        ("C.rrd", None),
        ("postgresql://host/db", None),
    ],
)
def test_a_viewer_has_an_address_and_a_file_has_none(target: str, url: str | None) -> None:
    assert rerun_target.url_of(target) == url


COMMANDS = {
    "convert": "convert --rerun{} log.mcap -o new.submaps",
    "relocalize": "relocalize --rerun{} log.mcap -d b.submaps",
    "export": "export --rerun{} b.submaps",
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
@pytest.mark.parametrize("where", ["", " out.rrd", " 127.0.0.1:9", "=out.rrd"])
def test_without_the_extra_it_says_what_to_install(
    command: str, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With and without a value: what follows is an input unless it is a place to stream to."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = CliRunner().invoke(app, command.format(where).split())
    assert isinstance(done.exception, ConfigError) and done.exception.hint == "pip install rerun-sdk"
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_streamed_to_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ConnectionRefusedError(111, "Connection refused")

    monkeypatch.setitem(sys.modules, "rerun", types.ModuleType("rerun"))
    monkeypatch.setattr(rerun_target.socket, "create_connection", refuse)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(OutputError, match="no rerun viewer answers: Connection refused") as nobody:
        rerun_target.require_target("robot:9876", force=False)
    assert "start one there with `rerun`" in str(nobody.value.hint)
    with pytest.raises(OutputError, match="no display") as blind:
        rerun_target.require_target("viewer", force=False)
    assert "--rerun HOST:PORT" in str(blind.value.hint)
    monkeypatch.setenv("DISPLAY", ":0")
    rerun_target.require_target("viewer", force=False)
    (tmp_path / "x.rrd").touch()
    with pytest.raises(OutputError, match="exists already"):
        rerun_target.require_target(str(tmp_path / "x.rrd"), force=False)
    rerun_target.require_target(str(tmp_path / "x.rrd"), force=True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("a.mcap b.mcap --rerun out.rrd", "several inputs"),
        ("a.mcap --rerun --jobs 2", "--dask or --jobs"),
        ("a.mcap --dask --rerun", "--dask or --jobs"),
    ],
)
def test_what_a_conversion_cannot_show(
    words: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["convert", *words.split(), "-o", "x.submaps"])
    assert isinstance(done.exception, ConfigError) and said in str(done.exception)


# --- with the SDK ---------------------------------------------------------------------------------------


MAP = {"map/walls", "map/submaps", "map/ways", "map/path", "map/loops"}
LIVE = {"live/base", "live/scan", "live/seen/0/points", "live/seen/0/way", "live/seen/2/way"}
COMMAND = [sys.executable, "-m", "rerun"]


def entities(recording: Path) -> set[str]:
    """The entities in a file, listed by rerun's own tool."""
    told = subprocess.run(
        [*COMMAND, "rrd", "stats", recording], check=True, capture_output=True, text=True
    ).stdout
    return {line[1:].rpartition(": ")[0] for line in told.splitlines() if line.startswith("/")}


@pytest.fixture
def sdk() -> None:
    pytest.importorskip("rerun", reason="the extra viz is not installed")


@pytest.mark.usefixtures("sdk")
def test_a_file_holds_all_that_was_shown(
    folder: Path, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    run("convert", folder / "drive.mcap", "-o", tmp_path / "x.submaps", "--rerun", tmp_path / "made.rrd")
    query = ("relocalize", folder / "drive.mcap", "-d", folder / "b.submaps")
    run(*query, "--rerun", tmp_path / "found.rrd")
    run("export", folder / "b.submaps", "--rerun", tmp_path / "kept.rrd")
    for name in ("made", "found", "kept"):
        subprocess.run([*COMMAND, "rrd", "verify", tmp_path / f"{name}.rrd"], check=True, capture_output=True)
    assert [w for w in recwarn if "Rerun" in w.category.__name__] == []
    assert {*MAP, "map/base"} == {e for e in entities(tmp_path / "kept.rrd") if e.startswith("map")}
    assert {*MAP, "map/base", *(f"map/{e}" for e in LIVE)} <= entities(tmp_path / "made.rrd")
    found = entities(tmp_path / "found.rrd")
    assert {*MAP, "query/path", "query/hypotheses", "query/base", "query/confidence"} <= found
    assert {"query/evidence/1/walls", "query/evidence/1/missed"} <= found
    assert {"query/live", "query/live/base", "query/live/seen/0/way"} <= found


@pytest.mark.usefixtures("sdk")
def test_the_viewer_opens_above_the_map_with_loops_off_and_a_fixed_axis() -> None:
    from pc2grid_cli.rerun_layout import layout

    world, curve = layout(office(), has_query=True, hidden=["query/evidence/2"]).root_container.contents
    eye = world.properties["EyeControls3D"]
    position, target, up = (
        values.as_arrow_array().flatten().to_pylist()
        for values in (eye.position, eye.look_target, eye.eye_up)
    )
    assert position[:2] == target[:2] == [10.0, 7.0]  # the middle of the office
    assert position[2] > 14.0 and target[2] == 0.0 and up == [0.0, 1.0, 0.0]
    off = {"map/loops", "map/ways", "query/evidence/2"}
    assert {entity for entity, how in world.visualizer_overrides.items() if "[False]" in str(how)} == off
    axis = curve.properties["ScalarAxis"]
    assert axis.range.as_arrow_array().flatten().to_pylist() == [0.0, 1.0]


@pytest.mark.usefixtures("sdk")
def test_a_viewer_sees_it_as_it_happens(folder: Path, tmp_path: Path) -> None:
    """rerun itself listens, and keeps what arrives."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    kept = tmp_path / "kept.rrd"
    viewer = subprocess.Popen(
        [*COMMAND, "--port", str(port), "--save", kept], stderr=subprocess.DEVNULL, preexec_fn=interruptible
    )
    try:
        for _ in range(100):
            with socket.socket() as knock:
                if knock.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        said = run(
            *("convert", folder / "drive.mcap", "-o", tmp_path / "x.submaps", "--rerun", f"127.0.0.1:{port}")
        )
        assert "not all" not in said
        time.sleep(0.5)
    finally:
        viewer.send_signal(signal.SIGINT)
        viewer.wait(timeout=20)
    assert {*MAP, "map/base", *(f"map/{e}" for e in LIVE)} <= entities(kept)


def test_the_image_of_a_grid_begins_with_the_row_of_the_largest_y(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the viewer draws it: the first row at the top, the lower left corner at `translation`."""
    components = types.SimpleNamespace(ImageFormat=dict, Colormap=types.SimpleNamespace(RvizMap="rviz"))
    fake = types.SimpleNamespace(GridMap=dict, components=components)
    monkeypatch.setattr(rerun_stream, "require_rerun", lambda: fake)
    cells = np.array([[0, 100, -1], [0, 0, 0]], np.int8)  # y is smallest in the first row
    made = rerun_stream._grid_map(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(1.0, 2.0)))
    assert list(made["data"]) == [0, 0, 0, 0, 100, 255]
    assert (made["format"]["width"], made["format"]["height"]) == (3, 2)
    assert made["translation"][:2] == [1.0, 2.0] and made["translation"][2] < 0.0
