"""`pc2grid watch`: the same robot by every way in gives the same answer."""

import json
import math
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.io.maps import save_map
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app, main
from pc2grid_cli.output import schema
from pc2grid_lab.recordings.run import write_joined
from signature.localization.localizer import ResetPolicy
from tests.helpers.interruptible import interruptible
from tests.helpers.json_schema import closed
from tests.helpers.nav2_map import as_mapped, valid_for_nav2
from tests.helpers.robot import LONG_S, Recorded, Robot
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import office

START_M = (10.0, 7.0)


@shared_folder()
def folder(folder: Path) -> None:
    """plan.submaps of the office, and tuesday.mcap of a laser that drives 3 m in it."""
    save_map(as_mapped(office()), folder / "plan", mode="raw")
    arguments = ["convert", str(folder / "plan.yaml"), "-o", str(folder / "plan.submaps")]
    assert CliRunner().invoke(app, arguments, catch_exceptions=False).exit_code == 0
    config = SimulationConfig(length_m=3.0, seed=7, clutter=0, start_m=START_M)
    simulate_session(folder / "tuesday.mcap", sensor="laser", grid=office(), config=config)


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    return folder


def watch(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, list[dict[str, Any]], str]:
    """Exit code, the documents on stdout, and stderr."""
    with pytest.raises(SystemExit) as stopped, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["pc2grid", "watch", *words, "-d", "plan.submaps", "--json"])
        main()
    out, err = capsys.readouterr()
    return int(stopped.value.code or 0), [json.loads(line) for line in out.splitlines()], err


def truth_at(folder: Path, stamp_ns: int) -> tuple[float, float]:
    truth = read_tum(folder / "tuesday.tum")
    pose = truth.T_session_base[int(np.argmin(np.abs(truth.stamps_ns - stamp_ns)))]
    return float(pose[0, 3]), float(pose[1, 3])


def answer_of(looks: list[dict[str, Any]]) -> list[tuple[Any, ...]]:
    """What must be equal however the bytes came."""
    return [(k["stamp_ns"], k["path_m"], k["state"], k["pose"], k["confidence"], k["map"]) for k in looks]


@pytest.fixture(scope="module")
def expected(folder: Path) -> list[tuple[Any, ...]]:
    """The answer for the finished file."""
    words = ["watch", "tuesday.mcap", "-d", "plan.submaps", "--json"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        said = CliRunner().invoke(app, words, catch_exceptions=False).stdout
    return answer_of([json.loads(line) for line in said.splitlines()])


def test_a_robot_is_located_where_it_is_each_time(
    here: Path, capsys: pytest.CaptureFixture[str], expected: list[tuple[Any, ...]]
) -> None:
    """Every scan of a recording is used."""
    code, looks, _ = watch(capsys, "tuesday.mcap")
    assert code == 0
    assert answer_of(looks) == expected
    for look in looks:
        jsonschema.validate(look, closed(schema("watch")))
    last = looks[-1]
    assert (last["state"], last["map"]["session"]) == ("located", "plan")
    assert math.dist((last["pose"]["x"], last["pose"]["y"]), truth_at(here, last["stamp_ns"])) < 0.1
    assert last["confidence"] >= 0.9 and len(last["map"]["digest"]) == 64
    with open_log("tuesday.mcap") as log:
        first_ns = next(log.scans()).stamp_ns
        assert looks[-1]["scans"] == sum(scan.stamp_ns <= looks[-1]["stamp_ns"] for scan in log.scans())
    assert first_ns < looks[0]["stamp_ns"]
    assert {(look["dropped"], look["reconnected"], look["lag_s"]) for look in looks} == {(0, 0, 0.0)}


def test_a_recording_in_real_time_is_a_robot_that_gives_the_same_answer(
    here: Path, capsys: pytest.CaptureFixture[str], expected: list[tuple[Any, ...]]
) -> None:
    code, looks, err = watch(capsys, "tuesday.mcap", "--real-time", "--first")
    assert code == 0, err
    assert answer_of(looks) == expected[: len(looks)]


def test_a_websocket_gives_the_same_answer_and_initialpose(
    here: Path, capsys: pytest.CaptureFixture[str], expected: list[tuple[Any, ...]]
) -> None:
    located_ns, second_ns = (stamp_ns for stamp_ns, *_ in expected[:2])
    # A busy computer leaves out the first search once the robot has driven on to the second one.
    with Robot(Recorded.read(here / "tuesday.mcap")) as robot, robot.playing(end_ns=second_ns):
        code, looks, err = watch(capsys, robot.url, "--publish", "initialpose", "--publish-map", "--first")
        robot.wait(lambda: not robot.clients)
    assert code == 0, err
    assert answer_of(looks) == expected[:1]
    decoded = dict(robot.told())
    assert sorted(decoded) == ["/initialpose", "/map"]
    assert len(robot.told()) == 2
    message = decoded["/initialpose"]
    stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    assert stamp_ns >= located_ns
    position = message.pose.pose.position
    assert math.dist((position.x, position.y), truth_at(here, stamp_ns)) < 0.1
    assert all(map(valid_for_nav2, decoded.values()))
    assert np.array_equal(decoded["/map"].data.reshape(office().cells.shape), as_mapped(office()).told())


def started(*words: str) -> subprocess.Popen[bytes]:
    """The program in a process of its own, which Ctrl-C stops."""
    return subprocess.Popen(
        [sys.executable, "-c", "from pc2grid_cli.main import main; main()", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=interruptible,
    )


def test_a_robot_that_is_located_is_told_so_once_and_followed_on(
    here: Path, expected: list[tuple[Any, ...]]
) -> None:
    second_ns = expected[1][0]
    with Robot(Recorded.read(here / "tuesday.mcap")) as robot, robot.playing(end_ns=second_ns):
        program = started("watch", robot.url, "-d", "plan.submaps", "--publish", "initialpose")
        try:
            assert program.stdout is not None
            lines = [program.stdout.readline().decode()]
            robot.play(m for m in robot.recorded.messages if m[1] >= second_ns)
            lines.append(program.stdout.readline().decode())
            program.send_signal(signal.SIGINT)
            _, err = program.communicate(timeout=LONG_S)
        finally:
            program.kill()
    assert all("located in plan: x " in line for line in lines), lines
    assert [line.endswith(", published /initialpose\n") for line in lines] == [True, False]
    assert [topic for topic, _ in robot.told()] == ["/initialpose"]
    assert program.returncode == 130
    assert b"interrupted: each file is complete, or as it was before" in err


def test_map_to_odom_is_published_until_the_program_is_stopped(
    here: Path, expected: list[tuple[Any, ...]]
) -> None:
    second_ns = expected[1][0]
    with Robot(Recorded.read(here / "tuesday.mcap")) as robot, robot.playing(end_ns=second_ns):
        program = started("watch", robot.url, "-d", "plan.submaps", "--publish", "tf", "--json")
        try:
            assert program.stdout is not None
            lines = [program.stdout.readline()]
            robot.play(m for m in robot.recorded.messages if m[1] >= second_ns)
            lines.append(program.stdout.readline())
            count = len(robot.told())
            robot.wait(lambda: len(robot.told()) >= count + 10)
            program.send_signal(signal.SIGINT)
            out, err = program.communicate(timeout=LONG_S)
        finally:
            program.kill()
    assert program.returncode == 130, err
    assert not out
    edges = [message.transforms[0] for _, message in robot.told()]
    assert {topic for topic, _ in robot.told()} == {"/tf"}
    assert {(e.header.frame_id, e.child_frame_id) for e in edges} == {("map", "odom")}
    looks = [json.loads(line) for line in lines]
    assert [look["published"] for look in looks] == [["/tf"]] * 2
    told = [look["T_map_odom"] for look in looks]
    for edge in edges:
        at = edge.transform.translation
        assert any(math.dist((at.x, at.y), (T["x"], T["y"])) < 1e-9 for T in told)


def test_what_is_not_located_ends_with_4(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, looks, _ = watch(capsys, "tuesday.mcap", "--set", "relocalize.accept=0.9999999999")
    assert code == 4
    assert {look["state"] for look in looks} == {"searching"}
    assert all(look["pose"] is None and look["map"] is None for look in looks)


def test_the_first_answer_is_enough_if_it_is_asked_for(
    here: Path, capsys: pytest.CaptureFixture[str], expected: list[tuple[Any, ...]]
) -> None:
    code, looks, _ = watch(capsys, "tuesday.mcap", "--first")
    assert code == 0
    states = [state for _, _, state, *_ in expected]
    assert answer_of(looks) == expected[: states.index("located") + 1] != expected


def test_a_robot_that_was_carried_away_is_told_so_in_words(here: Path, tmp_path: Path) -> None:
    """Along the corridor of the office, with wheels that do not turn."""
    config = SimulationConfig(length_m=6.0, seed=5, clutter=0, start_m=(2.0, 7.0))
    simulate_session(tmp_path / "there.mcap", sensor="laser", grid=office(), config=config)
    write_joined(here / "tuesday.mcap", tmp_path / "there.mcap", tmp_path / "carried.mcap")
    result = CliRunner().invoke(app, ["watch", str(tmp_path / "carried.mcap"), "-d", "plan.submaps"])
    assert result.exit_code == 0
    said = [line.partition(" m: ")[2] for line in result.stdout.splitlines()]
    lost = next(number for number, line in enumerate(said) if line.startswith("lost, no place fits"))
    assert all(line.startswith("located in plan: x ") for line in said[:lost])
    assert said[lost + 1].startswith("lost, perhaps in plan: x ")  # until a second look agrees
    assert said[lost + 2].startswith("recovered in plan: x ") and said[-1].startswith("located in plan: x ")


def test_a_robot_that_is_silent_is_given_up(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Robot(Recorded.read(here / "tuesday.mcap")) as robot:
        code, looks, err = watch(capsys, robot.url, "--timeout", "0.5")
    assert (code, looks) == (1, [])
    assert "/scan: no message yet" in err


def test_resets_are_paused() -> None:
    now_s = 0.0
    policy = ResetPolicy(pause_s=10.0, clock=lambda: now_s)
    allowed = {}
    for now_s in (0.0, 5.0, 11.0, 22.0, 40.0, 80.0, 85.0):
        assert not policy.allows("lost")  # from now on the next pose is news
        assert not policy.allows("doubtful")
        allowed[now_s] = policy.allows("located")
        assert not policy.allows("located")
    assert [now_s for now_s, may in allowed.items() if may] == [0.0, 11.0, 22.0, 40.0, 80.0]
