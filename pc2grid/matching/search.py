"""Correlative scan matching by branch and bound: where points fit on a map.

This is the one coarse search of a query, around proposed poses (`signature.places.hypotheses`) as over whole
maps. Tracking, and loops near their pose in the graph, search some metres with the few points of one scan or
local map (`pc2grid.estimation.line_map.best_placements`).

Poses lie on a lattice: squares of `SQUARE` x `SQUARE` cells, at headings two steps apart. A square has an
upper bound for the score of its poses: each point on the maximum of the likelihood field within the distance
that the square and the heading can move it (Olson 2015, "M3RSM: many-to-many multi-resolution scan matching";
Hess et al. 2016). At a fixed heading a point moves over neighbouring squares as over the cells of an image,
so all squares of a tile are summed at once, with vector instructions. Tiles are taken in the order of their
highest bound. Squares whose bound is too low are left out; the others are halved, first in heading, then in
position, down to single cells and half a step of heading.

A score is the mean over the points of the highest likelihood within half a cell and half a step of heading,
so a wall of one cell cannot be missed between two poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from pc2grid.geometry import F32, F64, I64, U8, U16
from pc2grid.libraries import compiled
from pc2grid.matching.walls import LIKELIHOOD, LikelihoodField, Walls
from pc2grid.model import OccupancyGrid

REACHES_M = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8)
"""Radii (Chebyshev) of the sliding maxima; the first is the field itself. Each is about a quarter more than
the one before: a bound is loose by that much at most."""
MARGIN_M = 2.0
"""Unknown cells around a map that is searched. Points farther outside are taken to lie on its edge, which
scores the same if the margin is wider than the last of `REACHES_M`."""
MOST_POINTS = 256
"""So many likelihoods of 8 bits add up in 16 bits."""
BOUND_SLACK = 0.98
"""A pose may exceed the bound of its square, because `levels_of` neglects half a cell. A square is left out
only if its bound is below this share of the best score found. Chosen by hand."""
SQUARE = 4
"""Side of a square of the lattice, in cells."""
TILE = 16, 64
"""Rows and columns of squares that are summed at once. A row of sums of 16 bits fills two of the widest
vector registers; shorter rows of a fixed length are not compiled to vector instructions (measured)."""
BLOCK = 4
"""Of a block of so many by so many squares, the best pose at a heading is reported."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchParameters:
    """What is reported; scores are 0..1.

    step_rad : headings at most this far apart are tried. It moves a wall 8 m away by 0.24 m, a little more
        than the likelihood field is wide; chosen by hand.
    floor, keep : poses scoring below `floor`, or below `keep` times the best, are not reported.
    most : poses reported at most. By default the best one alone, whatever it scores.
    apart_m, apart_rad : two reported poses differ by more than one of these; a pose nearer to a better one
        lies on the shoulder of its peak. The pair with the least log loss on real recordings, of 0.5 m and 10
        degrees to 1.5 m and 30.
    """

    step_rad: float = math.radians(1.7)
    floor: float = 0.0
    keep: float = 1.0
    most: int = 1
    apart_m: float = 0.75
    apart_rad: float = math.radians(15.0)


SEARCH = SearchParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchMap:
    """A map prepared to be searched.

    walls : its wall points and likelihood field, with a margin of `MARGIN_M`.
    images : (L, SQUARE, SQUARE, H, W) uint8, L sliding maxima of the field within each of `REACHES_M`. The
        cells that lie alike in their squares are an image of their own, with a margin of a tile of neutral
        squares.
    """

    walls: Walls
    images: U8

    @staticmethod
    def of(grid: OccupancyGrid, *, from_below: bool = False, drawn: bool = False) -> SearchMap:
        """Prepare a map for the search. Everything outside it counts as unknown.

        from_below : for queries of a sensor that is mounted lower: the free space of the map is as unknown
        ground for them.
        drawn : see `Walls.of`.
        """
        walls = Walls.of(grid, margin_m=MARGIN_M, drawn=drawn)
        values = walls.field.values
        if from_below:
            lifted = LIKELIHOOD.neutral * 255.0 + (1.0 - LIKELIHOOD.neutral) * values
            values = np.where(walls.field.known, lifted, values).astype(np.uint8)
        return SearchMap(walls=walls, images=_images(values, grid.resolution_m))

    @property
    def field(self) -> LikelihoodField:
        """Return the likelihood field of the map."""
        return self.walls.field


def _images(field: U8, resolution_m: float) -> U8:
    """Return `SearchMap.images` of a field (H, W)."""
    reaches = [math.ceil(reach_m / resolution_m - 1e-6) for reach_m in REACHES_M]
    height, width = (-(-side // SQUARE) for side in field.shape)
    above, left = TILE
    shape = len(reaches), SQUARE, SQUARE, height + 2 * above, width + 2 * left
    images = np.full(shape, LIKELIHOOD.neutral_value, np.uint8)
    below, right = height * SQUARE - field.shape[0], width * SQUARE - field.shape[1]
    maxima = cv2.copyMakeBorder(field, 0, below, 0, right, cv2.BORDER_REPLICATE)
    for image, (before, reach) in zip(images, pairwise([0, *reaches]), strict=True):
        # The maximum over a square of maxima over squares is that over the sum of both squares.
        side = 2 * (reach - before) + 1
        square = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
        maxima = cv2.dilate(maxima, square, borderType=cv2.BORDER_REPLICATE)
        cells = maxima.reshape(height, SQUARE, width, SQUARE).transpose(1, 3, 0, 2)
        image[..., above : above + height, left : left + width] = cells
    return images


def search_windows(
    target: SearchMap,
    points_m: F32,
    boxes: F64,
    *,
    half_t_m: float,
    half_a_rad: float,
    parameters: SearchParameters = SEARCH,
) -> F64:
    """Search boxes of poses; returns the best distinct poses of a point set, best first.

    points_m : (M, 2) at most `MOST_POINTS` points, relative to their centre of rotation. boxes : (B, 3) x, y,
    yaw of the centres of the boxes, with half widths `half_t_m` and `half_a_rad`; all squares of the lattice
    that one touches are searched. Many are searched faster if they have one heading.

    Returns (H, 4): x, y, yaw, and the score, an upper bound of the poses within half a cell and half a step
    of heading. Raises ValueError for too many points.
    """
    if len(points_m) > MOST_POINTS:
        raise ValueError(f"{len(points_m)} points; at most {MOST_POINTS}")
    if not len(points_m) or not len(boxes) or parameters.floor > 1.0:
        return np.empty((0, 4))
    res = target.field.resolution_m
    origin = np.array([*target.field.origin_m, 0.0])
    boxes = (np.asarray(boxes, np.float64) - origin) / (res, res, 1.0)
    turns = headings(half_a_rad, 2.0 * parameters.step_rad)
    points = np.asarray(points_m, np.float64) / res
    half_a_rad /= len(turns)  # half width of each of them
    keep = min(parameters.keep if parameters.most > 1 else 1.0, BOUND_SLACK)
    tiles, levels = Tiles.of(boxes, half_t_m / res), levels_of(points, half_a_rad, target)
    images, shape = target.images.reshape(-1), target.images.shape[-2:]
    bounds = tile_bounds(images, shape, levels[0], points, tiles.corner, tiles.yaw_rad, tiles.inside, turns)
    tile, turn = np.unravel_index(np.argsort(-bounds, axis=None, kind="stable"), bounds.shape)
    corners, yaws = tiles.corner[tile], tiles.yaw_rad[tile] + turns[turn]
    found = best_in_tiles(
        images, shape, levels, points, corners, yaws, tiles.inside, tile, bounds[tile, turn], half_a_rad,
        parameters.floor, keep,
    )  # fmt: skip
    # Of each block only the best pose, if it has a share `keep` of the best score.
    found = found[found[:, 3] >= keep * float(found[:, 3].max(initial=0.0))]
    found = found[np.argsort(-found[:, 3], kind="stable")]
    found[:, :2] = found[:, :2] * res + origin[:2]
    return _distinct(found, parameters)


@dataclass(frozen=True, slots=True)
class Tiles:
    """The parts of the lattice that are summed at once.

    corner : (T, 2) row and column of the first square. yaw_rad : (T,) heading of the boxes in it.
    inside : (T, *TILE) 65535 for the squares that a box touches, else 0.
    """

    corner: I64
    yaw_rad: F64
    inside: U16

    @staticmethod
    def of(boxes: F64, half_t: float) -> Tiles:
        """Return the tiles of all squares that boxes (B, 3) touch; lengths in cells. Boxes of one heading
        share their tiles.
        """
        yaws, group = np.unique(boxes[:, 2], return_inverse=True)
        low = np.floor((boxes[:, 1::-1] - half_t) / SQUARE).astype(np.int64)
        high = np.ceil((boxes[:, 1::-1] + half_t) / SQUARE).astype(np.int64)
        squares = low[:, None] + np.indices((high - low).max(axis=0)).reshape(2, -1).T
        box, step = np.nonzero((squares < high[:, None]).all(axis=2))
        touched = np.column_stack((group[box], squares[box, step]))
        first = touched.min(axis=0)
        beyond = tuple((touched - first).T)
        shape = tuple(int(most.max()) + 1 for most in beyond)
        keys = np.unique(np.ravel_multi_index(beyond, shape))  # each square once
        covered = np.column_stack(np.unravel_index(keys, shape)) + first
        number = _tile_numbers(covered)
        corner = np.full((number.max() + 1, 2), np.iinfo(np.int64).max)
        np.minimum.at(corner, number, covered[:, 1:])
        row, column = (covered[:, 1:] - corner[number]).T
        inside = np.zeros((len(corner), *TILE), np.uint16)
        inside[number, row, column] = np.iinfo(np.uint16).max
        yaw_rad = np.empty(len(corner))
        yaw_rad[number] = yaws[covered[:, 0]]
        return Tiles(corner, yaw_rad, inside)


def _tile_numbers(squares: I64) -> I64:
    """Return the number (N,) of the tile of each square, (N, 3) heading, row and column in this order.

    A tile begins at the first square that is in none, by rows and then by columns, so that much of it is
    covered.
    """
    number = np.empty(len(squares), np.int64)
    count = 0
    ends = np.flatnonzero(np.diff(squares[:, 0], append=-1)) + 1
    for begin, end in pairwise([0, *ends.tolist()]):
        while begin < end:
            band_end = begin + int(np.searchsorted(squares[begin:end, 1], squares[begin, 1] + TILE[0]))
            columns = squares[begin:band_end, 2]
            order = np.argsort(columns, kind="stable")
            at = 0
            while at < len(order):
                after = int(np.searchsorted(columns[order], columns[order[at]] + TILE[1]))
                number[begin + order[at:after]] = count
                at, count = after, count + 1
            begin = band_end
    return number


def levels_of(points: F64, half_a_rad: float, target: SearchMap) -> I64:
    """Return (4, N) the image for each point: for a square, for its half in heading, for a quarter of that,
    for a cell.

    It is the first of the sliding maxima that covers what the point can move. Half a cell is neglected: it is
    less than the width of the field, and covering it would blur the smallest squares. It is -1 where a point
    can move farther than any image covers; it then counts as on a wall.
    """
    res = target.field.resolution_m
    away = np.hypot(points[:, 0], points[:, 1])
    halves = ((0.5 * SQUARE, 1.0), (0.5 * SQUARE, 0.5), (0.25 * SQUARE, 0.5), (0.5, 0.5))
    reach = np.array([half_t + away * share * half_a_rad for half_t, share in halves])
    level = np.searchsorted(np.asarray(REACHES_M) / res, reach - 0.5)
    return np.where(level < len(REACHES_M), level, -1)


def headings(half_a_rad: float, step_rad: float) -> F64:
    """Return headings (T,) at most `step_rad` apart that divide -half_a_rad .. half_a_rad into equal
    parts."""
    count = max(1, math.ceil(2.0 * half_a_rad / step_rad))
    return np.asarray((np.arange(count) - 0.5 * (count - 1)) * (2.0 * half_a_rad / count), np.float64)


def _distinct(found: F64, parameters: SearchParameters) -> F64:
    """Return the first `most` of the poses (N, 4), best first, without those near a better one."""
    kept: list[F64] = []
    while len(found) and len(kept) < parameters.most:
        kept.append(found[0])
        off = np.abs(found - found[0])
        turn = np.abs((off[:, 2] + math.pi) % (2.0 * math.pi) - math.pi)
        apart = off[:, :2].max(axis=1) >= parameters.apart_m
        found = found[apart | (turn >= parameters.apart_rad)]
    return np.array(kept).reshape(-1, 4)


# --- compiled functions -------------------------------------------------------------------------------

_ROWS, _COLUMNS = TILE
_NEUTRAL = LIKELIHOOD.neutral_value
_HALF, _MIDDLE = SQUARE // 2, 0.5 * SQUARE
_PARTS = 1 + 4 + SQUARE * SQUARE
"""Parts of a square: all of it, and its quarters, each before its cells."""
_QUARTER = 1 + _HALF**2
"""Parts of a quarter: all of it, and its cells."""


@compiled(nogil=True)
def tile_bounds(
    flat: U8,
    shape: tuple[int, int],
    level: I64,
    points: F64,
    corner: I64,
    yaw_rad: F64,
    inside: U16,
    turns: F64,
) -> I64:
    """Return (T, K) the highest sum over the points at the centres of the squares of each tile, at each
    heading.

    flat, shape : images, and the size of one. level : (N,) the image for each point, -1: it counts as on a
    wall. points : (N, 2). corner, yaw_rad, inside : as of `Tiles`. turns : (K,).
    """
    bounds = np.empty((len(corner), len(turns)), np.int64)
    at, counted = np.empty(len(points), np.int64), np.empty(2, np.int64)
    sums = np.empty((_ROWS, _COLUMNS), np.uint16)
    for t in range(len(corner)):
        for k in range(len(turns)):
            _place(points, yaw_rad[t] + turns[k], level, _MIDDLE, _MIDDLE, shape, corner[t], at, counted)
            bounds[t, k] = _sum_tile(flat, at, counted, shape[1], inside[t], sums)
    return bounds


@compiled(nogil=True)
def best_in_tiles(
    flat: U8,
    shape: tuple[int, int],
    levels: I64,
    points: F64,
    corners: I64,
    yaws: F64,
    inside: U16,
    tile: I64,
    bounds: I64,
    half_a_rad: float,
    floor: float,
    keep: float,
) -> F64:
    """Return (N, 4) the best pose of each block of squares at each heading, and its score.

    Blocks below `floor` or below the share `keep` of the best score so far are left out. All cells of the
    squares count, at half a step of heading, `half_a_rad` / 2, to both sides.

    corners, yaws, tile, bounds : (B,) each tile at each heading, the highest bound first. tile : its number
    in `inside`.
    """
    n, full, width = len(points), 255.0 * len(points), shape[1]
    sums, number = np.empty((_ROWS, _COLUMNS), np.uint16), 0
    at, counted = np.empty((2, _PARTS, n), np.int64), np.empty((2, _PARTS, 2), np.int64)
    found = np.empty((64, 4))
    least = max(floor, 1.0 / full)
    for b in range(len(bounds)):
        if bounds[b] < full * least:
            break
        here, yaw = corners[b], yaws[b]
        _place(points, yaw, levels[0], _MIDDLE, _MIDDLE, shape, here, at[0, 0], counted[0, 0])
        _sum_tile(flat, at[0, 0], counted[0, 0], width, inside[tile[b]], sums)
        for side in range(2):
            for part in range(_PARTS):
                quarter, cell = (part - 1) // _QUARTER, (part - 1) % _QUARTER - 1
                level, down, right = 1, _MIDDLE, _MIDDLE
                if part:
                    level, down, right = 2, 0.5 * _HALF, 0.5 * _HALF
                    if cell >= 0:
                        level, down, right = 3, cell // _HALF + 0.5, cell % _HALF + 0.5
                    down, right = down + quarter // 2 * _HALF, right + quarter % 2 * _HALF
                half = yaw + (side - 0.5) * half_a_rad
                _place(
                    points, half, levels[level], down, right, shape, here, at[side, part], counted[side, part]
                )
        for block in range(_ROWS * _COLUMNS // BLOCK**2):
            down, right = block // (_COLUMNS // BLOCK) * BLOCK, block % (_COLUMNS // BLOCK) * BLOCK
            best, square, side, part = _best_in_block(
                flat, width, at, counted, sums, down, right, full * least
            )
            if best < 0:
                continue
            if number == len(found):
                more = np.empty((2 * number, 4))
                more[:number] = found
                found = more
            quarter, cell = (part - 1) // _QUARTER, (part - 1) % _QUARTER - 1
            i, j = quarter // 2 * _HALF + cell // _HALF, quarter % 2 * _HALF + cell % _HALF
            found[number, 0] = (here[1] + square % _COLUMNS) * SQUARE + j + 0.5
            found[number, 1] = (here[0] + square // _COLUMNS) * SQUARE + i + 0.5
            found[number, 2] = yaw + (side - 0.5) * half_a_rad
            found[number, 3] = best / full
            number += 1
            least = max(least, keep * best / full)
    return found[:number].copy()


@compiled(nogil=True)
def _best_in_block(
    flat: U8, width: int, at: I64, counted: I64, sums: U16, down: int, right: int, least: float
) -> tuple[int, int, int, int]:
    """Return the highest sum in a block of squares at `down`, `right` of a tile, and its square, side and
    part.

    The sum is -1 where all are below `least`. side : half of the heading. at, counted : of both sides.
    """
    best, best_square, best_side, best_part = -1, 0, 0, 0
    # The most promising square first: what it reaches excludes most of the others.
    first, top = 0, -1
    for square in range(BLOCK**2):
        here = sums[down + square // BLOCK, right + square % BLOCK]
        if here > top:
            first, top = square, here
    for visit in range(BLOCK**2):
        square = (first + visit) % BLOCK**2
        r, c = down + square // BLOCK, right + square % BLOCK
        for side in range(2):
            needed = max(least, best + 1.0)
            part = 0 if sums[r, c] >= needed else _PARTS
            while part < _PARTS:
                total = counted[side, part, 1]
                for p in range(counted[side, part, 0]):
                    total += flat[at[side, part, p] + r * width + c]
                is_whole = (part - 1) % _QUARTER == 0 or part == 0
                if not is_whole and total >= needed and total > best:
                    best, best_square, best_side, best_part = total, r * _COLUMNS + c, side, part
                if is_whole and total < needed:  # nor do its parts reach more
                    part += _QUARTER if part else _PARTS
                else:
                    part += 1
    return best, best_square, best_side, best_part


@compiled(nogil=True)
def _place(
    points: F64,
    yaw: float,
    level: I64,
    down: float,
    right: float,
    shape: tuple[int, int],
    corner: I64,
    at: I64,
    counted: I64,
) -> None:
    """Look up the cells of the points, turned by `yaw`, for a pose `down` and `right` of the corner of its
    square.

    Sets the first entries of `at` to the cells for the first square of the tile at `corner`, as indices into
    all images, flat. Sets `counted` (2,) to their number, and to the sum of all other points: those without a
    level, and those beyond the map for all squares of the tile.
    """
    height, width = shape
    count, rest = 0, 0
    c, s = math.cos(yaw), math.sin(yaw)
    for p in range(len(points)):
        if level[p] < 0:
            rest += 255
            continue
        i = math.floor(s * points[p, 0] + c * points[p, 1] + down)
        j = math.floor(c * points[p, 0] - s * points[p, 1] + right)
        row, column = corner[0] + i // SQUARE + _ROWS, corner[1] + j // SQUARE + _COLUMNS
        if row < 0 or column < 0 or row > height - _ROWS or column > width - _COLUMNS:
            rest += _NEUTRAL
            continue
        image = (level[p] * SQUARE + i % SQUARE) * SQUARE + j % SQUARE
        at[count] = (image * height + row) * width + column
        count += 1
    counted[0], counted[1] = count, rest


@compiled(nogil=True)
def _sum_tile(flat: U8, at: I64, counted: I64, width: int, inside: U16, sums: U16) -> int:
    """Set `sums` (TILE) to the sums of a tile, 0 for squares that are not `inside`; returns the highest."""
    top, rows = 0, 0
    for r in range(_ROWS):
        for k in range(_COLUMNS):
            sums[r, k] = counted[1]
            if inside[r, k]:
                rows = r + 1  # a tile begins at its first square; those below the last one are not summed
    for p in range(counted[0]):
        for r in range(rows):
            first = at[p] + r * width
            window, row = flat[first : first + _COLUMNS], sums[r]
            for k in range(_COLUMNS):
                row[k] += window[k]
    for r in range(_ROWS):
        for k in range(_COLUMNS):
            sums[r, k] &= inside[r, k]
            top = max(top, sums[r, k])
    return top
