"""Maps of parts of a small office, each turned and moved into a frame of its own."""

import cv2
import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import UNKNOWN, OccupancyGrid
from signature.join.join import JoinableMap
from tests.helpers.simulated_drives import RESOLUTION_M, building, office

WEST, EAST = (0.0, 0.0, 13.0, 14.0), (6.0, 0.0, 20.0, 14.0)
"""Two parts of the office (left, bottom, right, top; metres) that share its middle: a strip of 7 x 14 m."""
T_OFFICE_EAST = SE2(9.0, 2.0, 0.6)
"""The frame of the map of the east: not along the walls."""


def part(box: tuple[float, float, float, float], grid: OccupancyGrid | None = None) -> OccupancyGrid:
    """The plan, of which only a box is known."""
    grid = grid or office()
    left, bottom, right, top = (round(v / RESOLUTION_M) for v in box)
    cells = np.full(grid.cells.shape, UNKNOWN, np.int8)
    cells[bottom:top, left:right] = grid.cells[bottom:top, left:right]
    return OccupancyGrid(cells=cells, resolution_m=RESOLUTION_M, origin_m=grid.origin_m)


def in_frame(grid: OccupancyGrid, T_grid_frame: SE2) -> OccupancyGrid:
    """A map as it is drawn in another frame: every cell of it looks up the cell at its centre."""
    height, width = grid.cells.shape
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)]) * grid.resolution_m + grid.origin_m
    there = T_grid_frame.inverse().apply(corners)
    low, high = there.min(axis=0), there.max(axis=0)
    columns, rows = np.ceil((high - low) / grid.resolution_m).astype(int).tolist()
    empty = OccupancyGrid(
        cells=np.full((rows, columns), UNKNOWN, np.int8),
        resolution_m=grid.resolution_m,
        origin_m=(float(low[0]), float(low[1])),
    )
    centres = empty.to_point(np.argwhere(np.ones((rows, columns), bool)))
    at = (T_grid_frame.apply(centres) - grid.origin_m) / grid.resolution_m
    x, y = (at.T.reshape(2, rows, columns) - 0.5).astype(np.float32)
    cells = cv2.remap(grid.cells.astype(np.int16), x, y, cv2.INTER_NEAREST, borderValue=UNKNOWN)
    return OccupancyGrid(cells=cells.astype(np.int8), resolution_m=grid.resolution_m, origin_m=empty.origin_m)


def joinable(grid: OccupancyGrid) -> JoinableMap:
    return JoinableMap(building({"": grid}))
