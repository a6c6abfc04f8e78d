"""A grid prepared for matching: its likelihood field, and wall points with a weight for their permanence.

The field is of obstacles at any height; a point scores by its distance to the nearest occupied cell, exp(-d^2
/ 2 sigma^2) (Thrun, Burgard and Fox, "Probabilistic Robotics", section 6.4), so no correspondences are
needed. The points are what the other side must have observed if the pose is right; they depend on the heights
that it observes (`Walls.facing`).

Small objects that stand alone may have been moved between two visits, walls stay: the weight of a wall point
grows with the size of its connected object.

A wall has two sides. The outer wall of a building, mapped from its rooms and seen from the street, is one
line in both grids, although the two recordings have observed nothing in common. So the walls of a query keep
the ground in front of them, on the side from which they were observed (`seen_from`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F32, I64, U8, BoolGrid, cells_of
from pc2grid.model import SLICES, UNKNOWN, OccupancyGrid


@dataclass(frozen=True, slots=True, kw_only=True)
class LikelihoodParameters:
    """Shape of the field.

    sigma_m : standard deviation of a point's distance to the wall it belongs to: cell size, registration
        and sensor noise together. Chosen by hand.
    neutral : likelihood, 0..1, of a point on an unknown cell: about the mean score of a random point in a
        building, so that unobserved ground neither supports a pose nor contradicts it. Chosen by hand.
    """

    sigma_m: float = 0.10
    neutral: float = 0.35

    @property
    def neutral_value(self) -> int:
        """Return `neutral` in the units of `LikelihoodField.values`."""
        return int(self.neutral * 255.0)


LIKELIHOOD = LikelihoodParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class LikelihoodField:
    """A likelihood field with the cells that are known.

    values : (H, W) uint8, likelihood in units of 1/255; 255 is an occupied cell. Unknown cells hold at least
        the neutral likelihood.
    known : (H, W) bool, cells that are occupied or free.
    origin_m : (x, y) of the lower left corner of cell (0, 0), in the grid's frame.
    """

    values: U8
    known: BoolGrid
    resolution_m: float
    origin_m: tuple[float, float]

    @staticmethod
    def of(grid: OccupancyGrid, stands: BoolGrid) -> LikelihoodField:
        """Return the field of those cells (H, W) of a grid in which something stands."""
        known = stands | grid.occupied | grid.free
        values = np.zeros(stands.shape, np.uint8)
        if stands.any():
            distance = cv2.distanceTransform((~stands).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            # Farther away than this the likelihood is below 1/255.
            sigma_cells = LIKELIHOOD.sigma_m / grid.resolution_m
            near = distance < sigma_cells * math.sqrt(2.0 * math.log(255.0))
            values[near] = np.exp(-0.5 * (distance[near] / sigma_cells) ** 2) * 255.0
        values[~known] = np.maximum(values[~known], LIKELIHOOD.neutral_value)
        return LikelihoodField(
            values=values, known=known, resolution_m=grid.resolution_m, origin_m=grid.origin_m
        )

    def at(self, points_m: NDArray[np.floating], *, above: bool = False) -> tuple[F32, NDArray[np.bool_]]:
        """Return the likelihood (N,) 0..1 in the cells of points (N, 2), and a mask (N,) of the known cells.

        Both are 0 outside the field. above : the field is of a higher plane than the points. Its walls stand
        on the floor, but its free space passes over low obstacles, so only ground near walls counts as known.
        """
        xy = np.floor((points_m - np.asarray(self.origin_m)) / self.resolution_m).astype(np.int64)
        inside = ((xy >= 0) & (xy < self.values.shape[::-1])).all(axis=1)
        column, row = np.where(inside[:, None], xy, 0).T
        known = inside & self.known[row, column]
        values = np.where(inside, self.values[row, column], 0)
        if above:
            known &= values > LIKELIHOOD.neutral_value
        return values * np.float32(1.0 / 255.0), known


@dataclass(frozen=True, slots=True, kw_only=True)
class WallParameters:
    """How wall points are chosen and weighted.

    spacing_m : one point is kept in each square of this side, the field's standard deviation: points that are
        nearer to each other tell the same.
    grain_cells : low obstacles are smoothed by a median over squares of so many cells. Chosen by hand.
    plane_m : planes so far above each other show different objects, one for example a table that the other
        passes over. Chosen by hand.
    fixed_m : an object at least this long is taken to stay where it is: longer than furniture that is moved
        about. Chosen by hand.
    movable : weight of a low obstacle, relative to a wall. Chosen by hand: with a quarter, and with 1, one or
        two windows less are located of a room whose chairs have been moved, and none is wrong.
    """

    spacing_m: float = LIKELIHOOD.sigma_m
    grain_cells: int = 5
    plane_m: float = 0.5
    fixed_m: float = 2.0
    movable: float = 0.5


WALLS = WallParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Walls:
    """A grid prepared for alignment.

    field : likelihood field of obstacles at any height.
    points_m : (K, 2) float32 centres of occupied cells, of solid obstacles those along the edges, one per
        square of `WallParameters.spacing_m`, in the grid's frame.
    before_m : (K, 2) float32, points on the ground in front of them, where the other side must know the
        ground; `points_m` themselves if it does not matter from which side a wall was observed.
    weights : (K,) float32, 0..1, the permanence of each point, see `permanence`.
    height_m : see `OccupancyGrid.height_m`.
    at_all_heights : the same walls, with only those points that block every observed height; None for a grid
        without heights.
    only_explain : True if the other side need not have observed these points wherever it observes free space.
    """

    field: LikelihoodField
    points_m: F32
    before_m: F32
    weights: F32
    height_m: float | None = None
    at_all_heights: Walls | None = None
    only_explain: bool = False

    @staticmethod
    def of(
        grid: OccupancyGrid,
        *,
        margin_m: float = 0.0,
        drawn: bool = False,
    ) -> Walls:
        """Prepare a grid; it gets `margin_m`, rounded to whole cells, of unknown cells on each side.

        drawn : True for a map that was not built here: cells that no ray can have ended in are left out, see
        `_seen`.
        """
        n = round(margin_m / grid.resolution_m)
        if n:
            grid = replace(
                grid,
                cells=np.pad(grid.cells, n, constant_values=UNKNOWN),
                heights=None if grid.heights is None else np.pad(grid.heights, n),
                origin_m=(grid.origin_m[0] - n * grid.resolution_m, grid.origin_m[1] - n * grid.resolution_m),
            )
        if grid.heights is None:
            stands = _seen(grid) if drawn else grid.occupied
            return Walls._of(grid, stands, stands)
        # Low obstacles without grains of noise: the median around each cell.
        things = cv2.medianBlur(grid.things.astype(np.uint8), WALLS.grain_cells) > 0
        stands = grid.occupied | things
        never_passed = stands & (grid.heights < 1 << SLICES)
        return replace(
            Walls._of(grid, stands, _edges(stands)),
            at_all_heights=Walls._of(grid, stands, _edges(never_passed)),
        )

    @staticmethod
    def _of(grid: OccupancyGrid, stands: BoolGrid, shown: BoolGrid) -> Walls:
        """Prepare a grid with `stands` (H, W) as the cells of the field, and `shown` (H, W) as those of the
        points.
        """
        cells = cells_of(shown)
        cells = cells[thin_evenly(grid.to_point(cells), WALLS.spacing_m)]
        points_m = grid.to_point(cells).astype(np.float32)
        weights = permanence(shown, cells, grid.resolution_m)
        weights[grid.things[cells[:, 0], cells[:, 1]]] *= WALLS.movable
        return Walls(
            field=LikelihoodField.of(grid, stands),
            points_m=points_m,
            before_m=points_m,
            weights=weights,
            height_m=grid.height_m,
        )

    def facing(self, other: Walls) -> Walls:
        """Return the walls as they are compared with the other side.

        A side with heights has observed all of them, and must have observed all obstacles. One without
        heights may be a laser, which observes a single plane: it must have observed obstacles that block all
        heights, and of a table nothing. If that plane is known to be clearly above the one of these walls, it
        need not have observed any of them. The height is not known for a laser that tf does not lift above
        its base.
        """
        walls = self.at_all_heights if other.at_all_heights is None else self
        above_m = (other.height_m or math.nan) - (self.height_m or math.nan)
        return replace(walls or self, only_explain=above_m > WALLS.plane_m)

    def seen_from(self, free: F32) -> Walls:
        """Return the walls with the ground in front of them, on the side from which they were observed.

        free : (H, W) share of free ground, 0..1, on the cells of the field. It is blurred, because the free
        ground of a single scan consists of thin rays; its gradient points to that side. The points lie two
        standard deviations of the field from the wall, so that a slightly displaced wall does not cover them.
        """
        cells = np.floor((self.points_m - np.asarray(self.field.origin_m)) / self.field.resolution_m)
        column, row = cells.astype(np.int64).T
        blurred = cv2.GaussianBlur(free, (0, 0), LIKELIHOOD.sigma_m / self.field.resolution_m)
        gradient = np.stack(
            [cv2.Sobel(blurred, cv2.CV_32F, dx, 1 - dx)[row, column] for dx in (1, 0)], axis=1
        )
        length = np.maximum(np.hypot(*gradient.T), np.finfo(np.float32).tiny)
        away_m = 2.0 * LIKELIHOOD.sigma_m * gradient / length[:, None]
        part = self.at_all_heights and self.at_all_heights.seen_from(free)
        return replace(self, before_m=(self.points_m + away_m).astype(np.float32), at_all_heights=part)

    @property
    def weight(self) -> float:
        """Return the number of wall points, by weight."""
        return float(self.weights.sum(dtype=np.float64))


def _seen(grid: OccupancyGrid) -> BoolGrid:
    """Return the occupied cells (H, W) in which a ray can have ended.

    These lie no deeper behind the face of a wall than the field's standard deviation. The thick walls of a
    drawn map would otherwise fit any query. A wall without known free ground before it has no face, and is
    kept.
    """
    cells = cv2.distanceTransform((~grid.free).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    near = grid.occupied & (cells - 1.0 < LIKELIHOOD.sigma_m / grid.resolution_m)
    count, labels = cv2.connectedComponents(grid.occupied.astype(np.uint8), connectivity=8)
    with_face = np.zeros(count, bool)
    with_face[labels[near]] = True
    seen: BoolGrid = near | (grid.occupied & ~with_face[labels])
    return seen


def _edges(stands: BoolGrid) -> BoolGrid:
    """Remove the obstacle cells (H, W) whose neighbours are all obstacles: they are invisible."""
    inside: BoolGrid = cv2.erode(stands.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return stands & ~inside


def permanence(occupied: BoolGrid, cells: I64, resolution_m: float) -> F32:
    """Return the permanence (K,) 0..1 of the objects in `cells` (K, 2; row, column): how likely they stay in
    place.

    It is the longer side of the connected object of a cell, as a share of `fixed_m`, at most 1. Gaps of up to
    two cells are closed first.
    """
    closed = cv2.dilate(occupied.astype(np.uint8), np.ones((3, 3), np.uint8))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    longer = boxes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    extent_m = longer[labels[cells[:, 0], cells[:, 1]]] * resolution_m
    return np.asarray(np.minimum(extent_m / WALLS.fixed_m, 1.0), np.float32)


def thin_evenly(points_m: NDArray[np.floating], spacing_m: float) -> NDArray[np.intp]:
    """Return the indices (K,), ascending, of the first of the points (N, 2) in each square of `spacing_m`."""
    squares = np.floor(np.asarray(points_m) / spacing_m).astype(np.int64)
    if not len(squares):
        return np.empty(0, np.intp)
    squares -= squares.min(axis=0)
    numbers = squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1]
    return np.sort(np.unique(numbers, return_index=True)[1])
