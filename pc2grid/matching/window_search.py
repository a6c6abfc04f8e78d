"""Finds where points fit on a map: correlative scan matching with bounds.

This is the one coarse search. It is used twice:

- around each place that retrieval proposes, in boxes of 0.8 m and 16 degrees (`localization.hypotheses`);
- over a whole map, in such boxes side by side on all free ground, when retrieval did not settle the question.

A box is a set of poses. Three bounds, each of which no pose exceeds, keep most poses from being scored, as in
branch and bound (Olson 2015, "M3RSM: many-to-many multi-resolution scan matching"; Hess et al. 2016):

1. for a whole box: each point on the maximum of the likelihood field within the distance that the box can
   move it. What remains is halved and bounded again; boxes are taken in the order of this bound;
2. within a box, at each heading: each point on the maximum over a block of 2 x 2 cells. At a fixed heading
   the points move over rows of neighbouring cells, so all blocks of a box are summed with vector
   instructions;
3. the cells of the blocks that remain are scored one by one.

A score is the mean over the points of the highest likelihood within half a cell and half a step of heading,
so a wall of one cell cannot be missed between two poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pc2grid.arrays import F32, F64, I64, U8
from pc2grid.matching.likelihood_field import LIKELIHOOD, LikelihoodField
from pc2grid.matching.walls import Walls
from pc2grid.model import OccupancyGrid

MARGIN_M = 4.6
"""Unknown cells around a map that is searched. Points farther outside are taken to lie on its edge, which
scores the same if the margin is wider than the largest of `REACHES_M` and a box together."""
REACHES_M = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.2)
"""Radii (Chebyshev) of the sliding maxima; the first is the field itself. Each is about a quarter more than
the one before: a bound is loose by that much at most."""
MOST_POINTS = 256
"""So many likelihoods of 8 bits add up in 16 bits."""
MOST_HALF_T_M, MOST_HALF_A_RAD = 0.5, math.radians(10.0)
"""Larger boxes are divided first: their bounds would exclude hardly any."""
FEW_BOXES, SPLIT_ABOVE_M, PROBES = 100, 0.12, 16
"""Of more boxes than this, which move the points by more, those that remain are halved, in position or in
heading, whichever moves the points more; before that, so many of the most promising are searched for a lower
bound of the best score. Chosen by the time of a search of a floor: where nothing fits, balanced halves take
half the time of boxes that are halved in both at once."""

BOUND_SLACK = 0.98
"""A pose may exceed the bound of its box, because `levels_for` neglects half a cell. A box is left out only
if its bound is below this share of the best score found. Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchParameters:
    """What is reported; scores are 0..1.

    step_rad : headings this far apart are tried. It moves a wall 8 m away by 0.24 m, a little more than the
        likelihood field is wide; chosen by hand.
    floor, keep : poses scoring below `floor`, or below `keep` times the best, are not reported.
    most : poses reported at most.
    apart_m, apart_rad : two reported poses differ by more than one of these.
    """

    step_rad: float = math.radians(1.7)
    floor: float = 0.45
    keep: float = 0.8
    most: int = 10
    apart_m: float = 0.5
    apart_rad: float = math.radians(10.0)


SEARCH = SearchParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchMap:
    """A map prepared to be searched.

    walls : its wall points and likelihood field, with a margin of `MARGIN_M`.
    levels : (L, H, W) uint8, sliding maxima of the field within each of `REACHES_M`; of a map
        searched by heights, those of each slice, one after the other.
    blocks : (`BLOCK_LEVELS`, H // 2 * W // 2 + LANES) uint8, row by row a value for each block of 2 x 2
        cells that no cell of the block exceeds, for the first of the radii; for each slice.
    """

    walls: Walls
    levels: U8
    blocks: U8

    @staticmethod
    def of(grid: OccupancyGrid, *, from_below: bool = False, by_heights: bool = False) -> SearchMap:
        """Prepare a map. Everything outside it counts as unknown.

        from_below : for queries in a lower plane, to which its free space is as unknown ground.
        by_heights : for queries that tell heights; the map must, too.
        """
        from pc2grid.matching._kernels import BLOCK_LEVELS, LANES

        walls = Walls.of(grid, margin_m=MARGIN_M)
        fields = [part.field.values for part in walls.slices] if by_heights else [walls.field.values]
        if from_below:
            lifted = LIKELIHOOD.neutral * 255.0 + (1.0 - LIKELIHOOD.neutral) * fields[0]
            fields = [np.where(walls.field.known, lifted, fields[0]).astype(np.uint8)]
        levels = _sliding_maxima(fields, grid.resolution_m)
        # The maximum within at least a cell of a block's last cell covers the whole block.
        halves = levels[:, :BLOCK_LEVELS, 1::2, 1::2].reshape(len(fields) * BLOCK_LEVELS, -1)
        return SearchMap(
            walls=walls,
            levels=levels.reshape(-1, *fields[0].shape),
            blocks=np.pad(halves, ((0, 0), (0, LANES))),
        )

    @property
    def by_heights(self) -> bool:
        """Whether it is searched slice by slice."""
        return len(self.levels) > len(REACHES_M)

    @property
    def field(self) -> LikelihoodField:
        """The likelihood field of the map."""
        return self.walls.field


def _sliding_maxima(fields: Sequence[U8], resolution_m: float) -> U8:
    """(F, L, H, W) the maxima of F fields (H, W) within each of `REACHES_M`."""
    import cv2

    reaches = [math.ceil(reach_m / resolution_m - 1e-6) for reach_m in REACHES_M]
    # Tens of megabytes: they are written where they stay, as new memory costs more than the maxima.
    levels = np.empty((len(fields), len(reaches), *fields[0].shape), np.uint8)
    for field, maxima in zip(fields, levels, strict=True):
        maxima[0] = field
        for level, (before, reach) in enumerate(pairwise(reaches)):
            # The maximum over a square of maxima over squares is that over the sum of both squares.
            side = 2 * (reach - before) + 1
            square = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
            cv2.dilate(maxima[level], square, dst=maxima[level + 1], borderType=cv2.BORDER_REPLICATE)
    return levels


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

    points_m : (M, 2) at most `MOST_POINTS` points, relative to the point that they rotate about; for a map
    searched by heights (M, 3), with the number of the slice that each is in.
    boxes : (B, 3) x, y, yaw of the centres of the boxes, with half widths `half_t_m` and `half_a_rad`; many
    are searched faster if those of one heading follow each other.

    Returns (H, 4): x, y, yaw, and the score, which no pose within half a cell and half a step of heading
    exceeds; one pose a box at most. Raises ValueError for too many points.
    """
    if len(points_m) > MOST_POINTS:
        raise ValueError(f"{len(points_m)} points; at most {MOST_POINTS}")
    if not len(points_m) or not len(boxes) or parameters.floor > 1.0:
        return np.empty((0, 4))
    res = target.field.resolution_m
    origin = np.array([*target.field.origin_m, 0.0])
    points = np.asarray(points_m, np.float64) / ((res, res, 1.0)[: points_m.shape[1]])
    cells = (np.asarray(boxes, np.float64) - origin) / (res, res, 1.0)
    cells, half_t, half_a_rad = _split(
        cells, half_t_m / res, half_a_rad, MOST_HALF_T_M / res, MOST_HALF_A_RAD
    )
    keep = min(parameters.keep if parameters.most > 1 else 1.0, BOUND_SLACK)
    least, radius = parameters.floor, float(np.hypot(points[:, 0], points[:, 1]).mean())
    while True:
        bounds = _bounds(target, points, cells, half_t, half_a_rad)
        stays = bounds >= 255.0 * len(points) * least
        cells, bounds = cells[stays], bounds[stays]
        turned = half_a_rad * radius
        if len(cells) <= FEW_BOXES or max(half_t, turned) * res <= SPLIT_ABOVE_M:
            break
        # A few boxes give a lower bound of the best score before the others are divided.
        probes = _highest(bounds, PROBES)
        found = _best(
            target, points, cells[probes], bounds[probes], half_t, half_a_rad, parameters, least, keep
        )
        least = max(least, keep * float(found[:, 3].max()))
        cells = cells[bounds >= 255.0 * len(points) * least]
        by_heading = turned > half_t
        most_t, most_a = (half_t, 0.5 * half_a_rad) if by_heading else (0.5 * half_t, half_a_rad)
        cells, half_t, half_a_rad = _split(cells, half_t, half_a_rad, most_t, most_a)
    if not len(cells):
        return np.empty((0, 4))
    order = _highest(bounds, len(bounds))
    found = _best(target, points, cells[order], bounds[order], half_t, half_a_rad, parameters, least, keep)
    found = found[np.argsort(-found[:, 3], kind="stable")]
    found = found[found[:, 3] >= max(least, keep * float(found[0, 3]))]
    found[:, :2] = found[:, :2] * res + origin[:2]
    return _distinct(found, parameters)


def _bounds(target: SearchMap, points: F64, boxes: F64, half_t: float, half_a_rad: float) -> I64:
    """(B,) the sum over the points, in units of 1/255, that no pose of a box exceeds; lengths in cells.

    A point that a box moves farther than the last of the sliding maxima covers may be on a wall.
    """
    from pc2grid.matching._kernels import box_bounds

    res = target.field.resolution_m
    reach = 2 * math.ceil(half_t / 2) + np.hypot(points[:, 0], points[:, 1]) * half_a_rad
    covered = reach <= REACHES_M[-1] / res
    level = levels_for(reach, res) + len(REACHES_M) * _slices_of(points)
    bounds = box_bounds(target.levels, level[covered], points[covered], boxes)
    return np.asarray(bounds + 255 * np.count_nonzero(~covered), np.int64)


def _best(
    target: SearchMap,
    points: F64,
    boxes: F64,
    bounds: I64,
    half_t: float,
    half_a_rad: float,
    parameters: SearchParameters,
    least: float,
    keep: float,
) -> F64:
    """The best pose (B, 4) of each box, see `plain_best_of_boxes`; score -1 if it is left out."""
    from pc2grid.matching._kernels import BLOCK_LEVELS, best_of_boxes

    res = target.field.resolution_m
    turns = headings(half_a_rad, parameters.step_rad)
    reach = 0.5 + np.hypot(points[:, 0], points[:, 1]) * half_a_rad / len(turns)
    images = with_blocks(levels_for(reach, res), res)
    images += (images >= 0) * _slices_of(points)[:, None] * (len(REACHES_M), BLOCK_LEVELS)
    return best_of_boxes(
        target.levels.reshape(-1),
        target.blocks.reshape(-1),
        target.field.values.shape,
        images,
        points,
        boxes,
        bounds,
        2 * max(1, math.ceil(half_t / 2)),
        turns,
        least,
        keep,
    )


def _slices_of(points: F64) -> I64:
    """The number (N,) of the slice of points (N, 2) or (N, 3)."""
    return points[:, 2].astype(np.int64) if points.shape[1] > 2 else np.zeros(len(points), np.int64)


def _highest(bounds: I64, count: int) -> I64:
    """The numbers of the `count` highest bounds (B,), highest first."""
    found = np.argpartition(-bounds, count)[:count] if count < len(bounds) else np.arange(len(bounds))
    return np.asarray(found[np.argsort(-bounds[found], kind="stable")], np.int64)


def headings(half_a_rad: float, step_rad: float) -> F64:
    """Headings (T,) at most `step_rad` apart that divide -half_a_rad .. half_a_rad into equal steps."""
    count = max(1, math.ceil(2.0 * half_a_rad / step_rad))
    return np.asarray((np.arange(count) - 0.5 * (count - 1)) * (2.0 * half_a_rad / count), np.float64)


def levels_for(reach_cells: F64, resolution_m: float) -> I64:
    """(N,) the first of the sliding maxima that covers each of the reaches (N,), or the last one.

    Half a cell is neglected: it is less than the field is wide, and covering it would blur the smallest
    boxes.
    """
    reaches = np.asarray(REACHES_M) / resolution_m
    return np.asarray(np.searchsorted(reaches, reach_cells - 0.5).clip(max=len(reaches) - 1), np.int64)


def with_blocks(level: I64, resolution_m: float) -> I64:
    """(N, 2) the sliding maxima `level` (N,), and the first in `SearchMap.blocks` that covers each of them
    from all cells of a block of 2 x 2; -1 if there is none."""
    from pc2grid.matching._kernels import BLOCK_LEVELS

    reaches = np.ceil(np.asarray(REACHES_M) / resolution_m - 1e-6)
    cover = np.searchsorted(reaches, reaches[level] + 1.0)
    return np.column_stack((level, np.where(cover < BLOCK_LEVELS, cover, -1)))


def plain_box_bounds(levels: U8, level: I64, points: F64, boxes: F64) -> I64:
    """(B,) sum over the points of the sliding maximum `level` (N,) at the centre of each box; in cells."""
    _, height, width = levels.shape
    c, s = np.cos(boxes[:, 2:]), np.sin(boxes[:, 2:])
    j = np.floor(c * points[:, 0] - s * points[:, 1] + boxes[:, :1]).astype(np.int64)
    i = np.floor(s * points[:, 0] + c * points[:, 1] + boxes[:, 1:2]).astype(np.int64)
    values = levels[level, i.clip(0, height - 1), j.clip(0, width - 1)]
    return np.asarray(values.sum(axis=1), np.int64)


def plain_best_of_boxes(levels: U8, level: I64, points: F64, boxes: F64, half: int, turns: F64) -> F64:
    """The best pose (B, 4: x, y, yaw, score) of each box, by scoring all cells at all headings; in cells.

    level : (N,) the sliding maximum that each point is scored by. half : poses lie up to so many cells from
    the centre of a box. turns : (T,) headings relative to that of the box.
    """
    best = np.full((len(boxes), 4), -1.0)
    for b, (x, y, yaw) in enumerate(boxes):
        for turn in turns:
            for down in range(-half, half + 1):
                for right in range(-half, half + 1):
                    pose = np.array([[x + right, y + down, yaw + turn]])
                    score = plain_box_bounds(levels, level, points, pose)[0] / (255.0 * len(points))
                    if score > best[b, 3]:
                        best[b] = *pose[0], score
    return best


def _split(
    boxes: F64, half_t: float, half_a_rad: float, most_t: float, most_a_rad: float
) -> tuple[F64, float, float]:
    """Boxes (B, 3) cut into equal ones whose half widths are at most `most_t` and `most_a_rad`, and these.

    The parts are ordered so that boxes of one heading stay together, see `box_bounds`.
    """
    shift, turn = headings(half_t, 2.0 * most_t), headings(half_a_rad, 2.0 * most_a_rad)
    parts = np.stack(np.meshgrid(shift, shift, turn, indexing="ij"), axis=-1).reshape(-1, 3)
    return (boxes + parts[:, None]).reshape(-1, 3), half_t / len(shift), half_a_rad / len(turn)


def _distinct(found: F64, parameters: SearchParameters) -> F64:
    """The first `most` of the poses (N, 4), best first, without those that are near one before them."""
    kept: list[int] = []
    for k in range(len(found)):
        if len(kept) == parameters.most:
            break
        near = np.abs(found[kept, :2] - found[k, :2]).max(axis=1) < parameters.apart_m
        turn = np.abs((found[kept, 2] - found[k, 2] + math.pi) % (2.0 * math.pi) - math.pi)
        if not (near & (turn < parameters.apart_rad)).any():
            kept.append(k)
    return found[kept]
