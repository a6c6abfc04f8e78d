"""How an office floor is divided: corridors first, then rooms in the remaining space, then doors.

All lengths are whole cells of the floor plan; rectangles are half-open, x to the right and y up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


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
    x1, y1 = inside.x1 - deep(), inside.y1 - deep()
    kind = rng.choice(["ring", "ladder", "comb"], p=[0.5, 0.3, 0.2])
    corridors: list[Box] = []
    if kind == "ring":
        corridors += [Box(x0, y0, x1, y0 + wide()), Box(x0, y1 - wide(), x1, y1)]
        corridors += [Box(x0, y0, x0 + wide(), y1), Box(x1 - wide(), y0, x1, y1)]
        # A cross through the core, not in the middle, so that its arms differ.
        x, y = x0 + int((x1 - x0) * rng.uniform(0.3, 0.7)), y0 + int((y1 - y0) * rng.uniform(0.35, 0.65))
        corridors.append(Box(x, y0, x + wide(), y1))
        if rng.random() < 0.7:
            corridors.append(Box(x0, y, x1, y + wide()))
        if rng.random() < 0.6:
            x = x0 + int((x1 - x0) * rng.uniform(0.2, 0.8))
            over = _cells(1.0, unit)
            up, down = Box(x, y1 - over, x + wide(), inside.y1), Box(x, inside.y0, x + wide(), y0 + over)
            corridors.append(up if rng.random() < 0.5 else down)
    elif kind == "ladder":
        corridors += [Box(inside.x0, y0, x1, y0 + wide()), Box(x0, y1 - wide(), inside.x1, y1)]
        rungs = int(rng.integers(2, 5))
        pitch = (x1 - x0) / rungs
        for k in range(rungs):
            x = int(x0 + (k + rng.uniform(0.1, 0.7)) * pitch)
            corridors.append(Box(x, y0, x + wide(), y1))
    else:
        middle = inside.y0 + int(inside.height * rng.uniform(0.4, 0.6))
        spine = Box(inside.x0, middle, inside.x1, middle + wide())
        corridors.append(spine)
        teeth = int(rng.integers(3, 6))
        pitch = inside.width / teeth
        for k in range(teeth):
            x = int(inside.x0 + (k + rng.uniform(0.15, 0.75)) * pitch)
            side = rng.random()
            if side < 0.7:
                corridors.append(Box(x, spine.y0, x + wide(), y1))
            if side > 0.3:
                x = min(x + int(rng.uniform(-0.1, 0.1) * pitch), inside.x1 - wide())
                corridors.append(Box(x, y0, x + wide(), spine.y1))
        # A crossing corridor closes loops between the teeth.
        corridors.append(
            Box(int(inside.x0 + 0.2 * inside.width), y1 - wide(), int(inside.x1 - 0.2 * inside.width), y1)
        )
    return corridors


def _blocks(inside: Box, corridors: list[Box], rng: np.random.Generator) -> list[Box]:
    """The space between the corridors as few large rectangles."""
    xs = sorted(
        {inside.x0, inside.x1, *(v for c in corridors for v in (c.x0, c.x1) if inside.x0 < v < inside.x1)}
    )
    ys = sorted(
        {inside.y0, inside.y1, *(v for c in corridors for v in (c.y0, c.y1) if inside.y0 < v < inside.y1)}
    )
    left = np.ones((len(ys) - 1, len(xs) - 1), bool)
    for j in range(len(ys) - 1):
        for i in range(len(xs) - 1):
            left[j, i] = not any(c.x0 <= xs[i] < c.x1 and c.y0 <= ys[j] < c.y1 for c in corridors)
    blocks = []
    while left.any():
        j, i = (int(v) for v in np.argwhere(left)[0])
        wide, high = 1, 1
        first_along_x = rng.random() < 0.6
        for along_x in (first_along_x, not first_along_x):
            if along_x:
                while i + wide < left.shape[1] and left[j : j + high, i + wide].all():
                    wide += 1
            else:
                while j + high < left.shape[0] and left[j + high, i : i + wide].all():
                    high += 1
        left[j : j + high, i : i + wide] = False
        blocks.append(Box(xs[i], ys[j], xs[i + wide], ys[j + high]))
    return blocks


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
    share = rng.uniform(0.32, 0.68)
    if block.width >= block.height:
        at = block.x0 + int(block.width * share)
        parts = [Box(block.x0, block.y0, at, block.y1), Box(at, block.y0, block.x1, block.y1)]
    else:
        at = block.y0 + int(block.height * share)
        parts = [Box(block.x0, block.y0, block.x1, at), Box(block.x0, at, block.x1, block.y1)]
    return [room for part in parts for room in _rooms(part, unit, rng)]


def _shared_wall(a: Box, b: Box) -> tuple[bool, int, int, int] | None:
    """Where two boxes touch: whether along x, the line's position, from, to."""
    low, high = max(a.x0, b.x0), min(a.x1, b.x1)
    if low < high and (a.y1 == b.y0 or b.y1 == a.y0):
        return True, a.y1 if a.y1 == b.y0 else a.y0, low, high
    low, high = max(a.y0, b.y0), min(a.y1, b.y1)
    if low < high and (a.x1 == b.x0 or b.x1 == a.x0):
        return False, a.x1 if a.x1 == b.x0 else a.x0, low, high
    return None


def _door(a: Box, b: Box, wall: int, unit: float, rng: np.random.Generator) -> Box | None:
    """An opening with the width of a door, sometimes of a double one, away from the corners."""
    shared = _shared_wall(a, b)
    if shared is None:
        return None
    along_x, line, low, high = shared
    wide = (
        rng.uniform(1.6, 2.2)
        if rng.random() < 0.08 and high - low > _cells(4.0, unit)
        else rng.uniform(0.9, 1.0)
    )
    size, corner = _cells(float(wide), unit), _cells(0.3, unit)
    if high - low < size + 2 * corner:
        return None
    at = int(rng.integers(low + corner, high - corner - size + 1))
    across = wall + 1
    if along_x:
        return Box(at, line - across, at + size, line + across)
    return Box(line - across, at, line + across, at + size)


def _doors(
    corridors: list[Box], rooms: list[Box], wall: int, unit: float, rng: np.random.Generator
) -> list[Door]:
    """One door from every room to the corridor, or to a room that has one; some rooms have two."""
    doors: list[Door] = []
    reached: list[int] = []
    waiting = [int(k) for k in rng.permutation(len(rooms))]

    def open_between(k: int, other: Box, number: int) -> bool:
        box = _door(rooms[k], other, wall, unit, rng)
        if box is not None:
            doors.append(Door(box, (k, number)))
        return box is not None

    for k in list(waiting):
        tried = [corridors[int(i)] for i in rng.permutation(len(corridors))]
        opened = sum(open_between(k, corridor, -1) for corridor in tried[:1])
        for corridor in tried[1:]:
            if opened == 0 or (opened == 1 and rng.random() < 0.15):
                opened += open_between(k, corridor, -1)
        if opened:
            reached.append(k)
            waiting.remove(k)
    progress = True
    while waiting and progress:
        progress = False
        for k in list(waiting):
            for other in reached:
                if open_between(k, rooms[other], other):
                    reached.append(k)
                    waiting.remove(k)
                    progress = True
                    break
    for k in reached:
        for other in reached:
            if k < other and rng.random() < 0.1:
                open_between(k, rooms[other], other)
    return doors


def lay_out(inside: Box, wall: int, unit: float, rng: np.random.Generator) -> Layout:
    """Divide the inside of the outer walls.

    wall : half the thickness of an inner wall, cells. Rooms without a door are shafts.
    """
    corridors = _corridors(inside, unit, rng)
    rooms = [room for block in _blocks(inside, corridors, rng) for room in _rooms(block, unit, rng)]
    doors = _doors(corridors, rooms, wall, unit, rng)
    return Layout(tuple(corridors), tuple(rooms), tuple(doors), unit)
