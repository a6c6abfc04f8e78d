"""Foxglove's messages, written by its own published schemas, in protobuf and JSON."""

import base64
import importlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

IDENTITY = {
    "position": {"x": 0.0, "y": 0.0, "z": 0.0},
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
}
XYZ = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate("xyz")]
Content = tuple[str, str, int, dict[str, Any]]  # topic, type, stamp, fields


def stamped(stamp_ns: int, **fields: Any) -> dict[str, Any]:
    """The fields of a message with its timestamp."""
    sec, nsec = divmod(stamp_ns, 10**9)
    return {"timestamp": {"sec": sec, "nsec": nsec}, **fields}


def descriptors(kind: str) -> tuple[bytes, Any]:
    """The FileDescriptorSet of a type, as Foxglove's writers put it into a log, and its class."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    message = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{kind}_pb2"), kind)
    found = FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        for dependency in file.dependencies:
            add(dependency)
        if file.name not in seen:
            seen.add(file.name)
            file.CopyToProto(found.file.add())

    add(message.DESCRIPTOR.file)
    return found.SerializeToString(), message


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """The protobuf message with its fields set."""
    for name, value in fields.items():
        part = getattr(message, name)
        if name == "timestamp":
            part.seconds, part.nanos = value["sec"], value["nsec"]
        elif isinstance(value, dict):
            part.SetInParent()
            fill(part, value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for each in value:
                fill(part.add(), each)
        elif isinstance(value, list):
            part.extend(value)
        else:
            setattr(message, name, value)
    return message


def jsonable(value: Any) -> Any:
    """The fields as JSON holds them: bytes in base64, no NaN."""
    if isinstance(value, dict):
        return {key: jsonable(each) for key, each in value.items()}
    if isinstance(value, list):
        return [jsonable(each) for each in value]
    if isinstance(value, float) and math.isnan(value):
        return None
    return base64.b64encode(value).decode() if isinstance(value, bytes) else value


def write(path: Path, contents: list[Content], encoding: str) -> Path:
    """The messages as an MCAP; encoding: protobuf or json."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="")
        channels: dict[str, int] = {}
        for topic, kind, stamp, fields in contents:
            schema, message = descriptors(kind)
            protobuf = encoding == "protobuf"
            if topic not in channels:
                key = writer.register_schema(
                    f"foxglove.{kind}", encoding if protobuf else "jsonschema", schema if protobuf else b"{}"
                )
                channels[topic] = writer.register_channel(topic, encoding, key)
            text = json.dumps(jsonable(fields)).encode()
            data = fill(message(), fields).SerializeToString() if protobuf else text
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()
    return path


def cloud(stamp: int, points: Any, **fields: Any) -> Content:
    """A PointCloud of float32 points (N, 3), with other fields as given."""
    data = np.asarray(points, "<f4").tobytes()
    given = {"frame_id": "lidar", "pose": IDENTITY, "point_stride": 12, "fields": XYZ, "data": data, **fields}
    return "/points", "PointCloud", stamp, stamped(stamp, **given)


def edge(stamp: int, parent: str, child: str, x_m: float) -> dict[str, Any]:
    """The fields of a FrameTransform without rotation."""
    return stamped(
        stamp,
        parent_frame_id=parent,
        child_frame_id=child,
        translation={"x": x_m, "y": 0.0, "z": 0.0},
        rotation=IDENTITY["orientation"],
    )
