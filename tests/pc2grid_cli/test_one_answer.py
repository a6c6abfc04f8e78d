"""One recording and one database with points: every command and function gives the same answer."""

from __future__ import annotations

import json
import math
import threading
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from typer.testing import CliRunner

import pc2grid
from pc2grid.io.trajectory import read_tum
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app
from pc2grid_cli.view import Locator, ViewServer
from signature.config import Config
from signature.database import open_database
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.simulated_drives import office

SIMULATION = {
    "clutter": 0,
    "start_m": (2.0, 7.0),
    "lidar": {"rate_hz": 5.0, "columns": 360, "elevation_deg": 30.0},
    # The motion within the last sweep is known only from odometry that comes after it.
    "odometry": {"enabled": False},
}

Expected = dict[str, Any]


def run(*words: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def cut(source: Path, target: Path, end_ns: int) -> None:
    """The recording up to `end_ns`."""
    with source.open("rb") as stream, target.open("wb") as out:
        writer = Writer(out)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.id not in channels:
                known = 0 if schema is None else writer.register_schema(*_schema(schema))
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, known, channel.metadata
                )
            if message.log_time <= end_ns:
                writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


def _schema(schema: Any) -> tuple[str, str, bytes]:
    return schema.name, schema.encoding, schema.data


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Expected]:
    """The folder of monday.submaps, with points, and of tuesday.mcap, and what `watch` says at its end."""
    folder = tmp_path_factory.mktemp("doors")
    for name, length_m, seed in (("monday", 9.0, 1), ("long", 3.5, 2)):
        config = SimulationConfig.model_validate({"length_m": length_m, "seed": seed, **SIMULATION})
        simulate_session(folder / f"{name}.mcap", sensor="lidar", grid=office(), config=config)
    database, settings = folder / "monday.submaps", ("--set", "projection.points_voxel_m=0.1")
    run("convert", folder / "monday.mcap", "-o", database, *settings)
    said = run("watch", folder / "long.mcap", "-d", folder / "monday.submaps", "--json")
    last: Expected = json.loads(said.splitlines()[-1])
    cut(folder / "long.mcap", folder / "tuesday.mcap", last["stamp_ns"])
    return folder, last


def assert_same(document: Any, expected: Expected) -> None:
    """Equal numbers but for the rounding of sums, whose order in Open3D and BLAS depends on the machine."""
    for key in ("status", "pose", "in_space", "confidence"):
        assert document[key] == rounded(expected[key]), key


def rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: rounded(member) for key, member in value.items()}
    if isinstance(value, list):
        return [rounded(member) for member in value]
    return pytest.approx(value, rel=1e-9, abs=1e-9) if isinstance(value, float) else value


def test_watch_locates_in_space(expected: tuple[Path, Expected]) -> None:
    folder, last = expected
    assert last["state"] == "located" and last["in_space"]["status"] == "agrees"
    truth = read_tum(folder / "long.tum")
    made = read_tum(folder / "monday.tum")
    now = truth.T_session_base[list(truth.stamps_ns).index(last["stamp_ns"])]
    in_map = pc2grid.SE2.from_matrix(made.T_session_base[0]).inverse() @ pc2grid.SE2.from_matrix(now)
    assert math.dist((last["pose"]["x"], last["pose"]["y"]), (in_map.x, in_map.y)) < 2 * RESOLUTION_M


def test_relocalize(expected: tuple[Path, Expected]) -> None:
    folder, last = expected
    said = run("relocalize", folder / "tuesday.mcap", "-d", folder / "monday.submaps", "--json")
    document = json.loads(said)
    assert_same(document, last)
    assert document["history"][-1]["x"] == pytest.approx(last["pose"]["x"], abs=1e-9)


def test_relocalize_of_the_library(expected: tuple[Path, Expected]) -> None:
    folder, last = expected
    answer = pc2grid.relocalize(folder / "tuesday.mcap", folder / "monday.submaps")
    assert_same(answer.to_json(), last)


def test_view(expected: tuple[Path, Expected], tmp_path: Path) -> None:
    folder, last = expected
    recording = (folder / "tuesday.mcap").read_bytes()
    with open_database(folder / "monday.submaps") as database:
        locator = Locator(database, Config())
        server = ViewServer(0, locator.events, tmp_path, locator.work, most_bytes=len(recording))
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        request = urllib.request.Request(f"{server.url}locate?name=tuesday.mcap", data=recording)
        try:
            with urllib.request.urlopen(request) as reply:
                document = json.loads(reply.read())
        finally:
            server.shutdown()
            thread.join()
            server.stop()
    assert_same(document, last)


def test_localizer_of_the_library(expected: tuple[Path, Expected]) -> None:
    folder, last = expected
    with (
        open_database(folder / "monday.submaps") as database,
        pc2grid.open_log(folder / "tuesday.mcap") as log,
    ):
        config = database.config()
        localizer = pc2grid.Localizer(pc2grid.MapIndex.of(database, config))
        for registered, planar_scan in pc2grid.follow(log.scans(), config):
            localizer.add(registered, planar_scan)
        assert_same(localizer.answer().to_json(), last)


def relocalize_at_once(folder: Path, *words: object) -> Any:
    """`--check` does not search on the way, so that an early place cannot speak for or against the pose."""
    begin = ("relocalize", folder / "tuesday.mcap", "-d", folder / "monday.submaps", "--json")
    at_once = ("--set", "relocalize.step_m=100")
    return json.loads(CliRunner().invoke(app, [str(word) for word in (*begin, *at_once, *words)]).stdout)


def test_check_of_the_right_pose(expected: tuple[Path, Expected]) -> None:
    folder, _ = expected
    last = relocalize_at_once(folder)
    pose = last["pose"]
    document = relocalize_at_once(folder, "--check", pose["x"], pose["y"], math.degrees(pose["yaw"]))
    # The pose was typed with the digits of the document: micrometres off, which the mass of a place shows.
    assert document["status"] == "fine"
    assert document["probability"] == pytest.approx(last["confidence"], abs=1e-5)
    # The best place near the pose is found in space, too: it is the pose itself.
    assert document["off_m"] == pytest.approx(0.0, abs=1e-6)


def test_check_of_a_wrong_pose_tells_the_answer(expected: tuple[Path, Expected]) -> None:
    folder, watched = expected
    last = relocalize_at_once(folder)
    document = relocalize_at_once(folder, "--check", last["pose"]["x"] + 4.0, last["pose"]["y"], 0.0)
    assert document["status"] == "lost"
    assert document["better"]["pose"] == rounded(last["pose"]) == rounded(watched["pose"])
    # The pose that is checked was believed, so a little of the mass is there.
    assert document["better"]["confidence"] == pytest.approx(last["confidence"], abs=1e-3)
