"""Files of clouds and poses as messages, so that a folder of clouds is read like a recording.

A cloud is its stamp (int64, nanoseconds) and the bytes of its file; a pose is its stamp, the position (m) and
the quaternion (x, y, z, w), as float64. The bytes of a PCD, PLY or KITTI .bin file become a PointCloud2. Only
the header is interpreted here. The points stay the bytes of the file; `pc2grid.io.sensors.decode` finds
coordinates and times in them, as in every other cloud.

PCD: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, version 0.7.
PLY: https://paulbourke.net/dataformats/ply.

Not read by Open3D 0.19, whose readers lose data without an error:
- PLY: properties of the types char, short, ushort and uint (and their other names but `uint16`) are left out,
  among them the times of most lidars. A file that ends in the middle is accepted.
- PCD as text: numbers that are missing, or words in their place, are accepted.
- PCD: of a field of several values only the first is kept. A file of no points is refused. Damaged data of a
  compressed one overwrote other memory and ended the process, once in 3000 mutations: such a file is refused.
- Both are read from a path only, not from the bytes of a message.
A binary cloud of 75,000 points takes Open3D 11 ms (PCD) or 4 ms (PLY); here it is a view, 0.1 ms.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from pc2grid.errors import PointCloudError, UnsupportedSchema
from pc2grid.geometry import F64, quat_xyzw_from_pose
from pc2grid.io.messages.types import HEADER_BYTES, Bytes, Header, PointCloud2, StampedPose
from pc2grid.io.source import TopicInfo

SENSOR_FRAME, ODOMETRY_FRAME = "sensor", "odom"
_STAMP = struct.Struct("<q")
_POSE = struct.Struct("<q7d")


def pack_cloud(stamp_ns: int, content: bytes) -> bytes:
    """Pack the message of a cloud; `content` is its file."""
    return _STAMP.pack(stamp_ns) + content


def pack_pose(stamp_ns: int, T_odom_sensor: F64) -> bytes:
    """Pack the message of a pose, (4, 4)."""
    return _POSE.pack(stamp_ns, *T_odom_sensor[:3, 3], *quat_xyzw_from_pose(T_odom_sensor))


def decoder_for(channel: TopicInfo) -> Callable[[Any], Any]:
    """Return a function from such a message to a PointCloud2 or a StampedPose, by the channel's encoding."""
    if channel.encoding == "pose":
        return _decode_pose
    parse = parser(channel.encoding)

    def decode(data: Any) -> Any:
        view = memoryview(data)
        return parse(bytes(view[_STAMP.size :]), Header(_STAMP.unpack_from(view)[0], SENSOR_FRAME))

    return decode


def _decode_pose(data: Any) -> StampedPose:
    stamp_ns, x, y, z, qx, qy, qz, qw = _POSE.unpack(data)
    return StampedPose(Header(stamp_ns, ODOMETRY_FRAME), (x, y, z, qx, qy, qz, qw), SENSOR_FRAME)


Fields = tuple[tuple[str, int, int, int], ...]  # name, offset, datatype, count
Columns = list[tuple[str, int, int]]  # name, datatype, count

_SIZES = (0, 1, 1, 2, 2, 4, 4, 4, 8, 8, 8)  # bytes of the datatypes of sensor_msgs/PointField; 0: a list
_PCD_TYPES = {"I1": 1, "U1": 2, "I2": 3, "U2": 4, "I4": 5, "U4": 6, "F4": 7, "F8": 8, "I8": 9, "U8": 10}
_PLY_TYPES = {
    "char": 1, "int8": 1, "uchar": 2, "uint8": 2, "short": 3, "int16": 3, "ushort": 4, "uint16": 4,
    "int": 5, "int32": 5, "uint": 6, "uint32": 6, "float": 7, "float32": 7, "double": 8, "float64": 8,
}  # fmt: skip


def parser(suffix: str) -> Callable[[Bytes, Header], PointCloud2]:
    """Return the parser for files of a suffix: `pcd`, `ply` or `bin`.

    It raises PointCloudError for a file that contradicts itself, UnsupportedSchema for a kind that is not
    supported.
    """
    return {"pcd": _pcd, "ply": _ply, "bin": _kitti}[suffix]


def _kitti(data: Bytes, header: Header) -> PointCloud2:
    """Parse float32 x y z and reflectance, without any header."""
    if len(data) % 16:
        raise PointCloudError(f"{len(data)} bytes are not whole points of 16 bytes")
    fields = tuple((name, 4 * i, 7, 1) for i, name in enumerate("xyz"))
    return _cloud(header, fields, 16, len(data) // 16, data)


def _pcd(data: Bytes, header: Header) -> PointCloud2:
    match = re.search(rb"^DATA +(\w+)[ \r]*\n", data[:HEADER_BYTES], re.MULTILINE)
    if match is None:
        raise PointCloudError("a PCD without a DATA line")
    kind, body = match.group(1).decode(), memoryview(data)[match.end() :]
    columns, points = _pcd_columns(bytes(data[: match.start()]).decode("ascii", "replace"))
    if kind == "ascii":
        return _from_text(bytes(body), header, [(n, c) for n, _, c in columns], points)
    if kind != "binary":
        raise UnsupportedSchema(
            f"a PCD of data {kind!r:.40} is not read",
            hint="`pcl_convert_pcd_ascii_binary IN.pcd OUT.pcd 1` makes it binary",
        )
    fields, step = _packed(columns)
    return _cloud(header, fields, step, points, body)


def _pcd_columns(head: str) -> tuple[Columns, int]:
    """Parse the columns and the number of points in the header of a PCD. Raises PointCloudError."""
    lines = [line.split() for line in head.splitlines()]
    keys = {line[0]: line[1:] for line in lines if line and not line[0].startswith("#")}
    try:
        names = keys["FIELDS"]
        types = [kind_of + size for kind_of, size in zip(keys["TYPE"], keys["SIZE"], strict=True)]
        counts = [int(n) for n in keys.get("COUNT", ["1"] * len(names))]
        points = int(keys["WIDTH"][0]) * int(keys["HEIGHT"][0])
        columns = [(n, _PCD_TYPES[t], c) for n, t, c in zip(names, types, counts, strict=True)]
    except (KeyError, ValueError, IndexError) as error:
        raise PointCloudError(f"the header of a PCD makes no sense: {error}") from error
    if min([points, *counts]) < 0:
        raise PointCloudError("the header of a PCD makes no sense: a negative count")
    return columns, points


def _ply(data: Bytes, header: Header) -> PointCloud2:
    end = re.search(rb"^end_header[ \r]*\n", data[:HEADER_BYTES], re.MULTILINE)
    if bytes(data[:3]) != b"ply" or end is None:
        raise PointCloudError("a PLY without a header")
    kind, elements = _ply_elements(bytes(data[: end.start()]).decode("ascii", "replace"))
    body = memoryview(data)[end.end() :]
    for name, count, columns in elements:
        fields, step = _ply_packed(name, count, columns)
        if name == "vertex" and kind == "ascii":
            return _from_text(bytes(body), header, [(n, 1) for n, _, _ in columns], count)
        if name == "vertex" and kind in ("binary_little_endian", "binary_big_endian"):
            return _cloud(header, fields, step, count, body, big=kind == "binary_big_endian")
        skipped = step * count
        if kind == "ascii":
            skipped = sum(len(line) for line in bytes(body).splitlines(keepends=True)[:count])
        body = body[skipped:]
    raise PointCloudError(f"a PLY without points (format {kind!r:.30})")


def _ply_elements(head: str) -> tuple[str, list[tuple[str, int, Columns]]]:
    """Parse the format, and name, count and columns of the elements in the header of a PLY.

    Raises PointCloudError.
    """
    kind = ""
    elements: list[tuple[str, int, Columns]] = []
    try:
        for line in head.splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                kind = words[1]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                # A list has no fixed size, so the place of what follows it is not known.
                code = 0 if words[1] == "list" else _PLY_TYPES[words[1]]
                elements[-1][2].append((words[-1], code, 1))
    except (KeyError, ValueError, IndexError) as error:
        raise PointCloudError(f"the header of a PLY makes no sense: {error}") from error
    return kind, elements


def _ply_packed(name: str, count: int, columns: Columns) -> tuple[Fields, int]:
    """Return the fields of an element, and the bytes of one. Raises PointCloudError if it has no fixed
    size."""
    if count < 0 or any(code == 0 for _, code, _ in columns):
        raise PointCloudError(f"element {name} of a PLY stands before the points or in them, and has lists")
    return _packed(columns)


def _packed(columns: Columns) -> tuple[Fields, int]:
    """Return the fields of columns (name, datatype, count) without gaps, and the bytes of a point."""
    fields, at = [], 0
    for name, datatype, count in columns:
        fields.append((name, at, datatype, count))
        at += _SIZES[datatype] * count
    return tuple(fields), at


def _from_text(body: bytes, header: Header, columns: list[tuple[str, int]], points: int) -> PointCloud2:
    """Parse a cloud whose values stand as text, a point in each line. columns : (name, count of values)."""
    width = sum(count for _, count in columns)
    if width * points > len(body):
        raise PointCloudError(f"{len(body)} bytes of text where {width * points} numbers are declared")
    try:
        with warnings.catch_warnings():  # of empty lines, and of a text without numbers
            warnings.simplefilter("ignore")
            lines = io.BytesIO(body)
            values = np.loadtxt(lines, ndmin=2, max_rows=points) if points else np.empty((0, width))
    except ValueError as error:
        raise PointCloudError(f"not a line of numbers: {error}") from error
    if values.shape != (points, width):
        found = "{} x {}".format(*values.shape)
        raise PointCloudError(f"{found} numbers as text where {points} x {width} are declared")
    fields, step = _packed([(name, 8, count) for name, count in columns])
    return _cloud(header, fields, step, points, values.astype("<f8").tobytes())


def _cloud(
    header: Header, fields: Fields, step: int, points: int, data: bytes | memoryview, *, big: bool = False
) -> PointCloud2:
    return PointCloud2(header, 1, points, fields, big, step, step * points, data)
