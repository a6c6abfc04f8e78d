"""Rare cases in recordings: every number type, limits met exactly, and the words of refusals."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import (
    DatabaseError,
    LogCorrupt,
    PointCloudError,
    UnsupportedSchema,
)
from pc2grid.io import open_log
from pc2grid.io.messages import foxglove
from pc2grid.io.messages import ros as ros_messages
from pc2grid.io.messages.clouds import parser
from pc2grid.io.messages.types import Header, PointCloud2
from pc2grid.io.source import TopicInfo, guarded, guarded_stream
from pc2grid.settings import ReadConfig
from tests.helpers.cloud_folders import folder_of
from tests.helpers.recordings import T0

HEADER = Header(T0, "lidar")
NUMPY = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8"}


def values_of(cloud: PointCloud2) -> dict[str, np.ndarray]:
    """Each field (points, count), read by nothing but its description."""
    found = {}
    order = ">" if cloud.is_bigendian else "<"
    raw = np.frombuffer(bytes(cloud.data), np.uint8)[: cloud.width * cloud.point_step]
    table = raw.reshape(cloud.width, cloud.point_step)
    for name, offset, datatype, count in cloud.fields:
        kind = np.dtype(order + NUMPY[datatype])
        part = np.ascontiguousarray(table[:, offset : offset + count * kind.itemsize])
        found[name] = part.view(kind)
    return found


# --- every type of number -----------------------------------------------------------------------------


def columns(types: list[str], counts: list[int]) -> list[np.ndarray]:
    """Four points whose numbers fill their type."""
    rng = np.random.default_rng(3)
    made = []
    for kind, count in zip(types, counts, strict=True):
        if kind[0] == "f":
            made.append(rng.normal(size=(4, count)).astype(kind))
        else:
            low, high = np.iinfo(kind).min, np.iinfo(kind).max
            made.append(rng.integers(low, high, (4, count), dtype=kind, endpoint=True))
    return made


PCD_TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8"]
PCD_COUNTS = [1, 3, 2, 1, 4, 1, 2, 1, 1, 2]


def pcd(kind: str, made: list[np.ndarray]) -> bytes:
    names = [f"n{i}" for i in range(len(made))]
    lines = [
        "# .PCD v.7",
        "",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(m.dtype.itemsize) for m in made),
        "TYPE " + " ".join(m.dtype.kind.upper() for m in made),
        "COUNT " + " ".join(str(m.shape[1]) for m in made),
        "WIDTH 2",
        "HEIGHT 2",
        f"DATA {kind}",
    ]
    head = ("\n".join(lines) + "\n").encode()
    if kind == "ascii":
        rows = (" ".join(repr(v.item()) for m in made for v in m[i]) for i in range(4))
        return head + "\n".join(rows).encode() + b"\n"
    return head + b"".join(m[i].tobytes() for i in range(4) for m in made)


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_pcd_of_every_type_and_count(kind: str) -> None:
    made = columns(PCD_TYPES, PCD_COUNTS)
    found = values_of(parser("pcd")(pcd(kind, made), HEADER))
    assert list(found) == [f"n{i}" for i in range(len(made))]
    for values, wanted in zip(found.values(), made, strict=True):
        assert values.shape == wanted.shape
        if kind == "ascii":  # all numbers of a text are float64
            np.testing.assert_array_equal(values, wanted.astype("f8"))
        else:
            assert values.dtype == wanted.dtype
            np.testing.assert_array_equal(values, wanted)


PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4",
    "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_ply_of_every_type_behind_another_element(kind: str) -> None:
    made = columns(list(PLY_TYPES.values()), [1] * len(PLY_TYPES))
    order = ">" if "big" in kind else "<"
    head = ["ply", f"format {kind} 1.0", "element camera 3", "property float a", "property uchar b"]
    head += ["element vertex 4", *(f"property {name} {name}_" for name in PLY_TYPES), "end_header"]
    if kind == "ascii":
        rows = ["0.5 7"] * 3 + [" ".join(repr(m[i, 0].item()) for m in made) for i in range(4)]
        body = "\n".join(rows).encode()
    else:
        body = struct.pack(order + "fB", 0.5, 7) * 3
        body += b"".join(m[i].astype(m.dtype.newbyteorder(order)).tobytes() for i in range(4) for m in made)
    found = values_of(parser("ply")(("\n".join(head) + "\n").encode() + body, HEADER))
    assert list(found) == [f"{name}_" for name in PLY_TYPES]
    for values, wanted in zip(found.values(), made, strict=True):
        np.testing.assert_array_equal(values.astype("f8"), wanted.astype("f8"))


# --- refused with words -------------------------------------------------------------------------------


def topic(kind: str = "sensor_msgs/PointCloud2", encoding: str = "cdr", **more: Any) -> TopicInfo:
    entries = {"schema_encoding": "ros2msg", "schema": b"", "message_count": 1, **more}
    return TopicInfo(topic="/points", type=kind, encoding=encoding, **entries)


@pytest.mark.parametrize(
    ("channel", "words"),
    [
        (topic("std_msgs/String"), "messages of type std_msgs/String are not read"),
        (topic(""), "messages of type unknown are not read"),
        (topic(encoding="cbor"), "message encoding 'cbor' is not read"),
        (topic(schema_encoding="omgidl", schema=b"x"), "schema encoding 'omgidl' is not read"),
        (topic(schema=b"(("), "differently from ROS|is not readable"),
    ],
)
def test_ros_topics_that_are_not_read(channel: TopicInfo, words: str) -> None:
    with pytest.raises(UnsupportedSchema, match=words) as caught:
        ros_messages.decoder_for(channel)
    assert caught.value.message.startswith("/points: ")


@pytest.mark.parametrize(
    ("channel", "words"),
    [
        (topic("foxglove.Log", "json"), "json messages of type foxglove.Log are not read"),
        (topic("foxglove.PointCloud", "protobuf", schema_encoding="flatbuffer"), "'flatbuffer' is not read"),
    ],
)
def test_foxglove_topics_that_are_not_read(channel: TopicInfo, words: str) -> None:
    with pytest.raises(UnsupportedSchema, match=words):
        foxglove.decoder_for(channel)


@pytest.mark.parametrize(
    ("kind", "data", "words"),
    [
        ("sensor_msgs/PointCloud2", b"\0\1", "no whole sensor_msgs/PointCloud2"),
        ("tf2_msgs/TFMessage", b"\0\1\0\0" + struct.pack("<I", 100_001), "no whole tf2_msgs/TFMessage"),
        ("sensor_msgs/PointCloud2", b"\0\1\0\0\1\0\0\0", "no whole sensor_msgs/PointCloud2"),
    ],
)
def test_messages_that_are_too_short_or_too_large(kind: str, data: bytes, words: str) -> None:
    with pytest.raises(PointCloudError, match=words):
        ros_messages.decoder_for(topic(kind))(data)


def test_a_camera_matrix_of_other_sizes() -> None:
    decode = foxglove.decoder_for(topic("foxglove.CameraCalibration", "json"))
    message = {
        "timestamp": {"sec": 1, "nsec": 0}, "frame_id": "c", "width": 4, "height": 3, "D": [], "K": [1.0] * 8,
        "R": [], "P": [], "distortion_model": "",
    }  # fmt: skip
    with pytest.raises(PointCloudError, match="a camera matrix K of 8 numbers"):
        decode(json.dumps(message).encode())


def test_a_cloud_that_may_not_be_read_or_went_away(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "bin")
    with open_log(folder) as log:
        (folder / "scan_3.bin").unlink()
        (folder / "scan_3.bin").mkdir()
        with pytest.raises(LogCorrupt, match=r"scan_3\.bin: cannot be read: Is a directory"):
            list(log.scans())
    (folder / "scan_3.bin").rmdir()
    with pytest.raises(LogCorrupt, match=r"cannot be read: No such file"), open_log(folder) as log:
        (folder / "scan_5.bin").unlink()
        list(log.scans())


def test_a_part_of_a_folder_of_clouds(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "bin")
    with open_log(folder) as log:
        whole = [scan.stamp_ns for scan in log.scans()]
        part = [scan.stamp_ns for scan in log.scans(start_s=0.25, duration_s=0.5)]
    begin = whole[0] + 250_000_000
    assert part == [t for t in whole if begin <= t < begin + 500_000_000]


def test_what_others_raise_becomes_ours_but_for_memory() -> None:
    path = Path("log.mcap")

    def raising(error: BaseException) -> Any:
        def action() -> Any:
            raise error

        return action

    def stream(error: BaseException) -> Any:
        yield 1
        raise error

    for error, words in (
        (PermissionError(13, "Permission denied"), "log.mcap: cannot be read: Permission denied"),
        (KeyError("x\n\n y"), "log.mcap: damaged .KeyError: 'x"),
        (PointCloudError("odd"), "^log.mcap: odd$"),
        (PointCloudError("log.mcap: odd"), "^log.mcap: odd$"),
    ):
        with pytest.raises((LogCorrupt, PointCloudError), match=words):
            guarded(path, raising(error))
        with pytest.raises((LogCorrupt, PointCloudError), match=words):
            list(guarded_stream(path, stream(error)))
    strange = DatabaseError("busy")
    with pytest.raises(DatabaseError) as caught:
        guarded(path, raising(strange))
    assert caught.value is strange
    with pytest.raises(MemoryError):
        guarded(path, raising(MemoryError()))
    with pytest.raises(MemoryError):
        list(guarded_stream(path, stream(MemoryError())))


def test_an_origin_that_is_nowhere() -> None:
    from pc2grid.io.sensors.decode import ScanDecoder

    cloud = parser("bin")(struct.pack("<8f", 1, 2, 3, 0, 2, 3, 4, 0), HEADER)
    decoder = ScanDecoder("/points", "lidar", ReadConfig())
    moved = dataclasses.replace(cloud, origin=(1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0))
    scan = decoder.scan(moved, T0, np.eye(4), None)
    np.testing.assert_allclose(scan.points_m, [[2, 2, 3.5], [3, 3, 4.5]])
    nowhere = dataclasses.replace(cloud, origin=(float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    with pytest.raises(PointCloudError, match="the origin of the points is not finite"):
        decoder.scan(nowhere, T0, np.eye(4), None)
    with pytest.raises(PointCloudError, match="every point is farther than 1 m"):
        ScanDecoder("/points", "lidar", ReadConfig(max_range_m=1.0)).scan(cloud, T0, np.eye(4), None)
