"""Finds where points fit on a map: correlative scan matching with bounds.

This is the one coarse search. It is used twice:

- around each place that retrieval proposes, in boxes of 0.8 m and 16 degrees (`localization.hypotheses`);
- over a whole map, in squares side by side on all free ground at all headings, when retrieval did not settle
  the question.

Poses lie on a lattice: squares of `SQUARE` x `SQUARE` cells, at headings two steps apart. A square has a
bound that none of its poses exceeds: each point on the maximum of the likelihood field within the distance
that the square and the heading can move it (Olson 2015, "M3RSM: many-to-many multi-resolution scan
matching"; Hess et al. 2016). At a fixed heading a point moves over neighbouring squares as over the cells of
an image, so all squares of a tile are summed at once, with vector instructions. Tiles are taken in the order
of their highest bound, and squares that can hold nothing worth reporting are left out; the others are halved,
first in heading, then in position, until the poses are single cells and half a step of heading around them.

A score is the mean over the points of the highest likelihood within half a cell and half a step of heading,
so a wall of one cell cannot be missed between two poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from pc2grid.arrays import F32, F64, I64, U8, U16
from pc2grid.matching.lattice import SQUARE, TILE
from pc2grid.matching.likelihood_field import LIKELIHOOD, LikelihoodField
from pc2grid.matching.walls import Walls
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
"""A pose may exceed the bound of its square, because `levels_for` neglects half a cell. A square is left out
only if its bound is below this share of the best score found. Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchParameters:
    """What is reported; scores are 0..1.

    step_rad : headings at most this far apart are tried. It moves a wall 8 m away by 0.24 m, a little more
        than the likelihood field is wide; chosen by hand.
    floor, keep : poses scoring below `floor`, or below `keep` times the best, are not reported.
    most : poses reported at most.
    apart_m, apart_rad : two reported poses differ by more than one of these; what is nearer to a better pose
        is the shoulder of its peak and tells nothing of other places. Of 0.5 m and 10 degrees to 1.5 m and 30
        the one with the least log loss on real recordings.
    """

    step_rad: float = math.radians(1.7)
    floor: float = 0.45
    keep: float = 0.8
    most: int = 10
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
        """Prepare a map. Everything outside it counts as unknown.

        from_below : for queries in a lower plane, to which its free space is as unknown ground.
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
        """The likelihood field of the map."""
        return self.walls.field


def _images(field: U8, resolution_m: float) -> U8:
    """`SearchMap.images` of a field (H, W)."""
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
    """The best distinct poses of a point set in boxes of poses, best first.

    points_m : (M, 2) at most `MOST_POINTS` points, relative to the point that they rotate about.
    boxes : (B, 3) x, y, yaw of the centres of the boxes, with half widths `half_t_m` and `half_a_rad`; all
    squares of the lattice that one touches are searched. Many are searched faster if they have one heading.

    Returns (H, 4): x, y, yaw, and the score, which no pose within half a cell and half a step of heading
    exceeds. Raises ValueError for too many points.
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
    half_a_rad /= len(turns)
    keep = min(parameters.keep if parameters.most > 1 else 1.0, BOUND_SLACK)
    found = _best(target, points, Tiles.of(boxes, half_t_m / res), turns, half_a_rad, parameters.floor, keep)
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
        """The squares that boxes (B, 3) touch; lengths in cells. Boxes of one heading share their tiles."""
        yaws, group = np.unique(boxes[:, 2], return_inverse=True)
        low = np.floor((boxes[:, 1::-1] - half_t) / SQUARE).astype(np.int64)
        high = np.ceil((boxes[:, 1::-1] + half_t) / SQUARE).astype(np.int64)
        squares = low[:, None] + np.indices((high - low).max(axis=0)).reshape(2, -1).T
        box, step = np.nonzero((squares < high[:, None]).all(axis=2))
        first = np.full((len(yaws), 2), np.iinfo(np.int64).max)
        np.minimum.at(first, group, low)
        squares, group = squares[box, step], group[box]
        beyond = squares - first[group]
        of = np.column_stack((group, beyond // TILE)).T
        shape = tuple((of.max(axis=1) + 1).tolist())
        keys, tile = np.unique(np.ravel_multi_index(tuple(of), shape), return_inverse=True)
        group, down, across = np.unravel_index(keys, shape)
        row, column = (beyond % TILE).T
        inside = np.zeros((len(keys), *TILE), np.uint16)
        inside[tile, row, column] = np.iinfo(np.uint16).max
        return Tiles(first[group] + np.column_stack((down, across)) * TILE, yaws[group], inside)


def _best(
    target: SearchMap,
    points: F64,
    tiles: Tiles,
    turns: F64,
    half_a_rad: float,
    floor: float,
    keep: float,
) -> F64:
    """(N, 4) the best pose of each block that reaches `floor` and the share `keep` of the best; in cells.

    turns : (K,) headings relative to those of the tiles. half_a_rad : each stands for those so far beside it.
    """
    from pc2grid.matching._kernels import best_in_tiles, tile_bounds

    images, shape = target.images.reshape(-1), target.images.shape[-2:]
    levels = levels_of(points, half_a_rad, target)
    bounds = tile_bounds(images, shape, levels[0], points, tiles.corner, tiles.yaw_rad, tiles.inside, turns)
    tile, turn = np.unravel_index(np.argsort(-bounds, axis=None, kind="stable"), bounds.shape)
    found = best_in_tiles(
        images,
        shape,
        levels,
        points,
        tiles.corner[tile],
        tiles.yaw_rad[tile] + turns[turn],
        tiles.inside,
        tile,
        bounds[tile, turn],
        half_a_rad,
        floor,
        keep,
    )
    return found[found[:, 3] >= keep * float(found[:, 3].max(initial=0.0))]


def levels_of(points: F64, half_a_rad: float, target: SearchMap) -> I64:
    """(4, N) the images that each point is looked up in: by a square, by its half in heading, by a quarter of
    that, by a cell. -1 where a point is moved farther than any covers, so that it may be on a wall."""
    res = target.field.resolution_m
    away = np.hypot(points[:, 0], points[:, 1])
    halves = ((0.5 * SQUARE, 1.0), (0.5 * SQUARE, 0.5), (0.25 * SQUARE, 0.5), (0.5, 0.5))
    reach = np.array([half_t + away * share * half_a_rad for half_t, share in halves])
    covered = reach - 0.5 <= REACHES_M[-1] / res
    return np.where(covered, levels_for(reach, res), -1)


def headings(half_a_rad: float, step_rad: float) -> F64:
    """Headings (T,) at most `step_rad` apart that divide -half_a_rad .. half_a_rad into equal steps."""
    count = max(1, math.ceil(2.0 * half_a_rad / step_rad))
    return np.asarray((np.arange(count) - 0.5 * (count - 1)) * (2.0 * half_a_rad / count), np.float64)


def levels_for(reach_cells: F64, resolution_m: float) -> I64:
    """The first of the sliding maxima that covers each of the reaches, or the last one; in their shape.

    Half a cell is neglected: it is less than the field is wide, and covering it would blur the smallest
    squares.
    """
    reaches = np.asarray(REACHES_M) / resolution_m
    return np.asarray(np.searchsorted(reaches, reach_cells - 0.5).clip(max=len(reaches) - 1), np.int64)


def _distinct(found: F64, parameters: SearchParameters) -> F64:
    """The first `most` of the poses (N, 4), best first, without those that are near one before them."""
    kept: list[F64] = []
    while len(found) and len(kept) < parameters.most:
        kept.append(found[0])
        off = np.abs(found - found[0])
        turn = np.abs((off[:, 2] + math.pi) % (2.0 * math.pi) - math.pi)
        apart = off[:, :2].max(axis=1) >= parameters.apart_m
        found = found[apart | (turn >= parameters.apart_rad)]
    return np.array(kept).reshape(-1, 4)
