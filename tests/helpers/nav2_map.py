"""An independent reading of nav2 maps, and of what nav2, AMCL and tf2 are told, by their own rules."""

import itertools
import math
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from pc2grid.model import THING, OccupancyGrid

STATIC_LAYER = {-1: "unknown", **dict.fromkeys(range(99), "free"), 99: "inscribed", 100: "lethal"}
"""nav2_costmap_2d, static_layer.cpp, `interpretValue` by its defaults: trinary, lethal from 100 on."""
AMCL = {-1: "unknown", 0: "free", **dict.fromkeys(range(1, 100), "unknown"), 100: "occupied"}
"""nav2_amcl, amcl_node.cpp, `convertMap`: of 0 and 100 only it knows what they are."""
RVIZ = {-1: (112, 137, 134), **{cell: (255 - 255 * cell // 100,) * 3 for cell in range(101)}}
"""rviz_default_plugins, palette_builder.cpp, `makeMapPalette`: other values have the colours of errors."""
_SPOTS_M = {THING: (9.0, 10.0), 50: (11.0, 12.0), -1: (13.0, 14.0)}
"""From x to x, of the spots in a room of the office that `as_mapped` changes."""


def nav2_map(yaml_path: Path) -> tuple[np.ndarray, float, tuple[float, float]]:
    """A map as nav2's map server reads it, by another implementation: cells, metres a cell, origin."""
    keys = yaml.safe_load(yaml_path.read_text())
    pixels = cv2.imread(str(yaml_path.parent / keys["image"]), cv2.IMREAD_GRAYSCALE)
    states = np.array([by_nav2([grey], 255, keys) for grey in range(256)])
    cells = states[pixels[::-1]]
    return cells, keys["resolution"], tuple(keys["origin"][:2])


def as_mapped(plan: OccupancyGrid) -> OccupancyGrid:
    """The office as a drive maps it: no cell is 0 or 100 percent, there is a table, one spot is undecided and
    one unknown."""
    cells = np.select([plan.occupied, plan.free], [np.int8(82), np.int8(1)], plan.cells)
    for cell, (x0, x1) in _SPOTS_M.items():
        columns = slice(round(x0 / plan.resolution_m), round(x1 / plan.resolution_m))
        cells[round(12.5 / plan.resolution_m) : round(13.0 / plan.resolution_m), columns] = cell
    return replace(plan, cells=cells)


def valid_for_nav2(message: Any) -> bool:
    """nav2_ros_common, validate_messages.hpp: of a pose with covariance, or of an OccupancyGrid, decoded."""
    head = bool(message.header.frame_id) and 0 <= message.header.stamp.nanosec < 10**9
    if hasattr(message, "info"):
        info = message.info
        inside = 0 < info.width < 2**15 and 0 < info.height < 2**15
        return head and inside and len(message.data) == info.width * info.height
    q = message.pose.pose.orientation
    unit = abs(q.x**2 + q.y**2 + q.z**2 + q.w**2 - 1.0) < 1e-4
    return head and unit and all(0.0 <= number <= 1e9 for number in message.pose.covariance)


def spread_by_amcl(message: Any) -> list[list[float]]:
    """nav2_amcl, amcl_node.cpp, `handleInitialPose`: the covariance of x, y, yaw that its particles have."""
    c = message.pose.covariance
    return [[c[0], c[1], 0.0], [c[6], c[7], 0.0], [0.0, 0.0, c[35]]]


def known_at(edges: Iterable[Any], frames: Sequence[str], stamp_ns: int) -> bool:
    """tf2: whether frames, the uppermost first, are joined at a time by the transforms of /tf. Between two
    of an edge it interpolates; it does not extrapolate."""
    spans = {pair: [math.inf, -math.inf] for pair in itertools.pairwise(frames)}
    for edge in edges:
        span = spans.get((edge.header.frame_id, edge.child_frame_id))
        if span is not None:
            at_ns = edge.header.stamp.sec * 10**9 + edge.header.stamp.nanosec
            span[:] = min(span[0], at_ns), max(span[1], at_ns)
    return all(first <= stamp_ns <= last for first, last in spans.values())


def by_nav2(pixel: Sequence[int], white: int, keys: dict[str, Any]) -> int:
    """nav2_map_server of Humble, map_io.cpp, `loadMapFromFile`: the cell of a pixel's channels."""
    colours, alpha = (pixel[:3], pixel[3]) if len(pixel) == 4 else (pixel, None)
    counted = [*colours, alpha] if alpha is not None and keys["mode"] == "trinary" else colours
    shade = sum(counted) / (len(counted) * white)
    if keys["mode"] == "raw":
        percent = math.floor(shade * 255 + 0.5)
        return percent if percent <= 100 else -1
    if keys["mode"] == "scale" and alpha is not None and alpha < white:
        return -1
    occupied = shade if keys["negate"] else 1 - shade
    if occupied > keys["occupied_thresh"]:
        return 100
    if occupied < keys["free_thresh"]:
        return 0
    if keys["mode"] == "trinary":
        return -1
    return round((occupied - keys["free_thresh"]) / (keys["occupied_thresh"] - keys["free_thresh"]) * 100)


KEYS: dict[str, Any] = {
    "resolution": 0.05, "origin": [0, 0, 0], "negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196,
}  # fmt: skip


def map_of(folder: Path, pixels: bytes, name: str = "m.png", /, **keys: object) -> Path:
    """A map with this image. keys : of its YAML, in place of `KEYS`; None: left out."""
    (folder / name).write_bytes(pixels)
    path = folder / "m.yaml"
    known = {"image": name, **KEYS, **keys}
    path.write_text("".join(f"{key}: {value}\n" for key, value in known.items() if value is not None))
    return path


def png_chunk(kind: bytes, body: bytes) -> bytes:
    """With the right checksum: damage is caught by it, a liar is not."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
