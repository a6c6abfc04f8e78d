"""The maps of joined sessions as one: in each cell the newest session that is sure of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import hand_over
from pc2grid.geometry import SE2
from pc2grid.model import FREE, FREE_BELOW, OCCUPIED_FROM, THING, UNKNOWN, OccupancyGrid


def building_map(maps: Sequence[tuple[OccupancyGrid, SE2]]) -> OccupancyGrid:
    """The maps of sessions, oldest first, each with its T_building_session, as one in the building's frame.

    Cells are as large as those of the first map; each is what the newest map says that is sure of its centre
    (free, occupied, or a thing); where none is sure, the oldest that knows it.
    Raises ValueError without a map.

    >>> import pc2grid
    >>> plan = pc2grid.load_map("map.yaml")
    >>> moved = building_map([(plan, SE2(10.0, 0.0, 0.0))])
    >>> round(moved.free_m2 / plan.free_m2, 2), round(moved.origin_m[0] - plan.origin_m[0], 2)
    (1.0, 10.0)
    """
    if not maps:
        raise ValueError("a building without a map")
    cell_m = maps[0][0].resolution_m
    corners_m = np.concatenate([T.apply(_corners(grid)) for grid, T in maps])
    low = np.floor(corners_m.min(axis=0) / cell_m + 1e-6)
    width, height = (np.ceil(corners_m.max(axis=0) / cell_m - 1e-6) - low).astype(int).tolist()
    cells = np.full((height, width), UNKNOWN, np.int8)
    x, y = (low * cell_m).tolist()
    origin_m = (float(x), float(y))
    whole = OccupancyGrid(cells=cells, resolution_m=cell_m, origin_m=origin_m)
    for grid, T_building_session in maps:
        rows, columns = _covered(whole, T_building_session.apply(_corners(grid)))
        at = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
        told = _cells_at(grid, T_building_session.inverse().apply(whole.to_point(at.reshape(-1, 2))))
        window = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        told = told.reshape(window.shape)
        sure = (told >= OCCUPIED_FROM) | (told == THING) | ((told >= FREE) & (told < FREE_BELOW))
        chosen = sure | ((told != UNKNOWN) & (window == UNKNOWN))
        window[chosen] = told[chosen]
    return OccupancyGrid(cells=hand_over(cells), resolution_m=cell_m, origin_m=origin_m)


def _corners(grid: OccupancyGrid) -> NDArray[np.float64]:
    """(4, 2) of a map, in its frame."""
    height, width = grid.cells.shape
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.float64)
    return corners * grid.resolution_m + grid.origin_m


def _covered(
    whole: OccupancyGrid, corners_m: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of a grid that a box with these corners may lie in."""
    at = whole.to_cell(corners_m)
    low, high = at.min(axis=0).clip(min=0), at.max(axis=0).clip(max=np.array(whole.cells.shape) - 1)
    return np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)


def _cells_at(grid: OccupancyGrid, points_m: NDArray[np.float64]) -> NDArray[np.int8]:
    """The cells (N,) of a grid at points (N, 2); unknown outside."""
    at = grid.to_cell(points_m)
    inside = ((at >= 0) & (at < grid.cells.shape)).all(axis=1)
    found = np.full(len(at), UNKNOWN, np.int8)
    found[inside] = grid.cells[tuple(at[inside].T)]
    return found
