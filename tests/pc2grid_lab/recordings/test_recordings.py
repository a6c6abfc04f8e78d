"""`pc2grid compare recordings`: a small run over recordings that are good, broken and missing."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
from typer.testing import CliRunner

from pc2grid.io.maps import save_map
from pc2grid.model import OccupancyGrid
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid.simulate.scene import extrude
from pc2grid_cli.main import app
from pc2grid_lab.recordings import catalogue, run
from pc2grid_lab.recordings.catalogue import Pair, Recording, SimulatedDrive
from pc2grid_lab.recordings.run import Followed
from pc2grid_lab.runner import NOT_RUN, Finished, Task, kept_result, run_tasks
from tests.helpers.recordings import ros, write_mcap
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import plan

RECORDINGS = (
    Recording(
        name="a", file="a.mcap", building="office", sensor="laser", truth="a.tum", poses="a.tum", of_base=True
    ),
    Recording(name="b", file="b.mcap", building="office", sensor="laser", same_place=(0, 1)),
    Recording(
        name="driven",
        file="floor.obj",
        building="office",
        sensor="lidar",
        drive=SimulatedDrive(sensor="lidar", length_m=18.0, seed=2),
        mapped=False,
        poses="floor.obj",
        of_base=True,
    ),
    Recording(name="hall.yaml", file="hall.yaml", building="hall", sensor="map", quick=True),
    Recording(name="broken", file="broken.mcap", building="office", sensor="laser"),
    Recording(name="gone", file="gone.mcap", building="office", sensor="laser"),
)
PAIRS = (
    Pair(query="a", map="a", kind="later part", window_s=12.0, windows=2, until_s=70.0),
    Pair(query="b", map="a", kind="other day", window_s=12.0, windows=4),
    Pair(query="a", map="broken", kind="other day", window_s=8.0, windows=1),
    Pair(query="broken", map="a", kind="other day", window_s=8.0, windows=1),
    Pair(query="a", map="gone", kind="other day", window_s=8.0, windows=1),
    Pair(query="driven", map="a", kind="other sensor", window_s=6.0, windows=4, within_s=(0.0, 32.0)),
    Pair(query="b", map="hall.yaml", kind="elsewhere", window_s=8.0, windows=1, quick=True),
)


def rooms() -> OccupancyGrid:
    """14 x 9 m: three rooms at a corridor, no two alike, that a drive of 40 m sees all of."""
    inner = [(0, 5, 2, 5), (3, 5, 8, 5), (9, 5, 14, 5), (4, 5, 4, 9), (10, 5, 10, 9)]
    things = [(6, 7, 7, 7), (7, 7, 7, 8), (1, 2, 1, 3), (5, 1.5, 7, 1.5), (11, 2, 12, 3.5), (12, 7, 13, 7)]
    return plan(14.0, 9.0, [*inner, *things])


@shared_folder()
def data(folder: Path) -> None:
    """Two drives of a laser through an office; its 3D scan; no recording; the map of another building."""
    for name, seed, length_m in (("a", 3, 40.0), ("b", 5, 30.0)):
        slow: dict[str, Any] = {"laser": {"rate_hz": 4.0}, "length_m": length_m, "seed": seed, "clutter": 0}
        config = SimulationConfig.model_validate(slow)
        simulate_session(folder / f"{name}.mcap", sensor="laser", grid=rooms(), config=config)
    corners_m = extrude(rooms(), 2.2).reshape(-1, 3).astype(float)
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(corners_m),
        open3d.utility.Vector3iVector(np.arange(len(corners_m), dtype=np.int32).reshape(-1, 3)),
    )
    open3d.io.write_triangle_mesh(str(folder / "floor.obj"), mesh)
    (folder / "broken.mcap").write_bytes(b"no recording")
    save_map(plan(12.0, 9.0, [(0, 4, 7, 4), (7, 6, 7, 9), (3, 6, 3, 9)]), folder / "hall")


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalogue, "RECORDINGS", RECORDINGS)
    monkeypatch.setattr(catalogue, "PAIRS", PAIRS)
    followed = (Followed(before="b", map="a"), Followed(before="b", map="a", after="b"))
    monkeypatch.setattr(run, "FOLLOWED", followed)


def compare(data: Path, out: Path, *options: str) -> Any:
    arguments = ["compare", "recordings", str(data), "--out", str(out), *options]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done


def in_this_process(*arguments: str | Path) -> Finished:
    """What `pc2grid_lab.runner.pc2grid` does, without a process for each command."""
    done = CliRunner().invoke(app, [*map(str, arguments)])
    said = json.loads(done.stdout) if done.stdout else None
    code = done.exit_code if isinstance(done.exception, SystemExit | None) else 1
    return Finished(code=code, cpu_s=1.0, document=said, error=str(done.exception or ""))


@pytest.mark.nightly  # the tests below run parts of it
@pytest.mark.usefixtures("small")
def test_a_small_run(data: Path, tmp_path: Path) -> None:
    first = compare(data, tmp_path)
    document = json.loads((tmp_path / "real.json").read_text())
    maps = {row["name"]: row for row in document["maps"]}
    assert maps["a"]["error_m"] < RESOLUTION_M and maps["a"]["compared"] > 0.99 and maps["a"]["parts"] == 1
    assert maps["a"]["cpu_s"] > 0.5 and 35 < maps["a"]["metres"] < 45
    assert maps["hall.yaml"]["truth"] == "none" and maps["hall.yaml"]["error_m"] is None
    # The robot starts between its first two scans, so that they are not quite at one place.
    assert maps["b"]["truth"] == "loops" and 0.0 < maps["b"]["error_m"] < 0.15 and "driven" not in maps
    assert "broken.mcap" in maps["broken"]["problem"]
    assert maps["gone"]["problem"] == "not in the data folder"
    later, other, no_map, no_query, missing, driven, elsewhere = document["pairs"]
    assert later["truth"] == "poses"
    found = [q for q in later["queries"] if q["status"] == "located"]
    assert found and all(q["right"] and q["error_m"] < 3 * RESOLUTION_M for q in found)
    assert other["truth"] == "agreement" and other["agreeing"] >= 3
    found = [q for q in other["queries"] if q["status"] == "located"]
    assert len(found) >= 3 and all(
        q["covered"] and q["rank"] == 0 and q["error_m"] < 3 * RESOLUTION_M for q in found
    )
    assert "no map" in no_map["problem"] and no_query["problem"]
    assert missing["problem"] == "gone.mcap: not in the data folder"
    assert driven["sensors"] == "driven lidar in laser" and driven["agreeing"] >= 3
    assert [q["start_s"] for q in driven["queries"]] == [0.0, 8.667, 17.333, 26.0]
    assert all(q["right"] for q in driven["queries"])
    (drive,) = (tmp_path / "drives").glob("*.mcap")
    made_ns = drive.stat().st_mtime_ns
    assert [q["status"] for q in elsewhere["queries"]] == ["not_found"]
    free, carried = document["followed"]
    assert free["judged"] == free["located"] > 10 and free["wrong"] == free["alarms"] == 0
    assert free["noticed_s"] is None and carried["knew"] and carried["shown"]
    assert 0.0 <= carried["noticed_s"] <= carried["located_s"] < 15.0 and carried["located_m"] < 6.0
    assert carried["wrong"] == carried["alarms"] == 0
    assert "nothing to compare with" in first.stdout

    page = (tmp_path / "real.md").read_text()
    words = " ".join(page.split())
    assert "| a | office | laser |" in page and "broken.mcap" in page and "none is known to be wrong" in page
    assert "| a | b | b |" in page and "Of 1 kidnaps of a robot that knew where it was, 1 are" in words
    kept = json.loads((tmp_path / "real.json").read_text())

    # The answers are there: the next run computes nothing, and tells what the table had otherwise.
    kept["maps"][0] |= {"error_m": 0.9, "parts": 0}
    for query in kept["pairs"][1]["queries"]:
        query["error_m"], query["right"] = 9.0, False
    (tmp_path / "before.json").write_text(json.dumps(kept))
    again = compare(data, tmp_path, "--table", str(tmp_path / "before.json"))
    assert "- a: error 0.900 ->" in again.stdout and "- **worse** a: parts 0 -> 1" in again.stdout
    assert "- b in a: right 0 ->" in again.stdout
    assert json.loads((tmp_path / "before.json").read_text())["maps"] == document["maps"]
    assert "Changed since the run before" in (tmp_path / "before.md").read_text()
    assert drive.stat().st_mtime_ns == made_ns


@pytest.mark.usefixtures("small")
def test_ones_own_recordings_need_no_catalogue(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later parts of a drive are located in the map of its beginning, and judged by the poses beside it."""
    monkeypatch.setattr(run, "pc2grid", in_this_process)  # the next test starts processes
    own = tmp_path / "own"
    own.mkdir()
    for suffix in (".mcap", ".tum"):
        shutil.copy(data / f"b{suffix}", own / f"mine{suffix}")
    (own / "torn.mcap").write_bytes(b"no recording")
    compare(own, tmp_path / "out", "--of-base", "--jobs", "1")
    document = json.loads((tmp_path / "out" / "real.json").read_text())
    mine, torn = document["maps"]
    assert (mine["name"], mine["building"], mine["truth"]) == ("mine.mcap", "own", "poses")
    assert mine["error_m"] < RESOLUTION_M and "torn.mcap" in torn["problem"]
    (later,) = document["pairs"]
    assert (later["kind"], later["truth"]) == ("later part", "poses") and len(later["queries"]) == 4
    assert any(query["right"] and query["status"] == "located" for query in later["queries"])
    assert all(query["right"] for query in later["queries"] if query["status"] == "located")
    (tmp_path / "empty").mkdir()
    done = CliRunner().invoke(app, ["compare", "recordings", str(tmp_path / "empty")])
    assert "holds no recording" in str(done.exception)


@pytest.mark.usefixtures("small")
def test_a_part_of_a_run_replaces_no_table(data: Path, tmp_path: Path) -> None:
    done = compare(data, tmp_path, "--quick", "--page")
    assert "| hall.yaml | hall | map |" in done.stdout and "| a | office |" not in done.stdout
    assert "The quick form" in done.stdout and "there is no" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["work"]


@pytest.mark.usefixtures("small")
def test_what_cannot_be_run_is_refused(data: Path, tmp_path: Path) -> None:
    def refused(*arguments: str) -> str:
        done = CliRunner().invoke(app, ["compare", "recordings", *arguments])
        assert done.exit_code != 0
        return str(done.exception)

    assert "no such folder" in refused(str(tmp_path / "nowhere"))
    assert "--only moon: no recording" in refused(str(data), "--out", str(tmp_path), "--only", "moon")
    (tmp_path / "real.json").write_text("{}")
    assert "not a table" in refused(str(data), "--out", str(tmp_path), "--only", "gone")


# --- What is kept of the commands of a run ---


@pytest.mark.parametrize(("code", "is_kept"), [(0, True), (1, True), (-11, True), (130, False), (143, False)])
def test_a_command_that_was_stopped_is_done_by_the_next_run(tmp_path: Path, code: int, is_kept: bool) -> None:
    """A crash is a result; somebody who ends the program is none."""
    done = Finished(code=code, cpu_s=1.0, document=None)
    file, told = tmp_path / "answers" / "a.json", list[float]()
    run_tasks([Task(file, lambda: done, 0.0)], 1, told.append)
    assert told == [1]
    assert (kept_result(file).error != NOT_RUN) == is_kept


def test_a_disturbed_recording_has_other_last_bits(tmp_path: Path) -> None:
    """Points are moved by at most 1e-5 m; stamps and other messages stay as they are."""
    encoder, source, target = ros(), tmp_path / "a.mcap", tmp_path / "b.mcap"
    cloud = np.random.default_rng(0).uniform(-5.0, 5.0, (50, 3))
    drive = [
        encoder.tf(1, "odom", "base", 0.5),
        encoder.odometry("/odom", 2, 1.0),
        encoder.cloud("/points", 3, cloud),
        encoder.camera("/info", 4, 3, 3, 500.0),
    ]
    run.write_disturbed(write_mcap(source, drive), target, 1)
    before, after = (list(run.stored_messages(path)) for path in (source, target))
    assert [m.log_time_ns for m in after] == [1, 2, 3, 4]
    assert [m.data for m in after[:2]] == [m.data for m in before[:2]]
    points, camera = (
        np.array([read(encoder.store.deserialize_cdr(m[k].data, m[k].schema.name)) for m in (before, after)])
        for k, read in (
            (2, lambda content: content.data.view(np.float32)),
            (3, lambda content: np.array((content.k[0], content.p[0])) / 500.0),
        )
    )
    for pair in (points, camera):
        assert 0.0 < np.abs(pair[0] - pair[1]).max() < 1.1e-5
