"""The messages that a folder of clouds is read as, so that it can pass for a recording.

A cloud is its stamp (int64, nanoseconds) and the bytes of its file; a pose is its stamp, the position (m) and
the quaternion (x, y, z, w), as float64.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from pc2grid.arrays import F64
from pc2grid.geometry import quat_xyzw_from_pose
from pc2grid.io.message_source import TopicInfo
from pc2grid.io.messages import cloud_files
from pc2grid.io.messages.types import Header, Odometry

SENSOR_FRAME, ODOMETRY_FRAME = "sensor", "odom"
_STAMP = struct.Struct("<q")
_POSE = struct.Struct("<q7d")


def pack_cloud(stamp_ns: int, content: bytes) -> bytes:
    """The message of a cloud; `content` is its file."""
    return _STAMP.pack(stamp_ns) + content


def pack_pose(stamp_ns: int, T_odom_sensor: F64) -> bytes:
    """The message of a pose, (4, 4)."""
    return _POSE.pack(stamp_ns, *T_odom_sensor[:3, 3], *quat_xyzw_from_pose(T_odom_sensor))


def decoder_for(channel: TopicInfo) -> Callable[[Any], Any]:
    """A function from such a message to a PointCloud2 or an Odometry, by the channel's encoding."""
    if channel.encoding == "pose":
        return _decode_pose
    parse = cloud_files.parser(channel.encoding)

    def decode(data: Any) -> Any:
        view = memoryview(data)
        return parse(bytes(view[_STAMP.size :]), Header(_STAMP.unpack_from(view)[0], SENSOR_FRAME))

    return decode


def _decode_pose(data: Any) -> Odometry:
    stamp_ns, x, y, z, qx, qy, qz, qw = _POSE.unpack(data)
    return Odometry(Header(stamp_ns, ODOMETRY_FRAME), SENSOR_FRAME, (x, y, z, qx, qy, qz, qw))
