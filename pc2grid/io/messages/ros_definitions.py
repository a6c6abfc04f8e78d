"""Definitions of ROS message types: those of a recording, and those of ROS where it has none.

Both are parsed by `rosbags`. Messages whose arrays are large are decoded by `ros` itself; for these, the
recording's definition is reduced to the flat list of its primitive fields and compared with that of ROS, so
that a type of the right name but another layout is refused instead of read wrongly. All others are decoded by
a store of rosbags with the recording's own definition, which may have more fields than ROS's.

Texts are bounded before they are parsed, and only names and types of fields are registered.
"""

from __future__ import annotations

import functools
import keyword
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_idl, get_types_from_msg
from rosbags.typesys.store import Typestore

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

# ros2/common_interfaces, branch humble, without comments and constants. The layout is the wire format.
_OF_ROS = """\
float64 x
float64 y
float64 z
===
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
===
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
===
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
===
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
===
MSG: geometry_msgs/PoseStamped
std_msgs/Header header
geometry_msgs/Pose pose
===
MSG: geometry_msgs/PoseWithCovarianceStamped
std_msgs/Header header
geometry_msgs/PoseWithCovariance pose
===
MSG: geometry_msgs/Twist
geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular
===
MSG: geometry_msgs/TwistWithCovariance
geometry_msgs/Twist twist
float64[36] covariance
===
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
===
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
===
MSG: tf2_msgs/TFMessage
geometry_msgs/TransformStamped[] transforms
===
MSG: nav_msgs/Odometry
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
===
MSG: sensor_msgs/Imu
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
===
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
===
MSG: sensor_msgs/PointCloud2
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
===
MSG: sensor_msgs/LaserScan
std_msgs/Header header
float32 angle_min
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max
float32[] ranges
float32[] intensities
===
MSG: sensor_msgs/Image
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
===
MSG: sensor_msgs/CompressedImage
std_msgs/Header header
string format
uint8[] data
===
MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
===
MSG: sensor_msgs/CameraInfo
std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
"""
_TIME = "builtin_interfaces/msg/Time"
_SAME = {"byte": "uint8", "char": "uint8", "octet": "uint8"}
"""Types of one layout."""
_ROS_1_HEADER = "uint32 seq\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_ROS_2_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"

# The known types flatten to some tens of fields; their published definitions with all comments have up to
# 15,000 characters. The limits bound the time for a crafted text to half a second.
_MOST_FIELDS = 1000
_MOST_CHARACTERS = 1 << 16
_MOST_ITEMS = 100_000
"""Of a sequence in a message that rosbags decodes; no real one comes near."""
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)

Layout = tuple[tuple[str, str], ...]  # (path of a field, its primitive type)


def short_name(type_name: str) -> str:
    """`sensor_msgs/msg/PointCloud2` and `sensor_msgs/PointCloud2` to the latter."""
    return type_name.replace("/msg/", "/").replace("::msg::", "/").replace("::", "/")


def expected_layout(type_name: str, ros1: bool) -> Layout:
    """The layout of a type of ROS. type_name : one of those in `_OF_ROS`."""
    return _flatten(short_name(type_name), _of_ros(ros1))


def layout_of(type_name: str, encoding: str, text: str) -> Layout:
    """The layout of a type in a schema text of a log.

    encoding : `ros2msg`, `ros1msg` or `ros2idl`. Raises ValueError if the text cannot be understood.
    """
    return _flatten(short_name(type_name), _parsed(short_name(type_name), encoding, text))


@functools.lru_cache(maxsize=32)
def store_of(type_name: str, ros1: bool, encoding: str = "", text: str = "") -> Typestore:
    """A store of rosbags with a type and all types that it consists of; the names of fields in small letters.

    encoding, text : of the schema in the log, of which `layout_of` must be known; empty: as ROS defines it.
    """
    store = Typestore(max_sequence_length=_MOST_ITEMS)
    store.register(_parsed(short_name(type_name), encoding, text) if text else _of_ros(ros1))
    return store


@functools.cache
def _of_ros(ros1: bool) -> Typesdict:
    header = _ROS_1_HEADER if ros1 else _ROS_2_HEADER
    text = f"{_OF_ROS}===\nMSG: std_msgs/Header\n{header}"
    return _parsed("geometry_msgs/Point", "ros1msg" if ros1 else "ros2msg", text)


@functools.lru_cache(maxsize=32)  # a log's topics share types, and each is looked at several times
def _parsed(name: str, encoding: str, text: str) -> Typesdict:
    """The types in a definition; `name` is the first one of a text in the .msg language.

    Raises ValueError.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ValueError(f"{name}: a definition of {len(text)} characters")
    try:
        if encoding == "ros2idl":
            found = get_types_from_idl(_plain_idl(text))
        else:
            ruled = re.sub(r"^=+[ \t]*$", "=" * 80, text, flags=re.MULTILINE)
            found = get_types_from_msg(ruled, name.replace("/", "/msg/"))
    except Exception as error:  # the parser raises whatever a malformed text leads it to
        raise ValueError(f"{name}: not a definition that rosbags understands") from error
    types: Typesdict = {
        kind: ([], [(field.lower(), node) for field, node in fields]) for kind, (_, fields) in found.items()
    }
    _check_names(types)
    if encoding == "ros1msg" or _TIME not in types:
        sec: Any = (Nodetype.BASE, ("uint32" if encoding == "ros1msg" else "int32", 0))
        types[_TIME] = ([], [("sec", sec), ("nanosec", (Nodetype.BASE, ("uint32", 0)))])
    return types


def _check_names(types: Typesdict) -> None:
    """Raises ValueError for a name that is not one of ROS: rosbags makes Python code of them."""
    names = [part for kind in types for part in kind.split("/")]
    names += [field for _, fields in types.values() for field, _ in fields]
    for name in names:
        if not _NAME.fullmatch(name) or keyword.iskeyword(name):
            raise ValueError(f"{name!r:.40}: not a name in ROS")


def _plain_idl(text: str) -> str:
    """The structs and typedefs of an IDL text as rosbag2 writes it, without what the layout does not need.

    The time that rosbags takes grows by a factor of 100 with each level of parentheses
    (`const long b = ((1));` takes 20 s), and by 2 with each level of sequences.

    Raises ValueError for a text in which such are left.
    """
    # Comments and strings in one pass, to the end if they do not end: so each character is looked at once.
    text = re.sub(r"//[^\n]*|/\*.*?(?:\*/|\Z)|\"(?:[^\"\\]|\\.)*(?:\"|\Z)", "", text, flags=re.DOTALL)
    text = re.sub(r"@\w+\s*(\((?:[^()]|\([^()]*\))*\))?", "", text)
    text = re.sub(r"^[=#][^\n]*$|^IDL:[^\n]*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"\bconst\b[^;]*;", "", text)
    text = re.sub(r"\bmodule\s+\w+\s*\{\s*\}\s*;", "", text)  # of constants only
    text = re.sub(r"\b(w?string)\s*<\s*\d+\s*>", r"\1", text)
    if re.search(r"[()+*/%^|&~-]|<[^<>]*<", text):
        raise ValueError("expressions or nested sequences")
    return text


def _flatten(top: str, types: Typesdict) -> Layout:
    flat: list[tuple[str, str]] = []
    todo: list[tuple[Any, str]] = [((_named(), top.replace("/", "/msg/")), "")]
    seen = 0
    while todo:
        seen += 1
        if seen + len(todo) > _MOST_FIELDS:  # a few lines can nest into billions
            raise ValueError(
                f"{top}: its definitions nest without end, or into more than {_MOST_FIELDS} fields"
            )
        (node, kind), path = todo.pop()
        if node != _named():
            flat.append((path, _SAME.get(kind[0], kind[0])))
        elif kind not in types:
            raise ValueError(f"{short_name(kind)}: definition missing")
        else:
            todo += reversed(list(_inside(path, types[kind][1])))
    return tuple(flat)


def _inside(path: str, fields: list[tuple[str, Any]]) -> Iterator[tuple[Any, str]]:
    """The fields of a type with their paths; of an array or sequence what it holds. Raises ValueError."""
    for name, (node, content) in fields:
        inner, array = (node, content), ""
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            inner, size = content
            array = f"[{size}]" if node == Nodetype.ARRAY else "[]"
            if node == Nodetype.ARRAY and size > _MOST_FIELDS:  # rosbags writes code for each item
                raise ValueError(f"{name}: an array of {size}")
        yield inner, f"{path}.{name}{array}" if path else f"{name}{array}"


def _named() -> Any:
    """What rosbags calls a field that is a message."""
    return Nodetype.NAME
