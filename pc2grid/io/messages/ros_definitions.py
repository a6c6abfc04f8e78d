"""Does a recording define a ROS message type as `ros` decodes it?

`ros` decodes the fields of `_DECODED` in their order. A recording's own definition of a type is reduced to
the flat list of its primitive fields and compared with ours, so that a type of the right name but another
layout is refused instead of read wrongly.

Definitions in the .msg language are parsed by `rosbags`, those in IDL here: the time that rosbags needs for
nested parentheses in an IDL text grows by a factor of 100 a level (`const long b = ((1));` takes 20 s), so a
crafted recording of a few bytes could keep it busy for ever.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from typing import Any

# ros2/common_interfaces, branch humble, without comments and constants. The layout is the wire format.
_DECODED = """\
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
_HEADER, _TIME = "std_msgs/Header", "builtin_interfaces/Time"

# What .msg and IDL call the primitive types.
_PRIMITIVES = {
    "bool": "bool",
    "boolean": "bool",
    "byte": "uint8",
    "octet": "uint8",
    "char": "uint8",
    "int8": "int8",
    "uint8": "uint8",
    "int16": "int16",
    "short": "int16",
    "uint16": "uint16",
    "unsigned short": "uint16",
    "int32": "int32",
    "long": "int32",
    "uint32": "uint32",
    "unsigned long": "uint32",
    "int64": "int64",
    "long long": "int64",
    "uint64": "uint64",
    "unsigned long long": "uint64",
    "float32": "float32",
    "float": "float32",
    "float64": "float64",
    "double": "float64",
    "string": "string",
}

# The known types flatten to some tens of fields; their published definitions with all comments have up to
# 15,000 characters. The limits bound the time for a crafted text to half a second.
_MOST_FIELDS = 1000
_MOST_CHARACTERS = 1 << 16

Layout = tuple[tuple[str, str], ...]  # (path of a field, its primitive type)
_Fields = tuple[tuple[str, str, str], ...]  # (type, array suffix, name)


def short_name(type_name: str) -> str:
    """`sensor_msgs/msg/PointCloud2` and `sensor_msgs/PointCloud2` to the latter."""
    return type_name.replace("/msg/", "/").replace("::msg::", "/").replace("::", "/")


def expected_layout(type_name: str, ros1: bool) -> Layout:
    """The layout that `ros` decodes. type_name : one of the types that it decodes."""
    structs = dict(_decoded())
    structs[_HEADER] = ((_TIME, "", "stamp"), ("string", "", "frame_id"))
    if ros1:
        structs[_HEADER] = (("uint32", "", "seq"), *structs[_HEADER])
    structs[_TIME] = _time_fields(ros1)
    return _flatten(short_name(type_name), structs)


@functools.lru_cache(maxsize=32)  # a log's topics share types, and each is looked at several times
def layout_of(type_name: str, encoding: str, text: str) -> Layout:
    """The layout of a type in a schema text of a log.

    encoding : `ros2msg`, `ros1msg` or `ros2idl`. Raises ValueError if the text cannot be understood.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ValueError(f"{type_name}: a definition of {len(text)} characters")
    name = short_name(type_name)
    structs = _parse_idl(text) if encoding == "ros2idl" else _parse_msg(name, text)
    if encoding == "ros1msg" or _TIME not in structs:
        structs[_TIME] = _time_fields(encoding == "ros1msg")
    return _flatten(name, structs)


def _time_fields(ros1: bool) -> _Fields:
    return (("uint32" if ros1 else "int32", "", "sec"), ("uint32", "", "nanosec"))


@functools.cache
def _decoded() -> dict[str, _Fields]:
    return _parse_msg("geometry_msgs/Point", _DECODED)


def _flatten(top: str, structs: dict[str, _Fields]) -> Layout:
    flat: list[tuple[str, str]] = []
    todo, seen = [(top, "")], 0
    while todo:
        seen += 1
        if seen + len(todo) > _MOST_FIELDS:  # a few lines can nest into billions
            raise ValueError(
                f"{top}: its definitions nest without end, or into more than {_MOST_FIELDS} fields"
            )
        kind, path = todo.pop()
        if kind in _PRIMITIVES:
            flat.append((path, _PRIMITIVES[kind]))
            continue
        if kind not in structs:
            raise ValueError(f"{kind}: definition missing")
        for inner, array, field in reversed(structs[kind]):
            todo.append((inner, f"{path}.{field}{array}" if path else f"{field}{array}"))
    return tuple(flat)


def _parse_msg(name: str, text: str) -> dict[str, _Fields]:
    """The types of a concatenated .msg definition, as rosbag2 and ROS 1 write it; `name` is the first."""
    from rosbags.typesys import get_types_from_msg

    text = re.sub(r"^=+[ \t]*$", "=" * 80, text, flags=re.MULTILINE)
    try:
        types = get_types_from_msg(text, name.replace("/", "/msg/"))
    except Exception as error:  # the parser raises whatever a malformed text leads it to
        raise ValueError(f"{name}: not a definition in the .msg language") from error
    return {short_name(key): _fields(fields) for key, (_, fields) in types.items()}


def _fields(parsed: Iterable[tuple[str, Any]]) -> _Fields:
    """Fields as `rosbags` describes them: a kind of node with its content."""
    from rosbags.interfaces import Nodetype

    fields = []
    for name, (node, content) in parsed:
        array, inner, what = "", node, content
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (inner, what), size = content
            array = f"[{size}]" if node == Nodetype.ARRAY else "[]"
        kind = short_name(str(what)) if inner == Nodetype.NAME else str(what[0])
        fields.append((kind, array, name.lower()))
    return tuple(fields)


def _parse_idl(text: str) -> dict[str, _Fields]:
    """Structs of an IDL text as rosbag2 writes it (OMG IDL 4.2, the part that ROS 2 uses)."""
    # Comments and strings in one pass, to the end if they do not end: so each character is looked at once.
    text = re.sub(r"//[^\n]*|/\*.*?(?:\*/|\Z)|\"(?:[^\"\\]|\\.)*(?:\"|\Z)", "", text, flags=re.DOTALL)
    text = re.sub(r"@\w+\s*(\((?:[^()]|\([^()]*\))*\))?", "", text)
    text = re.sub(r"^[=#][^\n]*$|^IDL:[^\n]*$", "", text, flags=re.MULTILINE)
    typedefs: dict[str, tuple[str, str]] = {}
    for statement in re.split("[;{}]", text):
        words = statement.split()
        if words[:1] == ["typedef"] and words[-1].endswith("]"):
            declared, _, size = " ".join(words[1:]).removesuffix("]").rpartition("[")
            kind, _, alias = declared.rstrip().rpartition(" ")
            typedefs[alias] = (kind, f"[{size}]")
    structs: dict[str, _Fields] = {}
    package = ""
    for match in re.finditer(r"module\s+(\w+)|struct\s+(\w+)\s*\{([^{}]*)\}", text):
        if match.group(1):
            if match.group(1) != "msg":
                package = match.group(1)
            continue
        fields = []
        for member in match.group(3).split(";"):
            words = member.split()
            if not words:
                continue
            kind, name = " ".join(words[:-1]), words[-1].lower()
            kind, array = typedefs.get(kind, (kind, ""))
            sequence = re.fullmatch(r"sequence\s*<\s*([^,>]+?)\s*(?:,\s*\d+\s*)?>", kind)
            if sequence:
                kind, array = sequence.group(1), "[]"
            kind = re.sub(r"^string<.*", "string", kind)
            kind = kind if kind in _PRIMITIVES else short_name(kind)
            if kind not in _PRIMITIVES and "/" not in kind:
                kind = f"{package}/{kind}"
            fields.append((kind, array, name))
        structs[f"{package}/{match.group(2)}"] = tuple(fields)
    return structs
