"""What is read is refused by name, and before anything is allocated for what it only claims to hold.

Each row is a number of the catalogue (tests/test_faults_catalogue.py), an error, words of its message, what
is done with an empty folder, and how much memory that may take.
"""

import json
import math
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import (
    ConfigError,
    LimitExceeded,
    LogNotFound,
    LogTruncated,
    MapFileError,
    NotALog,
    Pc2GridError,
    PointCloudError,
    TrajectoryFileError,
    UnsupportedSchema,
)
from pc2grid.io.maps import load_map
from pc2grid.io.messages import clouds, foxglove
from pc2grid.io.messages.ros import decoder_for
from pc2grid.io.messages.types import Header, LaserScan, PointCloud2
from pc2grid.io.recording import open_log
from pc2grid.io.sensors.decode import decode_cloud, decode_laser
from pc2grid.io.sensors.depth import MAGIC
from pc2grid.io.source import TopicInfo
from pc2grid.io.trajectory import read_tum
from pc2grid.settings import ReadConfig
from tests.helpers import foxglove_messages
from tests.helpers.cloud_folders import folder_of
from tests.helpers.memory import peak_memory
from tests.helpers.nav2_map import map_of, png_chunk
from tests.helpers.recordings import T0, Message, drive, raw_log, read, ros, write_bag, write_mcap

INFO, DEPTH = "/camera/depth/camera_info", "/camera/depth/image_raw"
CLOUD = "sensor_msgs/PointCloud2"
Act = Callable[[Path], object]
ROWS: list[Any] = []


def refused(number: int, error: type[Pc2GridError], words: str, act: Act, most_mib: int = 64) -> None:
    """Add a row to the table."""
    name, mark = f"{number} {len(ROWS)} {words[:40]}", pytest.mark.fault(number)
    ROWS.append(pytest.param(error, words, act, most_mib, marks=mark, id=name))


# --- files --------------------------------------------------------------------------------------------


def opened(head: bytes) -> Act:
    def act(folder: Path) -> None:
        (folder / "a.mcap").write_bytes(head)
        open_log(folder / "a.mcap")

    return act


for _head, _words in (
    (b"\xff\xfe\xfd" * 30, "binary data of another kind"),
    (b"\x1f\x8b" + bytes(90), "a gzip archive.*unpack it first"),
    (b"PK\x03\x04" + bytes(90), "a zip archive.*unpack it first"),
    (b"\x28\xb5\x2f\xfd" + bytes(90), "a zstd-compressed file.*unpack it first"),
    (b"\x04\x22\x4d\x18" + bytes(90), "an lz4-compressed file.*unpack it first"),
    (b"#ROSBAG V1.2\n" + bytes(90), "a ROS 1 bag of an old format.*rosbag migrate"),
    (b"ply\nformat" + bytes(90), "a PLY cloud.*one file per scan"),
    (b"\0\1\2\3", "binary data of another kind"),
    (b"plain", "text"),
    (b"version https://git-lfs.github.com/spec/v1\n", "a Git LFS pointer.*git lfs pull"),
):
    refused(4, NotALog, rf"a\.mcap: not a recording; looks like {_words}", opened(_head))


refused(3, LogTruncated, "ends after its first 8 bytes", opened(b"\x89MCAP0\r\n"))


def pipe(folder: Path) -> Path:
    os.mkfifo(folder / "pipe.mcap")
    return folder / "pipe.mcap"


def loop(folder: Path) -> Path:
    (folder / "loop").symlink_to("loop")
    return folder / "loop"


def below_a_file(folder: Path) -> Path:
    (folder / "file").touch()
    return folder / "file" / "a.mcap"


refused(1, LogNotFound, r"pipe\.mcap: not a regular file", lambda folder: open_log(pipe(folder)))
refused(1, LogNotFound, r"file/a\.mcap: (Not a dir|no such)", lambda folder: open_log(below_a_file(folder)))
refused(1, LogNotFound, "loop: ", lambda folder: open_log(loop(folder)))


def part(*seconds: Any) -> Act:
    def act(folder: Path) -> None:
        with open_log(write_mcap(folder / "a.mcap", drive())) as log:
            log.scans(*seconds)

    return act


for _part in ((-1.0, None), (math.nan, None), (0.0, 0.0), (0.0, -1.0), (0.0, math.nan)):
    refused(46, ConfigError, "expected seconds", part(*_part))


def sidecar(**files: str) -> Act:
    def act(folder: Path) -> None:
        of_clouds = folder_of(folder, "bin", count=3)
        for name, content in files.items():
            (of_clouds / name.replace("_", ".")).write_text(content)
        read(of_clouds)

    return act


POSE = "1 0 0 0 0 0 0 1\n"
for _files, _words in (
    ({"times_txt": "1 2 2"}, r"times\.txt: time does not increase"),
    ({"times_txt": "1 2"}, r"times\.txt: 2 times for 3 clouds"),
    ({"times_txt": "1 two 3"}, r"times\.txt: not seconds, one per line"),
    ({"a_tum": POSE}, r"a \.tum of 1 poses for 3 clouds"),
    ({"a_tum": POSE, "b_tum": POSE}, r"several \.tum files: a\.tum, b\.tum"),
):
    refused(46, TrajectoryFileError, _words, sidecar(**_files))


def tum(content: bytes, size: int = 0) -> Act:
    def act(folder: Path) -> None:
        (folder / "t.txt").write_bytes(content)
        if size:
            os.truncate(folder / "t.txt", size)
        read_tum(folder / "t.txt")

    return act


refused(1, TrajectoryFileError, r"t\.txt: No such file", lambda folder: read_tum(folder / "t.txt"))
refused(46, TrajectoryFileError, r"t\.txt: not a text file", tum(b"\xff\xfe\x00"))
refused(46, TrajectoryFileError, "line 2: time does not increase", tum(2 * POSE.encode()))
refused(46, TrajectoryFileError, r"t\.txt: larger than \d+ bytes", tum(b"", 1 << 40))


def bag_with_large_records(folder: Path) -> Path:
    return write_bag(folder / "a.bag", drive("ros1"), chunk_bytes=2000)


def bag_of_a_hole(folder: Path) -> Path:
    """A record of 2 GB, in which nothing stands."""
    path = bag_with_large_records(folder)
    path.write_bytes(path.read_bytes()[:13] + struct.pack("<I", 1 << 31))
    os.truncate(path, 1 << 32)
    return path


refused(
    12, LimitExceeded, r"a record has \d+ bytes; the limit is 1000 .*max_record",
    lambda folder: read(bag_with_large_records(folder), ReadConfig(max_record_bytes=1000)),
)  # fmt: skip
refused(12, LimitExceeded, "2147483648 bytes", lambda folder: read(bag_of_a_hole(folder)), most_mib=16)


# --- images of maps, and of depths --------------------------------------------------------------------


def lying_png(width: int, height: int, bits: int = 8, colour: int = 0, data: bytes = b"") -> bytes:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    return MAGIC + header + png_chunk(b"IDAT", data or zlib.compress(bytes(64))) + png_chunk(b"IEND", b"")


def loaded(image: bytes, name: str = "m.png", size: int = 0) -> Act:
    """A map with this image, or one of another name, which may be made larger."""

    def act(folder: Path) -> None:
        path = map_of(folder, image, image=name)
        if size:
            os.truncate(folder / "m.png", size)
        if name == "pipe":
            os.mkfifo(folder / "pipe")
        load_map(path)

    return act


for _image, _words in (
    (lying_png(60_000, 60_000), "cannot hold 60000 x 60000 pixels"),
    (lying_png(2**31, 2**31), "cannot hold"),
    (lying_png(0, 5), "0 x 5 pixels"),
    (lying_png(20_000, 20_000, 1, data=zlib.compress(bytes(2501 * 20_000))), "the limit is 100000000"),
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
    (b"\xff\xd8\xff\xc0\x00\x11\x08\x23\x28\x23\x28\x03" + bytes(90), "cannot hold 9000 x 9000"),
    (b"\xff\xd8\xff\xff\xff\xff\xe0\x00\x02\xff\xc0\x00\x11\x08\0\0\0\x05", "5 x 0 pixels"),
    (b"\xff\xd8\xff\xe0\x00\x02\x00\xc0\x00\x11\x08\0\x01\0\x05", "its header makes no sense"),
    (b"\xff\xd8\xff\xe0\x00\x02", "it is cut off"),
    (b"P5 2 2 65536\n" + bytes(8), "its white is 65536"),
    (b"P5 2 2\n" + bytes(8), "its white is 0"),
    (b"P6 9000 9000 255\n" + bytes(99), "cannot hold"),
    (b"P4 9000 9000\n" + bytes(99), "cannot hold"),
):
    refused(46, MapFileError, rf"/m\.png: .*{_words}", loaded(_image))
refused(
    46, MapFileError, r"m\.png: larger than \d+ bytes: not the image of a map", loaded(b"P5", size=1 << 40)
)
for _name in ("/dev/zero", "pipe"):
    refused(46, MapFileError, "not a regular file", loaded(b"", _name))


def seen(image: Message, config: ReadConfig | None = None, **camera: Any) -> Act:
    info = ros().camera(INFO, T0, 6, 4, 100.0, **camera)
    return lambda folder: read(write_mcap(folder / "a.mcap", [info, image]), config)


for _image, _words in (
    (lying_png(60_000, 60_000, 16), "cannot hold 60000 x 60000"),
    (lying_png(300, 300, 16, data=zlib.compress(bytes(601 * 300))), "max_points"),
    (lying_png(6, 4, 8), "not one channel of 16 bits"),
    (lying_png(6, 4, 16, data=zlib.compress(bytes(20))), "damaged"),
):
    _depths = ros().compressed(DEPTH, T0, bytes(12) + _image, "16UC1; compressedDepth png")
    refused(37, PointCloudError, _words, seen(_depths, ReadConfig(max_points=50_000)))
_wall = ros().image(DEPTH, T0, np.full((4, 6), 2000, np.uint16), "16UC1")
refused(
    37, UnsupportedSchema, "the distortion model 'double_sphere' is not read",
    seen(_wall, model="double_sphere", d=np.array([0.1])),
)  # fmt: skip


# --- messages, and their definitions ------------------------------------------------------------------


def topic(kind: str = CLOUD, encoding: str = "cdr", schema: str = "ros2msg", text: bytes = b"") -> TopicInfo:
    return TopicInfo(
        topic="/points", type=kind, encoding=encoding, schema_encoding=schema, schema=text, message_count=1
    )


for _topic, _words in (
    (topic("std_msgs/String"), "messages of type std_msgs/String are not read"),
    (topic(""), "messages of type unknown are not read"),
    (topic(encoding="cbor"), "message encoding 'cbor' is not read"),
    (topic(schema="omgidl", text=b"x"), "schema encoding 'omgidl' is not read"),
    (topic(text=b"(("), ".*(differently from ROS|is not readable)"),
):
    refused(18, UnsupportedSchema, f"^/points: {_words}", lambda _, topic=_topic: decoder_for(topic))
for _topic, _words in (
    (topic("foxglove.Log", "json"), "json messages of type foxglove.Log are not read"),
    (topic("foxglove.PointCloud", "protobuf", "flatbuffer"), "'flatbuffer' is not read"),
):
    refused(18, UnsupportedSchema, _words, lambda _, topic=_topic: foxglove.decoder_for(topic))
for _kind, _data in (
    (CLOUD, b"\0\1"),
    ("tf2_msgs/TFMessage", b"\0\1\0\0" + struct.pack("<I", 100_001)),
    (CLOUD, b"\0\1\0\0\1\0\0\0"),
):
    refused(
        20, PointCloudError, f"no whole {_kind}",
        lambda _, kind=_kind, data=_data: decoder_for(topic(kind))(data),
    )  # fmt: skip
XYZ = [(name, 4 * i, 7, 1) for i, name in enumerate("xyz")]


def points(*fields: tuple[str, int, int, int], data: bytes = bytes(32), step: int = 16) -> Act:
    """A cloud of two points of these fields."""
    cloud = PointCloud2(Header(T0, ""), 1, 2, fields, False, step, 2 * step, data)
    return lambda _: decode_cloud(cloud)


for _fields, _words in (
    ([*XYZ[:2], ("z", 13, 7, 1)], "field z: ends at byte 17 of a 16-byte point"),
    ([*XYZ, ("y", 8, 7, 1)], "field y: defined twice"),
    (XYZ[:2], "field z: missing"),
    ([("x", 0, 7, 3), *XYZ[1:]], "field x: 3 values per point"),
):
    refused(25, PointCloudError, _words, points(*_fields))
refused(26, PointCloudError, "field x: unknown datatype 77", points(("x", 0, 77, 1), *XYZ[1:]))
refused(24, PointCloudError, "20 bytes of data where 32 are declared", points(*XYZ, data=bytes(20)))
refused(
    32, PointCloudError, r"field t: times that span 1\d+\.0 fit no unit .*point_time",
    points(*XYZ, ("t", 12, 8, 1), data=struct.pack("<3fd3fd", 1, 2, 3, 0, 1, 2, 3, 1e14), step=20),
)  # fmt: skip
refused(
    37, PointCloudError, "a CameraInfo with 1001 numbers of distortion",
    lambda _: decoder_for(topic("sensor_msgs/CameraInfo"))(
        ros().camera(INFO, T0, 6, 4, 100.0, d=np.zeros(1001)).data
    ),
)  # fmt: skip
CALIBRATION = {
    "timestamp": {"sec": 1, "nsec": 0}, "frame_id": "c", "width": 4, "height": 3, "D": [], "K": [1.0] * 8,
    "R": [], "P": [], "distortion_model": "",
}  # fmt: skip


def in_json(kind: str, data: bytes) -> Act:
    return lambda _: foxglove.decoder_for(topic(kind, "json"))(data)


refused(
    37, PointCloudError, "a camera matrix K of 8 numbers",
    in_json("foxglove.CameraCalibration", json.dumps(CALIBRATION).encode()),
)  # fmt: skip
for _data in (b"[" + b"0," * 2_000_001 + b"0]", b'"' + bytes(1 << 26) + b'"'):
    refused(
        12,
        LimitExceeded,
        r"a JSON message of \d+ bytes and \d+ values",
        in_json("foxglove.PointCloud", _data),
    )

HEAD = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 30000\nHEIGHT 1\nDATA "
refused(
    24, PointCloudError, "not a line of numbers",
    lambda _: clouds.parser("pcd")(HEAD + b"ascii\n" + b"1 2 3\n" * 29_999 + b"1 2", Header(1, "lidar")),
)  # fmt: skip
_packed = HEAD + b"binary_compressed\n" + struct.pack("<II", 9, 360_000) + bytes(9)
refused(10, UnsupportedSchema, "is not read", lambda _: clouds.parser("pcd")(_packed, Header(1, "lidar")))


def nested(levels: int, width: int, leaf: str = "int32 a\n") -> str:
    """A definition of width ** levels fields."""
    parts = ["".join(f"p/L0 f{i}\n" for i in range(width))]
    parts += [
        f"MSG: p/L{n}\n" + "".join(f"p/L{n + 1} f{i}\n" for i in range(width)) for n in range(levels - 1)
    ]
    return ("=" * 80 + "\n").join([*parts, f"MSG: p/L{levels - 1}\n{leaf}"])


def defined(text: str) -> Act:
    record = ("/points", "sensor_msgs/msg/PointCloud2", "ros2msg", text.encode())
    data = ros().cloud("/points", T0, [[1, 2, 3]]).data
    return lambda folder: read(
        raw_log(folder / "a.mcap", [(*record, data)]), ReadConfig(assume_identity=True)
    )


for _text in (
    nested(14, 12),
    nested(14, 12, leaf=""),
    nested(2, 5000),
    "sensor_msgs/PointCloud2 again\n",
    "int32 a\n" * 200_000,
):
    refused(12, UnsupportedSchema, "/points", defined(_text))


# --- lasers -------------------------------------------------------------------------------------------


def laser(start: float = -0.2, step: float = 0.1, count: int = 5) -> Act:
    scan = LaserScan(
        Header(T0, "laser"), angle_min=start, angle_max=start + (count - 1) * step, angle_increment=step,
        time_increment=0.0, scan_time=0.1, range_min=0.1, range_max=30.0, ranges=np.ones(count, np.float32),
    )  # fmt: skip
    return lambda _: decode_laser(scan, max_points=100)


refused(25, PointCloudError, "angles that are not finite", laser(start=math.nan))
refused(25, PointCloudError, "field angle_increment: 0", laser(step=0.0))
refused(12, LimitExceeded, "a scan of 200 beams; the limit is 100", laser(count=200))


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_a_laser_of_too_many_beams(tmp_path: Path, encoding: str) -> None:
    fields = foxglove_messages.stamped(
        T0, frame_id="laser", pose=foxglove_messages.IDENTITY, start_angle=0.0, end_angle=6.0,
        ranges=[0.0] * 1001, intensities=[],
    )  # fmt: skip
    path = foxglove_messages.write(tmp_path / "a.mcap", [("/scan", "LaserScan", T0, fields)], encoding)
    with pytest.raises(PointCloudError, match="a scan of 1001 beams; the limit is 1000"):
        read(path, ReadConfig(assume_identity=True, max_points=1000))


# --- running them -------------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def libraries(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is loaded at the first reading counts for no row."""
    read(write_mcap(tmp_path_factory.mktemp("first") / "a.mcap", drive()))
    yield


@pytest.mark.parametrize(("error", "words", "act", "most_mib"), ROWS)
def test_refused_by_name_and_before_much_is_allocated(
    tmp_path: Path, error: type[Pc2GridError], words: str, act: Act, most_mib: int
) -> None:
    with peak_memory() as peak, pytest.raises(error, match=words):
        act(tmp_path)
    assert peak.grown_bytes() < most_mib << 20


@pytest.mark.parametrize("target", ["/dev/zero", "pipe"])
def test_clouds_without_end(tmp_path: Path, target: str) -> None:
    if target == "pipe":
        target = str(pipe(tmp_path))
    folder = tmp_path / "clouds"
    folder.mkdir()
    (folder / "2.bin").symlink_to(target)
    (folder / "poses.tum").symlink_to(target)
    with pytest.raises(LogNotFound, match="a folder without a recording"):
        read(folder)
    (folder / "1.bin").write_bytes(np.ones((5, 4), "<f4").tobytes())
    assert len(read(folder)[0]) == 1
