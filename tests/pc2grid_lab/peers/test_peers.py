"""pc2grid beside its peers: what they get, what their answers are worth, and one small run."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.geometry import SE2
from pc2grid.io.maps import save_map
from pc2grid.model import Health, Scan, Trajectory
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app
from pc2grid_lab.peers import programs
from pc2grid_lab.peers.programs import (
    PEERS,
    PINS,
    PeerFailed,
    PeerTrial,
    Site,
    SiteQuery,
    _tasks,
    answers,
    best_threshold,
    carmen_log,
    how_to_install,
    save_beams,
)
from pc2grid_lab.runner import once
from pc2grid_lab.sensors import RegisteredSession
from tests.helpers.simulated_drives import drive, office

KINDS = {kind.name: kind for kind in PEERS}


def judged(
    error_m: float | None,
    score: float = 1.0,
    *,
    map_: str = "here",
    peer: str = "other",
    covered: bool = True,
    cpu_s: float = 1.0,
    turned_rad: float = 0.0,
) -> PeerTrial:
    """The answer to a query, so far beside the truth; None: no answer."""
    pose = None if error_m is None else (4.0, 3.0 + error_m, 0.5 + turned_rad)
    answer = {"pose": pose, "score": score, "cpu_s": cpu_s, "peak_mb": 100.0}
    return PeerTrial.of(peer, "here", map_, SiteQuery(pose=(4.0, 3.0, 0.5), covered=covered), answer)


def session(scans: int = 30) -> RegisteredSession:
    """A short drive through the office; its odometry is the truth."""
    driven = [row for _, row in zip(range(scans), drive(office(), [(2.0, 7.0), (14.0, 7.0)]), strict=False)]
    planar_scans = tuple(planar_scan for _, planar_scan, _ in driven)
    trajectory = Trajectory(
        stamps_ns=np.array([planar_scan.stamp_ns for planar_scan in planar_scans]),
        T_session_base=np.array([T.lift() for _, _, T in driven]),
        health=(Health.FINE,) * len(driven),
    )
    return RegisteredSession(
        sensor="laser",
        planar_scans=planar_scans,
        trajectory=trajectory,
        T_world_base=trajectory.planar(),
    )


def test_an_answer_is_right_near_the_truth_and_never_elsewhere() -> None:
    assert judged(0.2).right and not judged(0.4).right and not judged(None).right
    elsewhere = judged(0.0, map_="there")
    assert not elsewhere.right and elsewhere.place == "elsewhere" and elsewhere.error_m is None
    assert not judged(0.0, turned_rad=math.radians(6.0)).right


def test_the_threshold_is_the_best_one_for_the_peer() -> None:
    trials = [judged(0.1, 9.0), judged(0.1, 7.0), judged(2.0, 6.0), judged(0.1, 5.0, map_="there")]
    assert best_threshold(trials) == 7.0
    assert best_threshold([judged(2.0, 9.0), judged(0.1, 3.0)]) == math.inf
    assert best_threshold([judged(None)]) == math.inf


@pytest.mark.parametrize("first_deg", [-90.0, -89.5, -135.25])
def test_beams_lie_where_the_laser_measured_them(tmp_path: Path, first_deg: float) -> None:
    bearings = np.radians(first_deg + np.arange(180.0))
    ranges = 2.0 + np.arange(180.0) / 100.0
    T_base_sensor = SE2(0.2, 0.1, 0.3).lift()
    seen = np.arange(180) % 7 != 3  # the others came back from nothing
    in_sensor = np.column_stack((ranges * np.cos(bearings), ranges * np.sin(bearings), np.zeros(180)))[seen]
    points_m = in_sensor @ T_base_sensor[:3, :3].T + T_base_sensor[:3, 3]
    scan = Scan(stamp_ns=0, points_m=points_m, T_base_sensor=T_base_sensor, sensor="laser")
    save_beams(tmp_path / "q.npz", [scan, scan])
    with np.load(tmp_path / "q.npz") as file:
        rows, fov_rad, T_base_middle = file["ranges_m"], float(file["fov_rad"]), file["T_base_middle"]
    assert rows.shape == (2, 180) and fov_rad == pytest.approx(math.radians(179.0), abs=1e-5)
    assert np.array_equal(np.isfinite(rows[1]), seen)
    bearing = np.linspace(-fov_rad / 2, fov_rad / 2, 180)[seen]  # as the particle filter reads them
    beam = np.column_stack((rows[1, seen] * np.cos(bearing), rows[1, seen] * np.sin(bearing), 0 * bearing))
    np.testing.assert_allclose(beam @ T_base_middle[:3, :3].T + T_base_middle[:3, 3], points_m, atol=1e-4)


def test_the_carmen_log_has_a_line_for_each_step_of_motion() -> None:
    driven = session()
    ranges_m = np.full((len(driven.planar_scans), 5), np.inf, np.float32)
    ranges_m[:, 2] = 1.5
    lines = carmen_log(driven, ranges_m, math.radians(180.0), SE2(0.3, 0.0, 0.0)).splitlines()
    assert 3 < len(lines) < len(ranges_m)
    words = lines[-1].split()
    assert words[0] == "ROBOTLASER1" and words[8] == "5" and float(words[11]) == 1.5
    x, y, yaw = driven.trajectory.planar()[-1]
    assert [float(w) for w in words[18:21]] == pytest.approx([x, y, yaw], abs=1e-4)
    middle = SE2(x, y, yaw) @ SE2(0.3, 0.0, 0.0)
    assert [float(w) for w in words[15:18]] == pytest.approx([middle.x, middle.y, middle.yaw], abs=1e-4)


def test_what_is_missing_is_named_with_its_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(programs, "ENVIRONMENT", tmp_path / "none")
    commands = {kind.name: how_to_install(kind) for kind in PEERS}
    assert commands["pc2grid"] is None and commands["fpfh-ransac"] is None
    assert commands["particle-filter"] == "apt-get install mrpt-apps"
    assert PINS[0] in (commands["map-closures"] or "") and PINS[1] in (commands["kiss-matcher"] or "")
    sites = [
        Site(name="a", sensor="laser", folder=tmp_path),
        *(Site(name=name, sensor="lidar", folder=tmp_path) for name in "bc"),
    ]
    not_installed = {name: command for name, command in commands.items() if command is not None}
    assert [(kind.name, site.name, other.name) for kind, site, other in _tasks(sites, not_installed)] == [
        ("pc2grid", "a", "a"),
        *(("pc2grid", *pair) for pair in ("bb", "bc", "cc", "cb")),
        *(("fpfh-ransac", *pair) for pair in ("bb", "bc", "cc", "cb")),
    ]


def test_a_program_that_ends_without_answers_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(PeerFailed, match="fpfh-ransac: no answers"):
        answers(KINDS["fpfh-ransac"], tmp_path / "no map", [tmp_path / "00"], tmp_path / "kept.json")


def test_clouds_are_matched_in_a_process_of_its_own(tmp_path: Path) -> None:
    """A corner of a room, in the map of the room; kept answers are read again."""
    side = np.linspace(0.0, 6.0, 80)
    walls = [np.column_stack(p) for p in (
        (np.repeat(side, 80), np.zeros(6400), np.tile(side / 2, 80)),
        (np.zeros(6400), np.repeat(side / 2, 80), np.tile(side / 2, 80)),
        (np.repeat(side / 6, 80) + 2.0, np.full(6400, 1.5), np.tile(side / 4, 80)),
    )]  # fmt: skip
    room = np.concatenate(walls).astype(np.float32)
    np.savez(tmp_path / "map.npz", T_map_base=np.eye(4)[None], points_m=room, count=[len(room)])
    true = SE2(1.0, 2.0, 0.4)
    seen = room @ true.inverse().lift()[:3, :3].T + true.inverse().lift()[:3, 3]
    np.savez(tmp_path / "00.cloud.npz", points_m=seen.astype(np.float32))
    (answer,) = answers(KINDS["fpfh-ransac"], tmp_path / "map", [tmp_path / "00"], tmp_path / "kept.json")
    assert answer["pose"] == pytest.approx((1.0, 2.0, 0.4), abs=0.1)
    assert answer["cpu_s"] > 0.0 and answer["peak_mb"] > 50.0
    assert answers(KINDS["fpfh-ransac"], tmp_path / "gone", [tmp_path / "00"], tmp_path / "kept.json") == [
        answer
    ]


def test_the_particle_filter_is_told_the_map_and_the_scans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MRPT's programs are stood in for; the last estimate of the last one is the answer."""
    estimates = "".join(f"PDF estimation: ({x},2.0,30.0deg) .. tr(cov): 0.25\n" for x in (9.0, 1.0))
    (tmp_path / "estimates").write_text(estimates)
    for name, does in (
        ("ros-map-yaml2mrpt", "test -f $4"),
        ("carmen2rawlog", "cp $4 $6"),
        ("pf-localization", f"cp $1 $(dirname $1)/query.rawlog {tmp_path} && cat {tmp_path}/estimates"),
    ):
        (tmp_path / name).write_text(f"#!/bin/sh\n{does}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    save_map(office(), tmp_path / "map")
    driven = session()
    once(tmp_path / "00.pickle", lambda: driven)
    ranges_m = np.ones((len(driven.planar_scans), 5))
    np.savez(tmp_path / "00.ranges.npz", ranges_m=ranges_m, fov_rad=3.0, T_base_middle=np.eye(4))
    (answer,) = answers(KINDS["particle-filter"], tmp_path / "map", [tmp_path / "00"], tmp_path / "kept.json")
    assert answer["pose"] == pytest.approx((1.0, 2.0, math.radians(30.0))) and answer["score"] == -0.25
    assert (tmp_path / "query.rawlog").read_text() == carmen_log(driven, ranges_m, 3.0, SE2())
    config = (tmp_path / "query.ini").read_text().splitlines()
    assert {"particles_count=30000", "init_PDF_max_x=20.0", "init_PDF_max_y=14.0"} < set(config)


def test_a_drive_through_a_plan_beside_the_peers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pc2grid locates all; a program that is not installed is named."""
    simulation = SimulationConfig.model_validate(
        {"length_m": 8.0, "seed": 3, "clutter": 0, "laser": {"rate_hz": 5.0}}
    )
    simulate_session(tmp_path / "drive.mcap", sensor="laser", grid=office(), config=simulation)
    monkeypatch.setenv("PATH", str(tmp_path))  # whether MRPT is installed or not
    monkeypatch.setattr(programs, "ENVIRONMENT", tmp_path / "none")
    out = tmp_path / "out"
    words = ["compare", "peers", tmp_path / "drive.mcap", "--of-base", "--queries", "1", "--travel", "1.5"]
    done = CliRunner().invoke(app, [*map(str, words), "-o", str(out)], catch_exceptions=False)
    assert "kiss-matcher is not installed" in done.stderr and "drive" in done.stdout
    document: dict[str, Any] = json.loads((out / "peers.json").read_text())
    (own,) = document["cells"]
    assert own["peer"] == "pc2grid" and own["cpu_s"] > 0.0
    assert own["covered"] == own["right"] == 1 and own["wrong"] == 0
    assert set(document["setting"]["not_installed"]) == {"kiss-matcher", "map-closures", "particle-filter"}
