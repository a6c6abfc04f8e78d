"""Planar scans with poses -> log-odds occupancy grid.

The grid consists of tiles that are created where something was observed, so a long corridor needs no memory
for the empty rectangle around it.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import LimitExceeded
from pc2grid.geometry import I64, SE2, SUBPIXEL_BITS, polygon_corners
from pc2grid.model import FREE, OCCUPIED, THING, UNKNOWN, OccupancyGrid
from pc2grid.settings import ProjectionConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class OccupancyParameters:
    """Numbers of the occupancy grid; chosen by hand, checked on simulated drives.

    hit, miss, limit : log-odds in hundredths, as int16 adds them. One hit makes a cell occupied by nav2's
        threshold, two misses make it free. A hit weighs two misses, so a thin wall that passing rays graze
        stays; three misses clear a person who has left.
    body_m : radius of the robot's body around the origin of the base, which is free of obstacles.
    lone_window, lone_cells : a cell that was hit once is noise if at least `lone_cells` cells in the window
        of `lone_window` cells around it were hit more often.
    """

    hit: int = 150
    miss: int = -75
    limit: int = 500
    body_m: float = 0.15
    lone_window: tuple[int, int] = (3, 3)
    lone_cells: int = 3


OCCUPANCY = OccupancyParameters()
Slices = tuple[slice, slice]
"""Rows and columns of a part of an array."""


class GridBuilder:
    """Draws planar scans into a growing grid.

    Cells are aligned to multiples of the resolution in the session's frame. A cell that no planar scan
    observed stays unknown. Low obstacles have evidence of their own: what was taken for a wall until rays
    passed over it becomes a low obstacle.
    """

    def __init__(self, config: ProjectionConfig) -> None:
        self._config = config
        self._tiles: defaultdict[tuple[int, int], _Tile] = defaultdict(_Tile)
        self._things_seen = self._heights_seen = False
        self._planes_m = math.inf, -math.inf  # lowest and highest plane; NaN: not of planes

    def add(self, planar_scan: PlanarScan, T_grid_base: SE2) -> None:
        """Draw one planar scan taken at `T_grid_base`.

        Raises LimitExceeded if the map needs more than `max_cells`.
        """
        height_m = math.nan if planar_scan.height_m is None else planar_scan.height_m
        low_m, high_m = self._planes_m
        self._planes_m = float(np.minimum(low_m, height_m)), float(np.maximum(high_m, height_m))
        walls, hits, things, low = self._drawn(planar_scan, T_grid_base)
        standing, heights = np.zeros_like(walls), np.zeros(walls.shape, np.uint8)
        self._things_seen |= len(things) > 0
        if self._things_seen:
            standing[walls != 0] = OCCUPANCY.miss
            standing[things[:, 1], things[:, 0]] = OCCUPANCY.hit
            standing[walls > 0] = OCCUPANCY.miss
        if len(planar_scan.heights):
            self._heights_seen = True
            columns, rows = np.concatenate((hits, things)).T
            np.bitwise_or.at(heights, (rows, columns), planar_scan.heights)
        for number, of_tile, of_window in _under(low, walls.shape):
            touched = walls[of_window] != 0
            if touched.any():
                tile = self._tiles[number]
                tile.observed[of_tile] |= touched
                _sum(tile.walls[of_tile], walls[of_window])
                if self._things_seen:
                    _sum(tile.things[of_tile], standing[of_window])
                if self._heights_seen:
                    tile.heights[of_tile] |= heights[of_window]
        self._check_size(len(self._tiles) * _TILE * _TILE)

    def _drawn(self, planar_scan: PlanarScan, T_grid_base: SE2) -> tuple[NDArray[np.int16], I64, I64, I64]:
        """Return the log-odds (h, w) that a planar scan adds for walls, and the cells of its hits and low
        obstacles.

        The latter (M, 2) and (L, 2) are columns and rows of the window, whose first cell is at the last array
        (2,), column and row in the grid's frame.
        """
        p, resolution = OCCUPANCY, self._config.resolution_m
        outline = T_grid_base.apply(planar_scan.free_polygon()) / resolution
        hits, things = (
            np.floor(T_grid_base.apply(points_m) / resolution).astype(np.int64)
            for points_m in (planar_scan.hits_m, planar_scan.low_m)
        )
        here = np.floor(np.array([T_grid_base.x, T_grid_base.y]) / resolution).astype(np.int64)
        around = math.ceil(p.body_m / resolution) + 1
        edge = np.floor(outline).astype(np.int64)
        covered = np.concatenate((edge - 1, edge + 1, here[None] - around, here[None] + around, hits, things))
        low = covered.min(axis=0)
        columns, rows = (covered.max(axis=0) + 1 - low).tolist()
        update = np.zeros((rows, columns), dtype=np.int16)
        corners = polygon_corners(outline - low)
        cv2.fillPoly(update, [corners], p.miss, shift=SUBPIXEL_BITS)
        # The outline runs through cells of obstacles, most of all along a wall at a small angle to the view:
        # these cells are not drawn as free.
        cv2.polylines(update, _rims(corners, planar_scan.free_m), False, 0, shift=SUBPIXEL_BITS)
        hits, things = hits - low, things - low
        update[things[:, 1], things[:, 0]] = p.miss
        update[hits[:, 1], hits[:, 0]] = p.hit
        cv2.circle(update, (here - low).tolist(), round(p.body_m / resolution), 2 * p.miss, -1)
        return update, hits, things, low

    def grid(self) -> OccupancyGrid:
        """Return the map so far: 0..100 where observed, unknown elsewhere, cropped to the observed part."""
        p, resolution = OCCUPANCY, self._config.resolution_m
        if not self._tiles:
            return OccupancyGrid(
                cells=np.zeros((0, 0), np.int8), resolution_m=resolution, origin_m=(0.0, 0.0)
            )
        numbers = np.array(list(self._tiles))
        first = numbers.min(axis=0)
        rows, columns = ((np.ptp(numbers, axis=0) + 1) * _TILE).tolist()
        self._check_size(rows * columns)
        cells = np.full((rows, columns), UNKNOWN, dtype=np.int8)
        walls = np.zeros((rows, columns), dtype=np.int16)
        heights = np.zeros((rows, columns), dtype=np.uint8)
        for number, tile in self._tiles.items():
            r, c = ((np.array(number) - first) * _TILE).tolist()
            here = np.s_[r : r + _TILE, c : c + _TILE]
            odds = np.exp(tile.walls.astype(np.float32) / np.float32(-100.0))
            known = np.where(tile.observed, np.rint(OCCUPIED / (1.0 + odds)).astype(np.int8), UNKNOWN)
            known[(tile.things > 0) & (tile.things >= tile.walls)] = THING
            cells[here], walls[here], heights[here] = known, tile.walls, tile.heights
        # What was hit once and never observed free, beside cells hit more often, is a return one cell in
        # front of its wall. No later ray clears it, because the wall stops all of them.
        often = cv2.boxFilter(
            (walls > p.hit).astype(np.uint8),
            -1,
            p.lone_window,
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
        cells[(walls == p.hit) & (often >= p.lone_cells)] = UNKNOWN
        known_rows, known_columns = (np.flatnonzero((cells >= FREE).any(axis=axis)) for axis in (1, 0))
        r0, c0 = int(known_rows[0]), int(known_columns[0])
        kept = np.s_[r0 : int(known_rows[-1]) + 1, c0 : int(known_columns[-1]) + 1]
        y, x = (first * _TILE + (r0, c0)).tolist()
        low_m, high_m = self._planes_m
        return OccupancyGrid(
            cells=cells[kept].copy(),
            heights=heights[kept].copy() if self._heights_seen else None,
            resolution_m=resolution,
            origin_m=(x * resolution, y * resolution),
            height_m=low_m if high_m - low_m < resolution else None,  # of one plane, or not
        )

    def _check_size(self, cells: int) -> None:
        if cells > self._config.max_cells:
            raise LimitExceeded(
                f"the map needs {cells} cells, more than projection.max_cells = {self._config.max_cells}",
                hint="raise projection.max_cells, or choose a coarser projection.resolution_m",
            )


_TILE = 256  # cells along the edge of a tile


class _Tile:
    """A square of cells: evidence for walls and for low obstacles, log-odds in hundredths, and heights
    (`SLICES`).

    observed : cells with any observation.
    """

    def __init__(self) -> None:
        self.walls = np.zeros((_TILE, _TILE), np.int16)
        self.things = np.zeros((_TILE, _TILE), np.int16)
        self.observed = np.zeros((_TILE, _TILE), np.bool_)
        self.heights = np.zeros((_TILE, _TILE), np.uint8)


def _under(low: I64, shape: tuple[int, ...]) -> Iterator[tuple[tuple[int, int], Slices, Slices]]:
    """Yield the tiles under a window (h, w) whose first cell is in the column and the row `low`.

    Each comes with its row and column among the tiles, its cells in the tile, and the same cells in the
    window.
    """
    (x0, y0), (height, width) = low.tolist(), shape
    for row in range(y0 // _TILE, (y0 + height - 1) // _TILE + 1):
        for column in range(x0 // _TILE, (x0 + width - 1) // _TILE + 1):
            r, c = row * _TILE - y0, column * _TILE - x0
            of_window = np.s_[max(r, 0) : min(r + _TILE, height), max(c, 0) : min(c + _TILE, width)]
            of_tile = np.s_[max(-r, 0) : min(_TILE, height - r), max(-c, 0) : min(_TILE, width - c)]
            yield (row, column), of_tile, of_window


def _sum(evidence: NDArray[np.int16], more: NDArray[np.int16]) -> None:
    """Add log-odds in place, within the limit."""
    np.clip(evidence + more, -OCCUPANCY.limit, OCCUPANCY.limit, out=evidence)


def _rims(corners: NDArray[np.int32], free_m: NDArray[np.float32]) -> list[NDArray[np.int32]]:
    """Return the parts of an outline (B, 2) at known ranges; elsewhere the outline runs through the
    sensor."""
    known = np.flatnonzero(free_m > 0)
    if len(known) == len(free_m):
        return [np.concatenate((corners, corners[:1]))]
    runs = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    return [corners[run] for run in runs if len(run)]
