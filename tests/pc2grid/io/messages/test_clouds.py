"""test_clouds."""

import struct

import numpy as np
import pytest

from pc2grid.io.messages.clouds import parser
from pc2grid.io.messages.types import Header, PointCloud2
from tests.helpers.recordings import T0

HEADER = Header(T0, "lidar")
NUMPY = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8"}


def values_of(cloud: PointCloud2) -> dict[str, np.ndarray]:
    """Each field (points, count), read by nothing but its description."""
    found = {}
    order = ">" if cloud.is_bigendian else "<"
    raw = np.frombuffer(bytes(cloud.data), np.uint8)[: cloud.width * cloud.point_step]
    table = raw.reshape(cloud.width, cloud.point_step)
    for name, offset, datatype, count in cloud.fields:
        kind = np.dtype(order + NUMPY[datatype])
        part = np.ascontiguousarray(table[:, offset : offset + count * kind.itemsize])
        found[name] = part.view(kind)
    return found


def columns(types: list[str], counts: list[int]) -> list[np.ndarray]:
    """Four points whose numbers fill their type."""
    rng = np.random.default_rng(3)
    made = []
    for kind, count in zip(types, counts, strict=True):
        if kind[0] == "f":
            made.append(rng.normal(size=(4, count)).astype(kind))
        else:
            low, high = np.iinfo(kind).min, np.iinfo(kind).max
            made.append(rng.integers(low, high, (4, count), dtype=kind, endpoint=True))
    return made


PCD_TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8"]
PCD_COUNTS = [1, 3, 2, 1, 4, 1, 2, 1, 1, 2]


def pcd(kind: str, made: list[np.ndarray]) -> bytes:
    names = [f"n{i}" for i in range(len(made))]
    lines = [
        "# .PCD v.7",
        "",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(m.dtype.itemsize) for m in made),
        "TYPE " + " ".join(m.dtype.kind.upper() for m in made),
        "COUNT " + " ".join(str(m.shape[1]) for m in made),
        "WIDTH 2",
        "HEIGHT 2",
        f"DATA {kind}",
    ]
    head = ("\n".join(lines) + "\n").encode()
    if kind == "ascii":
        rows = (" ".join(repr(v.item()) for m in made for v in m[i]) for i in range(4))
        return head + "\n".join(rows).encode() + b"\n"
    return head + b"".join(m[i].tobytes() for i in range(4) for m in made)


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_pcd_of_every_type_and_count(kind: str) -> None:
    made = columns(PCD_TYPES, PCD_COUNTS)
    found = values_of(parser("pcd")(pcd(kind, made), HEADER))
    assert list(found) == [f"n{i}" for i in range(len(made))]
    for values, wanted in zip(found.values(), made, strict=True):
        assert values.shape == wanted.shape
        if kind == "ascii":  # all numbers of a text are float64
            np.testing.assert_array_equal(values, wanted.astype("f8"))
        else:
            assert values.dtype == wanted.dtype
            np.testing.assert_array_equal(values, wanted)


PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4",
    "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_ply_of_every_type_behind_another_element(kind: str) -> None:
    made = columns(list(PLY_TYPES.values()), [1] * len(PLY_TYPES))
    order = ">" if "big" in kind else "<"
    head = ["ply", f"format {kind} 1.0", "element camera 3", "property float a", "property uchar b"]
    head += ["element vertex 4", *(f"property {name} {name}_" for name in PLY_TYPES), "end_header"]
    if kind == "ascii":
        rows = ["0.5 7"] * 3 + [" ".join(repr(m[i, 0].item()) for m in made) for i in range(4)]
        body = "\n".join(rows).encode()
    else:
        body = struct.pack(order + "fB", 0.5, 7) * 3
        body += b"".join(m[i].astype(m.dtype.newbyteorder(order)).tobytes() for i in range(4) for m in made)
    found = values_of(parser("ply")(("\n".join(head) + "\n").encode() + body, HEADER))
    assert list(found) == [f"{name}_" for name in PLY_TYPES]
    for values, wanted in zip(found.values(), made, strict=True):
        np.testing.assert_array_equal(values.astype("f8"), wanted.astype("f8"))
