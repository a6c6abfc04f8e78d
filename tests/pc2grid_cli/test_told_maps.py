"""Maps and poses as the program tells them to others, read by the rules of nav2, AMCL, RViz and tf2."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

from pc2grid.errors import ConfigError
from pc2grid.io.export import write_cloud
from pc2grid.io.maps import load_map, save_map
from pc2grid.model import THING, OccupancyGrid
from pc2grid_cli.main import app
from signature.database import open_database
from tests.helpers.building_clouds import room_cloud
from tests.helpers.nav2_map import AMCL, RVIZ, STATIC_LAYER, as_mapped, known_at, nav2_map, valid_for_nav2
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import cut, office

BLACK, WHITE, NEITHER = (0, 0, 0), (255, 255, 255), (112, 137, 134)
TOLD = {
    # cell of a map: what the static layer, AMCL and RViz make of what they are told
    82: ("lethal", "occupied", BLACK),  # a wall
    THING: ("lethal", "occupied", BLACK),  # a table
    1: ("free", "free", WHITE),
    50: ("unknown", "unknown", NEITHER),  # not decided
    -1: ("unknown", "unknown", NEITHER),
}


@shared_folder("office_folder")
def folder(folder: Path) -> None:
    """b.submaps of the office with a table, mapped with doubt, and a part of it."""
    plan = as_mapped(office())
    save_map(plan, folder / "office", mode="raw")
    save_map(cut(plan, 8.0, 8.0, 14.5, 14.0), folder / "part", mode="raw")
    run("convert", folder / "office.yaml", "-o", folder / "b.submaps", "--force")


def run(*words: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stderr


def messages(path: Path) -> list[tuple[str, Any]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(channel.topic, told) for _, channel, _, told in reader.iter_decoded_messages()]


def assert_told(message: Any, grid: OccupancyGrid) -> None:
    """The message of a grid is right by the rules of all who read it."""
    assert valid_for_nav2(message)
    info = message.info
    assert (info.origin.position.x, info.origin.position.y) == pytest.approx(grid.origin_m, abs=1e-9)
    told = np.array(message.data).reshape(info.height, info.width)
    assert set(np.unique(grid.cells)) == set(TOLD)
    for kind in TOLD:
        (value,) = np.unique(told[grid.cells == kind])
        assert (STATIC_LAYER[value], AMCL[value], RVIZ[value]) == TOLD[kind], kind


def test_the_map_of_an_export_is_free_lethal_or_unknown(folder: Path, tmp_path: Path) -> None:
    run("export", folder / "b.submaps", "--mcap", tmp_path / "out.mcap")
    (told,) = (message for topic, message in messages(tmp_path / "out.mcap") if topic == "/map")
    assert_told(told, as_mapped(office()))


def test_so_are_the_maps_of_an_answer(folder: Path, tmp_path: Path) -> None:
    run("relocalize", folder / "part.yaml", "-d", folder / "b.submaps", "--output", tmp_path / "out.mcap")
    told = dict(messages(tmp_path / "out.mcap"))
    assert_told(told["/map"], as_mapped(office()))
    assert_told(told["/query_map"], load_map(folder / "part.yaml"))


def test_an_answer_can_be_played_to_nav2(folder: Path, tmp_path: Path) -> None:
    run("relocalize", folder / "drive.mcap", "-d", folder / "b.submaps", "--output", tmp_path / "out.mcap")
    told = messages(tmp_path / "out.mcap")
    edges = [edge for topic, message in told if topic == "/tf" for edge in message.transforms]
    frames = {topic: message.header.frame_id for topic, message in told if hasattr(message, "header")}
    assert set(frames.values()) == {"map"}
    (path,) = (message for topic, message in told if topic == "/query_path")
    for pose in (*path.poses, dict(told)["/initialpose"], dict(told)["/pose"]):
        at = pose.header.stamp
        assert known_at(edges, ("map", "odom", "base_link"), at.sec * 10**9 + at.nanosec)


@pytest.mark.parametrize(("of", "table"), [("everything", 100), ("walls", -1), ("raw", THING)])
def test_a_map_of_walls_leaves_furniture_out(folder: Path, tmp_path: Path, of: str, table: int) -> None:
    grid, stem = as_mapped(office()), tmp_path / "m"
    outputs = ("--map", stem, "--mcap", tmp_path / "m.mcap")
    said = run("export", folder / "b.submaps", *outputs, "--map-of", of)
    assert ("no obstacles" in said, "percent" in said) == (of == "walls", of == "raw")
    cells, *_ = nav2_map(tmp_path / "m.yaml")
    told = next(message for topic, message in messages(tmp_path / "m.mcap") if topic == "/map")
    assert np.array_equal(cells.ravel(), told.data)
    assert set(cells[grid.things]) == {table} and set(cells[grid.occupied]) == {82 if of == "raw" else 100}
    # Read back in: of everything furniture is walls, of walls it is unknown, and raw keeps what is known.
    run("convert", tmp_path / "m.yaml", "-o", tmp_path / "again.submaps")
    with open_database(tmp_path / "again.submaps") as again:
        assert np.array_equal(again.grid("m").cells, cells)
    if of == "raw":
        assert np.array_equal(cells, grid.cells)


def test_what_a_map_shows_is_asked_of_a_map(folder: Path, tmp_path: Path) -> None:
    words = ["export", str(folder / "b.submaps"), "--plot", str(tmp_path / "p.png"), "--map-of", "walls"]
    done = CliRunner().invoke(app, words)
    assert isinstance(done.exception, ConfigError) and "--map-of" in str(done.exception)


def test_a_map_says_at_which_heights_it_was_cut(folder: Path, tmp_path: Path) -> None:
    write_cloud(tmp_path / "room.ply", room_cloud(1.7))
    for source, said in (
        (folder / "office.yaml", "heights as in office.yaml"),
        (folder / "drive.mcap", "cut in the plane of a laser, 0.28 m above the base"),
        (tmp_path / "room.ply", "cut from 0.2 to 1.5 m above the floor"),
    ):
        run("convert", source, "-o", tmp_path / "x.submaps", "--set", "projection.band_max_m=1.5", "--force")
        run("export", tmp_path / "x.submaps", "--map", tmp_path / "x", "--force")
        assert said in (tmp_path / "x.yaml").read_text().splitlines()[0]


def test_a_pose_is_told_to_nav2_without_negative_numbers(folder: Path, tmp_path: Path) -> None:
    pose, mcap = tmp_path / "pose.json", tmp_path / "out.mcap"
    outputs = ("--initialpose", pose, "--output", mcap)
    run("relocalize", folder / "drive.mcap", "-d", folder / "b.submaps", *outputs)
    told = dict(messages(mcap))
    assert min(told["/pose"].pose.covariance) < 0.0  # the answer has them
    assert valid_for_nav2(told["/initialpose"])
    assert json.loads(pose.read_text())["pose"]["covariance"] == list(told["/initialpose"].pose.covariance)
