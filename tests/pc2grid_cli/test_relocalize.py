"""relocalize as a user of nav2 and Foxglove calls it: what it writes for a recording and for a map."""

import json
import math
import threading
import urllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

import pc2grid
import signature
from pc2grid.geometry import SE2
from pc2grid.io.trajectory import read_tum
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli import console
from pc2grid_cli.main import app
from pc2grid_cli.view import Locator, ViewServer
from signature.config import Config
from signature.database import open_database
from tests.helpers.nav2_map import spread_by_amcl, valid_for_nav2
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import office


def called(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""

    def command() -> Any:
        return app([str(a) for a in arguments], prog_name="pc2grid", standalone_mode=False)

    try:
        code = console.Console().run(command)
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def messages(path: Path) -> dict[str, list[Any]]:
    """Decoded messages by topic."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        for _, channel, _, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def test_a_recording_gives_nav2_and_foxglove_the_same_pose(
    office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose, mcap, page, plot = (tmp_path / f"a.{suffix}" for suffix in ("json", "mcap", "html", "png"))
    options = ("--initialpose", pose, "--output", mcap, "--report", page, "--plot", plot, "--json")
    database = office_folder / "b.submaps"
    before = database.read_bytes()
    code, out, err = called(capsys, "relocalize", office_folder / "drive.mcap", "-d", database, *options)
    assert code == 0, err
    assert database.read_bytes() == before and plot.read_bytes().startswith(b"\x89PNG")
    answer, initial = json.loads(out)["pose"], json.loads(pose.read_text())
    assert initial["header"]["frame_id"] == "map"
    stamp = initial["header"]["stamp"]
    assert stamp["sec"] * 10**9 + stamp["nanosec"] == answer["stamp_ns"]
    assert initial["pose"]["pose"]["position"] == {"x": answer["x"], "y": answer["y"], "z": 0.0}
    (told,) = messages(mcap)["/initialpose"]
    assert told.header.frame_id == "map"
    assert told.pose.pose.position.x == answer["x"] and told.pose.pose.position.y == answer["y"]
    for axis, value in initial["pose"]["pose"]["orientation"].items():
        assert getattr(told.pose.pose.orientation, axis) == pytest.approx(value)
    assert list(told.pose.covariance) == initial["pose"]["covariance"]
    assert valid_for_nav2(told)
    assert np.array_equal(spread_by_amcl(told), np.diag(np.diagonal(answer["covariance"])))
    (whole,) = messages(mcap)["/pose"]
    full = np.reshape(whole.pose.covariance, (6, 6))
    assert np.array_equal(full[np.ix_((0, 1, 5), (0, 1, 5))], answer["covariance"])
    assert np.array_equal(full[2:5, 2:5], 1e6 * np.eye(3)) and np.count_nonzero(full) == 12
    assert '"status":"located"' in page.read_text(encoding="utf-8")


def test_a_map_is_located_and_laid_over_the_other(
    office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mcap = tmp_path / "answer.mcap"
    where = ("relocalize", office_folder / "part.yaml", "-d", office_folder / "b.submaps")
    code, out, err = called(capsys, *where, "--output", mcap, "--json")
    assert code == 0, err
    document = json.loads(out)
    assert document["status"] == "located" and document["query"]["sensor"] == "map"
    assert (document["T_map_odom"]["x"], document["T_map_odom"]["y"]) == pytest.approx(
        (4, 3), abs=RESOLUTION_M
    )
    told = messages(mcap)
    assert told["/query_map"][0].header.frame_id == "query_map"
    (edge,) = told["/tf_static"][0].transforms
    assert (edge.header.frame_id, edge.child_frame_id) == ("map", "query_map")
    assert (edge.transform.translation.x, edge.transform.translation.y) == pytest.approx(
        (4, 3), abs=RESOLUTION_M
    )
    assert "/initialpose" not in told
    code, out, err = called(capsys, *where)
    assert code == 0 and out.startswith("located in office: x 4.0") and "travel" not in out


@pytest.mark.parametrize("option", ["--initialpose", "--trajectory"])
def test_a_map_has_no_robot_to_write_about(
    option: str, office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "x"
    code, out, err = called(
        capsys, "relocalize", office_folder / "part.yaml", "-d", office_folder / "b.submaps", option, target
    )
    assert code == 2 and out == "" and option in err and not target.exists()


def test_no_answer_no_pose_but_a_page(
    office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose, page = tmp_path / "pose.json", tmp_path / "page.html"
    unsure = ("--duration", "1", "--set", "relocalize.accept=0.999999")
    where = ("relocalize", office_folder / "drive.mcap", "-d", office_folder / "b.submaps")
    code, _, err = called(capsys, *where, *unsure, "--initialpose", pose, "--report", page)
    assert code == 4 and not pose.exists() and "not written" in err
    assert '"status":"located"' not in page.read_text(encoding="utf-8")


def test_export_writes_a_page_and_does_not_overwrite_it(
    office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    assert called(capsys, "export", office_folder / "b.submaps", "--report", page)[0] == 0
    before = page.read_bytes()
    code, _, err = called(capsys, "export", office_folder / "b.submaps", "--report", page)
    assert code == 1 and "--force" in err and page.read_bytes() == before


# --- `pc2grid relocalize` of a drive whose tracking drifts: where it was on the way ---


DRIFT_RAD_PER_M = math.radians(1.0)


@shared_folder("office_folder")
def folder(folder: Path) -> None:
    """The office, and drive.mcap of a laser that drives 14 m in it."""
    config = SimulationConfig(length_m=14.0, seed=3, clutter=0)
    simulate_session(folder / "drive.mcap", sensor="laser", grid=office(), config=config, overwrite=True)


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


follow = pc2grid.estimation.tracker.follow


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


# --- One recording and one database with points: every command and function gives the same answer ---


SIMULATION = {
    "clutter": 0,
    "start_m": (2.0, 7.0),
    "lidar": {"rate_hz": 5.0, "columns": 360, "elevation_deg": 30.0},
    # The motion within the last sweep is known only from odometry that comes after it.
    "odometry": {"enabled": False},
}

Expected = dict[str, Any]


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


@shared_folder()
def doors(folder: Path) -> None:
    """monday.submaps, with points; tuesday.mcap; last.json, what `watch` says at its end."""
    for name, length_m, seed in (("monday", 9.0, 1), ("long", 3.5, 2)):
        config = SimulationConfig.model_validate({"length_m": length_m, "seed": seed, **SIMULATION})
        simulate_session(folder / f"{name}.mcap", sensor="lidar", grid=office(), config=config)
    database, settings = folder / "monday.submaps", ("--set", "projection.points_voxel_m=0.1")
    run("convert", folder / "monday.mcap", "-o", database, *settings)
    said = run("watch", folder / "long.mcap", "-d", folder / "monday.submaps", "--json")
    last: Expected = json.loads(said.splitlines()[-1])
    cut(folder / "long.mcap", folder / "tuesday.mcap", last["stamp_ns"])
    (folder / "last.json").write_text(json.dumps(last))


@pytest.fixture
def expected(doors: Path) -> tuple[Path, Expected]:
    return doors, json.loads((doors / "last.json").read_text())


def assert_same(document: Any, expected: Expected) -> None:
    """Equal numbers but for the rounding of sums, whose order in Open3D and BLAS depends on the machine."""
    for key in ("status", "pose", "in_space", "confidence"):
        assert document[key] == rounded(expected[key]), key


def rounded(value: Any, to: float = 1e-9) -> Any:
    if isinstance(value, dict):
        return {key: rounded(member, to) for key, member in value.items()}
    if isinstance(value, list):
        return [rounded(member, to) for member in value]
    return pytest.approx(value, rel=to, abs=to) if isinstance(value, float) else value


def test_watch_locates_in_space(expected: tuple[Path, Expected]) -> None:
    folder, last = expected
    assert last["state"] == "located" and last["in_space"]["status"] == "agrees"
    truth = read_tum(folder / "long.tum")
    made = read_tum(folder / "monday.tum")
    now = truth.T_session_base[list(truth.stamps_ns).index(last["stamp_ns"])]
    in_map = pc2grid.SE2.from_matrix(made.T_session_base[0]).inverse() @ pc2grid.SE2.from_matrix(now)
    assert math.dist((last["pose"]["x"], last["pose"]["y"]), (in_map.x, in_map.y)) < 2 * RESOLUTION_M


def by_the_command(log: Path, database: Path, _: Path) -> Any:
    document = json.loads(run("relocalize", log, "-d", database, "--json"))
    assert document["history"][-1]["x"] == pytest.approx(document["pose"]["x"], abs=1e-9)
    return document


def by_a_function(log: Path, database: Path, _: Path) -> Any:
    return pc2grid.relocalize(log, database).to_json()


def by_view(log: Path, database: Path, uploads: Path) -> Any:
    recording = log.read_bytes()
    with open_database(database) as opened:
        locator = Locator(opened, Config())
        server = ViewServer(0, locator.events, uploads, locator.work, most_bytes=len(recording))
        request = urllib.request.Request(f"{server.url}locate?name={log.name}", data=recording)
        serving = threading.Thread(target=server.serve_forever, daemon=True)
        serving.start()
        try:
            with urllib.request.urlopen(request) as reply:
                return json.loads(reply.read())
        finally:
            server.shutdown()
            serving.join()
            server.stop()


def by_a_localizer(log: Path, database: Path, _: Path) -> Any:
    with open_database(database) as opened, pc2grid.open_log(log) as scans:
        localizer = pc2grid.Localizer(pc2grid.MapIndex.of(opened, opened.config()))
        for registered, planar_scan in pc2grid.follow(scans.scans(), opened.config()):
            localizer.add(registered, planar_scan)
        return localizer.answer().to_json()


@pytest.mark.parametrize("ask", [by_the_command, by_a_function, by_view, by_a_localizer])
def test_by_every_door_comes_the_same_answer(
    ask: Callable[..., Any], expected: tuple[Path, Expected], tmp_path: Path
) -> None:
    folder, last = expected
    assert_same(ask(folder / "tuesday.mcap", folder / "monday.submaps", tmp_path), last)


def relocalize_at_once(folder: Path, *words: object) -> Any:
    """`--check` does not search on the way, so that an early place cannot speak for or against the pose."""
    begin = ("relocalize", folder / "tuesday.mcap", "-d", folder / "monday.submaps", "--json")
    at_once = ("--set", "relocalize.step_m=100")
    return json.loads(CliRunner().invoke(app, [str(word) for word in (*begin, *at_once, *words)]).stdout)


def test_a_right_pose_is_fine_and_a_wrong_one_tells_the_answer(expected: tuple[Path, Expected]) -> None:
    folder, watched = expected
    last = relocalize_at_once(folder)
    pose = last["pose"]
    document = relocalize_at_once(folder, "--check", pose["x"], pose["y"], math.degrees(pose["yaw"]))
    # The pose was typed with the digits of the document: micrometres off, which the mass of a place shows.
    assert document["status"] == "fine"
    assert document["probability"] == pytest.approx(last["confidence"], abs=1e-5)
    # The best place near the pose is found in space, too: it is the pose itself, as exactly as ICP ends.
    assert document["off_m"] == pytest.approx(0.0, abs=1e-5)
    document = relocalize_at_once(folder, "--check", pose["x"] + 4.0, pose["y"], 0.0)
    assert document["status"] == "lost"
    # ICP ends within micrometres, from wherever a search has begun.
    assert document["better"]["pose"] == rounded(pose, 1e-5)
    assert pose == rounded(watched["pose"])
    # The pose that is checked was believed, so a little of the mass is there.
    assert document["better"]["confidence"] == pytest.approx(last["confidence"], abs=1e-3)
