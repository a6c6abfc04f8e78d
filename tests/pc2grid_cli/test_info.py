"""`pc2grid info`: the document and the table."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.errors import LogNotFound
from pc2grid.io.export import write_cloud
from pc2grid.io.maps import save_map
from pc2grid_cli.info import describe
from pc2grid_cli.main import app
from signature.database.maintenance import store
from tests.helpers.building_clouds import room_cloud
from tests.helpers.databases import make_entry
from tests.helpers.recordings import STEP, T0, drive, read, ros, write_mcap
from tests.helpers.simulated_drives import office

runner = CliRunner()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "drive.mcap", drive())


def test_json_is_one_document_of_what_is_there(log: Path) -> None:
    result = runner.invoke(app, ["info", str(log), "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["format"] == "mcap/ros2"
    assert found["start_ns"] == T0
    assert found["duration_s"] == pytest.approx(1.1)
    assert found["message_count"] == 25
    assert {t["topic"]: (t["type"], t["message_count"]) for t in found["topics"]} == {
        "/odom": ("nav_msgs/Odometry", 12),
        "/points": ("sensor_msgs/PointCloud2", 12),
        "/tf_static": ("tf2_msgs/TFMessage", 1),
    }
    assert found["choice"]["topic"] == "/points"
    assert found["choice"]["odometry_topic"] == "/odom"
    assert (found["choice"]["base_frame"], found["choice"]["sensor_frame"]) == ("base_link", "lidar")
    assert found["problem"] is None
    assert found["size_bytes"] == log.stat().st_size


def test_the_table_names_topics_and_their_use(log: Path) -> None:
    result = runner.invoke(app, ["info", str(log)])
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    row = next(line for line in lines if line.startswith("/points"))
    assert row.split() == ["/points", "sensor_msgs/PointCloud2", "12", "scans", "(lidar)"]
    for topic, use in (("/odom", "odometry"), ("/tf_static", "transforms")):
        assert next(line for line in lines if line.startswith(topic)).split()[-1] == use
    assert "1.1 s from 2023-11-14T22:13:20Z" in result.stdout
    assert "base frame base_link, scans in frame lidar" in result.stdout


def test_one_info_for_logs_maps_and_databases(tmp_path: Path) -> None:
    save_map(office(), tmp_path / "office")
    store(tmp_path / "b.submaps", [make_entry("monday")], keep=False)
    said = runner.invoke(app, ["info", str(tmp_path / "office.yaml")]).stdout
    assert "nav2 map, 400 x 280 cells of 0.05 m (20.0 x 14.0 m)" in said and said.count("\n") == 1
    of_database = runner.invoke(app, ["info", str(tmp_path / "b.submaps")]).stdout
    assert of_database.startswith(f"{tmp_path}/b.submaps: 1 session, 3 submaps")
    assert of_database == runner.invoke(app, ["db", "info", str(tmp_path / "b.submaps")]).stdout


def test_the_calibration_of_a_depth_camera_is_shown_as_used(tmp_path: Path) -> None:
    pixels = np.full((4, 6), 2000, np.uint16)
    messages = []
    for i in range(3):
        messages.append(ros().camera("/camera/depth/camera_info", T0 + i * STEP, 6, 4, 5.0))
        messages.append(ros().image("/camera/depth/image_raw", T0 + i * STEP, pixels, "16UC1"))
        messages.append(ros().camera("/other/camera_info", T0 + i * STEP, 6, 4, 5.0))
    path = write_mcap(tmp_path / "depth.mcap", messages)
    assert describe(path).choice.camera_topic == "/camera/depth/camera_info"
    rows = [line.split() for line in runner.invoke(app, ["info", str(path)]).stdout.splitlines()]
    used = {row[0]: row[3:] for row in rows if row and row[0].startswith("/")}
    assert used["/camera/depth/camera_info"] == ["calibration"]
    assert used["/camera/depth/image_raw"] == ["scans", "(depth)"]
    assert used["/other/camera_info"] == []


def test_a_log_that_convert_could_not_use_is_described_all_the_same(tmp_path: Path) -> None:
    two = [ros().cloud(topic, T0, [[1, 2, 3]]) for topic in ("/front", "/rear")]
    path = write_mcap(tmp_path / "two.mcap", two)
    found = describe(path)
    assert found.choice is None
    assert "several topics hold scans" in found.problem
    assert "convert cannot use this log" in runner.invoke(app, ["info", str(path)]).stdout
    assert describe(path, topic="/rear").choice.topic == "/rear"


def test_absent_checksums_show_in_info(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), enable_crcs=False, enable_data_crcs=False)
    assert any("no checksum" in w for w in describe(path).warnings)


def test_what_is_lost_of_a_damaged_log_shows_in_the_exit_code(log: Path) -> None:
    assert runner.invoke(app, ["info", str(log), "--recover"]).exit_code == 0
    data = bytearray(write_mcap(log, drive(), chunk_size=1000).read_bytes())
    mark = b"\x04\0\0\0zstd"  # in the head of each chunk
    second = data.index(mark, data.index(mark) + 1)
    data[second + 30 : second + 50] = bytes(20)
    log.write_bytes(data)
    result = runner.invoke(app, ["info", str(log), "--json", "--recover"])
    assert json.loads(result.stdout)["bytes_lost"] > 0
    assert result.exit_code == 3


def test_markup_in_a_topic_is_shown_and_not_obeyed(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", [ros().cloud("/[bold]x[/bold]", T0 + STEP, [[1, 2, 3]])])
    assert "/[bold]x[/bold]" in runner.invoke(app, ["info", str(path)]).stdout
    assert len(read(path)[0]) == 1


def test_cloud_of_a_building(tmp_path: Path) -> None:
    path = tmp_path / "room.ply"
    write_cloud(path, room_cloud(1.7, 1.0))
    result = runner.invoke(app, ["info", str(path), "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["format"] == "cloud"
    assert found["floor_z_m"] == pytest.approx(1.7 + 3.0 * np.radians(1.0), abs=0.05)
    assert found["tilt_deg"] == pytest.approx(1.0, abs=0.1)
    assert 38 < found["free_m2"] < 48
    text = runner.invoke(app, ["info", str(path)]).stdout
    assert "floor at z 1.7" in text and "tilted by 1.0 degrees" in text
    write_cloud(path, 1000.0 * room_cloud())
    refused = runner.invoke(app, ["info", str(path)])
    assert refused.exit_code == 1 and "too high for a building in metres" in str(refused.exception)
    scaled = runner.invoke(app, ["info", str(path), "--set", "read.unit_m=0.001", "--json"])
    assert scaled.exit_code == 0 and json.loads(scaled.stdout)["free_m2"] > 38


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is locked for root")
def test_a_locked_folder_is_named_itself(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o000)
    with pytest.raises(LogNotFound, match=r"locked: Permission denied$"):
        runner.invoke(app, ["info", str(tmp_path / "locked")], catch_exceptions=False)
