"""The message types that pc2grid reads and writes: their definitions, and whether a log agrees with them.

The texts follow ros2/common_interfaces (Apache-2.0 interfaces, the layout is the wire format). They are
written into MCAP as `ros2msg` schemas; when reading, a log's own schema is reduced to the flat list of its
primitive fields and compared with ours, so that a type of the right name but another layout is refused
instead of guessed at.
"""

from __future__ import annotations

import functools
import re

_TIME = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec")

DEFINITIONS: dict[str, str] = dict(
    [
        _TIME,
        ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id"),
        ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z"),
        ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
        ("geometry_msgs/Quaternion", "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1"),
        ("geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation"),
        ("geometry_msgs/PoseStamped", "std_msgs/Header header\ngeometry_msgs/Pose pose"),
        ("geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance"),
        (
            "geometry_msgs/PoseWithCovarianceStamped",
            "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
        ),
        ("geometry_msgs/Twist", "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular"),
        ("geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist twist\nfloat64[36] covariance"),
        ("geometry_msgs/Transform", "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"),
        (
            "geometry_msgs/TransformStamped",
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform",
        ),
        ("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms"),
        (
            "nav_msgs/Odometry",
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
            "geometry_msgs/TwistWithCovariance twist",
        ),
        (
            "nav_msgs/MapMetaData",
            "builtin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\n"
            "geometry_msgs/Pose origin",
        ),
        ("nav_msgs/OccupancyGrid", "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data"),
        ("nav_msgs/Path", "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses"),
        ("sensor_msgs/PointField", "string name\nuint32 offset\nuint8 datatype\nuint32 count"),
        (
            "sensor_msgs/PointCloud2",
            "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
            "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
        ),
        (
            "sensor_msgs/LaserScan",
            "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n"
            "float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\n"
            "float32[] ranges\nfloat32[] intensities",
        ),
        (
            "sensor_msgs/Image",
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
            "uint32 step\nuint8[] data",
        ),
        ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data"),
        (
            "sensor_msgs/RegionOfInterest",
            "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify",
        ),
        (
            "sensor_msgs/CameraInfo",
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
            "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
            "sensor_msgs/RegionOfInterest roi",
        ),
        ("std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a"),
        ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec"),
        ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v"),
        ("visualization_msgs/MeshFile", "string filename\nuint8[] data"),
        (
            "visualization_msgs/Marker",
            "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n"
            "geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\n"
            "bool frame_locked\ngeometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\n"
            "string texture_resource\nsensor_msgs/CompressedImage texture\n"
            "visualization_msgs/UVCoordinate[] uv_coordinates\nstring text\nstring mesh_resource\n"
            "visualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials",
        ),
        ("visualization_msgs/MarkerArray", "visualization_msgs/Marker[] markers"),
    ]
)

_POINT_FIELD_CONSTANTS = (
    "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n"
    "uint8 FLOAT32=7\nuint8 FLOAT64=8\n"
)

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

# Types that we know flatten to some tens of fields, and published definitions have thousands of characters.
_MOST_FIELDS = 1000
_MOST_CHARACTERS = 1 << 20

Layout = tuple[tuple[str, str], ...]
_Fields = tuple[tuple[str, str, str], ...]  # (type, array suffix, name)


def short_name(type_name: str) -> str:
    """`sensor_msgs/msg/PointCloud2` and `sensor_msgs/PointCloud2` to the latter."""
    return type_name.replace("/msg/", "/").replace("::msg::", "/").replace("::", "/")


def schema_text(type_name: str) -> str:
    """Concatenated `ros2msg` definition of a type and all it uses, as rosbag2 stores it in MCAP."""
    top = short_name(type_name)
    parts = [_published(top)]
    parts += ["=" * 80 + f"\nMSG: {name}\n{_published(name)}" for name in _dependencies(top)]
    return "\n".join(parts)


def _published(name: str) -> str:
    constants = _POINT_FIELD_CONSTANTS if name == "sensor_msgs/PointField" else ""
    return constants + DEFINITIONS[name] + "\n"


def _dependencies(name: str) -> list[str]:
    found: list[str] = []
    for line in DEFINITIONS[name].splitlines():
        inner = re.sub(r"\[.*", "", line.split()[0])
        if inner in DEFINITIONS:
            found += [n for n in (inner, *_dependencies(inner)) if n not in found]
    return found


@functools.cache
def expected_layout(type_name: str, ros1: bool) -> Layout | None:
    """Flat (path, primitive type) list of a type that we know, else None."""
    name = short_name(type_name)
    if name not in DEFINITIONS:
        return None
    structs = {key: _parse_msg(text) for key, text in DEFINITIONS.items()}
    if ros1:
        structs["std_msgs/Header"] = (("uint32", "", "seq"), *structs["std_msgs/Header"])
        structs[_TIME[0]] = (("uint32", "", "sec"), ("uint32", "", "nanosec"))
    return _flatten(name, structs)


@functools.lru_cache(maxsize=32)  # a log's topics share types, and each is looked at several times
def layout_of(type_name: str, encoding: str, text: str) -> Layout:
    """Flat (path, primitive type) list of a type in a schema text of a log.

    encoding : `ros2msg`, `ros1msg` or `ros2idl`. Raises ValueError if the text cannot be understood.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ValueError(f"{type_name}: a definition of {len(text)} characters")
    name = short_name(type_name)
    structs = dict(_parse_idl(text)) if encoding == "ros2idl" else _parse_concatenated(name, text)
    structs.setdefault("builtin_interfaces/Time", (("int32", "", "sec"), ("uint32", "", "nanosec")))
    if encoding == "ros1msg":
        structs["builtin_interfaces/Time"] = (("uint32", "", "sec"), ("uint32", "", "nanosec"))
    return _flatten(name, structs)


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
            full = inner if inner in _PRIMITIVES else _resolve(inner, kind, structs)
            todo.append((full, f"{path}.{field}{array}" if path else f"{field}{array}"))
    return tuple(flat)


def _resolve(kind: str, user: str, structs: dict[str, _Fields]) -> str:
    """Full name of a type as written inside `user`."""
    if kind in ("time", "builtin_interfaces/Time"):
        return "builtin_interfaces/Time"
    if kind == "Header":
        return "std_msgs/Header"
    full = short_name(kind)
    if "/" in full:
        return full
    same_package = f"{user.split('/', maxsplit=1)[0]}/{full}"
    if same_package in structs:
        return same_package
    return next((name for name in structs if name.endswith("/" + full)), same_package)


def _parse_concatenated(name: str, text: str) -> dict[str, _Fields]:
    head, *rest = re.split(r"^=+\s*\n(?=MSG:)", text, flags=re.MULTILINE)
    structs = {name: _parse_msg(head)}
    for part in rest:
        title, _, body = part.partition("\n")
        structs[short_name(title.removeprefix("MSG:").strip())] = _parse_msg(body)
    return structs


def _parse_msg(text: str) -> _Fields:
    """Fields of one .msg definition; comments, constants and defaults left out."""
    fields = []
    for line in text.splitlines():
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if len(words) < 2:
            raise ValueError(f"not a field: {line.strip()!r}")
        if "=" in words[1] or (len(words) > 2 and words[2].startswith("=")):
            continue  # a constant
        match = re.fullmatch(r"([\w/]+)(?:<=\d+)?(\[[^\]]*\])?", words[0])
        if match is None:
            raise ValueError(f"not a field: {line.strip()!r}")
        array = re.sub(r"<=\d+", "", match.group(2) or "")
        fields.append((match.group(1), array, words[1].lower()))
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
            fields.append((re.sub(r"^string<.*", "string", kind), array, name))
        structs[f"{package}/{match.group(2)}"] = tuple(fields)
    return structs
