"""A procedural office floor as an occupancy grid: walls, doors and everything that does not move.

The floor is divided into corridors first, then rooms in the remaining space, then doors (`lay_out`). All
lengths are whole cells of the floor plan; rectangles are half-open, x to the right and y up. `Passages`
places objects so that the free space stays connected for a robot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pc2grid.errors import ConfigError
from pc2grid.geometry import F32, F64, I64, BoolGrid
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

OUTER_WALL_M = 0.3
INNER_WALL_M = 0.1


def office_floorplan(
    seed: int, width_m: float = 44.0, height_m: float = 32.0, *, resolution_m: float = 0.05
) -> OccupancyGrid:
    """Make an office floor, different for each seed: corridors, rooms, doors, pillars, niches, built-in
    shelves.

    Cells outside and in shafts are unknown. The origin is the outer corner of the building. Raises
    ConfigError below 20 x 20 m, where corridors and rooms do not fit, or for cells above 0.1 m.
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
    """Yield the begin, the end and the depth, in cells, of pieces along a wall from `low` to `high`."""
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
    def flipped(self) -> Box:
        """Return the box with x and y exchanged."""
        return Box(self.y0, self.x0, self.y1, self.x1)

    def grown(self, by: int) -> Box:
        """Return a box that is larger by `by` on every side; smaller if negative."""
        return Box(self.x0 - by, self.y0 - by, self.x1 + by, self.y1 + by)


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


class Door(NamedTuple):
    """An opening: the cells of the wall that it removes, and the two places that it connects."""

    box: Box
    sides: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Layout:
    """The division of a floor.

    corridors : touching or crossing each other, one space. rooms : disjoint. doors : sides are numbers of
    rooms, or -1 for the corridor. unit : cells per metre.
    """

    corridors: tuple[Box, ...]
    rooms: tuple[Box, ...]
    doors: tuple[Door, ...]
    unit: float


def lay_out(inside: Box, wall: int, unit: float, rng: np.random.Generator) -> Layout:
    """Divide the inside of the outer walls.

    wall : half the thickness of an inner wall, cells. Rooms without a door are shafts.
    """
    corridors = _corridors(inside, unit, rng)
    rooms = [room for block in _blocks(inside, corridors, rng) for room in _rooms(block, unit, rng)]
    doors = _doors(corridors, rooms, wall, unit, rng)
    return Layout(tuple(corridors), tuple(rooms), tuple(doors), unit)


def _cells(metres: float, unit: float) -> int:
    return round(metres * unit)


def _corridors(inside: Box, unit: float, rng: np.random.Generator) -> list[Box]:
    """Make corridors as a ring, a ladder or a comb, with random widths and positions."""

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


def _doors(
    corridors: list[Box], rooms: list[Box], wall: int, unit: float, rng: np.random.Generator
) -> list[Door]:
    """Open a door from every room to the corridor, or to a room that has one; some rooms get two."""
    opened: list[Door] = []

    def opens(room: int, other: Box, number: int) -> bool:
        box = _door(rooms[room], other, wall, unit, rng)
        if box is not None:
            opened.append(Door(box, (room, number)))
        return box is not None

    def to_corridor(room: int) -> bool:
        """Open one door to a corridor, sometimes two."""
        tried = [corridors[int(i)] for i in rng.permutation(len(corridors))]
        count = sum(opens(room, corridor, -1) for corridor in tried[:1])
        for corridor in tried[1:]:
            if count == 0 or (count == 1 and rng.random() < 0.15):
                count += opens(room, corridor, -1)
        return count > 0

    def to_room(room: int, others: Iterable[int]) -> bool:
        """Open a door to the first possible one of other rooms."""
        return any(opens(room, rooms[other], other) for other in others)

    order = [int(k) for k in rng.permutation(len(rooms))]
    reached = [k for k in order if to_corridor(k)]
    _through_rooms(to_room, reached, [k for k in order if k not in reached])
    for k in reached:
        for other in reached:
            if k < other and rng.random() < 0.1:
                to_room(k, [other])
    return opened


def _through_rooms(
    to_room: Callable[[int, Iterable[int]], bool], reached: list[int], waiting: list[int]
) -> None:
    """Open doors from waiting rooms to reached ones, and add them to these, until none is left."""
    while waiting:
        for k in waiting:
            if to_room(k, reached):
                reached.append(k)
        left = [k for k in waiting if k not in reached]
        if left == waiting:
            return
        waiting = left


def _door(a: Box, b: Box, wall: int, unit: float, rng: np.random.Generator) -> Box | None:
    """Return an opening with the width of a door, sometimes of a double one, away from the corners."""
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
    reserved : (H, W) cells on which no object may be placed.
    """

    def __init__(self, free: BoolGrid, resolution_m: float, robot_m: float) -> None:
        self.free = free.copy()
        self.reserved: BoolGrid = np.zeros_like(self.free)
        self.resolution_m = resolution_m
        self.robot_m = robot_m
        self._passable = clearance_m(free, resolution_m) >= robot_m

    def reserve(self, cells: BoolGrid) -> None:
        """Reserve cells (H, W): no object is placed on them from now on; they stay passable."""
        self.reserved |= cells

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
        kept: NDArray[np.int64] = np.unique(parts[after])
        if count_after != count_before or len(kept) != count_before:
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
