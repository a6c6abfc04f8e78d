"""Objects that are in other places in each session: chairs, boxes, tables, people."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64, BoolGrid
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid.simulate.passage import Passages, outline_mask
from pc2grid.simulate.scene import Mesh, prism

_TRIES_PER_OBJECT = 40
_SQUARE_SHARE = 0.5  # of the objects are aligned with the axes of the map
_KEPT_FREE_M = 1.0  # around the start of the drive


@dataclass(frozen=True, slots=True)
class Prism:
    """One part of an object: a convex outline (N, 2) in the object's frame, between two heights, metres."""

    outline_m: F64
    bottom_m: float
    top_m: float


@dataclass(frozen=True, slots=True)
class Furniture:
    """One movable object; people who stand still count as such.

    kind : a key of `KINDS`. pose : T_map_object. outline_m : (N, 2) convex hull on the floor, in its frame.
    """

    kind: str
    pose: SE2
    outline_m: F64
    parts: tuple[Prism, ...]

    def mesh(self) -> Mesh:
        """Its triangles in the map frame."""
        return Mesh.join(prism(self.pose.apply(p.outline_m), p.bottom_m, p.top_m) for p in self.parts)


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> F64:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _disc(radius_m: float) -> F64:
    angles = np.arange(16) * (2 * math.pi / 16)
    return radius_m * np.column_stack((np.cos(angles), np.sin(angles)))


def _legs(width: float, depth: float, thickness: float, top: float) -> list[Prism]:
    x, y, t = width / 2, depth / 2, thickness
    corners = ((-x, -y), (x - t, -y), (x - t, y - t), (-x, y - t))
    return [Prism(_rectangle(a, b, a + t, b + t), 0.0, top) for a, b in corners]


def _box(rng: np.random.Generator) -> tuple[F64, list[Prism]]:
    width, depth, height = rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.6), rng.uniform(0.3, 1.2)
    outline = _rectangle(-width / 2, -depth / 2, width / 2, depth / 2)
    return outline, [Prism(outline, 0.0, height)]


def _person(rng: np.random.Generator) -> tuple[F64, list[Prism]]:
    outline = _disc(rng.uniform(0.18, 0.26))
    return outline, [Prism(outline, 0.0, rng.uniform(1.55, 1.9))]


def _bin(rng: np.random.Generator) -> tuple[F64, list[Prism]]:
    outline = _disc(rng.uniform(0.14, 0.22))
    return outline, [Prism(outline, 0.0, rng.uniform(0.3, 0.75))]


def _chair(rng: np.random.Generator) -> tuple[F64, list[Prism]]:
    size, seat, back = rng.uniform(0.42, 0.5), rng.uniform(0.42, 0.48), rng.uniform(0.8, 1.0)
    half = size / 2
    outline = _rectangle(-half, -half, half, half)
    rest = Prism(_rectangle(-half, -half, -half + 0.04, half), seat, back)
    return outline, [Prism(outline, seat - 0.05, seat), rest, *_legs(size, size, 0.04, seat)]


def _table(rng: np.random.Generator) -> tuple[F64, list[Prism]]:
    width, depth, height = rng.uniform(1.0, 1.6), rng.uniform(0.6, 0.8), rng.uniform(0.7, 0.76)
    outline = _rectangle(-width / 2, -depth / 2, width / 2, depth / 2)
    return outline, [Prism(outline, height - 0.03, height), *_legs(width, depth, 0.06, height)]


KINDS: dict[str, tuple[Callable[[np.random.Generator], tuple[F64, list[Prism]]], float]] = {
    "chair": (_chair, 0.35),
    "box": (_box, 0.25),
    "table": (_table, 0.15),
    "person": (_person, 0.15),
    "bin": (_bin, 0.10),
}
"""For each kind the function that makes one, and its share of all objects (chosen by hand)."""


def place_clutter(
    grid: OccupancyGrid,
    count: int,
    rng: np.random.Generator,
    *,
    robot_m: float,
    keep_free_m: tuple[tuple[float, float], ...] = (),
) -> tuple[Furniture, ...]:
    """Put up to `count` objects on free cells so that a robot of radius `robot_m` still gets everywhere.

    keep_free_m : points of the map frame; objects stay `_KEPT_FREE_M` away from them.
    Returns fewer objects if there is no room for all.
    """
    passages = Passages(grid.free, grid.resolution_m, robot_m)
    places = np.flatnonzero(grid.free)
    names = list(KINDS)
    shares = np.array([KINDS[name][1] for name in names])
    placed: list[Furniture] = []
    for _ in range(_TRIES_PER_OBJECT * count if len(places) else 0):
        if len(placed) == count:
            break
        name = names[rng.choice(len(names), p=shares / shares.sum())]
        outline, parts = KINDS[name][0](rng)
        cell = np.array([np.unravel_index(places[rng.integers(len(places))], grid.cells.shape)])
        x, y = (float(v) for v in grid.to_point(cell)[0])
        square = rng.random() < _SQUARE_SHARE
        yaw = rng.choice(4) * math.pi / 2 if square else rng.uniform(-math.pi, math.pi)
        candidate = Furniture(name, SE2(x, y, float(yaw)), outline, tuple(parts))
        reach = float(np.linalg.norm(outline, axis=1).max())
        if any(math.hypot(x - px, y - py) < _KEPT_FREE_M + reach for px, py in keep_free_m):
            continue
        footprint = (candidate.pose.apply(outline) - grid.origin_m) / grid.resolution_m
        if passages.put(footprint):
            placed.append(candidate)
    return tuple(placed)


def covered(grid: OccupancyGrid, clutter: tuple[Furniture, ...]) -> BoolGrid:
    """Cells (H, W) below any of the objects."""
    shape = (grid.cells.shape[0], grid.cells.shape[1])
    mask: BoolGrid = np.zeros(shape, bool)
    for furniture in clutter:
        footprint = (furniture.pose.apply(furniture.outline_m) - grid.origin_m) / grid.resolution_m
        mask |= outline_mask(footprint, shape)
    return mask
