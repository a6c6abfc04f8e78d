"""How an office floor is divided: corridors first, then rooms in the remaining space, then doors.

All lengths are whole cells of the floor plan; rectangles are half-open, x to the right and y up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pc2grid.arrays import I64, BoolGrid


class Box(NamedTuple):
    """x0 <= x < x1, y0 <= y < y1, in cells."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        """Along x."""
        return self.x1 - self.x0

    @property
    def height(self) -> int:
        """Along y."""
        return self.y1 - self.y0

    @property
    def flipped(self) -> Box:
        """With x and y exchanged."""
        return Box(self.y0, self.x0, self.y1, self.x1)

    def grown(self, by: int) -> Box:
        """Larger by `by` on every side; smaller if negative."""
        return Box(self.x0 - by, self.y0 - by, self.x1 + by, self.y1 + by)


class Door(NamedTuple):
    """An opening: the cells of the wall that it removes, and the two places that it connects."""

    box: Box
    sides: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Layout:
    """corridors : touching or crossing each other, one space. rooms : disjoint. doors : sides are numbers of
    rooms, or -1 for the corridor. unit : cells per metre."""

    corridors: tuple[Box, ...]
    rooms: tuple[Box, ...]
    doors: tuple[Door, ...]
    unit: float


def _cells(metres: float, unit: float) -> int:
    return round(metres * unit)


def _corridors(inside: Box, unit: float, rng: np.random.Generator) -> list[Box]:
    """Corridors as a ring, a ladder or a comb, with random widths and positions."""

    def wide() -> int:
        return _cells(float(rng.uniform(1.7, 2.5)), unit)

    def deep() -> int:
        return _cells(float(rng.uniform(4.5, 7.0)), unit)

    x0, y0 = inside.x0 + deep(), inside.y0 + deep()
    core = Box(x0, y0, inside.x1 - deep(), inside.y1 - deep())
    kind = rng.choice(["ring", "ladder", "comb"], p=[0.5, 0.3, 0.2])
    if kind == "ring":
        return _ring(inside, core, wide, _cells(1.0, unit), rng)
    if kind == "ladder":
        return _ladder(inside, core, wide, rng)
    return _comb(inside, core, wide, rng)


def _ring(inside: Box, core: Box, wide: Callable[[], int], over: int, rng: np.random.Generator) -> list[Box]:
    """A ring around the core, a cross through it, and perhaps an arm to the outer wall.

    wide : draws the width of a corridor. over : cells by which the arm overlaps the ring.
    """
    x0, y0, x1, y1 = core
    corridors = [Box(x0, y0, x1, y0 + wide()), Box(x0, y1 - wide(), x1, y1)]
    corridors += [Box(x0, y0, x0 + wide(), y1), Box(x1 - wide(), y0, x1, y1)]
    # The cross is not in the middle, so that its arms differ.
    x, y = x0 + int((x1 - x0) * rng.uniform(0.3, 0.7)), y0 + int((y1 - y0) * rng.uniform(0.35, 0.65))
    corridors.append(Box(x, y0, x + wide(), y1))
    if rng.random() < 0.7:
        corridors.append(Box(x0, y, x1, y + wide()))
    if rng.random() < 0.6:
        x = x0 + int((x1 - x0) * rng.uniform(0.2, 0.8))
        up, down = Box(x, y1 - over, x + wide(), inside.y1), Box(x, inside.y0, x + wide(), y0 + over)
        corridors.append(up if rng.random() < 0.5 else down)
    return corridors


def _ladder(inside: Box, core: Box, wide: Callable[[], int], rng: np.random.Generator) -> list[Box]:
    """Two long corridors and rungs between them."""
    x0, y0, x1, y1 = core
    corridors = [Box(inside.x0, y0, x1, y0 + wide()), Box(x0, y1 - wide(), inside.x1, y1)]
    rungs = int(rng.integers(2, 5))
    for k in range(rungs):
        x = int(x0 + (k + rng.uniform(0.1, 0.7)) * ((x1 - x0) / rungs))
        corridors.append(Box(x, y0, x + wide(), y1))
    return corridors


def _comb(inside: Box, core: Box, wide: Callable[[], int], rng: np.random.Generator) -> list[Box]:
    """A spine with teeth to both sides."""
    middle = inside.y0 + int(inside.height * rng.uniform(0.4, 0.6))
    spine = Box(inside.x0, middle, inside.x1, middle + wide())
    corridors = [spine]
    teeth = int(rng.integers(3, 6))
    pitch = inside.width / teeth
    for k in range(teeth):
        x = int(inside.x0 + (k + rng.uniform(0.15, 0.75)) * pitch)
        side = rng.random()
        if side < 0.7:
            corridors.append(Box(x, spine.y0, x + wide(), core.y1))
        if side > 0.3:
            x = min(x + int(rng.uniform(-0.1, 0.1) * pitch), inside.x1 - wide())
            corridors.append(Box(x, core.y0, x + wide(), spine.y1))
    # A crossing corridor closes loops between the teeth.
    x0, x1 = int(inside.x0 + 0.2 * inside.width), int(inside.x1 - 0.2 * inside.width)
    corridors.append(Box(x0, core.y1 - wide(), x1, core.y1))
    return corridors


def _blocks(inside: Box, corridors: list[Box], rng: np.random.Generator) -> list[Box]:
    """The space between the corridors as few large rectangles."""
    xs = _lines(inside.x0, inside.x1, [v for c in corridors for v in (c.x0, c.x1)])
    ys = _lines(inside.y0, inside.y1, [v for c in corridors for v in (c.y0, c.y1)])
    left = np.ones((len(ys) - 1, len(xs) - 1), bool)
    for c in corridors:
        inside_x, inside_y = (c.x0 <= xs) & (xs < c.x1), (c.y0 <= ys) & (ys < c.y1)
        left &= ~(inside_y[:-1, None] & inside_x[:-1])
    blocks = []
    while left.any():
        j, i = (int(v) for v in np.argwhere(left)[0])
        wide, high = _largest(left[j:, i:], along_x_first=rng.random() < 0.6)
        left[j : j + high, i : i + wide] = False
        blocks.append(Box(int(xs[i]), int(ys[j]), int(xs[i + wide]), int(ys[j + high])))
    return blocks


def _lines(low: int, high: int, edges: list[int]) -> I64:
    """The edges between two outer walls, and these, in order; each once."""
    return np.unique([low, high, *(v for v in edges if low < v < high)])


def _largest(left: BoolGrid, *, along_x_first: bool) -> tuple[int, int]:
    """Columns and rows of a rectangle of true cells at the corner, grown along one axis, then the other."""
    wide, high = 1, 1
    for along_x in (along_x_first, not along_x_first):
        if along_x:
            while wide < left.shape[1] and left[:high, wide].all():
                wide += 1
        else:
            while high < left.shape[0] and left[high, :wide].all():
                high += 1
    return wide, high


def _rooms(block: Box, unit: float, rng: np.random.Generator) -> list[Box]:
    """Divide a block until its parts are rooms: mostly offices, sometimes a hall."""
    long, short = max(block.width, block.height) / unit, min(block.width, block.height) / unit
    area = long * short
    if (
        long < 5.0
        or (area < 90 and long < 12 and rng.random() < 0.08)
        or (area < rng.uniform(12, 32) and long < 2.2 * short)
    ):
        return [block]
    upright = block.width < block.height
    x0, y0, x1, y1 = block.flipped if upright else block
    at = x0 + int((x1 - x0) * rng.uniform(0.32, 0.68))
    parts = [Box(x0, y0, at, y1), Box(at, y0, x1, y1)]
    return [room for part in parts for room in _rooms(part.flipped if upright else part, unit, rng)]


def _shared_wall(a: Box, b: Box) -> tuple[int, int, int] | None:
    """Where two boxes touch along x: the line's position, from, to."""
    low, high = max(a.x0, b.x0), min(a.x1, b.x1)
    if low < high and (a.y1 == b.y0 or b.y1 == a.y0):
        return a.y1 if a.y1 == b.y0 else a.y0, low, high
    return None


def _door(a: Box, b: Box, wall: int, unit: float, rng: np.random.Generator) -> Box | None:
    """An opening with the width of a door, sometimes of a double one, away from the corners."""
    along_x = _shared_wall(a, b)
    shared = along_x or _shared_wall(a.flipped, b.flipped)
    if shared is None:
        return None
    line, low, high = shared
    double = rng.random() < 0.08 and high - low > _cells(4.0, unit)
    wide = rng.uniform(1.6, 2.2) if double else rng.uniform(0.9, 1.0)
    size, corner = _cells(float(wide), unit), _cells(0.3, unit)
    if high - low < size + 2 * corner:
        return None
    at = int(rng.integers(low + corner, high - corner - size + 1))
    across = wall + 1
    box = Box(at, line - across, at + size, line + across)
    return box if along_x else box.flipped


class _Doors:
    """Opens doors between rooms and corridors.

    opened : so far. wall : half the thickness of an inner wall, cells.
    """

    def __init__(self, rooms: list[Box], wall: int, unit: float, rng: np.random.Generator) -> None:
        self.opened: list[Door] = []
        self._rooms, self._wall, self._unit, self._rng = rooms, wall, unit, rng

    def to_corridor(self, room: int, corridors: list[Box]) -> bool:
        """Open one door from a room to a corridor, sometimes two; whether there is one."""
        rng = self._rng
        tried = [corridors[int(i)] for i in rng.permutation(len(corridors))]
        count = sum(self._open(room, corridor, -1) for corridor in tried[:1])
        for corridor in tried[1:]:
            if count == 0 or (count == 1 and rng.random() < 0.15):
                count += self._open(room, corridor, -1)
        return count > 0

    def to_room(self, room: int, others: Iterable[int]) -> bool:
        """Open a door from a room to the first of others that it can have one to; whether there is one."""
        return any(self._open(room, self._rooms[other], other) for other in others)

    def _open(self, room: int, other: Box, number: int) -> bool:
        box = _door(self._rooms[room], other, self._wall, self._unit, self._rng)
        if box is not None:
            self.opened.append(Door(box, (room, number)))
        return box is not None


def _doors(
    corridors: list[Box], rooms: list[Box], wall: int, unit: float, rng: np.random.Generator
) -> list[Door]:
    """One door from every room to the corridor, or to a room that has one; some rooms have two."""
    doors = _Doors(rooms, wall, unit, rng)
    order = [int(k) for k in rng.permutation(len(rooms))]
    reached = [k for k in order if doors.to_corridor(k, corridors)]
    _through_rooms(doors, reached, [k for k in order if k not in reached])
    for k in reached:
        for other in reached:
            if k < other and rng.random() < 0.1:
                doors.to_room(k, [other])
    return doors.opened


def _through_rooms(doors: _Doors, reached: list[int], waiting: list[int]) -> None:
    """Open doors from waiting rooms to those that are reached, and add them to these, until none is left."""
    while waiting:
        for k in waiting:
            if doors.to_room(k, reached):
                reached.append(k)
        left = [k for k in waiting if k not in reached]
        if left == waiting:
            return
        waiting = left


def lay_out(inside: Box, wall: int, unit: float, rng: np.random.Generator) -> Layout:
    """Divide the inside of the outer walls.

    wall : half the thickness of an inner wall, cells. Rooms without a door are shafts.
    """
    corridors = _corridors(inside, unit, rng)
    rooms = [room for block in _blocks(inside, corridors, rng) for room in _rooms(block, unit, rng)]
    doors = _doors(corridors, rooms, wall, unit, rng)
    return Layout(tuple(corridors), tuple(rooms), tuple(doors), unit)
