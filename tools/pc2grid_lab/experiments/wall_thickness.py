"""How thick a map draws its walls: poses that err draw a wall several times, side by side.

Around each point of a wall the direction of the wall is that of the largest variance of what is occupied.
Across it, the occupied cells are counted by their distance; the thickness is the full width at half of the
largest count, from the first line that reaches it to the last one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pc2grid.arrays import F64, cells_of
from pc2grid.matching.walls import steadiness, thin_evenly
from pc2grid.model import OccupancyGrid


@dataclass(frozen=True, slots=True, kw_only=True)
class ThicknessParameters:
    """What is measured. All chosen by hand.

    around_m : radius around a point. straight : largest share of the variance across a wall in that along
        it: of 1 m of a wall that is 0.4 m thick it is a sixth; at corners it is about 1.
    spacing_m : between two points.
    """

    around_m: float = 0.5
    straight: float = 0.3
    spacing_m: float = 0.2


THICKNESS = ThicknessParameters()


def wall_thickness(grid: OccupancyGrid, parameters: ThicknessParameters = THICKNESS) -> F64:
    """The thickness (N,) of the straight walls of a map at points along them, metres.

    What is shorter than `pc2grid.matching.walls.WallParameters.fixed_m` is no wall.

    >>> import numpy as np
    >>> cells = np.zeros((40, 100), np.int8)
    >>> cells[[10, 12]] = 100  # one wall that is drawn twice, 0.1 m apart
    >>> grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    >>> float(np.median(wall_thickness(grid)).round(2))
    0.15
    """
    p = parameters
    cells = cells_of(grid.occupied)
    points_m = grid.to_point(cells)
    steady = np.flatnonzero(steadiness(grid.occupied, cells, grid.resolution_m) >= 1.0)
    at = steady[thin_evenly(points_m[steady], p.spacing_m)]
    found = []
    for near in cKDTree(points_m).query_ball_point(points_m[at], p.around_m) if len(at) else ():
        away_m = points_m[near] - points_m[near].mean(axis=0)
        variance, axes = np.linalg.eigh(away_m.T @ away_m)
        if variance[0] <= p.straight * variance[1]:
            # Of a disc, the part in which walls up to 0.8 of its radius are as long as in the middle.
            middle = np.abs(away_m @ axes[:, 1]) <= 0.6 * p.around_m
            across = np.rint(away_m[middle] @ axes[:, 0] / grid.resolution_m).astype(int)
            count = np.bincount(across - across.min())
            lines = np.flatnonzero(count >= 0.5 * count.max())
            found.append((lines[-1] - lines[0] + 1) * grid.resolution_m)
    return np.array(found)
