"""ROS messages, decoded from CDR (ROS 2) or ROS 1 serialisation.

Clouds, scans and images have own decoders, field by field in the order of `ros_definitions`, because those of
kiss-icp and of rosbags were measured to be 9 and more times slower. `decoder_for` first checks that the log's
own definition of the type has the layout decoded here. Large arrays stay views of the log's bytes. All other
messages are decoded by rosbags, with the log's own definition.
"""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError
from rosbags.typesys.base import TypesysError

from pc2grid.errors import PointCloudError, UnsupportedSchema
from pc2grid.io.message_source import TopicInfo
from pc2grid.io.messages import ros_definitions
from pc2grid.io.messages.types import (
    Bytes,
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    Imu,
    LaserScan,
    Odometry,
    PointCloud2,
    PoseStamped,
    Seven,
    Transform,
    valid_pose,
)

# Counts that no real message reaches: a damaged one is refused before memory is allocated for it.
_MOST_CLOUD_FIELDS = 1000
_MOST_DISTORTION = 100


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


_PARSERS: dict[str, Callable[[Reader], Any]] = {
    "sensor_msgs/PointCloud2": _point_cloud,
    "sensor_msgs/LaserScan": _laser_scan,
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
}


# --- messages that rosbags decodes, with the names of their fields in small letters --------------------


def _camera_info(m: Any) -> CameraInfo:
    if len(m.d) > _MOST_DISTORTION:
        raise PointCloudError(f"a CameraInfo with {len(m.d)} numbers of distortion")
    d, k, p = (tuple(values.tolist()) for values in (m.d, m.k, m.p))
    return CameraInfo(_header(m.header), m.height, m.width, m.distortion_model, d, k, p)


def _odometry(m: Any) -> Odometry:
    pose = m.pose.pose
    return Odometry(_header(m.header), m.child_frame_id.lstrip("/"), _seven(pose.position, pose.orientation))


def _imu(m: Any) -> Imu:
    """Raises PointCloudError for numbers that are not finite; a quaternion of zeros is none."""
    q, w, a = m.orientation, m.angular_velocity, m.linear_acceleration
    orientation = (q.x, q.y, q.z, q.w) if _measured(m.orientation_covariance) else None
    turn_rate = (w.x, w.y, w.z) if _measured(m.angular_velocity_covariance) else None
    acceleration = (a.x, a.y, a.z) if _measured(m.linear_acceleration_covariance) else None
    if not all(map(math.isfinite, (*(turn_rate or ()), *(acceleration or ())))):
        raise PointCloudError("the message is not finite")
    if orientation is not None and not valid_pose((0.0, 0.0, 0.0, *orientation)):
        orientation = None
    return Imu(_header(m.header), orientation, turn_rate, acceleration)


def _measured(covariance: Any) -> bool:
    """Whether an IMU measures what this is the covariance of, see sensor_msgs/Imu."""
    return bool(covariance[0] != -1.0)


def _pose_stamped(m: Any) -> PoseStamped:
    return PoseStamped(_header(m.header), _seven(m.pose.position, m.pose.orientation))


def _pose_with_covariance(m: Any) -> PoseStamped:
    pose = m.pose.pose
    return PoseStamped(
        _header(m.header), _seven(pose.position, pose.orientation), tuple(m.pose.covariance.tolist())
    )


def _transforms(m: Any) -> tuple[Transform, ...]:
    return tuple(
        Transform(
            _header(edge.header),
            edge.child_frame_id.lstrip("/"),
            _seven(edge.transform.translation, edge.transform.rotation),
        )
        for edge in m.transforms
    )


def _header(m: Any) -> Header:
    return Header(m.stamp.sec * 1_000_000_000 + m.stamp.nanosec, m.frame_id.lstrip("/"))


def _seven(p: Any, q: Any) -> Seven:
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


_CONVERTERS: dict[str, Callable[[Any], Any]] = {
    "sensor_msgs/CameraInfo": _camera_info,
    "nav_msgs/Odometry": _odometry,
    "sensor_msgs/Imu": _imu,
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
    if channel.type not in _PARSERS and channel.type not in _CONVERTERS:
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
    text = _checked_schema(channel, ros1)
    if channel.type in _PARSERS:
        parse = _PARSERS[channel.type]
        return lambda data: parse(Reader(data, ros1=ros1))
    return _by_rosbags(channel, ros1, text)


def _by_rosbags(channel: TopicInfo, ros1: bool, text: str) -> Callable[[Bytes], Any]:
    """The decoder of a message by its definition in the log, or that of ROS if the text is empty."""
    known = channel.type if text else _name_of(channel)
    store = ros_definitions.store_of(known, ros1, channel.schema_encoding, text)
    name, convert = known.replace("/", "/msg/"), _CONVERTERS[channel.type]
    parse = store.deserialize_ros1 if ros1 else store.deserialize_cdr

    def decode(data: Bytes) -> Any:
        try:
            return convert(parse(memoryview(data), name))
        except (SerdeError, TypesysError) as error:
            reason = " ".join(str(error).split())[:120]
            raise PointCloudError(f"the message is not a {channel.type}: {reason}") from error

    return decode


def _name_of(channel: TopicInfo) -> str:
    """The type as ROS calls it today."""
    return "tf2_msgs/TFMessage" if channel.type == "tf/tfMessage" else channel.type


def _checked_schema(channel: TopicInfo, ros1: bool) -> str:
    """The log's definition of the type; empty if some writer left it out.

    Raises UnsupportedSchema if it cannot be read, or has not the fields of ROS: exactly these for a type with
    a parser, and at least these for the others.
    """
    text = channel.schema.decode("utf-8", "replace").replace("\r\n", "\n")
    if not text.strip():
        return ""
    known = ("ros1msg",) if ros1 else ("ros2msg", "ros2idl")
    if channel.schema_encoding not in known:
        raise UnsupportedSchema(
            f"{channel.topic}: schema encoding {channel.schema_encoding!r:.40} is not read",
            hint=f"supported: {', '.join(known)}",
        )
    expected = ros_definitions.expected_layout(_name_of(channel), ros1)
    try:
        found = ros_definitions.layout_of(channel.type, channel.schema_encoding, text)
    except ValueError as error:
        raise UnsupportedSchema(
            f"{channel.topic}: the schema of {channel.type} is not readable: {error}"
        ) from error
    same = found == expected if channel.type in _PARSERS else set(expected) <= set(found)
    if not same:
        differences = [f"{t} {n}" for n, t in dict.fromkeys((*found, *expected))]
        odd = [d for d in differences if (d in _named(found)) != (d in _named(expected))]
        raise UnsupportedSchema(
            f"{channel.topic}: the log defines {channel.type} differently from ROS: "
            f"{', '.join(odd[:4]) or 'the order of its fields'}"
        )
    return text


def _named(layout: ros_definitions.Layout) -> set[str]:
    return {f"{kind} {name}" for name, kind in layout}
