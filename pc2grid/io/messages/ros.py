"""ROS messages, decoded by `rosbags` from CDR (ROS 2) or ROS 1 serialisation.

If a recording has its own definition of a type, it is used: its fields may stand in another order, and there
may be more of them; else that of ROS is used. The texts are bounded before `rosbags` parses them, and only
names and types of fields are registered. Large arrays stay views of the log's bytes.
"""

from __future__ import annotations

import functools
import keyword
import math
import re
from collections.abc import Callable
from typing import Any, cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from pc2grid.errors import PointCloudError, UnsupportedSchema
from pc2grid.io.messages.types import (
    HEADER_BYTES,
    MOST_PARTS,
    Bytes,
    CameraInfo,
    CompressedImage,
    Header,
    Image,
    Imu,
    LaserScan,
    PointCloud2,
    Seven,
    StampedPose,
    Transform,
    valid_pose,
)
from pc2grid.io.source import TopicInfo


def decoder_for(channel: TopicInfo) -> Callable[[Bytes], Any]:
    """Return a function from the bytes of this topic's messages to one of the classes of `types`.

    Raises UnsupportedSchema for a type, an encoding or a definition of the type in the log that is not
    supported. The function raises PointCloudError for a message that is not of the type.
    """
    if channel.type not in _CONVERTERS:
        raise UnsupportedSchema(
            f"{channel.topic}: messages of type {channel.type or 'unknown'} are not read",
            hint="supported: PointCloud2, LaserScan, depth Image or CompressedImage",
        )
    if channel.encoding not in ("cdr", "ros1"):
        raise UnsupportedSchema(
            f"{channel.topic}: message encoding {channel.encoding!r:.40} is not read",
            hint="supported: cdr (ROS 2), ros1, and protobuf or json of Foxglove's types",
        )
    ros1, (convert, needed) = channel.encoding == "ros1", _CONVERTERS[channel.type]
    name, store = _store_of(channel, ros1, needed)
    parse = store.deserialize_ros1 if ros1 else store.deserialize_cdr

    def decode(data: Bytes) -> Any:
        try:
            return convert(parse(memoryview(data), name))
        except (SerdeError, TypesysError, AttributeError, TypeError) as error:
            raise PointCloudError(f"the message is no whole {channel.type}") from error

    return decode


def _store_of(channel: TopicInfo, ros1: bool, needed: str) -> tuple[str, Any]:
    """Return the name of the type, and a store with the log's definition of it, or that of ROS without one.

    Raises UnsupportedSchema if it cannot be read, or lacks a field that is needed.
    """
    text = channel.schema.decode("utf-8", "replace").replace("\r\n", "\n").strip()
    encoding = "ros1msg" if ros1 else "ros2msg"
    if text and channel.schema_encoding != encoding:
        raise UnsupportedSchema(
            f"{channel.topic}: schema encoding {channel.schema_encoding!r:.40} is not read",
            hint=f"supported: {encoding}",
        )
    # tf/tfMessage is called so today.
    short = channel.type if text else channel.type.replace("tf/tfMessage", "tf2_msgs/TFMessage")
    name = short.replace("/", "/msg/")
    try:
        store = store_of(short, encoding, text)
    except ValueError as error:
        raise UnsupportedSchema(
            f"{channel.topic}: the schema of {channel.type} is not readable: {error}"
        ) from error
    there = {field for field, _ in store.fielddefs[name][1]}
    missing = [field for field in needed.split() if field not in there]
    if missing:
        raise UnsupportedSchema(
            f"{channel.topic}: the log defines {channel.type} differently from ROS: "
            f"without {', '.join(missing)}"
        )
    return name, store


# --- converters of messages with the names of their fields in small letters ---------------------------

# --- messages with the names of their fields in small letters -----------------------------------------


def _point_cloud(m: Any) -> PointCloud2:
    if len(m.fields) > MOST_PARTS:
        raise PointCloudError(f"a cloud with {len(m.fields)} fields")
    fields = tuple((f.name, f.offset, f.datatype, f.count) for f in m.fields)
    big = bool(m.is_bigendian)
    return PointCloud2(
        _header(m.header), m.height, m.width, fields, big, m.point_step, m.row_step, memoryview(m.data)
    )


def _laser_scan(m: Any) -> LaserScan:
    angles = m.angle_min, m.angle_max, m.angle_increment
    times, limits = (m.time_increment, m.scan_time), (m.range_min, m.range_max)
    return LaserScan(_header(m.header), *angles, *times, *limits, m.ranges)


def _image(m: Any) -> Image:
    big, data = bool(m.is_bigendian), memoryview(m.data)
    return Image(_header(m.header), m.height, m.width, m.encoding, big, m.step, data)


def _compressed_image(m: Any) -> CompressedImage:
    return CompressedImage(_header(m.header), m.format, memoryview(m.data))


def _camera_info(m: Any) -> CameraInfo:
    if len(m.d) > MOST_PARTS:
        raise PointCloudError(f"a CameraInfo with {len(m.d)} numbers of distortion")
    d, k, p = (tuple(values.tolist()) for values in (m.d, m.k, m.p))
    return CameraInfo(_header(m.header), m.height, m.width, m.distortion_model, d, k, p)


def _odometry(m: Any) -> StampedPose:
    pose = m.pose.pose
    child = m.child_frame_id.lstrip("/")
    return StampedPose(_header(m.header), _seven(pose.position, pose.orientation), child)


def _imu(m: Any) -> Imu:
    """Convert an IMU message; a quaternion of zeros is none. Raises PointCloudError for non-finite
    numbers."""
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
    """Return True unless the covariance marks a quantity of an IMU as not measured, see sensor_msgs/Imu."""
    return bool(covariance[0] != -1.0)


def _pose_stamped(m: Any) -> StampedPose:
    return StampedPose(_header(m.header), _seven(m.pose.position, m.pose.orientation))


def _pose_with_covariance(m: Any) -> StampedPose:
    pose, covariance = m.pose.pose, tuple(m.pose.covariance.tolist())
    return StampedPose(_header(m.header), _seven(pose.position, pose.orientation), covariance=covariance)


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


_CONVERTERS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "sensor_msgs/PointCloud2": (
        _point_cloud,
        "header height width fields is_bigendian point_step row_step data",
    ),
    "sensor_msgs/LaserScan": (
        _laser_scan,
        "header angle_min angle_max angle_increment time_increment scan_time range_min range_max ranges",
    ),
    "sensor_msgs/Image": (_image, "header height width encoding is_bigendian step data"),
    "sensor_msgs/CompressedImage": (_compressed_image, "header format data"),
    "sensor_msgs/CameraInfo": (_camera_info, "header height width distortion_model d k p"),
    "nav_msgs/Odometry": (_odometry, "header child_frame_id pose"),
    "sensor_msgs/Imu": (_imu, "header orientation angular_velocity linear_acceleration"),
    "geometry_msgs/PoseStamped": (_pose_stamped, "header pose"),
    "geometry_msgs/PoseWithCovarianceStamped": (_pose_with_covariance, "header pose"),
    "tf2_msgs/TFMessage": (_transforms, "transforms"),
    "tf/tfMessage": (_transforms, "transforms"),
}
"""Of each type what makes one of the classes of `types` of it, and the fields that this needs."""


# --- definitions of types -----------------------------------------------------------------------------

_TIME = "builtin_interfaces/msg/Time"
_TF = (
    "tf2_msgs/msg/TFMessage",
    "geometry_msgs/TransformStamped[] transforms",
)  # rosbags knows it of ROS 2 only


_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)


def short_name(type_name: str) -> str:
    """Shorten `sensor_msgs/msg/PointCloud2` to `sensor_msgs/PointCloud2`."""
    return type_name.replace("/msg/", "/").replace("::msg::", "/").replace("::", "/")


@functools.lru_cache(maxsize=32)  # a log's topics share types, and each is looked at several times
def store_of(type_name: str, encoding: str, text: str) -> Typestore:
    """Return a store with a type and all types that it consists of; the names of fields in small letters.

    encoding : of the schema in the log, `ros2msg` or `ros1msg`. text : the schema; empty: the definition of
    ROS. Raises ValueError if the text cannot be understood.
    """
    store, name = Typestore(), short_name(type_name)
    types = _parsed(name, encoding, text) if text else _of_ros(encoding)
    store.register(_needed(name.replace("/", "/msg/"), types))
    return store


def _of_ros(encoding: str) -> Typesdict:
    ros1 = encoding == "ros1msg"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    return {**store.fielddefs, **(get_types_from_msg(_TF[1], _TF[0]) if ros1 else {})}


def _parsed(name: str, encoding: str, text: str) -> Typesdict:
    """Parse the types in a definition in the .msg language, of which `name` is the first. Raises
    ValueError."""
    if len(text) > HEADER_BYTES:
        raise ValueError(f"{name}: a definition of {len(text)} characters")
    try:
        ruled = re.sub(r"^=+[ \t]*$", "=" * 80, text, flags=re.MULTILINE)
        found = get_types_from_msg(ruled, name.replace("/", "/msg/"))
    except Exception as error:  # the parser raises whatever a malformed text leads it to
        raise ValueError(f"{name}: not a definition that rosbags understands") from error
    _check_names(found)
    if encoding == "ros1msg" or _TIME not in found:
        sec: Any = (Nodetype.BASE, ("uint32" if encoding == "ros1msg" else "int32", 0))
        found[_TIME] = ([], [("sec", sec), ("nanosec", (Nodetype.BASE, ("uint32", 0)))])
    return found


def _check_names(types: Typesdict) -> None:
    """Raise ValueError for a name that is not one of ROS: rosbags makes Python code of them."""
    names = [part for kind in types for part in kind.split("/")]
    names += [field for _, fields in types.values() for field, _ in fields]
    for name in names:
        if not _NAME.fullmatch(name) or keyword.iskeyword(name):
            raise ValueError(f"{name!r:.40}: not a name in ROS")


def _needed(top: str, types: Typesdict) -> Typesdict:
    """Return a type and those that it consists of, without constants, in small letters: ROS 1 has a
    CameraInfo.D.

    Raises ValueError for one that nests without end, into too many fields, or into a type without a
    definition: a few lines can nest into billions, and rosbags writes code for each item of an array.
    """
    todo, count = [top], 0
    needed: Typesdict = {}
    while todo:
        kind = todo.pop()
        if kind not in types:
            raise ValueError(f"{short_name(kind)}: definition missing")
        fields = types[kind][1]
        needed[kind] = ([], [(name.lower(), field) for name, field in fields])
        for _, field in fields:
            node, content = cast("tuple[Nodetype, Any]", field)
            if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                count += content[1] if node == Nodetype.ARRAY else 0
                node, content = content[0]
            todo += [content] if node == Nodetype.NAME else []
            count += 1
        if count + len(todo) > MOST_PARTS:
            raise ValueError(
                f"{top}: its definitions nest without end, or into more than {MOST_PARTS} fields"
            )
    return needed
