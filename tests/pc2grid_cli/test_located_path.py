"""`pc2grid relocalize` of a drive whose tracking drifts: where it was on the way."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import pc2grid.pipeline
import signature.sessions
from pc2grid.geometry import SE2
from pc2grid.io.trajectory import read_tum
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app
from tests.helpers.simulated_drives import office

DRIFT_RAD_PER_M = math.radians(1.0)


@pytest.fixture(scope="module")
def folder(office_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The office, and drive.mcap of a laser that drives 14 m in it."""
    folder = shutil.copytree(office_folder, tmp_path_factory.mktemp("path"), dirs_exist_ok=True)
    config = SimulationConfig(length_m=14.0, seed=3, clutter=0)
    simulate_session(folder / "drive.mcap", sensor="laser", grid=office(), config=config, overwrite=True)
    return folder


def run(*words: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def drifting(*arguments: Any) -> Iterator[Any]:
    """As `pc2grid.follow`, but each metre turns the robot a little more than it did."""
    before = at = None
    for registered, planar_scan in follow(*arguments):
        pose = SE2.from_matrix(registered.T_session_base)
        if before is None or at is None:
            at = pose
        else:
            step = before.inverse() @ pose
            at = at @ step @ SE2(0.0, 0.0, DRIFT_RAD_PER_M * math.hypot(step.x, step.y))
        before = pose
        yield replace(registered, T_session_base=at.lift()), planar_scan


follow = pc2grid.pipeline.follow


def test_the_path_follows_where_the_robot_was_located(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(signature.sessions, "follow", drifting)
    words = ("--trajectory", tmp_path / "found.tum", "--json")
    document = json.loads(run("relocalize", folder / "drive.mcap", "-d", folder / "b.submaps", *words))
    truth, found = read_tum(folder / "drive.tum"), read_tum(tmp_path / "found.tum")
    np.testing.assert_array_equal(truth.stamps_ns, found.stamps_ns)
    errors_m = np.linalg.norm((truth.T_session_base - found.T_session_base)[:, :2, 3], axis=1)
    located = [m for m in document["history"] if m["status"] == "located"]
    first = int(np.searchsorted(found.stamps_ns, located[0]["stamp_ns"]))
    assert errors_m[first:].max() < 0.2 and errors_m.max() < 0.3
    hung = SE2(**document["T_map_odom"]).lift()
    drifted = [hung @ registered.T_session_base for registered, _ in drifting(*scans_and_config(folder))]
    drifted_m = np.linalg.norm((truth.T_session_base - np.array(drifted))[:, :2, 3], axis=1)
    assert drifted_m[first:].max() > 0.4  # dead reckoning from the last scan, by the same answer


def scans_and_config(folder: Path) -> tuple[Any, Any]:
    with pc2grid.open_log(folder / "drive.mcap") as log:
        return iter(list(log.scans())), pc2grid.Config()


def test_a_recording_is_followed_as_a_robot_is(folder: Path) -> None:
    """What `watch` says on the way is the history of the answer of `relocalize`."""
    words = (folder / "drive.mcap", "-d", folder / "b.submaps", "--json")
    said = [json.loads(line) for line in run("watch", *words).splitlines()]
    history = json.loads(run("relocalize", *words))["history"]
    assert len(said) >= 10
    for told, moment in zip(said, history, strict=False):
        assert [told[key] for key in ("stamp_ns", "path_m", "status", "confidence")] == [
            moment[key] for key in ("stamp_ns", "path_m", "status", "confidence")
        ]
