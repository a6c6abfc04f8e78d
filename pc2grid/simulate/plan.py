"""A procedural office floor as an occupancy grid: walls, doors and everything that does not move.

The floor is divided into corridors first, then rooms in the remaining space, then doors. All lengths are
whole cells of the floor plan; rectangles are half-open, x to the right and y up. `Passages` places objects so
that the free space stays connected for a robot.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from pc2grid.errors import ConfigError
from pc2grid.geometry import F32, F64, I64, BoolGrid
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

OUTER_WALL_M = 0.3
RESOLUTION_M = 0.05
_PER_M = 1.0 / RESOLUTION_M
_WALL = 1  # half the thickness of an inner wall, cells


def office_floorplan(seed: int, width_m: float = 44.0, height_m: float = 32.0) -> OccupancyGrid:
    """Make an office floor, different for each seed: corridors, rooms, doors, pillars, niches, built-in
    shelves.

    Cells outside and in shafts are unknown. The origin is the outer corner of the building. Raises
    ConfigError below 20 x 20 m, where corridors and rooms do not fit.
    """
    if min(width_m, height_m) < 20:
        raise ConfigError(f"an office of {width_m:g} x {height_m:g} m is too small", hint="20 x 20 m or more")
    rng = np.random.default_rng([seed, 0x0FF1CE])
    outer = Box(0, 0, round(width_m * _PER_M), round(height_m * _PER_M))
    inside = outer.grown(-round(OUTER_WALL_M * _PER_M))
    corridors = _corridors(inside, rng)
    rooms = [room for block in _blocks(inside, corridors, rng) for room in _rooms(block, rng)]
    reached, doors = _doors(corridors, rooms, rng)
    cells = np.full((outer.height, outer.width), OCCUPIED, np.int8)
    for number, room in enumerate(rooms):
        cells[room.grown(-_WALL).cells] = FREE if number in reached else UNKNOWN
    for corridor in corridors:
        cells[corridor.grown(-_WALL).within(inside).cells] = FREE
    for door in doors:
        cells[door.cells] = FREE
    passages = Passages(cells == FREE, RESOLUTION_M, robot_m=0.4)
    for door in doors:
        passages.reserved[door.grown(round(0.7 * _PER_M)).cells] = True
    passages.reserved &= passages.free
    _relief(passages, corridors, rng)
    _columns(passages, inside, rng)
    _shelves(passages, rooms, rng)
    cells[(cells == FREE) & ~passages.free] = OCCUPIED
    margin = round(0.5 * _PER_M)
    return OccupancyGrid(
        cells=np.pad(cells, margin, constant_values=UNKNOWN),
        resolution_m=RESOLUTION_M,
        origin_m=(-margin / _PER_M, -margin / _PER_M),
    )


def _relief(passages: Passages, corridors: list[Box], rng: np.random.Generator) -> None:
    """Put pilasters, pipes, radiators and cases on corridor walls, so that no corridor is smooth."""
    for whole in corridors:
        others = [other for other in corridors if other != whole]
        corridor = whole.grown(-_WALL)
        upright = corridor.width < corridor.height
        low, y0, high, y1 = corridor.flipped if upright else corridor
        for near in (True, False):
            for begin, end, deep in _pieces(low, high, rng):
                foot = y0 if near else y1 - deep
                box = Box(begin, foot, end, foot + deep)
                box = box.flipped if upright else box
                if all(box.within(other).is_empty for other in others):
                    passages.put(box.corners)


def _pieces(low: int, high: int, rng: np.random.Generator) -> Iterator[tuple[int, int, int]]:
    """Yield the begin, the end and the depth, in cells, of pieces along a wall from `low` to `high`."""
    at = low + float(rng.uniform(0.3, 2.0)) * _PER_M
    while at < high:
        slim = rng.random() < 0.5
        long_m = float(rng.uniform(0.15, 0.4) if slim else rng.uniform(0.6, 1.6))
        deep = max(round(float(rng.uniform(0.05, 0.2 if slim else 0.15)) * _PER_M), 1)
        yield round(at), round(at + long_m * _PER_M), deep
        at += (long_m + float(rng.uniform(0.6, 4.0))) * _PER_M


def _columns(passages: Passages, inside: Box, rng: np.random.Generator) -> None:
    """Put structural columns on a regular pitch, where they leave passages open."""
    pitch_x, pitch_y = rng.uniform(5.0, 7.5, size=2) * _PER_M
    half = round(float(rng.uniform(0.15, 0.25)) * _PER_M)
    start_x, start_y = rng.uniform(0.3, 0.7, size=2) * (pitch_x, pitch_y)
    for x in np.arange(inside.x0 + start_x, inside.x1, pitch_x):
        for y in np.arange(inside.y0 + start_y, inside.y1, pitch_y):
            column = Box(round(x) - half, round(y) - half, round(x) + half, round(y) + half)
            passages.put(column.corners, overlap=True)


def _shelves(passages: Passages, rooms: list[Box], rng: np.random.Generator) -> None:
    """Put shelves and cabinets along the walls of rooms, and some free-standing ones in halls."""
    for room in rooms:
        free = room.grown(-_WALL)
        area_m2 = free.width * free.height / _PER_M**2
        for _ in range(rng.poisson(1.0 + area_m2 / 12)):
            long = round(float(rng.uniform(0.6, 2.2)) * _PER_M)
            deep = round(float(rng.uniform(0.3, 0.5)) * _PER_M)
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
            passages.put(Box(x, y, x + width, y + height).corners)


# --- the division of a floor --------------------------------------------------------------------------


class Box(NamedTuple):
    """x0 <= x < x1, y0 <= y < y1, in cells."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        """Return the width along x."""
        return self.x1 - self.x0

    @property
    def height(self) -> int:
        """Return the height along y."""
        return self.y1 - self.y0

    @property
    def is_empty(self) -> bool:
        """Return True if it holds no cell."""
        return self.width <= 0 or self.height <= 0

    @property
    def flipped(self) -> Box:
        """Return the box with x and y exchanged."""
        return Box(self.y0, self.x0, self.y1, self.x1)

    def grown(self, by: int) -> Box:
        """Return a box that is larger by `by` on every side; smaller if negative."""
        return Box(self.x0 - by, self.y0 - by, self.x1 + by, self.y1 + by)

    def within(self, other: Box) -> Box:
        """Return what lies in the other box, too."""
        low, high = np.maximum(self[:2], other[:2]), np.minimum(self[2:], other[2:])
        return Box(*low.tolist(), *high.tolist())

    @property
    def cells(self) -> tuple[slice, slice]:
        """Return its rows and columns, without negative ones."""
        return np.s_[max(self.y0, 0) : max(self.y1, 0), max(self.x0, 0) : max(self.x1, 0)]

    @property
    def corners(self) -> F64:
        """Return the centres (4, 2) of its outermost cells: their outline covers exactly its cells."""
        x0, y0, x1, y1 = self.x0 + 0.5, self.y0 + 0.5, self.x1 - 0.5, self.y1 - 0.5
        return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _corridors(inside: Box, rng: np.random.Generator) -> list[Box]:
    """Make corridors as a ring, a ladder or a comb, with random widths and positions."""

    def wide() -> int:
        return round(float(rng.uniform(1.7, 2.5)) * _PER_M)

    def deep() -> int:
        return round(float(rng.uniform(4.5, 7.0)) * _PER_M)

    x0, y0 = inside.x0 + deep(), inside.y0 + deep()
    core = Box(x0, y0, inside.x1 - deep(), inside.y1 - deep())
    kind = rng.choice(["ring", "ladder", "comb"], p=[0.5, 0.3, 0.2])
    if kind == "ring":
        return _ring(inside, core, wide, round(_PER_M), rng)
    if kind == "ladder":
        return _ladder(inside, core, wide, rng)
    return _comb(inside, core, wide, rng)


def _ring(inside: Box, core: Box, wide: Callable[[], int], over: int, rng: np.random.Generator) -> list[Box]:
    """Make a ring around the core, a cross through it, and perhaps an arm to the outer wall.

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
    """Make two long corridors and rungs between them."""
    x0, y0, x1, y1 = core
    corridors = [Box(inside.x0, y0, x1, y0 + wide()), Box(x0, y1 - wide(), inside.x1, y1)]
    rungs = int(rng.integers(2, 5))
    for k in range(rungs):
        x = int(x0 + (k + rng.uniform(0.1, 0.7)) * ((x1 - x0) / rungs))
        corridors.append(Box(x, y0, x + wide(), y1))
    return corridors


def _comb(inside: Box, core: Box, wide: Callable[[], int], rng: np.random.Generator) -> list[Box]:
    """Make a spine with teeth to both sides."""
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
    """Divide the space between the corridors into few large rectangles."""
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
    """Return the edges between two outer walls, and these, in order; each once."""
    return np.unique([low, high, *(v for v in edges if low < v < high)])


def _largest(left: BoolGrid, *, along_x_first: bool) -> tuple[int, int]:
    """Return columns and rows of a rectangle of true cells at the corner, grown along one axis, then the
    other."""
    wide, high = 1, 1
    for along_x in (along_x_first, not along_x_first):
        if along_x:
            while wide < left.shape[1] and left[:high, wide].all():
                wide += 1
        else:
            while high < left.shape[0] and left[high, :wide].all():
                high += 1
    return wide, high


def _rooms(block: Box, rng: np.random.Generator) -> list[Box]:
    """Divide a block until its parts are rooms: mostly offices, sometimes a hall."""
    long, short = max(block.width, block.height) / _PER_M, min(block.width, block.height) / _PER_M
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
    return [room for part in parts for room in _rooms(part.flipped if upright else part, rng)]


def _doors(corridors: list[Box], rooms: list[Box], rng: np.random.Generator) -> tuple[list[int], list[Box]]:
    """Open a door from every room to the corridor, or to a room that has one; some rooms get two.

    Returns the numbers of the rooms that have a door, and the doors.
    """
    doors: list[Box] = []

    def opens(room: Box, other: Box) -> bool:
        door = _door(room, other, rng)
        if door is not None:
            doors.append(door)
        return door is not None

    order: list[int] = rng.permutation(len(rooms)).tolist()
    reached: list[int] = []
    for k in order:
        count = 0
        for i in rng.permutation(len(corridors)):
            if count == 0 or (count == 1 and rng.random() < 0.15):
                count += opens(rooms[k], corridors[i])
        if count:
            reached.append(k)
    before = 0
    while before < len(reached):  # until no further room can be reached
        before = len(reached)
        for k in order:
            if k not in reached and any(opens(rooms[k], rooms[other]) for other in reached):
                reached.append(k)
    for k, other in itertools.product(reached, reached):
        if k < other and rng.random() < 0.1:
            opens(rooms[k], rooms[other])
    return reached, doors


def _door(a: Box, b: Box, rng: np.random.Generator) -> Box | None:
    """Return an opening with the width of a door, sometimes of a double one, away from the corners."""
    along_x = _shared_wall(a, b)
    shared = along_x or _shared_wall(a.flipped, b.flipped)
    if shared is None:
        return None
    line, low, high = shared
    double = rng.random() < 0.08 and high - low > round(4.0 * _PER_M)
    wide = rng.uniform(1.6, 2.2) if double else rng.uniform(0.9, 1.0)
    size, corner = round(float(wide) * _PER_M), round(0.3 * _PER_M)
    if high - low < size + 2 * corner:
        return None
    at = int(rng.integers(low + corner, high - corner - size + 1))
    across = _WALL + 1
    box = Box(at, line - across, at + size, line + across)
    return box if along_x else box.flipped


def _shared_wall(a: Box, b: Box) -> tuple[int, int, int] | None:
    """Return the segment along x where two boxes touch: the line's position, from, to."""
    low, high = max(a.x0, b.x0), min(a.x1, b.x1)
    if low < high and (a.y1 == b.y0 or b.y1 == a.y0):
        return a.y1 if a.y1 == b.y0 else a.y0, low, high
    return None


# --- placing objects ----------------------------------------------------------------------------------

_WINDOW_M = 1.2  # around an object, beyond the radius of the robot


class Passages:
    """Free space in which objects are placed so that it stays connected for a robot.

    free : (H, W) cells that are empty; changes with each object.
    reserved : (H, W) cells on which no object may be placed; they stay passable.
    """

    def __init__(self, free: BoolGrid, resolution_m: float, robot_m: float) -> None:
        self.free = free.copy()
        self.reserved: BoolGrid = np.zeros_like(self.free)
        self.resolution_m = resolution_m
        self.robot_m = robot_m
        self._passable = clearance_m(free, resolution_m) >= robot_m

    def put(self, outline_cells: F64, *, overlap: bool = False) -> bool:
        """Place an object if it stands on free cells only and leaves every passage beside it open.

        outline_cells : (N, 2) convex outline, x and y in cells from the grid's corner.
        overlap : the object may reach into walls and other objects.

        The passable space in a window around the object must stay connected. This is stricter than
        connectivity of the whole building: a corridor is not blocked even if there is another way.
        """
        margin = int(np.ceil((self.robot_m + _WINDOW_M) / self.resolution_m))
        low = np.floor(outline_cells.min(axis=0)).astype(int) - margin
        high = np.ceil(outline_cells.max(axis=0)).astype(int) + margin
        height, width = self.free.shape
        c0, r0 = (int(v) for v in np.maximum(low, 0))
        c1, r1 = min(int(high[0]), width), min(int(high[1]), height)
        if r0 >= r1 or c0 >= c1 or (outline_cells < 0).any() or (outline_cells > (width, height)).any():
            return False
        window = np.s_[r0:r1, c0:c1]
        mask = outline_mask(outline_cells - (c0, r0), (r1 - r0, c1 - c0))
        distance = _distance_m(~mask, self.resolution_m)
        if (mask & self.reserved[window]).any() or not (overlap or self.free[window][mask].all()):
            return False
        before = self._passable[window]
        after = before & (distance >= self.robot_m)
        eight = np.ones((3, 3), bool)
        parts, count_before = ndimage.label(before, eight)
        _, count_after = ndimage.label(after, eight)
        if not count_before == count_after == len(np.unique(parts[after])):
            return False
        self.free[window] &= ~mask
        self._passable[window] = after
        return True


def outline_mask(outline_cells: F64, shape: tuple[int, int]) -> BoolGrid:
    """Return a mask of the cells that a convex outline (N, 2), x and y in cells from the corner, touches."""
    shift = 6
    corners = np.round((outline_cells - 0.5) * (1 << shift)).astype(np.int32)
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, corners, 1, lineType=cv2.LINE_8, shift=shift)
    return mask.astype(bool)


def clearance_m(free: BoolGrid, resolution_m: float) -> F32:
    """Return the distance (H, W) from each cell's centre to the edge of the nearest cell that is not free,
    metres.

    Cells outside of the grid are not free.
    """
    return _distance_m(np.pad(free, 1), resolution_m)[1:-1, 1:-1]


def _distance_m(free: BoolGrid, resolution_m: float) -> F32:
    """Return the distance to cells that are not free, without an assumption about cells outside of the
    grid."""
    cells = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.maximum(cells - np.float32(0.5), 0).astype(np.float32) * np.float32(resolution_m))
