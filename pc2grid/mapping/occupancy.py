"""Planar scans with poses -> log-odds occupancy grid.

The grid consists of tiles that are created where something was observed, so a long corridor needs no memory
for the empty rectangle around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import I64, SUBPIXEL_BITS, U8, polygon_corners
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.config import ProjectionConfig
from pc2grid.errors import LimitExceeded
from pc2grid.geometry import SE2
from pc2grid.model import FREE, OCCUPIED, THING, UNKNOWN, OccupancyGrid


@dataclass(frozen=True, slots=True, kw_only=True)
class OccupancyParameters:
    """Numbers of the occupancy grid; chosen by hand, checked on simulated drives.

    hit, miss, limit : log-odds in hundredths, as int16 adds them. One hit makes a cell occupied by nav2's
        threshold, two misses make it free. A hit weighs two misses, so a thin wall that passing rays graze
        stays; three misses clear a person who has left.
    body_m : radius of the robot's body around the origin of the base, where no obstacle can be.
    lone_window, lone_cells : a cell that was hit once is noise if at least `lone_cells` cells in the square
        of `lone_window` around it were hit more often.
    merged : marks of cells that are collected before each cell is reduced to one entry.
    """

    hit: int = 150
    miss: int = -75
    limit: int = 500
    body_m: float = 0.15
    lone_window: int = 3
    lone_cells: int = 3
    merged: int = 200_000


OCCUPANCY = OccupancyParameters()

_TILE = 256  # cells along the edge of a tile
_COLUMN_OFFSET = 1 << 31  # makes column numbers positive, so that row and column fit into one int64


class _Tiles:
    """Log-odds in hundredths, in tiles that are created where there is something to add.

    log_odds, observed : tiles by the row and column of a tile; `observed` is what something was added to.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.log_odds: dict[tuple[int, int], NDArray[np.int16]] = {}
        self.observed: dict[tuple[int, int], NDArray[np.bool_]] = {}

    def add(self, update: NDArray[np.int16], x0: int, y0: int) -> None:
        """Add log-odds (h, w), whose first cell is in column `x0` and row `y0`."""
        height, width = update.shape
        for row in range(y0 // _TILE, (y0 + height - 1) // _TILE + 1):
            for column in range(x0 // _TILE, (x0 + width - 1) // _TILE + 1):
                r, c = row * _TILE - y0, column * _TILE - x0
                part = update[max(r, 0) : max(r + _TILE, 0), max(c, 0) : max(c + _TILE, 0)]
                touched = part != 0
                if not touched.any():
                    continue
                if (row, column) not in self.log_odds:
                    self.log_odds[row, column] = np.zeros((_TILE, _TILE), dtype=np.int16)
                    self.observed[row, column] = np.zeros((_TILE, _TILE), dtype=np.bool_)
                where = np.s_[
                    max(-r, 0) : max(-r, 0) + part.shape[0], max(-c, 0) : max(-c, 0) + part.shape[1]
                ]
                tile = self.log_odds[row, column][where]
                np.clip(tile + part, -self._limit, self._limit, out=tile)
                self.observed[row, column][where] |= touched


class _Marks:
    """A byte for each of some cells, of which bits are set; memory grows with these cells, not with the
    number of times that they are marked.

    at_once : marks that are collected before each cell is reduced to one entry.
    """

    def __init__(self, at_once: int) -> None:
        self._at_once = at_once
        self._kept: list[tuple[I64, U8]] = [(np.empty(0, np.int64), np.empty(0, np.uint8))]

    def add(self, cells: I64, bits: U8) -> None:
        """Set bits (N,) of cells (N, 2), column and row."""
        self._kept.append(((cells[:, 1] << 32) + (cells[:, 0] + _COLUMN_OFFSET), bits))
        if sum(len(codes) for codes, _ in self._kept[1:]) > self._at_once:
            self._merge()

    def within(self, first: tuple[int, int], shape: tuple[int, ...]) -> tuple[I64, I64, U8]:
        """Rows, columns and bits (N,) of the marked cells of a window; `first` is the cell (0, 0) there."""
        codes, bits = self._merge()
        rows, columns = (
            (codes >> 32) - first[0],
            (codes & (2 * _COLUMN_OFFSET - 1)) - _COLUMN_OFFSET - first[1],
        )
        inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
        return rows[inside], columns[inside], bits[inside]

    def _merge(self) -> tuple[I64, U8]:
        codes, bits = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
        order = np.argsort(codes, kind="stable")
        unique, starts = np.unique(codes[order], return_index=True)
        self._kept = [(unique, np.bitwise_or.reduceat(bits[order], starts) if len(starts) else bits)]
        return self._kept[0]


class GridBuilder:
    """Draws planar scans into a growing grid.

    Cells are aligned to multiples of the resolution in the session's frame. A cell that no planar scan
    observed stays unknown. Things on the floor that are no walls have evidence of their own: what was taken
    for a wall until rays passed over it becomes a thing.
    """

    def __init__(self, config: ProjectionConfig, parameters: OccupancyParameters = OCCUPANCY) -> None:
        self._config = config
        self._parameters = parameters
        self._walls, self._things = _Tiles(parameters.limit), _Tiles(parameters.limit)
        self._heights_m: tuple[float, float] | None = None  # lowest and highest plane; NaN: not of planes
        self._heights = _Marks(parameters.merged)

    def add(self, planar_scan: PlanarScan, T_grid_base: SE2) -> None:
        """Draw one planar scan taken at `T_grid_base`.

        Raises LimitExceeded if the map needs more than `max_cells`.
        """
        height_m = math.nan if planar_scan.height_m is None else planar_scan.height_m
        low_m, high_m = self._heights_m or (height_m, height_m)
        self._heights_m = float(np.minimum(low_m, height_m)), float(np.maximum(high_m, height_m))
        p, resolution = self._parameters, self._config.resolution_m
        outline = T_grid_base.apply(planar_scan.free_polygon()) / resolution
        hits = np.floor(T_grid_base.apply(planar_scan.hits_m) / resolution).astype(np.int64)
        low = np.floor(outline.min(axis=0)).astype(np.int64) - 1
        high = np.floor(outline.max(axis=0)).astype(np.int64) + 2
        here = np.floor(np.array([T_grid_base.x, T_grid_base.y]) / resolution).astype(np.int64)
        around = math.ceil(p.body_m / resolution) + 1
        low, high = np.minimum(low, here - around), np.maximum(high, here + around + 1)
        if len(hits):
            low, high = np.minimum(low, hits.min(axis=0)), np.maximum(high, hits.max(axis=0) + 1)
        update = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.int16)
        corners = polygon_corners(outline - low)
        cv2.fillPoly(update, [corners], p.miss, shift=SUBPIXEL_BITS)
        # The outline runs through cells of obstacles, most of all along a wall that is seen at a small angle:
        # these cells are not drawn as free.
        cv2.polylines(update, _rims(corners, planar_scan.free_m), False, 0, shift=SUBPIXEL_BITS)
        things = np.floor(T_grid_base.apply(planar_scan.low_m) / resolution).astype(np.int64)
        if len(planar_scan.heights):
            self._heights.add(np.concatenate((hits, things)), planar_scan.heights)
        things = things[((things >= low) & (things < high)).all(axis=1)] - low
        update[things[:, 1], things[:, 0]] = p.miss
        update[hits[:, 1] - low[1], hits[:, 0] - low[0]] = p.hit
        cv2.circle(update, (here - low).tolist(), round(p.body_m / resolution), 2 * p.miss, -1)
        if len(things) or self._things.log_odds:
            standing = np.where(update != 0, np.int16(p.miss), np.int16(0))
            standing[things[:, 1], things[:, 0]] = p.hit
            standing[update > 0] = p.miss
            self._things.add(standing, int(low[0]), int(low[1]))
        self._walls.add(update, int(low[0]), int(low[1]))
        self._check_size(len(self._walls.log_odds) * _TILE * _TILE)

    def grid(self) -> OccupancyGrid:
        """The map so far: 0..100 where observed, unknown elsewhere, cropped to the observed part."""
        tiles = self._walls.log_odds
        if not tiles:
            return OccupancyGrid(
                cells=np.zeros((0, 0), np.int8), resolution_m=self._config.resolution_m, origin_m=(0.0, 0.0)
            )
        rows, columns = zip(*tiles, strict=True)
        height = (max(rows) - min(rows) + 1) * _TILE
        width = (max(columns) - min(columns) + 1) * _TILE
        self._check_size(height * width)
        cells = np.full((height, width), UNKNOWN, dtype=np.int8)
        summed = np.zeros((height, width), dtype=np.int16)
        for (row, column), log_odds in tiles.items():
            percent = np.rint(_percent(log_odds.astype(np.float32))).astype(np.int8)
            known = np.where(self._walls.observed[row, column], percent, UNKNOWN)
            if (row, column) in self._things.log_odds:
                things = self._things.log_odds[row, column]
                known[(things > 0) & (things >= log_odds)] = THING
            r, c = (row - min(rows)) * _TILE, (column - min(columns)) * _TILE
            cells[r : r + _TILE, c : c + _TILE] = known
            summed[r : r + _TILE, c : c + _TILE] = log_odds
        self._erase_lone_hits(cells, summed)
        known_rows = np.flatnonzero((cells >= FREE).any(axis=1))
        known_columns = np.flatnonzero((cells >= FREE).any(axis=0))
        r0, r1 = int(known_rows[0]), int(known_rows[-1]) + 1
        c0, c1 = int(known_columns[0]), int(known_columns[-1]) + 1
        resolution = self._config.resolution_m
        shape = r1 - r0, c1 - c0
        at_row, at_column, bits = self._heights.within(
            (min(rows) * _TILE + r0, min(columns) * _TILE + c0), shape
        )
        heights = np.zeros(shape, np.uint8) if len(bits) else None
        if heights is not None:
            heights[at_row, at_column] = bits
        return OccupancyGrid(
            cells=cells[r0:r1, c0:c1].copy(),
            heights=heights,
            resolution_m=resolution,
            origin_m=((min(columns) * _TILE + c0) * resolution, (min(rows) * _TILE + r0) * resolution),
            height_m=self._height_m,
        )

    @property
    def _height_m(self) -> float | None:
        """Of the plane that all planar scans are of; None if they are not of one."""
        low_m, high_m = self._heights_m or (math.nan, math.nan)
        return low_m if high_m - low_m < self._config.resolution_m else None

    def _erase_lone_hits(self, cells: NDArray[np.int8], log_odds: NDArray[np.int16]) -> None:
        """Make cells (H, W) unknown that were hit once, never observed free, beside cells hit more often.

        Such a hit is a return one cell in front of its wall. No later ray clears it, because the wall stops
        all of them.
        """
        hit = self._parameters.hit
        often = _count_around(log_odds > hit, self._parameters.lone_window)
        cells[(log_odds == hit) & (often >= self._parameters.lone_cells)] = UNKNOWN

    def _check_size(self, cells: int) -> None:
        if cells > self._config.max_cells:
            raise LimitExceeded(
                f"the map needs {cells} cells, more than projection.max_cells = {self._config.max_cells}",
                hint="raise projection.max_cells, or choose a coarser projection.resolution_m",
            )


def _percent(log_odds: NDArray[np.floating] | np.floating) -> NDArray[np.floating]:
    """Log-odds in hundredths as a probability in percent."""
    return np.asarray(OCCUPIED / (1.0 + np.exp(-log_odds / np.float32(100.0))))


def _count_around(mask: NDArray[np.bool_], width: int) -> NDArray[np.uint8]:
    """Number of cells of the mask (H, W) in the square of `width` cells around each cell."""
    return np.asarray(
        cv2.boxFilter(
            mask.astype(np.uint8), -1, (width, width), normalize=False, borderType=cv2.BORDER_CONSTANT
        ),
        np.uint8,
    )


def _rims(corners: NDArray[np.int32], free_m: NDArray[np.float32]) -> list[NDArray[np.int32]]:
    """The parts of an outline (B, 2) at known ranges; elsewhere the outline runs through the sensor."""
    known = np.flatnonzero(free_m > 0)
    if len(known) == len(free_m):
        return [np.concatenate((corners, corners[:1]))]
    runs = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    return [corners[run] for run in runs if len(run)]
