"""A procedural office floor as an occupancy grid: walls, doors and everything that does not move."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, BoolGrid
from pc2grid.errors import ConfigError
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from pc2grid.simulate.layout import Box, Layout, lay_out
from pc2grid.simulate.passage import Passages

OUTER_WALL_M = 0.3
INNER_WALL_M = 0.1


def _fill(cells: NDArray[np.int8], box: Box, value: int) -> None:
    cells[max(box.y0, 0) : max(box.y1, 0), max(box.x0, 0) : max(box.x1, 0)] = value


def _within(box: Box, other: Box) -> Box:
    return Box(max(box.x0, other.x0), max(box.y0, other.y0), min(box.x1, other.x1), min(box.y1, other.y1))


def _touch(box: Box, other: Box) -> bool:
    common = _within(box, other)
    return common.width > 0 and common.height > 0


def _corners(box: Box) -> F64:
    # Through the centres of the outermost cells, so that exactly the cells of the box are covered.
    x0, y0, x1, y1 = box.x0 + 0.5, box.y0 + 0.5, box.x1 - 0.5, box.y1 - 0.5
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def office_floorplan(
    seed: int, width_m: float = 44.0, height_m: float = 32.0, *, resolution_m: float = 0.05
) -> OccupancyGrid:
    """An office floor, different for each seed: corridors, rooms, doors, pillars, niches, built-in shelves.

    Cells outside and in shafts are unknown. The origin is the outer corner of the building.
    Raises ConfigError below 20 x 20 m, where corridors and rooms do not fit, or for cells above 0.1 m.
    """
    if min(width_m, height_m) < 20:
        raise ConfigError(f"an office of {width_m:g} x {height_m:g} m is too small", hint="20 x 20 m or more")
    if not 0.02 <= resolution_m <= 0.1:
        raise ConfigError(f"office walls need cells of 0.02 to 0.1 m, not {resolution_m:g} m")
    rng = np.random.default_rng([seed, 0x0FF1CE])
    unit = 1.0 / resolution_m
    outer = Box(0, 0, round(width_m * unit), round(height_m * unit))
    inside = outer.grown(-round(OUTER_WALL_M * unit))
    wall = max(round(INNER_WALL_M * unit / 2), 1)
    layout = lay_out(inside, wall, unit, rng)
    cells = np.full((outer.height, outer.width), OCCUPIED, np.int8)
    _carve(cells, layout, inside, wall)
    margin = round(0.5 * unit)
    cells = np.pad(cells, margin, constant_values=UNKNOWN)
    passages = Passages(cells == FREE, resolution_m, robot_m=0.4)
    _keep_doors_clear(passages, layout, margin)
    _relief(passages, layout, wall, margin, rng)
    _columns(passages, inside, margin, unit, rng)
    _shelves(passages, layout, wall, margin, rng)
    solid = (cells == FREE) & ~passages.free
    cells[solid] = OCCUPIED
    return OccupancyGrid(cells=cells, resolution_m=resolution_m, origin_m=(-margin / unit, -margin / unit))


def _carve(cells: NDArray[np.int8], layout: Layout, inside: Box, wall: int) -> None:
    """Make rooms, corridors and doors free in the solid block."""
    reached = {side for door in layout.doors for side in door.sides}
    for number, room in enumerate(layout.rooms):
        _fill(cells, room.grown(-wall), FREE if number in reached else UNKNOWN)
    for corridor in layout.corridors:
        _fill(cells, _within(corridor.grown(-wall), inside), FREE)
    for door in layout.doors:
        _fill(cells, door.box, FREE)


def _keep_doors_clear(passages: Passages, layout: Layout, margin: int) -> None:
    """Reserve the space in front of doors."""
    reserved: BoolGrid = np.zeros(passages.free.shape, bool)
    for door in layout.doors:
        box = door.box.grown(round(0.7 * layout.unit))
        reserved[box.y0 + margin : box.y1 + margin, box.x0 + margin : box.x1 + margin] = True
    passages.reserve(reserved & passages.free)


def _relief(passages: Passages, layout: Layout, wall: int, margin: int, rng: np.random.Generator) -> None:
    """Put pilasters, pipes, radiators and cases on corridor walls, so that no corridor is smooth."""
    for whole in layout.corridors:
        others = [other for other in layout.corridors if other != whole]
        corridor = whole.grown(-wall)
        upright = corridor.width < corridor.height
        low, y0, high, y1 = corridor.flipped if upright else corridor
        for near in (True, False):
            for begin, end, deep in _pieces(low, high, layout.unit, rng):
                foot = y0 if near else y1 - deep
                box = Box(begin, foot, end, foot + deep)
                box = box.flipped if upright else box
                if not any(_touch(box, other) for other in others):
                    passages.put(_corners(box) + margin)


def _pieces(low: int, high: int, unit: float, rng: np.random.Generator) -> Iterator[tuple[int, int, int]]:
    """Where pieces along a wall from `low` to `high` begin and end, and how deep they are, in cells."""
    at = low + float(rng.uniform(0.3, 2.0)) * unit
    while at < high:
        slim = rng.random() < 0.5
        long_m = float(rng.uniform(0.15, 0.4) if slim else rng.uniform(0.6, 1.6))
        deep = max(round(float(rng.uniform(0.05, 0.2 if slim else 0.15)) * unit), 1)
        yield round(at), round(at + long_m * unit), deep
        at += (long_m + float(rng.uniform(0.6, 4.0))) * unit


def _columns(passages: Passages, inside: Box, margin: int, unit: float, rng: np.random.Generator) -> None:
    """Put structural columns on a regular pitch, where they leave passages open."""
    pitch_x, pitch_y = rng.uniform(5.0, 7.5, size=2) * unit
    half = round(float(rng.uniform(0.15, 0.25)) * unit)
    start_x, start_y = rng.uniform(0.3, 0.7, size=2) * (pitch_x, pitch_y)
    for x in np.arange(inside.x0 + start_x, inside.x1, pitch_x):
        for y in np.arange(inside.y0 + start_y, inside.y1, pitch_y):
            column = Box(round(x) - half, round(y) - half, round(x) + half, round(y) + half)
            passages.put(_corners(column) + margin, overlap=True)


def _shelves(passages: Passages, layout: Layout, wall: int, margin: int, rng: np.random.Generator) -> None:
    """Put shelves and cabinets along the walls of rooms, and some free-standing ones in halls."""
    unit = layout.unit
    for room in layout.rooms:
        free = room.grown(-wall)
        area_m2 = free.width * free.height / unit**2
        for _ in range(rng.poisson(1.0 + area_m2 / 12)):
            long, deep = (
                round(float(rng.uniform(0.6, 2.2)) * unit),
                round(float(rng.uniform(0.3, 0.5)) * unit),
            )
            side = int(rng.integers(4))
            width, height = (long, deep) if side < 2 else (deep, long)
            if width >= free.width or height >= free.height:
                continue
            x = int(rng.integers(free.x0, free.x1 - width + 1))
            y = int(rng.integers(free.y0, free.y1 - height + 1))
            # Against the lower, upper, left or right wall; in large rooms some stand free.
            if area_m2 < 30 or rng.random() < 0.7:
                if side < 2:
                    y = (free.y0, free.y1 - height)[side]
                else:
                    x = (free.x0, free.x1 - width)[side - 2]
            passages.put(_corners(Box(x, y, x + width, y + height)) + margin)
