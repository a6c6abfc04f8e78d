"""Rare cases of reading, which must be right or refused like the common ones."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pc2grid.errors import (
    ConfigError,
    FrameError,
    LimitExceeded,
    LogNotFound,
    MapFileError,
    NotALog,
    PointCloudError,
    TrajectoryFileError,
    UnsupportedSchema,
)
from pc2grid.io import open_log
from pc2grid.io.frames import PoseTrack
from pc2grid.io.maps import load_map, save_map
from pc2grid.io.messages.types import Header, LaserScan
from pc2grid.io.sensors import decode as laserscan
from pc2grid.io.trajectory import read_tum, stamp_ns_from_text
from pc2grid.model import OccupancyGrid
from pc2grid.settings import ReadConfig
from tests.helpers.cloud_folders import folder_of
from tests.helpers.recordings import STEP, T0, Message, check_drive, drive, read, ros, write_mcap

INFO, DEPTH = "/camera/depth/camera_info", "/camera/depth/image_raw"


# --- what a path may be -------------------------------------------------------------------------------


def test_paths_that_are_not_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(LogNotFound, match=r"pipe\.mcap: not a regular file"):
        open_log(tmp_path / "pipe.mcap")
    (tmp_path / "file").write_text("")
    with pytest.raises(LogNotFound, match=r"file/a\.mcap: (Not a directory|no such file)"):
        open_log(tmp_path / "file" / "a.mcap")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(LogNotFound, match="loop: "):
        open_log(tmp_path / "loop")


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"\xff\xfe\xfd" * 30, "binary data of another kind"),
        (b"\x1f\x8b" + bytes(90), "a gzip archive.*unpack it first"),
        (b"PK\x03\x04" + bytes(90), "a zip archive.*unpack it first"),
        (b"\x28\xb5\x2f\xfd" + bytes(90), "a zstd-compressed file.*unpack it first"),
        (b"\x04\x22\x4d\x18" + bytes(90), "an lz4-compressed file.*unpack it first"),
        (b"#ROSBAG V1.2\n" + bytes(90), "a ROS 1 bag of an old format.*rosbag migrate"),
        (b"ply\nformat" + bytes(90), "a PLY cloud.*one file per scan"),
        (b"\0\1\2\3", "binary data of another kind"),
        (b"plain", "text"),
    ],
)
def test_what_a_file_looks_like(tmp_path: Path, head: bytes, words: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(head)
    with pytest.raises(NotALog, match=rf"a\.mcap: not a recording; looks like {words}"):
        open_log(path)


def test_names_in_a_file_break_no_line(tmp_path: Path) -> None:
    to = ros()
    mount = to.tf(T0, "mast\x1b[31m", "li\ndar", 0.2, topic="/tf_static")
    path = write_mcap(tmp_path / "a\nb.mcap", [mount, to.cloud("/points", T0, [[1, 2, 3]])])
    with pytest.raises(FrameError) as caught:
        read(path)
    assert str(caught.value).isprintable()
    assert r"frames in the log: li\ndar, mast\x1b[31m" in caught.value.message
    assert caught.value.message.count("a\\nb.mcap") == 1


# --- parts, times, odometry ---------------------------------------------------------------------------


@pytest.mark.parametrize("part", [(-1.0, None), (math.nan, None), (0.0, 0.0), (0.0, -1.0), (0.0, math.nan)])
def test_parts_that_make_no_sense(tmp_path: Path, part: tuple[float, float | None]) -> None:
    with (
        open_log(write_mcap(tmp_path / "a.mcap", drive())) as log,
        pytest.raises(ConfigError, match="expected seconds"),
    ):
        log.scans(*part)


def test_the_shortest_of_several_odometries_is_used_and_reported(tmp_path: Path) -> None:
    to, messages = ros(), drive()
    wheels = [to.odometry("/wheels/odometry", T0 + i * STEP, 7.0) for i in range(12)]
    with open_log(write_mcap(tmp_path / "a.mcap", [*messages, *wheels])) as log:
        assert "odometry from /odom (also there: /wheels/odometry" in log.choose().reason
        check_drive(list(log.scans()))


@pytest.mark.parametrize("in_tf", [False, True])
def test_one_stray_time_of_recording_is_no_other_clock(tmp_path: Path, in_tf: bool) -> None:
    """A message that was recorded with a time of the year before comes first, and decides nothing."""
    to = ros()
    mount, *messages = drive()
    if in_tf:
        clouds = [m for m in messages if m.topic == "/points"]
        messages = [*clouds, *(to.tf(T0 + i * STEP, "odom", "base_link", 0.1 * i) for i in range(12))]
    k = next(k for k, message in enumerate(messages) if message.topic != "/points")
    messages[k] = messages[k]._replace(log_time_ns=T0 - 10**16)
    path = write_mcap(tmp_path / "a.mcap", sorted([mount, *messages], key=lambda m: m.log_time_ns))
    with open_log(path) as log:
        assert log.choose().odometry_topic == ("/tf" if in_tf else "/odom")
        check_drive(list(log.scans()))
        assert not any("clocks" in warning for warning in log.report().warnings)


def test_odometry_of_a_frame_that_moves_on_the_base(tmp_path: Path) -> None:
    to = ros()
    messages = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    for i in range(12):
        stamp = T0 + i * STEP
        messages.append(to.tf(stamp, "base_link", "arm", 0.1 * i))
        messages.append(to.odometry("/odom", stamp, 0.1 * i, child="arm"))
        messages.append(to.cloud("/points", stamp, [[1, 2, 3]]))
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert len(scans) == 12
    assert any("the odometry is of frame arm, which is taken for base_link" in w for w in report.warnings)


def test_a_track_forgets_what_is_long_gone() -> None:
    track = PoseTrack()
    for i in range(50_000):
        assert track.add(i * STEP, (0.1 * i, 0, 0, 0, 0, 0, 1))
    assert len(track) <= 40_000
    assert track.at(0) is None
    last = track.at(49_999 * STEP)
    assert last is not None
    assert last[0, 3] == pytest.approx(4999.9)


# --- lasers -------------------------------------------------------------------------------------------


def beams(count: int = 5, **changes: float) -> LaserScan:
    start, step = changes.pop("angle_min", -0.2), changes.pop("angle_increment", 0.1)
    known = {
        "angle_min": start, "angle_max": start + (count - 1) * step, "angle_increment": step,
        "time_increment": 0.0, "scan_time": 0.1, "range_min": 0.1, "range_max": 30.0,
    }  # fmt: skip
    ranges = 1.0 + (np.arange(count) % 20).astype(np.float32)
    return LaserScan(Header(T0, "laser"), **(known | changes), ranges=ranges)


@pytest.mark.parametrize(
    ("scan", "error", "words"),
    [
        (beams(angle_min=math.nan), PointCloudError, "angles that are not finite"),
        (beams(angle_increment=0.0), PointCloudError, "field angle_increment: 0"),
        (beams(200), LimitExceeded, "a scan of 200 beams; the limit is 100"),
    ],
)
def test_lasers_that_contradict_themselves(scan: LaserScan, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        laserscan.decode(scan, max_points=100)


def test_laser_whose_beams_would_take_years_is_taken_at_one_time() -> None:
    for wrong in (0.5, -0.5, 1e30):
        found = laserscan.decode(beams(time_increment=wrong))
        assert found.offsets_s is None
        assert found.notes == ("time_increment makes a scan longer than 2 s: it is ignored",)
    assert laserscan.decode(beams(time_increment=0.4)).notes == ()


def test_beams_and_their_times() -> None:
    found = laserscan.decode(beams(time_increment=0.01, range_min=2.0, range_max=5.0))
    assert found.dropped == 2  # 1 m is too near, 5 m is the reach itself
    angles = np.array([-0.1, 0.0, 0.1])
    expected = np.array([2, 3, 4])[:, None] * np.column_stack((np.cos(angles), np.sin(angles), 0 * angles))
    np.testing.assert_allclose(found.xyz_m, expected, atol=1e-6)
    np.testing.assert_allclose(found.offsets_s, [0.01, 0.02, 0.03])
    unlimited = laserscan.decode(beams(range_max=0.0, range_min=0.0))
    assert len(unlimited.xyz_m) == 5
    assert unlimited.offsets_s is None
    assert len(laserscan.decode(beams(range_max=math.inf)).xyz_m) == 5
    assert len(laserscan.decode(beams(1, angle_increment=0.0)).xyz_m) == 1


def test_a_range_of_zero_is_no_return() -> None:
    ranges = np.array([0.0, 1.0, -1.0, np.inf, np.nan], np.float32)
    found = laserscan.decode(dataclasses.replace(beams(range_min=0.0), ranges=ranges))
    np.testing.assert_allclose(np.linalg.norm(found.xyz_m, axis=1), [1.0], rtol=1e-6)


@pytest.mark.parametrize(("count", "slack"), [(5, 2), (1000, 20)])
def test_angles_may_be_off_by_two_beams_or_two_percent(count: int, slack: int) -> None:
    """Drivers round the last angle, or leave a beam out."""

    def declared(beams_more: float) -> LaserScan:
        return beams(count, angle_increment=0.001, angle_max=-0.2 + 0.001 * (count - 1 + beams_more))

    for fine in (-slack + 0.01, slack - 0.01):
        assert laserscan.decode(declared(fine), max_points=10_000).notes == ()
    for wrong in (-slack - 0.5, slack + 0.5):
        (note,) = laserscan.decode(declared(wrong), max_points=10_000).notes
        assert "angle_max is ignored" in note


# --- cameras with lenses ------------------------------------------------------------------------------


def camera(model: str, d: list[float]) -> Message:
    """A CameraInfo of 64 x 48 pixels, its axis in the middle."""
    k, p = [40.0, 0, 32, 0, 40, 24, 0, 0, 1], [40.0, 0, 32, 0, 0, 40, 24, 0, 0, 0, 1, 0]
    return ros().camera(INFO, T0, 64, 48, 40.0, d=np.array(d), k=np.array(k), p=np.array(p), model=model)


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_distorted_image_projects_back_onto_its_pixels(tmp_path: Path, model: str) -> None:
    """By OpenCV's projection, the inverse of what is used for reading."""
    d = [-0.1, 0.02, 0.001, -0.001, 0.0] if model == "plumb_bob" else [0.01, -0.004, 0.002, 0.0]
    image = ros().image(DEPTH, T0, np.full((48, 64), 2000, np.uint16), "16UC1")
    path = write_mcap(tmp_path / "a.mcap", [camera(model, d), image])
    (scan,), _ = read(path, ReadConfig(depth_stride=1))
    optical = np.column_stack((-scan.points_m[:, 1], -scan.points_m[:, 2], scan.points_m[:, 0]))
    k = np.array([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    pixels = project(optical.astype(float)[:, None], np.zeros(3), np.zeros(3), k, np.array(d))[0][:, 0]
    v, u = np.mgrid[:48, :64]
    np.testing.assert_allclose(pixels, np.column_stack((u.ravel(), v.ravel())), atol=0.05)
    rectified = write_mcap(
        tmp_path / "b.mcap", [camera(model, d), image._replace(topic="/camera/depth/image_rect")]
    )
    (plain,), _ = read(rectified, ReadConfig(depth_stride=1))
    np.testing.assert_allclose(plain.points_m[:, 1], -(u.ravel() - 32) / 40 * 2, atol=1e-5)


def test_an_unknown_lens(tmp_path: Path) -> None:
    image = ros().image(DEPTH, T0, np.full((48, 64), 2000, np.uint16), "16UC1")
    with pytest.raises(UnsupportedSchema, match="the distortion model 'double_sphere' is not read"):
        read(write_mcap(tmp_path / "a.mcap", [camera("double_sphere", [0.1]), image]))


def test_an_image_without_pixels_is_an_empty_scan(tmp_path: Path) -> None:
    to = ros()
    images = [to.image(DEPTH, T0 + i, np.ones((i, i), np.uint16), "16UC1") for i in (0, 2)]
    (scan, _), _ = read(write_mcap(tmp_path / "a.mcap", [to.camera(INFO, T0, 0, 0, 40.0), *images]))
    assert scan.points_m.shape == (0, 3)


# --- times and poses next to clouds -------------------------------------------------------------------


def written(name: str, content: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(content) and None


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (written("times.txt", "1 2 2"), r"times\.txt: time does not increase"),
        (written("times.txt", "1 2"), r"times\.txt: 2 times for 3 clouds"),
        (written("times.txt", "1 two 3"), r"times\.txt: not seconds, one per line"),
        (written("a.tum", "1 0 0 0 0 0 0 1\n"), r"a \.tum of 1 poses for 3 clouds"),
        (
            lambda folder: [(folder / f"{n}.tum").write_text("1 0 0 0 0 0 0 1") for n in "ab"],
            r"several \.tum files: a\.tum, b\.tum",
        ),
    ],
)
def test_sidecars_that_do_not_fit(tmp_path: Path, spoil: Callable[[Path], object], words: str) -> None:
    folder = folder_of(tmp_path, "bin", count=3)
    spoil(folder)
    with pytest.raises(TrajectoryFileError, match=words):
        read(folder)


@pytest.mark.parametrize("word", ["", "x", "1..2", "--1", "1e", "nan", "inf", "9" * 30, "1e999999999999"])
def test_words_that_are_no_times(word: str) -> None:
    with pytest.raises((ValueError, ArithmeticError)):
        stamp_ns_from_text(word)


@pytest.mark.parametrize(
    ("word", "stamp_ns"), [("1.283e+09", 1_283_000_000 * 10**9), ("-0.5", -(10**9) // 2), (".5", 5 * 10**8)]
)
def test_words_that_are_times(word: str, stamp_ns: int) -> None:
    assert stamp_ns_from_text(word) == stamp_ns


def test_trajectory_files_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    with pytest.raises(TrajectoryFileError, match=r"t\.txt: No such file"):
        read_tum(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TrajectoryFileError, match=r"t\.txt: not a text file"):
        read_tum(path)
    path.write_text("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    with pytest.raises(TrajectoryFileError, match="line 2: time does not increase"):
        read_tum(path)


# --- maps ---------------------------------------------------------------------------------------------


def test_paths_of_maps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    grid = OccupancyGrid(cells=np.zeros((2, 3), np.int8), resolution_m=0.05, origin_m=(0, 0))
    yaml_path, image_path = save_map(grid, tmp_path / "m")
    with pytest.raises(MapFileError, match=r"none\.yaml: No such file"):
        load_map(tmp_path / "none.yaml")
    plain = yaml_path.read_text()
    (tmp_path / "inner").mkdir()
    inner = tmp_path / "inner" / "m.yaml"
    inner.write_text(plain.replace("m.pgm", "../m.pgm"))
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(load_map(inner).cells, grid.cells)
    assert "leaves the folder of the map" in caplog.text
    inner.write_text(plain.replace("m.pgm", str(image_path)))
    np.testing.assert_array_equal(load_map(inner).cells, grid.cells)
    for name in ('"a\\0b"', "3", '""', "[a]"):
        inner.write_text(plain.replace("m.pgm", name))
        with pytest.raises(MapFileError, match=r"inner/m\.yaml: image: "):
            load_map(inner)
    with pytest.raises(MapFileError, match="mode: 'odd' is not one of"):
        save_map(grid, tmp_path / "n", mode="odd")  # type: ignore[arg-type]
    assert not (tmp_path / "n.yaml").exists() and not (tmp_path / "n.pgm").exists()
