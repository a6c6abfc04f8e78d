"""A grid as what two maps are compared by: wall points, how surely they stay, and a likelihood field.

Small things that stand alone may have been moved between two visits, walls stay. So a wall point counts by
the size of the connected object that it belongs to.

A wall has two sides. The outer wall of a building, mapped from its rooms and seen from the street, is one
line in both grids, but nothing that both have seen. So the walls of a query keep the ground in front of them,
on the side that they were seen from (`seen_from`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, U8, BoolGrid, cells_of
from pc2grid.matching.likelihood_field import LIKELIHOOD, LikelihoodField, padded_grid
from pc2grid.model import FREE, OCCUPIED, SLICES, UNKNOWN, OccupancyGrid


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
_ANY_HEIGHT = (1 << SLICES) - 1
"""What stands at heights that are not known is compared at all of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Slice:
    """What stands in a slice of heights, walls and things. A counter is a wall if only its front is seen, a
    thing if the camera looks over it; below its top both views agree.

    field : likelihood field of the cells that are occupied there; known are those, and those observed to be
        free there.
    points_m, weights : middles of the cells along the edges, thinned and weighted as those of `Walls`; a cell
        that is occupied in several slices counts once.
    """

    field: LikelihoodField
    points_m: F32
    weights: F32

    @staticmethod
    def all_of(grid: OccupancyGrid, parameters: WallParameters = WALLS) -> tuple[Slice, ...]:
        """The slices of a grid, lowest first; none if it does not tell heights."""
        if grid.heights is None:
            return ()
        things = _things(grid, parameters)
        standing, passed = _standing(grid, things)
        count = sum((standing >> k & 1).astype(np.uint8) for k in range(SLICES))
        weight = np.where(things, parameters.movable, 1.0) / np.maximum(count, 1)
        return tuple(
            Slice._of(grid, (standing >> k & 1) > 0, (passed >> k & 1) > 0, weight, parameters)
            for k in range(SLICES)
        )

    @staticmethod
    def _of(grid: OccupancyGrid, stands: BoolGrid, passed: BoolGrid, weight: F64, p: WallParameters) -> Slice:
        """One slice. stands : (H, W) cells that are occupied there. passed : those of cells with something at
        another height that are free there. weight : of each cell."""
        cells = cells_of(stands & ~_inside(stands))
        cells = cells[thin_evenly(grid.to_point(cells), p.spacing_m)]
        steady = steadiness(stands, cells, grid.resolution_m, p) * weight[cells[:, 0], cells[:, 1]]
        known = stands | passed | grid.free
        return Slice(
            field=LikelihoodField.around(stands, known, grid.resolution_m, grid.origin_m),
            points_m=grid.to_point(cells).astype(np.float32),
            weights=steady.astype(np.float32),
        )

    @property
    def before_m(self) -> F32:
        """As `Walls.before_m`: which side of them was seen does not matter, as their heights are known."""
        return self.points_m

    @property
    def weight(self) -> float:
        """The number of points, by weight."""
        return float(self.weights.sum(dtype=np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class Walls:
    """A grid prepared for alignment.

    field : its likelihood field.
    points_m : (K, 2) float32 centres of occupied cells, one per square of `WallParameters.spacing_m`, in the
        grid's frame.
    before_m : (K, 2) float32, points on the ground in front of them, on which the other side is asked for
        what it knows; `points_m` themselves if it does not matter which side of a wall was seen.
    weights : (K,) float32, 0..1, how surely each of them stays where it is, see `steadiness`.
    slices : what stands at each height; empty if the grid does not tell.
    height_m : see `OccupancyGrid.height_m`.
    """

    field: LikelihoodField
    points_m: F32
    before_m: F32
    weights: F32
    slices: tuple[Slice, ...] = ()
    height_m: float | None = None

    @staticmethod
    def of(grid: OccupancyGrid, parameters: WallParameters = WALLS, *, margin_m: float = 0.0) -> Walls:
        """Prepare a grid; the field gets `margin_m` of unknown cells on each side."""
        padded = padded_grid(grid, margin_m)
        cells = cells_of(padded.occupied)
        cells = cells[thin_evenly(padded.to_point(cells), parameters.spacing_m)]
        points_m = padded.to_point(cells).astype(np.float32)
        return Walls(
            field=LikelihoodField.of(padded),
            points_m=points_m,
            before_m=points_m,
            weights=steadiness(padded.occupied, cells, padded.resolution_m, parameters),
            slices=Slice.all_of(padded, parameters),
            height_m=grid.height_m,
        )

    def seen_from(self, free: F32) -> Walls:
        """The walls with the ground in front of them, on the side that they were seen from.

        free : (H, W) where the ground is free, 0..1, on the cells of the field. Blurred, because that of a
        single scan consists of thin rays, its gradient points to that side. The points lie two standard
        deviations of the field from the wall, so that one drawn a little off does not hide them.
        """
        import cv2

        cells = np.floor((self.points_m - np.asarray(self.field.origin_m)) / self.field.resolution_m)
        column, row = cells.astype(np.int64).T
        blurred = cv2.GaussianBlur(free, (0, 0), LIKELIHOOD.sigma_m / self.field.resolution_m)
        gradient = np.stack(
            [cv2.Sobel(blurred, cv2.CV_32F, dx, 1 - dx)[row, column] for dx in (1, 0)], axis=1
        )
        length = np.maximum(np.hypot(*gradient.T), np.finfo(np.float32).tiny)
        away_m = 2.0 * LIKELIHOOD.sigma_m * gradient / length[:, None]
        return replace(self, before_m=(self.points_m + away_m).astype(np.float32))

    def is_above(self, height_m: float | None) -> bool:
        """Whether these are walls of one plane that is clearly higher than another plane."""
        if self.height_m is None or height_m is None:
            return False
        return self.height_m - height_m > WALLS.plane_m

    @property
    def weight(self) -> float:
        """The number of wall points, by weight."""
        return float(self.weights.sum(dtype=np.float64))


def comparable(target: Walls, query: Walls) -> tuple[tuple[Walls | Slice, Walls | Slice], ...]:
    """The parts of two maps that are compared: their slices if both have some, else all heights in one."""
    return tuple(zip(target.slices, query.slices, strict=False)) or ((target, query),)


def at_all_heights(grid: OccupancyGrid, parameters: WallParameters = WALLS) -> OccupancyGrid:
    """What any planar laser sees of a grid that tells heights, whatever its own height: what stands somewhere
    and no ray was seen to pass. What stands at some heights only is unknown: things, which are moved about.
    """
    standing, passed = _standing(grid, _things(grid, parameters))
    stands = (standing > 0) & (passed == 0)
    cells = np.full(grid.cells.shape, UNKNOWN, np.int8)
    cells[grid.free] = FREE
    cells[stands & ~_inside(stands)] = OCCUPIED
    return replace(grid, cells=cells, heights=None)


def _standing(grid: OccupancyGrid, things: BoolGrid) -> tuple[U8, U8]:
    """(H, W) each: the slices in which something was seen to stand in a cell, and those in which rays have
    passed it. Where the heights of what stands are not known, it stands in all of them. things : (H, W), see
    `_things`."""
    assert grid.heights is not None
    heights = np.where(grid.heights, grid.heights, np.uint8(_ANY_HEIGHT))
    heights[~(grid.occupied | things)] = 0
    return heights & np.uint8(_ANY_HEIGHT), heights >> np.uint8(SLICES)


def _things(grid: OccupancyGrid, parameters: WallParameters) -> BoolGrid:
    """(H, W) the things of a grid without grains of noise: the middle value around each cell."""
    import cv2

    things: BoolGrid = cv2.medianBlur(grid.things.astype(np.uint8), parameters.grain_cells) > 0
    return things


def _inside(stands: BoolGrid) -> BoolGrid:
    """The cells (H, W) of things that have all their neighbours in them: nothing sees these."""
    import cv2

    inside: BoolGrid = cv2.erode(stands.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return inside


def steadiness(
    occupied: BoolGrid, cells: I64, resolution_m: float, parameters: WallParameters = WALLS
) -> F32:
    """How surely the objects in `cells` (K, 2; row, column) stay where they are: (K,) 0..1.

    The longer side of the connected object that a cell belongs to, as a share of `fixed_m`, at most 1. Gaps
    of up to two cells are closed first.
    """
    import cv2

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
