"""`pc2grid relocalize` of several recordings, and of windows along them."""

import csv
import json
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from pc2grid.geometry import SE2
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import read_tum, stamp_ns_from_text
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app
from pc2grid_cli.output import schema
from pc2grid_cli.relocalize import write_places
from signature.places.map_index import MapIndex
from tests.helpers.interruptible import interruptible
from tests.helpers.json_schema import closed
from tests.helpers.session_maps import way
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import office


@shared_folder("office_folder")
def folder(folder: Path) -> None:
    """The office, and a.mcap and b.mcap of a laser that drives in it."""
    for name, seed in (("a", 3), ("b", 5)):
        config = SimulationConfig(length_m=4.0, seed=seed, clutter=0)
        simulate_session(folder / f"{name}.mcap", sensor="laser", grid=office(), config=config)
    (folder / "text.mcap").write_text("no recording")


def run(*words: object, code: int = 0) -> Result:
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == code, done.output
    return done


def relocalize(folder: Path, names: str, *words: object, code: int = 0) -> Result:
    logs = [folder / name for name in names.split()]
    return run("relocalize", *logs, "-d", folder / "b.submaps", *words, code=code)


def documents(done: Result) -> list[Any]:
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_several_recordings_are_answered_as_one_is(folder: Path) -> None:
    together = documents(relocalize(folder, "a.mcap b.mcap", "--json"))
    assert [document["query"]["source"] for document in together] == ["a.mcap", "b.mcap"]
    for document in together:
        jsonschema.validate(document, closed(schema("relocalize")))
        alone = json.loads(relocalize(folder, document["query"]["source"], "--json").stdout)
        assert document["pose"] == alone["pose"] and document["confidence"] == alone["confidence"]


def test_windows_along_a_recording_are_located_by_one_index(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, index_of = [], MapIndex.of
    monkeypatch.setattr(MapIndex, "of", lambda *given: made.append(given) or index_of(*given))
    words = ("--start", 1, "--every", 2, "--duration", 3, "--plot", tmp_path / "all.png", "--json")
    answers = documents(relocalize(folder, "a.mcap", *words))
    assert len(made) == 1 and len(answers) > 1
    with open_log(folder / "a.mcap") as log:
        start_ns, end_s = log.info.start_ns, (log.info.end_ns - log.info.start_ns) * 1e-9
    assert [answer["query"]["start_s"] for answer in answers] == [1.0 + 2.0 * k for k in range(len(answers))]
    for answer in answers:
        until_s = answer["query"]["start_s"] + answer["query"]["duration_s"]
        assert until_s <= end_s
        assert (answer["query"]["stamp_ns"] - start_ns) * 1e-9 == pytest.approx(until_s, abs=0.3)
    assert cv2.imread(str(tmp_path / "all.png")) is not None


def test_a_person_gets_a_line_for_each_window(folder: Path) -> None:
    text = relocalize(folder, "a.mcap office.yaml").stdout
    assert text.startswith("2 queries: 2 located")
    assert text.count("a.mcap") == 1 and text.count("office.yaml") == 1


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_windows_become_a_table_for_scripts_and_a_trajectory(folder: Path, tmp_path: Path) -> None:
    words = ("--every", 2, "--csv", tmp_path / "all.csv", "--trajectory", tmp_path / "all.tum", "--json")
    answers = documents(relocalize(folder, "a.mcap", *words))
    rows = rows_of(tmp_path / "all.csv")
    poses = read_tum(tmp_path / "all.tum")
    assert len(rows) == len(answers) == len(poses) > 1  # all are located
    for row, answer, stamp_ns, place in zip(rows, answers, poses.stamps_ns, poses.planar(), strict=True):
        at, pose = [float(row[name]) for name in ("x_m", "y_m", "yaw_rad")], answer["pose"]
        assert at == pytest.approx([pose["x"], pose["y"], pose["yaw"]], abs=1e-6)
        assert at == pytest.approx(place, abs=1e-6)
        assert stamp_ns_from_text(row["time_s"]) == stamp_ns == answer["query"]["stamp_ns"]
        assert float(row["start_s"]) == answer["query"]["start_s"]
        named = [row[name] for name in ("recording", "status", "session", "frame")]
        assert named == ["a.mcap", "located", "office", "office"]
        sigmas = [float(row[f"sigma_{name}"]) for name in ("x_m", "y_m", "yaw_rad")]
        assert sigmas == pytest.approx(np.sqrt(np.diag(pose["covariance"])), abs=1e-6)


def test_a_query_that_is_not_located_has_a_line_without_a_pose(folder: Path, tmp_path: Path) -> None:
    files = ("--csv", tmp_path / "one.csv", "--trajectory", tmp_path / "one.tum")
    done = relocalize(folder, "a.mcap", "--near", 99, 99, 1, *files, code=4)
    (row,) = rows_of(tmp_path / "one.csv")
    assert row["status"] in ("not_found", "ambiguous") and row["time_s"] and not row["x_m"]
    assert "one.tum: not written" in done.stderr and not (tmp_path / "one.tum").exists()


def test_a_trajectory_is_in_one_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The answers in the session in which most are located."""
    answers: list[Any] = [
        SimpleNamespace(frame=None, session=session, stamp_ns=stamp_ns, T_map_odom=SE2(x_m, 0.0, 0.0))
        for session, stamp_ns, x_m in (("monday", 1, 0.0), ("tuesday", 3, 3.0), ("tuesday", 2, 2.0))
    ]
    write_places(tmp_path / "a.tum", [(way(), answer) for answer in answers])
    assert read_tum(tmp_path / "a.tum").planar()[:, 0] - way().planar()[-1, 0] == pytest.approx([2.0, 3.0])
    assert "in the frame of tuesday; 1 poses in monday left out" in capsys.readouterr().err


def test_who_interrupts_keeps_the_answers_so_far(folder: Path) -> None:
    words = ["relocalize", "a.mcap", "-d", "b.submaps", "--every", "0.1", "--duration", "1", "--json"]
    program = subprocess.Popen(
        [sys.executable, "-c", "from pc2grid_cli.main import main; main()", *words],
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=interruptible,
    )  # fmt: skip
    assert program.stdout is not None
    first = program.stdout.readline()
    program.send_signal(signal.SIGINT)
    rest, err = program.communicate(timeout=60)
    assert program.returncode == 130
    assert all(json.loads(line)["query"] for line in [first, *rest.splitlines()])
    assert b"interrupted: each file is complete, or as it was before" in err


def test_exit_code_4_if_none_is_located(folder: Path) -> None:
    done = relocalize(folder, "a.mcap a.mcap", "--set", "relocalize.accept=0.9999999", code=4)
    assert "2 queries: 2 ambiguous" in done.stdout or "not found" in done.stdout


def test_others_go_on_if_a_recording_cannot_be_read(folder: Path, tmp_path: Path) -> None:
    done = relocalize(folder, "text.mcap a.mcap", "--csv", tmp_path / "two.csv", code=3)
    failed, found = rows_of(tmp_path / "two.csv")
    assert [value for value in failed.values() if value] == ["text.mcap", "0.0", "failed"] and found["x_m"]
    assert "failed" in done.stdout and "located" in done.stdout
    assert "text.mcap" in done.stderr
    relocalize(folder, "text.mcap text.mcap", code=1)
