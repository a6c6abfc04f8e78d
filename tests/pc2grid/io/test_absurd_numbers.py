"""Numbers that no robot and no map has: refused by name, and before anything is allocated for them."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pc2grid.errors import (
    FrameError,
    LimitExceeded,
    LogNotFound,
    MapFileError,
    PointCloudError,
    TrajectoryFileError,
    UnsupportedSchema,
)
from pc2grid.io.frames import FrameTree
from pc2grid.io.maps import load_map, save_map
from pc2grid.io.messages import clouds as cloud_files
from pc2grid.io.messages.foxglove import decoder_for as foxglove_decoder
from pc2grid.io.messages.ros import decoder_for
from pc2grid.io.messages.types import Header, Transform
from pc2grid.io.sensors.depth import MAGIC
from pc2grid.io.source import TopicInfo
from pc2grid.io.trajectory import read_tum
from pc2grid.model import OccupancyGrid
from pc2grid.settings import ReadConfig
from tests.helpers import foxglove_messages as foxglove
from tests.helpers.memory import peak_memory
from tests.helpers.recordings import (
    STEP,
    T0,
    Message,
    drive,
    raw_log,
    read,
    ros,
    write_bag,
    write_mcap,
)

INFO, DEPTH = "/camera/depth/camera_info", "/camera/depth/image_raw"
CELLS = np.random.default_rng(1).choice(np.array([-1, 0, 100], np.int8), (9, 13))
GRID = OccupancyGrid(cells=CELLS, resolution_m=0.05, origin_m=(-1.0, 2.0))
MIB = 1 << 20


def chunk(kind: bytes, body: bytes) -> bytes:
    """With the right checksum: damage is caught by it, a liar is not."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def lying_png(width: int, height: int, bits: int = 8, colour: int = 0, data: bytes = b"") -> bytes:
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return (
        MAGIC
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", data or zlib.compress(bytes(64)))
        + chunk(b"IEND", b"")
    )


def map_with(folder: Path, content: bytes, suffix: str = "png", **keys: object) -> Path:
    known: dict[str, object] = {
        "image": f"m.{suffix}", "resolution": 0.05, "origin": "[0, 0, 0]", "negate": 0,
        "occupied_thresh": 0.65, "free_thresh": 0.196,
    }  # fmt: skip
    (folder / f"m.{suffix}").write_bytes(content)
    path = folder / "m.yaml"
    path.write_text("".join(f"{k}: {v}\n" for k, v in (known | keys).items()))
    return path


# --- images of maps -----------------------------------------------------------------------------------


def test_a_flipped_bit_anywhere_in_a_png_changes_no_pixel(tmp_path: Path) -> None:
    """It is seen by the checksums, but for those of parts without pixels."""
    yaml_path, image_path = save_map(GRID, tmp_path / "m", image_format="png")
    whole = image_path.read_bytes()
    for at in range(len(whole)):
        image_path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :])
        try:
            read = load_map(yaml_path)
        except MapFileError as error:
            assert "m.png: " in error.message
        else:
            np.testing.assert_array_equal(read.cells, CELLS)
            assert at >= len(whole) - 12
    for at in range(len(whole) - 12):
        image_path.write_bytes(whole[:at])
        with pytest.raises(MapFileError, match=r"m\.png: "):
            load_map(yaml_path)
    image_path.write_bytes(whole + b"more")
    np.testing.assert_array_equal(load_map(yaml_path).cells, CELLS)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (lying_png(60_000, 60_000), "cannot hold 60000 x 60000 pixels"),
        (lying_png(2**31, 2**31), "cannot hold"),
        (lying_png(0, 5), "0 x 5 pixels"),
        (
            lying_png(20_000, 20_000, bits=1, data=zlib.compress(bytes(2501 * 20_000))),
            "the limit is 100000000",
        ),
        (lying_png(6, 6, bits=16), "a damaged image"),
        (lying_png(4, 4, colour=5), "its header makes no sense"),
        (MAGIC + struct.pack(">I", 2**31) + b"IHDR", "it is cut off"),
        (b"\xff\xd8\xff\xe0 a photo", "not the image of a map"),
        (b"BM" + bytes(100), "0 x 0 pixels"),
        (b"BM" + bytes(16) + struct.pack("<iiHHI", 9000, 9000, 1, 24, 0), "cannot hold 9000 x 9000"),
        (b"P5 90000 90000 255\n" + bytes(99), "cannot hold"),
        (b"P2 9000 9000 255\n1 2 3", "cannot hold"),
        (b"P2 2 2 255\n1 2 3 -4\n", "a damaged image"),
        (b"P2 2 2 255\n1 2 3\n", "a damaged image"),
        (b"P2 2 2 99999\n1 2 3 9\n", "its white is 99999"),
    ],
)  # fmt: skip
def test_images_that_lie_are_refused_before_they_are_decoded(
    tmp_path: Path, image: bytes, words: str
) -> None:
    path = map_with(tmp_path, image)
    with peak_memory() as peak, pytest.raises(MapFileError, match=words) as caught:
        load_map(path)
    assert str(tmp_path / "m.png") in caught.value.message
    assert peak.grown_bytes() < 64 * MIB


def test_what_a_decoder_would_unpack_besides_the_pixels_is_left_out(tmp_path: Path) -> None:
    _, image_path = save_map(GRID, tmp_path / "m", image_format="png")
    whole = image_path.read_bytes()
    bomb = chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(64 * MIB), 1)) + chunk(b"tEXt", b"a\0b")
    image_path.write_bytes(whole[:33] + bomb + whole[33:])
    with peak_memory() as peak:
        np.testing.assert_array_equal(load_map(tmp_path / "m.yaml").cells, CELLS)
    assert peak.grown_bytes() < 32 * MIB


def test_a_large_map_takes_room_for_its_cells_only(tmp_path: Path) -> None:
    """9 million cells: were shades computed per pixel, each of the arrays would take 72 MB."""
    pixels = np.zeros((3000, 3000), np.uint8)
    path = map_with(tmp_path, bytes(cv2.imencode(".png", pixels)[1]))
    load_map(path)
    with peak_memory() as peak:
        assert load_map(path).cells.all()
    assert peak.grown_bytes() < 60 * MIB


@pytest.mark.parametrize(
    ("suffix", "channels"), [("pgm", 1), ("bmp", 1), ("bmp", 3), ("png", 1), ("png", 3), ("png", 4)]
)
def test_formats_of_images(tmp_path: Path, suffix: str, channels: int) -> None:
    grey = np.array([[254, 0, 205], [0, 254, 254]], np.uint8)
    opaque = [np.full_like(grey, 255)] * (channels == 4)
    image = grey if channels == 1 else np.dstack([grey, grey, grey, *opaque])
    path = map_with(tmp_path, bytes(cv2.imencode(f".{suffix}", image)[1]), suffix)
    unknown = 0 if channels == 4 else -1  # nav2 averages opacity in: (3 * 205 + 255) / 4 is free
    assert load_map(path).cells.tolist() == [[100, 0, 0], [0, 100, unknown]]


def test_colour_and_transparency(tmp_path: Path) -> None:
    image = np.full((2, 3, 4), 254, np.uint8)
    image[..., 3] = 255
    image[0, 0, 3] = 0
    image[1, 1] = 0, 0, 0, 255
    path = map_with(tmp_path, bytes(cv2.imencode(".png", image)[1]), mode="scale", free_thresh=0)
    # Shade 254 is 1/255 of the way from free to occupied at 0.65.
    assert load_map(path).cells.tolist() == [[1, 100, 1], [-1, 1, 1]]
    image[0, 0] = 0, 254, 254, 255  # a shade of 0.75, with alpha as a fourth colour
    path = map_with(tmp_path, bytes(cv2.imencode(".png", image)[1]))
    assert load_map(path).cells.tolist() == [[0, 100, 0], [-1, 0, 0]]


# --- depth images -------------------------------------------------------------------------------------


def seen_by(camera: Message, image: Message, folder: Path, config: ReadConfig | None = None) -> list[Any]:
    return read(write_mcap(folder / "a.mcap", [camera, image]), config)[0]


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (lying_png(60_000, 60_000, 16), "cannot hold 60000 x 60000"),
        (lying_png(300, 300, 16, data=zlib.compress(bytes(601 * 300))), "max_points"),
        (lying_png(6, 4, 8), "not one channel of 16 bits"),
        (lying_png(6, 4, 16, data=zlib.compress(bytes(20))), "damaged"),
    ],
)
def test_depth_images_that_unpack_without_end(tmp_path: Path, image: bytes, words: str) -> None:
    message = ros().compressed(DEPTH, T0, bytes(12) + image, "16UC1; compressedDepth png")
    with peak_memory() as peak, pytest.raises(PointCloudError, match=words):
        seen_by(ros().camera(INFO, T0, 6, 4, 100.0), message, tmp_path, ReadConfig(max_points=50_000))
    assert peak.grown_bytes() < 64 * MIB


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30, 1e300])
@pytest.mark.parametrize("place", range(5))
def test_cameras_with_absurd_distortion(tmp_path: Path, value: float, place: int) -> None:
    """Refused, or points that are possible: never NaN."""
    camera = ros().camera(INFO, T0, 6, 4, 100.0)
    at = camera.data.index(struct.pack("<d", 100.0)) - 40 + 8 * place  # d stands right before k
    assert camera.data[at : at + 8] == bytes(8)
    camera = camera._replace(data=camera.data[:at] + struct.pack("<d", value) + camera.data[at + 8 :])
    image = ros().image(DEPTH, T0, np.full((4, 6), 1000, np.uint16), "16UC1")
    try:
        (scan,) = seen_by(camera, image, tmp_path)
    except PointCloudError as error:
        assert INFO in error.message
    else:
        assert np.isfinite(scan.points_m).all()


def test_a_camera_with_very_many_numbers_of_distortion() -> None:
    decode = decoder_for(TopicInfo(topic=INFO, type="sensor_msgs/CameraInfo", encoding="cdr"))
    assert len(decode(ros().camera(INFO, T0, 6, 4, 100.0, d=np.zeros(14)).data).d) == 14
    with pytest.raises(PointCloudError, match="a CameraInfo with 101 numbers of distortion"):
        decode(ros().camera(INFO, T0, 6, 4, 100.0, d=np.zeros(101)).data)


# --- poses --------------------------------------------------------------------------------------------


def moved(message: Message, old: float, new: float) -> Message:
    """The message with one of its numbers replaced."""
    before = struct.pack("<d", old)
    assert before in message.data
    return message._replace(data=message.data.replace(before, struct.pack("<d", new), 1))


ABSURD = [1e300, -1e300, 1e39, 1.1e8, float("nan"), float("inf")]


NOWHERE = [*((0.25, value) for value in ABSURD), *((1.0, w) for w in (0.0, 1e-200, 1e200, float("nan")))]


@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])
@pytest.mark.parametrize(("old", "new"), NOWHERE)
def test_a_mount_that_is_nowhere_or_turned_nowhere_is_refused_by_name(
    tmp_path: Path, old: float, new: float, topic: str
) -> None:
    """x of a transform, or w of its quaternion."""
    to = ros()
    mount = moved(to.tf(T0, "base_link", "lidar", 0.25, topic=topic), old, new)
    path = write_mcap(tmp_path / "a.mcap", [mount, to.cloud("/points", T0, [[1, 2, 3]])])
    with pytest.raises(FrameError, match=r"a transform base_link -> lidar of the log makes no sense"):
        read(path)
    scans, report = read(path, ReadConfig(assume_identity=True))
    assert scans[0].points_m.tolist() == [[1, 2, 3]]
    assert any("base_link -> lidar" in warning for warning in report.warnings)


def test_a_chain_of_very_many_frames() -> None:
    links = [
        Transform(Header(T0, f"f{i}"), f"f{i + 1}", (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        for i in range(10_100)
    ]
    tree = FrameTree()
    tree.add_all(tuple(links), static=True)
    tree.add_all(tuple(links[9_990:]), static=True)
    assert len(tree.frames) == 10_001
    assert any("more than 10000 frames" in w for w in tree.warnings)
    assert len(tree.chain("f10000")) == 10_001
    tree.add(Transform(Header(T0, "f9000"), "f0", links[0].pose), static=True)
    assert len(tree.chain("f10000")) == 10_001  # f0 had no parent before, and there is no room for it
    tree.add(Transform(Header(T0, "f9000"), "f1", links[0].pose), static=True)
    with pytest.raises(FrameError, match=r"tf goes in a circle: .* -> f1 -> f9000$"):
        tree.chain("f10000")


def test_an_unreadable_tf_message_is_not_taken_for_no_tf(tmp_path: Path) -> None:
    to = ros()
    mount = to.tf(T0, "base_link", "lidar", 0.25, topic="/tf_static")
    cloud = to.cloud("/points", T0, [[1, 2, 3]])
    path = write_mcap(tmp_path / "a.mcap", [mount._replace(data=mount.data[:-20]), cloud])
    with pytest.raises(FrameError, match="some tf messages are unreadable"):
        read(path)
    scans, report = read(write_mcap(tmp_path / "b.mcap", [cloud]))
    assert len(scans) == 1
    assert any("the log has no tf" in warning for warning in report.warnings)


@pytest.mark.parametrize("value", ABSURD)
def test_odometry_that_is_nowhere_on_earth_is_ignored_and_said(tmp_path: Path, value: float) -> None:
    to = ros()
    messages = []
    for i in range(12):
        odometry = to.odometry("/odom", T0 + i * STEP, 0.25 + i)
        messages.append(moved(odometry, 5.25, value) if i == 5 else odometry)
        messages.append(to.cloud("/points", T0 + i * STEP, [[1, 2, 3]]))
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    found = [scan.T_odom_base[0, 3] for scan in scans if scan.T_odom_base is not None]
    assert found == pytest.approx([0.25 + i for i in range(12)])  # between its neighbours
    assert any("odometry messages are unreadable or not finite" in w for w in report.warnings)


# --- times --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seconds", [10**10, 10**30, -(10**30)])
def test_stamps_past_all_calendars_are_skipped(tmp_path: Path, seconds: int) -> None:
    def change(fields: dict[str, Any]) -> None:
        fields["timestamp"]["sec"] = seconds

    path = json_clouds(tmp_path / "a.mcap", change)
    scans, report = read(path)
    assert len(scans) == 19
    (reason,) = report.scans_skipped
    assert "stamp" in reason


def json_clouds(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """20 clouds in JSON, of which the eleventh is changed."""
    clouds = [foxglove.jsonable(foxglove.cloud(T0 + i * STEP, [[1, 2, 3]])[3]) for i in range(20)]
    change(clouds[10])
    points = "/points", "foxglove.PointCloud", "jsonschema", b"{}"
    return raw_log(path, [(*points, json.dumps(fields).encode()) for fields in clouds], "json")


@pytest.mark.parametrize("late", [1 << 63, (1 << 64) - 1])
def test_times_of_recording_past_all_calendars(tmp_path: Path, late: int) -> None:
    """Stamps are zero, so the times of recording have to do, and these do not."""
    messages = [ros().cloud("/points", 0, [[1, 2, 3]])._replace(log_time_ns=T0 + i * STEP) for i in range(20)]
    messages[-1] = messages[-1]._replace(log_time_ns=late)
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert len(scans) == 19
    assert report.scans_skipped == {"stamp is past the year 2262": 1}


# --- a few bytes that ask for gigabytes or hours ------------------------------------------------------


def yaml_bomb() -> str:
    """A list named l9 of 9^10 items in a kilobyte."""
    lines = ["l0: &l0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, 10)]
    return "\n".join(lines) + "\n"


@pytest.mark.fault(46)
@pytest.mark.parametrize(
    "key",
    ["image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"],
)
@pytest.mark.parametrize("value", ["*l9", "0x" + "f" * 9000, "[*l9, 0, 0]", "{a: *l9}"])
def test_values_of_billions_of_items_are_not_written_out(tmp_path: Path, key: str, value: str) -> None:
    path = map_with(tmp_path, b"P5 2 2 255\n" + bytes(4), "pgm", **{key: value})
    path.write_text(yaml_bomb() + path.read_text())
    with peak_memory() as peak, pytest.raises(MapFileError, match=f"{key}: ") as caught:
        load_map(path)
    assert len(caught.value.message) < 400
    assert peak.grown_bytes() < 16 * MIB


@pytest.mark.parametrize("target", ["/dev/zero", "pipe"])
def test_images_and_clouds_without_end(tmp_path: Path, target: str) -> None:
    if target == "pipe":
        target = str(tmp_path / "pipe")
        os.mkfifo(target)
    with pytest.raises(MapFileError, match="not a regular file"):
        load_map(map_with(tmp_path, b"", "pgm", image=target))
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    (clouds / "2.bin").symlink_to(target)
    (clouds / "poses.tum").symlink_to(target)
    with pytest.raises(LogNotFound, match="a folder without a recording"):
        read(clouds)
    (clouds / "1.bin").write_bytes(np.ones((5, 4), "<f4").tobytes())
    assert len(read(clouds)[0]) == 1


def test_files_that_are_too_large_are_not_read(tmp_path: Path) -> None:
    path = map_with(tmp_path, b"P5 2 2 255\n", "pgm")
    with (tmp_path / "m.pgm").open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(MapFileError, match=r"m\.pgm: larger than \d+ bytes: not the image of a map"):
        load_map(path)
    with (tmp_path / "a.tum").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(TrajectoryFileError, match=r"a\.tum: larger than \d+ bytes"):
        read_tum(tmp_path / "a.tum")


HEADER = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 30000\nHEIGHT 1\nDATA "


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (HEADER + b"ascii\n" + b"1 2 3\n" * 29_999 + b"1 2", "not a line of numbers"),
        (HEADER + b"binary_compressed\n" + struct.pack("<II", 9, 360_000) + bytes(9), "is not read"),
    ],
)
def test_clouds_that_swell(content: bytes, words: str) -> None:
    with peak_memory() as peak, pytest.raises((PointCloudError, UnsupportedSchema), match=words):
        cloud_files.parser("pcd")(content, Header(1, "lidar"))
    assert peak.grown_bytes() < 64 * MIB


def nested(levels: int, width: int, leaf: str = "int32 a\n") -> str:
    """A definition of width ** levels fields."""
    parts = ["".join(f"p/L0 f{i}\n" for i in range(width))]
    parts += [
        f"MSG: p/L{n}\n" + "".join(f"p/L{n + 1} f{i}\n" for i in range(width)) for n in range(levels - 1)
    ]
    return ("=" * 80 + "\n").join([*parts, f"MSG: p/L{levels - 1}\n{leaf}"])


@pytest.mark.parametrize(
    "text",
    [
        nested(14, 12),
        nested(14, 12, leaf=""),
        nested(2, 5000),
        "sensor_msgs/PointCloud2 again\n",
        "int32 a\n" * 200_000,
    ],
)
def test_definitions_that_swell_or_take_for_ever(tmp_path: Path, text: str) -> None:
    cloud = ros().cloud("/points", T0, [[1, 2, 3]])
    path = raw_log(
        tmp_path / "a.mcap",
        [("/points", "sensor_msgs/msg/PointCloud2", "ros2msg", text.encode(), cloud.data)],
    )
    with peak_memory() as peak, pytest.raises(UnsupportedSchema, match="/points"):
        read(path, ReadConfig(assume_identity=True))
    assert peak.grown_bytes() < 64 * MIB


def test_small_messages_do_not_keep_large_chunks_in_memory(tmp_path: Path) -> None:
    """16 chunks of 8 MB that overlap in time, each with one scan among images that are not read."""
    image = Message("/other", "sensor_msgs/Image", T0, bytes(8 * MIB))
    messages = []
    for i in range(16):
        messages += [image, ros().cloud("/points", T0 + i * STEP, [[1, 2, 3]])]
    path = write_mcap(tmp_path / "a.mcap", messages, chunk_size=7 * MIB)
    assert path.stat().st_size < MIB
    with peak_memory() as peak:
        assert len(read(path, ReadConfig(assume_identity=True))[0]) == 16
    assert peak.grown_bytes() < 66 * MIB


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_a_laser_of_too_many_beams(tmp_path: Path, encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pc2grid.io.messages.foxglove.MOST_BEAMS", 1000)
    fields = foxglove.stamped(
        T0, frame_id="laser", pose=foxglove.IDENTITY, start_angle=0.0, end_angle=6.0,
        ranges=[0.0] * 1001, intensities=[],
    )  # fmt: skip
    path = foxglove.write(tmp_path / "a.mcap", [("/scan", "LaserScan", T0, fields)], encoding)
    with pytest.raises(LimitExceeded, match="a scan of 1001 beams; the limit is 1000"):
        read(path, ReadConfig(assume_identity=True))


@pytest.mark.parametrize("data", [b"[" + b"0," * 2_000_001 + b"0]", b'"' + bytes(1 << 26) + b'"'])
def test_json_that_would_become_millions_of_objects(data: bytes) -> None:
    channel = TopicInfo(topic="/points", type="foxglove.PointCloud", encoding="json")
    with (
        peak_memory() as peak,
        pytest.raises(LimitExceeded, match=r"a JSON message of \d+ bytes and \d+ values"),
    ):
        foxglove_decoder(channel)(data)
    assert peak.grown_bytes() < 80 * MIB


@pytest.mark.parametrize("name", ["9999999999.5", "9999999999999999999"])
def test_names_past_all_calendars_are_no_times(tmp_path: Path, name: str) -> None:
    (tmp_path / f"{name}.bin").write_bytes(np.ones((5, 4), "<f4").tobytes())
    scans, report = read(tmp_path)
    assert len(scans) == 1
    assert any("10 clouds a second are assumed" in w for w in report.warnings)


def test_a_bag_whose_records_are_too_large(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", drive("ros1"), chunk_bytes=2000)
    with pytest.raises(LimitExceeded, match=r"a record has \d+ bytes; the limit is 1000 .*max_record"):
        read(path, ReadConfig(max_record_bytes=1000))
    whole = path.read_bytes()
    with path.open("wb") as file:
        file.write(whole[:13] + struct.pack("<I", 1 << 31))
        file.truncate(1 << 32)  # nothing but a hole
    with peak_memory() as peak, pytest.raises(LimitExceeded, match="2147483648 bytes"):
        read(path)
    assert peak.grown_bytes() < 16 * MIB
