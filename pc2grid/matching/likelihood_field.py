"""The likelihood field of a grid: how well a point of an obstacle fits at each cell.

Thrun, Burgard and Fox, "Probabilistic Robotics", section 6.4: a point scores by its distance to the nearest
occupied cell, exp(-d^2 / 2 sigma^2). Scan matching on it needs no correspondences.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, U8, BoolGrid
from pc2grid.model import UNKNOWN, OccupancyGrid


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
