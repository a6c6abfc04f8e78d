"""pc2grid beside its peers: what they get, what their answers are worth, and one small run."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.errors import ConfigError, LogNotFound
from pc2grid.geometry import SE2
from pc2grid.model import Scan
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.json_schemas import schema
from pc2grid_cli.main import app
from pc2grid_lab.compare import peers as compare_peers
from pc2grid_lab.compare import peers_report
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.peers.environment import PEERS, PINS, PeerEnvironment, PeerKind
from pc2grid_lab.peers.experiment import run, tasks
from pc2grid_lab.peers.outcome import PeerTrial, best_threshold, counted
from pc2grid_lab.peers.particle_filter import carmen_log
from pc2grid_lab.peers.peer_process import PeerAnswer, PeerFailed, PeerProcess
from pc2grid_lab.peers.site import Site, SiteQuery, is_covered, save_beams, site_name, truth_file
from signature.config import Config
from tests.helpers.json_schema import closed
from tests.helpers.simulated_drives import drive, office

QUERY = SiteQuery(pose=(4.0, 3.0, 0.5), covered=True, travel_m=10.0)


def judged(
    error_m: float | None, score: float = 1.0, *, map_: str = "here", peer: str = "other", **query: Any
) -> PeerTrial:
    """The answer to a query, so far beside the truth; None: no answer."""
    pose = None if error_m is None else (4.0, 3.0 + error_m, 0.5)
    answer = PeerAnswer(pose=pose, score=score, cpu_s=1.0, peak_mb=100.0)
    asked = SiteQuery(**{"pose": QUERY.pose, "covered": True, "travel_m": 10.0, **query})
    return PeerTrial.of(peer, "here", map_, 0, asked, answer)


def session(scans: int = 30) -> RegisteredSession:
    """A short drive through the office; its odometry is the truth."""
    driven = [row for _, row in zip(range(scans), drive(office(), [(2.0, 7.0), (14.0, 7.0)]), strict=False)]
    poses = np.array([(T.x, T.y, T.yaw) for _, _, T in driven])
    return RegisteredSession(
        sensor="laser",
        planar_scans=tuple(planar_scan for _, planar_scan, _ in driven),
        T_odom_base=poses,
        lost=np.zeros(len(driven), bool),
        T_world_base=poses,
    )


def test_an_answer_is_right_near_the_truth_and_never_elsewhere() -> None:
    assert judged(0.2).right and not judged(0.4).right and not judged(None).right
    elsewhere = judged(0.0, map_="there")
    assert not elsewhere.right and elsewhere.place == "elsewhere" and elsewhere.error_m is None
    turned = PeerAnswer(pose=(4.0, 3.0, 0.5 + math.radians(6.0)), score=1.0, cpu_s=0.0, peak_mb=0.0)
    assert not PeerTrial.of("other", "here", "here", 0, QUERY, turned).right


def test_the_threshold_is_the_best_one_for_the_peer() -> None:
    trials = [judged(0.1, 9.0), judged(0.1, 7.0), judged(2.0, 6.0), judged(0.1, 5.0, map_="there")]
    assert best_threshold(trials) == 7.0
    assert best_threshold([judged(2.0, 9.0), judged(0.1, 3.0)]) == math.inf
    assert best_threshold([judged(None)]) == math.inf


def test_cells_count_every_query_once() -> None:
    trials = [
        judged(0.1, 9.0),
        judged(0.1, 8.0),
        judged(0.1, 8.0),
        judged(2.0, 8.5),
        judged(0.1, 0.5),
        judged(None),
        judged(1.0, 9.5, covered=False),
        judged(None, covered=False),
        judged(0.0, 1.0, map_="there"),
        *(judged(0.05, 9.0) for _ in range(4)),
    ]
    (cell,) = counted(trials)
    assert cell.threshold == 8.0
    assert (cell.covered, cell.right, cell.wrong, cell.unanswered) == (10, 7, 1, 2)
    assert (cell.uncovered, cell.uncovered_wrong, cell.elsewhere, cell.elsewhere_wrong) == (2, 1, 1, 0)
    assert cell.right_low is not None and cell.right_high is not None
    assert 0.0 < cell.right_low < 7 / 10 < cell.right_high < 1.0
    assert cell.median_error_m == pytest.approx(0.05)
    assert cell.cpu_s == cell.elsewhere_cpu_s == 1.0


def test_answers_elsewhere_do_not_count_in_the_time_of_an_answer() -> None:
    here, there = judged(0.1), judged(None, map_="there")
    (cell,) = counted([here, replace(there, cpu_s=7.0), replace(there, cpu_s=9.0)])
    assert (cell.cpu_s, cell.elsewhere_cpu_s) == (1.0, 8.0)
    (cell,) = counted([here])
    assert (cell.cpu_s, cell.elsewhere_cpu_s) == (1.0, None)


def test_pc2grid_gets_no_threshold() -> None:
    """It would only take wrong answers away that a user gets."""
    (cell,) = counted([judged(3.0, 0.5, peer="pc2grid"), judged(0.1, 0.9, peer="pc2grid")])
    assert cell.threshold is None and (cell.right, cell.wrong) == (1, 1)


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
    ranges_m = np.full((len(driven), 5), np.inf, np.float32)
    ranges_m[:, 2] = 1.5
    lines = carmen_log(driven, ranges_m, math.radians(180.0), SE2(0.3, 0.0, 0.0)).splitlines()
    assert 3 < len(lines) < len(driven)
    words = lines[-1].split()
    assert words[0] == "ROBOTLASER1" and words[8] == "5" and float(words[11]) == 1.5
    x, y, yaw = driven.T_odom_base[-1]
    assert [float(w) for w in words[18:21]] == pytest.approx([x, y, yaw], abs=1e-4)
    middle = SE2(x, y, yaw) @ SE2(0.3, 0.0, 0.0)
    assert [float(w) for w in words[15:18]] == pytest.approx([middle.x, middle.y, middle.yaw], abs=1e-4)


def test_a_query_is_covered_where_the_map_shows_what_it_saw() -> None:
    driven = session()
    truth = driven.true_pose(len(driven) - 1)
    assert truth is not None
    hits_m = driven.planar_scans[-1].hits_m
    assert is_covered(office(), hits_m, truth)
    assert not is_covered(office(), hits_m, truth @ SE2(1.3, 0.7, 0.4))
    assert not is_covered(office(), hits_m[:0], truth)


def test_a_true_pose_is_carried_on_from_the_nearest_known_one() -> None:
    driven = session()
    known = driven.T_world_base.copy()
    known[5:] = np.nan
    partly = RegisteredSession(
        sensor="laser",
        planar_scans=driven.planar_scans,
        T_odom_base=driven.T_odom_base,
        lost=driven.lost,
        T_world_base=known,
    )
    carried, true = partly.true_pose(20), driven.true_pose(20)
    assert carried is not None and true is not None
    assert (carried.x, carried.y, carried.yaw) == pytest.approx((true.x, true.y, true.yaw))
    known[:] = np.nan
    assert partly.true_pose(20) is None


def test_a_process_is_asked_line_by_line_and_its_end_is_an_error(tmp_path: Path) -> None:
    code = tmp_path / "peer.py"
    code.write_text(
        "import json, sys\n"
        "for n, line in enumerate(sys.stdin):\n"
        "    if n: sys.exit(1)\n"
        "    answer = {'pose': [1, 2, 0], 'score': len(sys.argv), 'cpu_s': 0.1, 'peak_mb': 5.0}\n"
        "    print(json.dumps(answer), flush=True)\n"
    )
    with PeerProcess([sys.executable, code], "name", tmp_path / "map") as peer:
        assert peer.locate(tmp_path / "00") == PeerAnswer(pose=(1, 2, 0), score=3, cpu_s=0.1, peak_mb=5.0)
        with pytest.raises(PeerFailed, match="no answer"):
            peer.locate(tmp_path / "01")


def test_what_a_library_prints_is_no_answer(tmp_path: Path) -> None:
    """Open3D prints warnings to the standard output, from C++."""
    code = tmp_path / "peer.py"
    code.write_text(
        "import os, sys\n"
        "import numpy as np\n"
        "from pc2grid_lab.peers.cloud_matchers import answer_stream, serve\n"
        "answers = answer_stream()\n"
        "def locate(query):\n"
        "    os.write(1, b'[Open3D WARNING] Too few correspondences\\n')\n"
        "    print('a line', flush=True)\n"
        "    return np.eye(4), 3.0\n"
        "serve(locate, answers)\n"
    )
    with PeerProcess([sys.executable, code], "name", tmp_path / "map") as peer:
        for number in ("00", "01"):
            answer = peer.locate(tmp_path / number)
            assert (answer.pose, answer.score) == ((0.0, 0.0, 0.0), 3.0)


def test_what_is_missing_is_named_with_its_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    environment = PeerEnvironment(folder=tmp_path / "none")
    missing = {kind.name: environment.missing(kind) for kind in PEERS}
    assert missing["pc2grid"] is None and missing["fpfh-ransac"] is None
    assert missing["particle-filter"] == "apt-get install mrpt-apps"
    assert PINS[0] in (missing["map-closures"] or "") and PINS[1] in (missing["kiss-matcher"] or "")
    sites = [
        Site(name="a", sensor="laser", folder=tmp_path),
        *(Site(name=name, sensor="lidar", folder=tmp_path) for name in "bc"),
    ]
    asked = [(kind.name, site.name, other.name) for kind, site, other in tasks(sites, environment)]
    assert asked == [
        ("pc2grid", "a", "a"),
        *(("pc2grid", *pair) for pair in ("bb", "bc", "cc", "cb")),
        *(("fpfh-ransac", *pair) for pair in ("bb", "bc", "cc", "cb")),
    ]


def test_kept_answers_are_judged_again_and_asked_for_again_of_another_program(tmp_path: Path) -> None:
    asked: list[str] = []

    class Here:
        def locate(self, query: Path) -> PeerAnswer:
            asked.append(query.name)
            return PeerAnswer(pose=QUERY.pose, score=1.0, cpu_s=1.0, peak_mb=1.0)

        def close(self) -> None:
            asked.append("closed")

    class Environment(PeerEnvironment):
        def version(self, kind: PeerKind) -> str:
            return self.folder.name

        def start(self, kind: PeerKind, map_stem: Path) -> Here:
            return Here()

    def true_poses(*poses: tuple[float, float, float]) -> None:
        for number, pose in enumerate(poses):
            made = SiteQuery(pose=pose, covered=True, travel_m=10.0)
            site.stem(number).with_suffix(".json").write_text(json.dumps(asdict(made)))

    site = Site(name="a", sensor="laser", folder=tmp_path / "a.1")
    (site.folder / "queries").mkdir(parents=True)
    true_poses(QUERY.pose)

    def right(version: str, map_site: Site = site) -> list[bool]:
        environment = Environment(folder=tmp_path / version)
        return [trial.right for trial in run((PEERS[0], site, map_site), environment, tmp_path)]

    assert right("first") == [True] and asked == ["00", "closed"]
    true_poses((9.0, 3.0, 0.5), QUERY.pose)
    assert right("first") == [False, True] and asked[2:] == ["01", "closed"]
    assert right("first") == [False, True] and len(asked) == 4
    assert right("second") == [False, True] and asked[4:] == ["00", "01", "closed"]
    moved = Site(name="a", sensor="laser", folder=tmp_path / "a.2")
    assert right("first", moved) == [False, True] and asked[7:] == ["00", "01", "closed"]


def test_what_a_site_is_made_from_is_in_the_name_of_its_folder(tmp_path: Path) -> None:
    for name, y_m in (("a", 0.0), ("b", 1.0)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "plan.xyz").write_text(f"0 {y_m} 0\n1 0 0\n")
    config, coarser = Config(), Config.model_validate({"projection": {"resolution_m": 0.1}})
    asked = {"queries": 2, "travel_m": 3.0, "mapped_s": None, "of_base": False}
    cases = [
        (tmp_path / "a" / "plan.xyz", config, asked),
        (tmp_path / "b" / "plan.xyz", config, asked),
        (tmp_path / "a" / "plan.xyz", coarser, asked),
        *(
            (tmp_path / "a" / "plan.xyz", config, {**asked, **other})
            for other in ({"queries": 3}, {"of_base": True})
        ),
    ]
    names = [site_name(source, settings, **other) for source, settings, other in cases]
    assert len(set(names)) == len(names) and all(name.startswith("plan.") for name in names)
    assert site_name(tmp_path / "a" / "plan.xyz", config, **asked) == names[0]


def test_true_poses_stand_beside_the_recording(tmp_path: Path) -> None:
    with pytest.raises(LogNotFound, match=r"log\.tum"):
        truth_file(tmp_path / "log.mcap")
    (tmp_path / "log_corrected.tum").touch()
    assert truth_file(tmp_path / "log.mcap").name == "log_corrected.tum"


def test_mapped_names_one_of_the_recordings() -> None:
    for text in ("b=3", "a=x", "a"):
        done = CliRunner().invoke(app, ["compare", "peers", "a.mcap", "--mapped", text])
        assert isinstance(done.exception, ConfigError) or done.exit_code


def test_a_drive_through_a_plan_beside_the_peers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pc2grid locates all; a peer that is not installed is named, and its row is empty."""
    simulation = SimulationConfig.model_validate(
        {"length_m": 8.0, "seed": 3, "clutter": 0, "laser": {"rate_hz": 5.0}}
    )
    simulate_session(tmp_path / "drive.mcap", sensor="laser", grid=office(), config=simulation)
    monkeypatch.setenv("PATH", str(tmp_path))  # whether MRPT is installed or not
    drawn: list[Any] = []
    monkeypatch.setattr(compare_peers, "draw", lambda *arguments: drawn.append(arguments))
    out = tmp_path / "out"
    words = ["compare", "peers", tmp_path / "drive.mcap", "--of-base", "--queries", "1", "--travel", "1.5"]
    words += ["--environment", tmp_path / "none", "-o", out, "--json"]
    done = CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)
    document = json.loads(done.stdout)
    jsonschema.validate(document, closed(schema("compare-peers")))
    assert len(drawn) == 1 and "kiss-matcher is not installed" in done.stderr
    own = next(cell for cell in document["cells"] if cell["peer"] == "pc2grid")
    assert own["covered"] == own["right"] == 1 and own["wrong"] == 0 and own["cpu_s"] > 0.0
    assert set(document["not_installed"]) == {"kiss-matcher", "map-closures", "particle-filter"}
    peers_report.print_table(
        counted([PeerTrial(**trial) for trial in document["trials"]]), {"drive": "laser"}, {}
    )
