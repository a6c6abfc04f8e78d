"""Foxglove's own messages (`foxglove.PointCloud` and others), in protobuf or JSON.

Both are decoded to the classes of `types`, as ROS messages are. Protobuf is parsed by the descriptor that the
log carries.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Schema

from pc2grid.errors import LimitExceeded, PointCloudError, UnsupportedSchema
from pc2grid.io.messages.types import (
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    LaserScan,
    PointCloud2,
    Seven,
    StampedPose,
    Transform,
)
from pc2grid.io.source import TopicInfo

# PackedElementField.NumericType to the codes of sensor_msgs/PointField.
_NUMERIC = {
    "UINT8": 2,
    "INT8": 1,
    "UINT16": 4,
    "INT16": 3,
    "UINT32": 6,
    "INT32": 5,
    "FLOAT32": 7,
    "FLOAT64": 8,
}
# A JSON message above these limits is refused before it is parsed.
_MOST_JSON_BYTES = 64 << 20
_MOST_JSON_VALUES = 2_000_000
_NUMERIC_NAMES = ("UNKNOWN", *_NUMERIC)


def decoder_for(channel: TopicInfo) -> Callable[[Any], Any]:
    """Return a function from the bytes of this topic's messages to one of the classes of `types`.

    Raises UnsupportedSchema for a type that is not supported or a descriptor that is damaged. The function
    raises PointCloudError for a message that is not of its type.
    """
    convert = _CONVERTERS.get(channel.type)
    if convert is None:
        raise UnsupportedSchema(
            f"{channel.topic}: {channel.encoding} messages of type {channel.type or 'unknown'} are not read",
            hint="supported: foxglove.PointCloud, LaserScan, RawImage or CompressedImage of depth",
        )
    parse = _parse_json if channel.encoding == "json" else _protobuf_parser(channel)

    def decode(data: Any) -> Any:
        try:
            return convert(parse(bytes(data)))
        except (AttributeError, TypeError, ValueError, IndexError, RecursionError, OverflowError) as error:
            reason = " ".join(str(error).split())[:120]
            raise PointCloudError(f"the message is not a {channel.type}: {reason}") from error

    return decode


def _parse_json(data: bytes) -> Any:
    # Each value between two commas can become a Python object of a hundred bytes.
    if len(data) > _MOST_JSON_BYTES or data.count(b",") > _MOST_JSON_VALUES:
        raise LimitExceeded(
            f"a JSON message of {len(data)} bytes and {data.count(b',')} values; "
            f"the limits are {_MOST_JSON_BYTES} and {_MOST_JSON_VALUES}"
        )
    return json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))


def _protobuf_parser(channel: TopicInfo) -> Callable[[bytes], Any]:
    from google.protobuf.message import DecodeError
    from mcap_protobuf.decoder import DecoderFactory

    schema = Schema(id=1, name=channel.type, encoding=channel.schema_encoding, data=channel.schema)
    try:
        parse = DecoderFactory().decoder_for("protobuf", schema)
    except (McapError, DecodeError, TypeError, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())[:120]
        raise UnsupportedSchema(
            f"{channel.topic}: the schema of {channel.type} is not readable: {reason}"
        ) from error
    if parse is None:
        raise UnsupportedSchema(
            f"{channel.topic}: schema encoding {channel.schema_encoding!r:.40} is not read",
            hint="supported: protobuf",
        )

    def checked(data: bytes) -> Any:
        try:
            return parse(data)
        except DecodeError as error:
            raise ValueError("it cannot be parsed") from error

    return checked


# --- parts --------------------------------------------------------------------------------------------


def _header(message: Any, frame_field: str = "frame_id") -> Header:
    time = message.timestamp
    # google.protobuf.Timestamp has seconds and nanos, the JSON schema sec and nsec.
    seconds = time.seconds if hasattr(time, "seconds") else time.sec
    rest = time.nanos if hasattr(time, "nanos") else time.nsec
    return Header(int(seconds) * 1_000_000_000 + int(rest), str(getattr(message, frame_field)).lstrip("/"))


def _bytes(value: Any) -> bytes:
    return value if isinstance(value, bytes) else base64.b64decode(value, validate=True)


def _size(value: Any) -> int:
    if int(value) < 0:
        raise PointCloudError(f"a size of {value}")
    return int(value)


def _float(value: Any) -> float:
    """Return a number as a float. JSON has no NaN; writers use null instead."""
    return math.nan if value is None else float(value)


def _floats(values: Sequence[Any]) -> tuple[float, ...]:
    return tuple(map(_float, values))


def _pose(pose: Any) -> Seven | None:
    """Convert a pose, None if it is not set; a quaternion of zeros, protobuf's default, is the identity."""
    if pose is None:
        return None
    return _seven(pose.position, pose.orientation)


def _seven(p: Any, q: Any) -> Seven:
    quaternion = (q.x, q.y, q.z, q.w)
    if not any(quaternion):
        quaternion = (0.0, 0.0, 0.0, 1.0)
    x, y, z, qx, qy, qz, qw = _floats((p.x, p.y, p.z, *quaternion))
    return (x, y, z, qx, qy, qz, qw)


# --- messages -----------------------------------------------------------------------------------------


def _point_cloud(m: Any) -> PointCloud2:
    stride, data = int(m.point_stride), _bytes(m.data)
    if stride <= 0:
        raise PointCloudError(f"a cloud of points of {stride} bytes")
    fields = tuple((str(f.name), _size(f.offset), _datatype(f.type), 1) for f in m.fields)
    width = len(data) // stride
    pose = _pose(getattr(m, "pose", None))
    return PointCloud2(_header(m), 1, width, fields, False, stride, stride * width, data, pose)


def _datatype(value: Any) -> int:
    if isinstance(value, str):
        return _NUMERIC.get(value, 0)
    # In protobuf an enumeration can hold any number, also a negative one.
    return _NUMERIC[_NUMERIC_NAMES[value]] if 0 < value < len(_NUMERIC_NAMES) else 0


def _laser_scan(m: Any) -> LaserScan:
    ranges = np.fromiter(map(_float, m.ranges), np.float64, len(m.ranges))
    start, end = float(m.start_angle), float(m.end_angle)
    step = (end - start) / (len(ranges) - 1) if len(ranges) > 1 else 0.0
    pose = _pose(getattr(m, "pose", None))
    return LaserScan(_header(m), start, end, step, 0.0, 0.0, 0.0, math.inf, ranges, pose)


def _raw_image(m: Any) -> Image:
    return Image(
        _header(m), _size(m.height), _size(m.width), str(m.encoding), False, _size(m.step), _bytes(m.data)
    )


def _compressed_image(m: Any) -> CompressedImage:
    return CompressedImage(_header(m), str(m.format), _bytes(m.data))


def _camera_info(m: Any) -> CameraInfo:
    d, k, p = _floats(m.D), _floats(m.K), _floats(m.P)
    if len(k) != 9:
        raise PointCloudError(f"a camera matrix K of {len(k)} numbers")
    size = _size(m.height), _size(m.width)
    return CameraInfo(_header(m), *size, str(m.distortion_model), d, k, p if len(p) == 12 else (0.0,) * 12)


def _stamped_pose(m: Any) -> StampedPose:
    """Convert odometry, or a pose that names no child frame, which is then taken to be the base."""
    child = getattr(m, "body_frame_id", getattr(m, "child_frame_id", ""))
    return StampedPose(_header(m), _seven(m.pose.position, m.pose.orientation), str(child).lstrip("/"))


def _transform(m: Any) -> tuple[Transform, ...]:
    child = str(m.child_frame_id).lstrip("/")
    pose = _seven(m.translation, m.rotation)
    # Foxglove has no tf_static: a transform is valid until a newer one is published.
    return (Transform(_header(m, "parent_frame_id"), child, pose, lasting=True),)


def _transforms(m: Any) -> tuple[Transform, ...]:
    return tuple(edge for each in m.transforms for edge in _transform(each))


_CONVERTERS: dict[str, Callable[[Any], Any]] = {
    "foxglove.PointCloud": _point_cloud,
    "foxglove.LaserScan": _laser_scan,
    "foxglove.RawImage": _raw_image,
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.CameraCalibration": _camera_info,
    "foxglove.PoseInFrame": _stamped_pose,
    "foxglove.Odometry": _stamped_pose,
    "foxglove.FrameTransform": _transform,
    "foxglove.FrameTransforms": _transforms,
}
