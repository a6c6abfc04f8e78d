"""A grid as what two maps are compared by: wall points, how surely they stay, and a likelihood field.

What one side has seen is explained by what stands on the other side at any height: that is the field. It is
contradicted only by what it must have seen itself, and has not: these are the points, which depend on how
much the other side sees (`Walls.facing`).

Small things that stand alone may have been moved between two visits, walls stay. So a wall point counts by
the size of the connected object that it belongs to.

A wall has two sides. The outer wall of a building, mapped from its rooms and seen from the street, is one
line in both grids, but nothing that both have seen. So the walls of a query keep the ground in front of them,
on the side that they were seen from (`seen_from`).

The likelihood field of a grid: how well a point of an obstacle fits at each cell.

Thrun, Burgard and Fox, "Probabilistic Robotics", section 6.4: a point scores by its distance to the nearest
occupied cell, exp(-d^2 / 2 sigma^2). Scan matching on it needs no correspondences.
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
        """`neutral` in the units of `LikelihoodField.values`."""
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
    def of(
        grid: OccupancyGrid, parameters: LikelihoodParameters = LIKELIHOOD, *, margin_m: float = 0.0
    ) -> LikelihoodField:
        """The field of a grid, with `margin_m` of unknown cells added on each side."""
        padded = padded_grid(grid, margin_m)
        occupied = padded.occupied
        return LikelihoodField.around(
            occupied, occupied | padded.free, padded.resolution_m, padded.origin_m, parameters
        )

    @staticmethod
    def around(
        occupied: BoolGrid,
        known: BoolGrid,
        resolution_m: float,
        origin_m: tuple[float, float],
        parameters: LikelihoodParameters = LIKELIHOOD,
    ) -> LikelihoodField:
        """The field of a mask (H, W) of occupied cells, `known` (H, W) being those observed at all."""
        values = np.zeros(occupied.shape, np.uint8)
        if occupied.any():
            distance = cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            # Farther away than this the likelihood is below 1/255.
            sigma_cells = parameters.sigma_m / resolution_m
            near = distance < sigma_cells * math.sqrt(2.0 * math.log(255.0))
            values[near] = np.exp(-0.5 * (distance[near] / sigma_cells) ** 2) * 255.0
        values[~known] = np.maximum(values[~known], parameters.neutral_value)
        return LikelihoodField(values=values, known=known, resolution_m=resolution_m, origin_m=origin_m)

    def at(self, points_m: NDArray[np.floating], *, above: bool = False) -> tuple[F32, NDArray[np.bool_]]:
        """Likelihood (N,) 0..1 in the cells of points (N, 2), and whether these cells are known (N,).

        Both are 0 outside the field. above : the field is of a higher plane than the points. Its walls stand
        on the floor, but its free space passes over things, so that only ground near walls is known.
        """
        height, width = self.values.shape
        cells = np.floor((points_m - np.asarray(self.origin_m)) / self.resolution_m).astype(np.int64)
        column, row = cells[:, 0], cells[:, 1]
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        flat = np.where(inside, row * width + column, 0)
        known = inside & self.known.reshape(-1)[flat]
        values = np.where(inside, self.values.reshape(-1)[flat], 0)
        if above:
            known &= values > LIKELIHOOD.neutral_value
        return values * np.float32(1.0 / 255.0), known


def padded_grid(grid: OccupancyGrid, margin_m: float) -> OccupancyGrid:
    """The grid with `margin_m`, rounded to whole cells, of unknown cells on each side."""
    n = round(margin_m / grid.resolution_m)
    if not n:
        return grid
    return replace(
        grid,
        cells=np.pad(grid.cells, n, constant_values=UNKNOWN),
        heights=None if grid.heights is None else np.pad(grid.heights, n),
        origin_m=(grid.origin_m[0] - n * grid.resolution_m, grid.origin_m[1] - n * grid.resolution_m),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class WallParameters:
    """How wall points are chosen and weighted.

    spacing_m : one point is kept in each square of this side; chosen by hand, twice the usual cell.
    grain_cells : things are smoothed by a median over squares of so many cells. Chosen by hand.
    plane_m : planes so far above each other show different things: one a table, the other what is over it.
        Chosen by hand.
    fixed_m : an object at least this long is taken to stay where it is: longer than furniture that is moved
        about. Chosen by hand.
    movable : weight of a thing beside that of a wall. Chosen by hand: with a quarter, and with 1, one or two
        windows less are located of a room whose chairs have been moved, and none is wrong.
    """

    spacing_m: float = 0.1
    grain_cells: int = 5
    plane_m: float = 0.5
    fixed_m: float = 2.0
    movable: float = 0.5


WALLS = WallParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Walls:
    """A grid prepared for alignment.

    field : likelihood field of what stands at any height.
    points_m : (K, 2) float32 centres of the cells that something stands in, of what is solid those along its
        edges, one per square of `WallParameters.spacing_m`, in the grid's frame.
    before_m : (K, 2) float32, points on the ground in front of them, on which the other side is asked for
        what it knows; `points_m` themselves if it does not matter which side of a wall was seen.
    weights : (K,) float32, 0..1, how surely each of them stays where it is, see `steadiness`.
    height_m : see `OccupancyGrid.height_m`.
    at_all_heights : with the points of what no ray was seen to pass, at any height; None if the grid does not
        tell heights.
    only_explain : whether the other side need not have seen these points, wherever it sees free space.
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
        parameters: WallParameters = WALLS,
        *,
        margin_m: float = 0.0,
        drawn: bool = False,
    ) -> Walls:
        """Prepare a grid; the field gets `margin_m` of unknown cells on each side.

        drawn : of a map that somebody else made, without what no ray can have ended in, see `_seen`.
        """
        grid = padded_grid(grid, margin_m)
        if grid.heights is None:
            stands = _seen(grid) if drawn else grid.occupied
            return Walls._of(grid, stands, stands, parameters)
        stands = grid.occupied | _things(grid, parameters)
        never_passed = stands & (grid.heights < 1 << SLICES)
        return replace(
            Walls._of(grid, stands, _edges(stands), parameters),
            at_all_heights=Walls._of(grid, stands, _edges(never_passed), parameters),
        )

    @staticmethod
    def _of(grid: OccupancyGrid, stands: BoolGrid, shown: BoolGrid, parameters: WallParameters) -> Walls:
        """stands, shown : (H, W) the cells of the field, and those of the points."""
        cells = cells_of(shown)
        cells = cells[thin_evenly(grid.to_point(cells), parameters.spacing_m)]
        points_m = grid.to_point(cells).astype(np.float32)
        weights = steadiness(shown, cells, grid.resolution_m, parameters)
        weights[grid.things[cells[:, 0], cells[:, 1]]] *= parameters.movable
        return Walls(
            field=LikelihoodField.around(
                stands, stands | grid.occupied | grid.free, grid.resolution_m, grid.origin_m
            ),
            points_m=points_m,
            before_m=points_m,
            weights=weights,
            height_m=grid.height_m,
        )

    def facing(self, other: Walls) -> Walls:
        """The walls as they are compared with the other side.

        A side that tells heights has looked at all of them, and must have seen all that stands. One that does
        not tell them may be a laser, which sees a single plane: it must have seen what stands at all heights,
        and of a table nothing. If that plane is known to be clearly above the one of these walls, it need not
        have seen any of them. It is not known of a laser that tf does not lift above its base.
        """
        walls = self.at_all_heights if other.at_all_heights is None else self
        above_m = (other.height_m or math.nan) - (self.height_m or math.nan)
        return replace(walls or self, only_explain=above_m > WALLS.plane_m)

    def seen_from(self, free: F32) -> Walls:
        """The walls with the ground in front of them, on the side that they were seen from.

        free : (H, W) where the ground is free, 0..1, on the cells of the field. Blurred, because that of a
        single scan consists of thin rays, its gradient points to that side. The points lie two standard
        deviations of the field from the wall, so that one drawn a little off does not hide them.
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
        """The number of wall points, by weight."""
        return float(self.weights.sum(dtype=np.float64))


def _things(grid: OccupancyGrid, parameters: WallParameters) -> BoolGrid:
    """(H, W) the things of a grid without grains of noise: the middle value around each cell."""
    things: BoolGrid = cv2.medianBlur(grid.things.astype(np.uint8), parameters.grain_cells) > 0
    return things


def _seen(grid: OccupancyGrid) -> BoolGrid:
    """The occupied cells (H, W) that a ray can have ended in: no deeper behind the face of a wall than the
    field's standard deviation. In the thick walls of a drawn map, whatever a query has seen would fit.

    A wall that no free ground is known before has no face, and stays as it is.
    """
    cells = cv2.distanceTransform((~grid.free).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    near = grid.occupied & (cells - 1.0 < LIKELIHOOD.sigma_m / grid.resolution_m)
    count, labels = cv2.connectedComponents(grid.occupied.astype(np.uint8), connectivity=8)
    with_face = np.zeros(count, bool)
    with_face[labels[near]] = True
    seen: BoolGrid = near | (grid.occupied & ~with_face[labels])
    return seen


def _edges(stands: BoolGrid) -> BoolGrid:
    """The cells (H, W) of what stands without those that have all their neighbours in it: nothing sees
    these."""
    inside: BoolGrid = cv2.erode(stands.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return stands & ~inside


def steadiness(
    occupied: BoolGrid, cells: I64, resolution_m: float, parameters: WallParameters = WALLS
) -> F32:
    """How surely the objects in `cells` (K, 2; row, column) stay where they are: (K,) 0..1.

    The longer side of the connected object that a cell belongs to, as a share of `fixed_m`, at most 1. Gaps
    of up to two cells are closed first.
    """
    closed = cv2.dilate(occupied.astype(np.uint8), np.ones((3, 3), np.uint8))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    longer = boxes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    extent_m = longer[labels[cells[:, 0], cells[:, 1]]] * resolution_m
    return np.asarray(np.minimum(extent_m / parameters.fixed_m, 1.0), np.float32)


def thin_evenly(points_m: NDArray[np.floating], spacing_m: float) -> NDArray[np.intp]:
    """Indices (K,), ascending, of the first of the points (N, 2) in each square of `spacing_m`."""
    squares = np.floor(np.asarray(points_m) / spacing_m).astype(np.int64)
    if not len(squares):
        return np.empty(0, np.intp)
    squares -= squares.min(axis=0)
    numbers = squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1]
    return np.sort(np.unique(numbers, return_index=True)[1])
