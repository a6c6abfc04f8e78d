"""ROS messages, decoded from CDR (ROS 2) or ROS 1 serialisation.

Own decoders, field by field in the order of `ros_definitions`, because those of kiss-icp and of rosbags were
measured to be 9 and more times slower on clouds and images. `decoder_for` first checks that the log's own
definition of the type has the layout decoded here. Large arrays stay views of the log's bytes.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import PointCloudError, UnsupportedSchema
from pc2grid.io.message_source import TopicInfo
from pc2grid.io.messages import ros_definitions
from pc2grid.io.messages.types import (
    Bytes,
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    LaserScan,
    Odometry,
    PointCloud2,
    PoseStamped,
    Seven,
    Transform,
)

# Counts that no real message reaches: a damaged one is refused before memory is allocated for it.
_MOST_CLOUD_FIELDS = 1000
_MOST_DISTORTION = 100
_MOST_TRANSFORMS = 100_000


class Reader:
    """Position in a serialised message. Reading past its end raises PointCloudError."""

    def __init__(self, data: Bytes, *, ros1: bool = False) -> None:
        self.data = memoryview(data)
        self.size = len(self.data)
        self.ros1 = ros1
        self.order = "<"
        self.at = 0
        if not ros1:
            if self.size < 4:
                raise PointCloudError("the message is shorter than its encapsulation header")
            kind = self.data[1]
            if self.data[0] != 0 or kind not in (0, 1):
                raise UnsupportedSchema(f"CDR encapsulation {bytes(self.data[:2]).hex()} is not read")
            self.order = "<" if kind == 1 else ">"
            self.at = 4

    def take(self, codes: str) -> tuple[Any, ...]:
        """Values of the same size, one for each struct character of `codes`."""
        layout, item = _struct(self.order, codes)
        start = self.at if self.ros1 else self._aligned(item)
        stop = start + layout.size
        if stop > self.size:
            raise PointCloudError("the message is shorter than its schema")
        self.at = stop
        return layout.unpack_from(self.data, start)

    def number(self, code: str) -> Any:
        """One value, by its struct character."""
        return self.take(code)[0]

    def blob(self, item: int = 1, count: int | None = None) -> memoryview:
        """The bytes of `count` items of `item` bytes each; None: the count is read first."""
        if count is None:
            (count,) = self.take("I")
        assert count is not None
        start = self.at if self.ros1 or not count else self._aligned(item)
        stop = start + item * count
        if stop > self.size:
            raise PointCloudError("the message is shorter than its schema")
        self.at = stop
        return self.data[start:stop]

    def array(self, code: str, count: int | None = None) -> NDArray[Any]:
        """Numbers as a numpy array in the byte order of the message."""
        dtype = np.dtype(self.order + code)
        return np.frombuffer(self.blob(dtype.itemsize, count), dtype=dtype)

    def text(self) -> str:
        """A string; in ROS 2 it ends with a zero byte, in ROS 1 it does not."""
        raw = bytes(self.blob())
        try:
            return (raw if self.ros1 else raw.rstrip(b"\0")).decode("utf-8")
        except UnicodeDecodeError:
            raise PointCloudError("a name in the message is not text") from None

    def header(self) -> Header:
        """std_msgs/Header; frame names lose the leading slash of old ROS 1."""
        seconds, rest = self.take("III")[1:] if self.ros1 else self.take("iI")
        return Header(seconds * 1_000_000_000 + rest, self.text().lstrip("/"))

    def _aligned(self, size: int) -> int:
        """The next position aligned to a size; CDR counts from the end of its 4-byte encapsulation header."""
        return self.at + (4 - self.at) % size


@functools.cache
def _struct(order: str, codes: str) -> tuple[struct.Struct, int]:
    """The struct of some values, and the bytes of one of them."""
    layout = struct.Struct(order + codes)
    return layout, layout.size // len(codes)


def _point_cloud(r: Reader) -> PointCloud2:
    header = r.header()
    height, width, count = r.take("III")
    if count > _MOST_CLOUD_FIELDS:
        raise PointCloudError(f"a cloud with {count} fields")
    fields = tuple((r.text(), r.number("I"), r.number("B"), r.number("I")) for _ in range(count))
    big = bool(r.number("B"))
    point_step, row_step = r.take("II")
    return PointCloud2(header, height, width, fields, big, point_step, row_step, r.blob())


def _laser_scan(r: Reader) -> LaserScan:
    header = r.header()
    low, high, step, time_step, scan_time, near, far = r.take("fffffff")
    return LaserScan(header, low, high, step, time_step, scan_time, near, far, r.array("f4"))


def _image(r: Reader) -> Image:
    header = r.header()
    height, width = r.take("II")
    return Image(header, height, width, r.text(), bool(r.number("B")), r.number("I"), r.blob())


def _compressed_image(r: Reader) -> CompressedImage:
    return CompressedImage(r.header(), r.text(), r.blob())


def _camera_info(r: Reader) -> CameraInfo:
    header = r.header()
    height, width = r.take("II")
    model, d, k = r.text(), r.array("f8"), r.array("f8", 9)
    if len(d) > _MOST_DISTORTION:
        raise PointCloudError(f"a CameraInfo with {len(d)} numbers of distortion")
    r.array("f8", 9)
    p = r.array("f8", 12)
    return CameraInfo(header, height, width, model, tuple(d.tolist()), tuple(k.tolist()), tuple(p.tolist()))


def _odometry(r: Reader) -> Odometry:
    header, child = r.header(), r.text().lstrip("/")
    return Odometry(header, child, _seven(r.take("ddddddd")))


def _pose_stamped(r: Reader) -> PoseStamped:
    return PoseStamped(r.header(), _seven(r.take("ddddddd")))


def _pose_with_covariance(r: Reader) -> PoseStamped:
    header, pose = r.header(), _seven(r.take("ddddddd"))
    return PoseStamped(header, pose, tuple(r.array("f8", 36).tolist()))


def _transforms(r: Reader) -> tuple[Transform, ...]:
    count = int(r.number("I"))
    if count > _MOST_TRANSFORMS:
        raise PointCloudError(f"a tf message with {count} transforms")
    return tuple(Transform(r.header(), r.text().lstrip("/"), _seven(r.take("ddddddd"))) for _ in range(count))


def _seven(values: tuple[Any, ...]) -> Seven:
    x, y, z, qx, qy, qz, qw = values
    return (x, y, z, qx, qy, qz, qw)


_PARSERS: dict[str, Callable[[Reader], Any]] = {
    "sensor_msgs/PointCloud2": _point_cloud,
    "sensor_msgs/LaserScan": _laser_scan,
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/CameraInfo": _camera_info,
    "nav_msgs/Odometry": _odometry,
    "geometry_msgs/PoseStamped": _pose_stamped,
    "geometry_msgs/PoseWithCovarianceStamped": _pose_with_covariance,
    "tf2_msgs/TFMessage": _transforms,
    "tf/tfMessage": _transforms,
}


def decoder_for(channel: TopicInfo) -> Callable[[Bytes], Any]:
    """A function from the bytes of this topic's messages to one of the classes of `types`.

    Raises UnsupportedSchema for a type, an encoding or a definition of the type in the log that is not
    supported. The function raises PointCloudError for a message that is too short.
    """
    parse = _PARSERS.get(channel.type)
    if parse is None:
        raise UnsupportedSchema(
            f"{channel.topic}: messages of type {channel.type or 'unknown'} are not read",
            hint="supported: PointCloud2, LaserScan, depth Image or CompressedImage",
        )
    if channel.encoding not in ("cdr", "ros1"):
        raise UnsupportedSchema(
            f"{channel.topic}: message encoding {channel.encoding!r:.40} is not read",
            hint="supported: cdr (ROS 2), ros1, and protobuf or json of Foxglove's types",
        )
    ros1 = channel.encoding == "ros1"
    check_schema(channel, ros1)
    return lambda data: parse(Reader(data, ros1=ros1))


def check_schema(channel: TopicInfo, ros1: bool) -> None:
    """Raise UnsupportedSchema if the log defines the type differently from `ros_definitions`."""
    type_name = "tf2_msgs/TFMessage" if channel.type == "tf/tfMessage" else channel.type
    expected = ros_definitions.expected_layout(type_name, ros1)
    text = channel.schema.decode("utf-8", "replace").replace("\r\n", "\n")
    if not text.strip():
        return  # some writers omit the text; then only the name can be compared
    known = ("ros1msg",) if ros1 else ("ros2msg", "ros2idl")
    if channel.schema_encoding not in known:
        raise UnsupportedSchema(
            f"{channel.topic}: schema encoding {channel.schema_encoding!r:.40} is not read",
            hint=f"supported: {', '.join(known)}",
        )
    try:
        found = ros_definitions.layout_of(channel.type, channel.schema_encoding, text)
    except ValueError as error:
        raise UnsupportedSchema(
            f"{channel.topic}: the schema of {channel.type} is not readable: {error}"
        ) from error
    if found != expected:
        differences = [f"{t} {n}" for n, t in dict.fromkeys((*found, *expected))]
        odd = [d for d in differences if (d in _named(found)) != (d in _named(expected))]
        raise UnsupportedSchema(
            f"{channel.topic}: the log defines {channel.type} differently from ROS: "
            f"{', '.join(odd[:4]) or 'the order of its fields'}"
        )


def _named(layout: ros_definitions.Layout) -> set[str]:
    return {f"{kind} {name}" for name, kind in layout}
