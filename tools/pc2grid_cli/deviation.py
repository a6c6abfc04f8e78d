"""How exactly an answer is known, in text and pictures for people; JSON documents hold the covariance."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.arrays import F64


def deviation(covariance: F64, resolution_m: float, radius_m: float) -> tuple[float, float, float]:
    """Standard deviations of x, y (metres) and yaw (radians), but not less than the map can show.

    covariance : (3, 3), of the refinement alone: with thousands of wall points it gets far smaller than the
        error of the map. resolution_m : of the map; a position is given no finer than half a cell.
    radius_m : of the submaps; a heading is given no finer than the angle that moves a wall so far away by
        half a cell.

    >>> [round(float(v), 4) for v in deviation(np.diag([1e-6, 0.04, 1e-8]), 0.05, 5.0)]
    [0.025, 0.2, 0.005]
    """
    half_cell_m = 0.5 * resolution_m
    x, y, yaw = np.sqrt(np.diag(covariance)).tolist()
    return max(x, half_cell_m), max(y, half_cell_m), max(yaw, math.atan(half_cell_m / radius_m))
