"""Definitions of ROS message types, parsed by `rosbags`: those of a recording, or of ROS where it has none.

Texts are bounded before they are parsed, and only names and types of fields are registered.
"""

from __future__ import annotations

import functools
import keyword
import re
from typing import TYPE_CHECKING, Any, cast

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict

_TIME = "builtin_interfaces/msg/Time"
_TF = (
    "tf2_msgs/msg/TFMessage",
    "geometry_msgs/TransformStamped[] transforms",
)  # rosbags knows it of ROS 2 only

# The known types flatten to some tens of fields; their published definitions with all comments have up to
# 15,000 characters. The limits bound the time for a crafted text to half a second.
_MOST_FIELDS = 1000
_MOST_CHARACTERS = 1 << 16
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)


def short_name(type_name: str) -> str:
    """`sensor_msgs/msg/PointCloud2` and `sensor_msgs/PointCloud2` to the latter."""
    return type_name.replace("/msg/", "/").replace("::msg::", "/").replace("::", "/")


@functools.lru_cache(maxsize=32)  # a log's topics share types, and each is looked at several times
def store_of(type_name: str, encoding: str, text: str) -> Typestore:
    """A store with a type and all that it consists of; the names of fields in small letters.

    encoding : of the schema in the log, `ros2msg` or `ros1msg`. text : the schema; empty: as ROS
    defines the type. Raises ValueError if the text cannot be understood.
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
    """The types in a definition in the .msg language, of which `name` is the first. Raises ValueError."""
    if len(text) > _MOST_CHARACTERS:
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
    """Raises ValueError for a name that is not one of ROS: rosbags makes Python code of them."""
    names = [part for kind in types for part in kind.split("/")]
    names += [field for _, fields in types.values() for field, _ in fields]
    for name in names:
        if not _NAME.fullmatch(name) or keyword.iskeyword(name):
            raise ValueError(f"{name!r:.40}: not a name in ROS")


def _needed(top: str, types: Typesdict) -> Typesdict:
    """A type and those that it consists of, without constants, in small letters: ROS 1 has a CameraInfo.D.

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
        if count + len(todo) > _MOST_FIELDS:
            raise ValueError(
                f"{top}: its definitions nest without end, or into more than {_MOST_FIELDS} fields"
            )
    return needed
