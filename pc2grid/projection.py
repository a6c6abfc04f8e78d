"""Sweeps with poses -> log-odds occupancy grid.

The grid is kept in tiles that come into being where something was seen, so a long corridor does not pay
for the empty rectangle around it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pc2grid.config import ProjectionConfig
from pc2grid.errors import LimitExceeded
from pc2grid.geometry import F64, SE2
from pc2grid.model import FREE, I64, OCCUPIED, UNKNOWN, OccupancyGrid
from pc2grid.sweep import Sweep

_TILE = 256
_SUBPIXEL = 4  # fractional bits of cv2's polygon corners
# Log-odds in hundredths, as int16. Two looks make a cell free by nav2's threshold, one hit makes it
# occupied. A hit weighs two misses, so a thin wall that passing rays graze stays, and a person who left is
# cleared by the third look.
_HIT = 150
_MISS = -75
_CLAMP = 500
_GLIMPSED = round(OCCUPIED / (1.0 + math.exp(-_HIT / 100.0)))
_HALF, _MANY_GLIMPSED = 1 << 31, 200_000
BODY_M = 0.15
"""Around the origin of the base nothing but the robot has room."""


class GridBuilder:
    """Draws sweeps into a growing grid.

    Cells are aligned to multiples of the resolution in the map frame. What no sweep looked at stays
    unknown.
    """

    def __init__(self, config: ProjectionConfig) -> None:
        self._config = config
        self._log_odds: dict[tuple[int, int], NDArray[np.int16]] = {}
        self._seen: dict[tuple[int, int], NDArray[np.bool_]] = {}
        self._glimpsed = np.empty(0, np.int64)  # cells, row and column in one number
        self._more_glimpsed: list[I64] = []

    def add(self, sweep: Sweep, T_map_base: SE2) -> None:
        """Draw one sweep taken at `T_map_base`. Raises LimitExceeded if the map grows past `max_cells`."""
        import cv2

        resolution = self._config.resolution_m
        outline = T_map_base.apply(sweep.free_polygon()) / resolution
        hits = np.floor(T_map_base.apply(sweep.hits_m) / resolution).astype(np.int64)
        low = np.floor(outline.min(axis=0)).astype(np.int64) - 1
        high = np.floor(outline.max(axis=0)).astype(np.int64) + 2
        here = np.floor(np.array([T_map_base.x, T_map_base.y]) / resolution).astype(np.int64)
        around = math.ceil(BODY_M / resolution) + 1
        low, high = np.minimum(low, here - around), np.maximum(high, here + around + 1)
        if len(hits):
            low, high = np.minimum(low, hits.min(axis=0)), np.maximum(high, hits.max(axis=0) + 1)
        update = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.int16)
        corners = np.rint((outline - low - 0.5) * (1 << _SUBPIXEL)).astype(np.int32)
        cv2.fillPoly(update, [corners], _MISS, shift=_SUBPIXEL)
        # The cells that the outline runs through belong to the obstacle, above all those of a wall that is
        # seen along itself.
        cv2.polylines(update, _rims(corners, sweep.free_m), False, 0, shift=_SUBPIXEL)
        update[hits[:, 1] - low[1], hits[:, 0] - low[0]] = _HIT
        # Where the robot is there is nothing else.
        cv2.circle(update, (here - low).tolist(), round(BODY_M / resolution), 2 * _MISS, -1)
        self._add_window(update, int(low[0]), int(low[1]))

    def glimpse(self, hits_m: F64) -> None:
        """Obstacles (N, 2) in the map frame that count only where no sweep says anything, now or later."""
        columns, rows = np.floor(hits_m / self._config.resolution_m).astype(np.int64).T
        self._more_glimpsed.append((rows << 32) + (columns + _HALF))
        if sum(map(len, self._more_glimpsed)) > _MANY_GLIMPSED:
            self._merge_glimpsed()

    def _merge_glimpsed(self) -> None:
        """Each cell once, so that they are as many as the area has, however often the robot comes by."""
        self._glimpsed = np.unique(np.concatenate((self._glimpsed, *self._more_glimpsed)))
        self._more_glimpsed = []

    def grid(self) -> OccupancyGrid:
        """The map so far: 0..100 where seen, unknown elsewhere, cropped to what was seen."""
        if not self._log_odds:
            return OccupancyGrid(
                cells=np.zeros((0, 0), np.int8), resolution_m=self._config.resolution_m, origin_m=(0.0, 0.0)
            )
        rows, columns = zip(*self._log_odds, strict=True)
        height = (max(rows) - min(rows) + 1) * _TILE
        width = (max(columns) - min(columns) + 1) * _TILE
        self._check_size(height * width)
        cells = np.full((height, width), UNKNOWN, dtype=np.int8)
        summed = np.zeros((height, width), dtype=np.int16)
        for (row, column), log_odds in self._log_odds.items():
            odds = log_odds.astype(np.float32) / 100.0
            percent = np.rint(OCCUPIED / (1.0 + np.exp(-odds))).astype(np.int8)
            r, c = (row - min(rows)) * _TILE, (column - min(columns)) * _TILE
            cells[r : r + _TILE, c : c + _TILE] = np.where(self._seen[row, column], percent, UNKNOWN)
            summed[r : r + _TILE, c : c + _TILE] = log_odds
        _erase_lone_hits(cells, summed)
        self._draw_glimpsed(cells, (min(rows) * _TILE, min(columns) * _TILE))
        known_rows = np.flatnonzero((cells >= FREE).any(axis=1))
        known_columns = np.flatnonzero((cells >= FREE).any(axis=0))
        r0, r1 = int(known_rows[0]), int(known_rows[-1]) + 1
        c0, c1 = int(known_columns[0]), int(known_columns[-1]) + 1
        resolution = self._config.resolution_m
        return OccupancyGrid(
            cells=cells[r0:r1, c0:c1].copy(),
            resolution_m=resolution,
            origin_m=((min(columns) * _TILE + c0) * resolution, (min(rows) * _TILE + r0) * resolution),
        )

    def _draw_glimpsed(self, cells: NDArray[np.int8], first: tuple[int, int]) -> None:
        """Put what was only glimpsed into unknown cells; `first` is the cell that is (0, 0) there.

        In front of a drawn wall it is the wall's noise; where a wall goes on or has a gap, fewer than five
        cells around are drawn.
        """
        self._merge_glimpsed()
        rows, columns = self._glimpsed >> 32, (self._glimpsed & (2 * _HALF - 1)) - _HALF
        at = np.column_stack((rows, columns)) - first
        row, column = at[((at >= 0) & (at < cells.shape)).all(axis=1)].T
        walls = _count_around(cells >= 65, 5)
        kept = (cells[row, column] == UNKNOWN) & (walls[row, column] < 5)
        cells[row[kept], column[kept]] = _GLIMPSED

    def _add_window(self, update: NDArray[np.int16], x0: int, y0: int) -> None:
        height, width = update.shape
        for row in range(y0 // _TILE, (y0 + height - 1) // _TILE + 1):
            for column in range(x0 // _TILE, (x0 + width - 1) // _TILE + 1):
                r, c = row * _TILE - y0, column * _TILE - x0
                part = update[max(r, 0) : max(r + _TILE, 0), max(c, 0) : max(c + _TILE, 0)]
                touched = part != 0
                if not touched.any():
                    continue
                if (row, column) not in self._log_odds:
                    self._check_size((len(self._log_odds) + 1) * _TILE * _TILE)
                    self._log_odds[row, column] = np.zeros((_TILE, _TILE), dtype=np.int16)
                    self._seen[row, column] = np.zeros((_TILE, _TILE), dtype=np.bool_)
                where = np.s_[
                    max(-r, 0) : max(-r, 0) + part.shape[0], max(-c, 0) : max(-c, 0) + part.shape[1]
                ]
                tile = self._log_odds[row, column][where]
                np.clip(tile + part, -_CLAMP, _CLAMP, out=tile)
                self._seen[row, column][where] |= touched

    def _check_size(self, cells: int) -> None:
        if cells > self._config.max_cells:
            raise LimitExceeded(
                f"the map needs {cells} cells, more than projection.max_cells = {self._config.max_cells}",
                hint="raise projection.max_cells, or choose a coarser projection.resolution_m",
            )


def _erase_lone_hits(cells: NDArray[np.int8], log_odds: NDArray[np.int16]) -> None:
    """Make unknown again what was hit once, and never looked through, beside a wall that was hit more often:
    a return that strayed a cell from it, and that no later ray can clear because the wall stops them all."""
    often = _count_around(log_odds > _HIT, 3)
    cells[(log_odds == _HIT) & (often >= 3)] = UNKNOWN


def _count_around(mask: NDArray[np.bool_], width: int) -> NDArray[np.uint8]:
    """How many cells of the mask are in the square of `width` cells around each cell (H, W)."""
    import cv2

    return np.asarray(
        cv2.boxFilter(
            mask.astype(np.uint8), -1, (width, width), normalize=False, borderType=cv2.BORDER_CONSTANT
        ),
        np.uint8,
    )


def _rims(corners: NDArray[np.int32], free_m: NDArray[np.float32]) -> list[NDArray[np.int32]]:
    """The parts of an outline (B, 2) where something was learned; elsewhere it runs through the sensor."""
    known = np.flatnonzero(free_m > 0)
    if len(known) == len(free_m):
        return [np.concatenate((corners, corners[:1]))]
    runs = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    return [corners[run] for run in runs if len(run)]
