"""What can be seen from a place of a grid: its isovist, ray by ray.

Two recordings of one place agree only on what both could see; what lies behind a wall is known to one
and not to the other. Cutting both sides down to the isovist of a common centre makes them comparable
whatever the sensor (Benedikt 1979, "To take hold of space", for the notion).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, OCCUPIED, UNKNOWN, OccupancyGrid, Submap, _freeze

BEARINGS = 360

WALL, OPEN, HIDDEN = 1, 0, -1
"""How a ray ends: on an occupied cell, at the limit of sight, or where nothing is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Isovist:
    """What is seen from `center_m` up to `sight_m`.

    ranges_m : (B,) float32, how far ray b reaches; bearing of ray b is 2 pi b / B from the map's x axis.
    ends : (B,) int8, WALL, OPEN (nothing within sight) or HIDDEN (ran into unknown cells).
    """

    center_m: tuple[float, float]
    sight_m: float
    ranges_m: F32
    ends: NDArray[np.int8]

    def __post_init__(self) -> None:
        _freeze(self, "ranges_m", np.float32, (None,))
        _freeze(self, "ends", np.int8, (len(self.ranges_m),))

    @property
    def observed(self) -> float:
        """Share of the rays, 0..1, whose end is known (not HIDDEN)."""
        return float(np.mean(self.ends != HIDDEN))

    @property
    def area_m2(self) -> float:
        """Area of the star-shaped polygon."""
        return float(np.mean(self.ranges_m.astype(np.float64) ** 2) * np.pi)


@numba.njit(cache=True, nogil=True)
def _cast(
    cells: NDArray[np.int8], rows: F64, columns: F64, limit: float, bearings: int, patience: int
) -> tuple[F32, NDArray[np.int8]]:
    """Walk the rays of each place (N,) half a cell at a time; all lengths in cells. Returns (N, B) each."""
    height, width = cells.shape
    flat = np.ascontiguousarray(cells).reshape(-1)
    ranges = np.empty((len(rows), bearings), dtype=np.float32)
    ends = np.empty((len(rows), bearings), dtype=np.int8)
    step = 0.5
    for b in range(bearings):
        angle = 2.0 * np.pi * b / bearings
        dc, dr = np.cos(angle) * step, np.sin(angle) * step
        for n in range(len(rows)):
            r, c, length = rows[n], columns[n], 0.0
            end = 0
            known = 0.0
            unknown_run = 0
            while length < limit:
                r += dr
                c += dc
                length += step
                if not (0.0 <= r < height and 0.0 <= c < width):
                    end = -1
                    break
                value = flat[np.uint64(r) * np.uint64(width) + np.uint64(c)]
                if value >= 65:
                    end = 1
                    known = length
                    break
                if value < 0:
                    unknown_run += 1
                    if unknown_run > patience:
                        end = -1
                        break
                else:
                    unknown_run = 0
                    known = length
            ranges[n, b] = known
            ends[n, b] = end
    return ranges, ends


def look_around(
    grid: OccupancyGrid,
    centers_m: F64,
    sight_m: float,
    *,
    bearings: int = BEARINGS,
    patience_m: float = 0.1,
) -> tuple[F32, NDArray[np.int8]]:
    """Ranges (N, B) in metres and ends (N, B) of the isovists of many points (N, 2); see `isovist`."""
    columns, rows = ((centers_m - np.asarray(grid.origin_m)) / grid.resolution_m).T
    ranges, ends = _cast(
        grid.cells,
        np.ascontiguousarray(rows, np.float64),
        np.ascontiguousarray(columns, np.float64),
        sight_m / grid.resolution_m,
        bearings,
        int(2 * patience_m / grid.resolution_m),
    )
    return ranges * np.float32(grid.resolution_m), ends


def isovist(
    grid: OccupancyGrid,
    center_m: tuple[float, float],
    sight_m: float,
    *,
    bearings: int = BEARINGS,
    patience_m: float = 0.1,
) -> Isovist:
    """Cast `bearings` rays from a point of the map frame.

    A ray ends at the first occupied cell, at `sight_m`, or when it has run through more than `patience_m`
    of unknown cells (single unobserved cells between beams do not hide what lies behind them).
    """
    ranges_m, ends = look_around(
        grid, np.array([center_m]), sight_m, bearings=bearings, patience_m=patience_m
    )
    return Isovist(center_m=center_m, sight_m=sight_m, ranges_m=ranges_m[0], ends=ends[0])


def polygon_mask(view: Isovist, grid: OccupancyGrid, *, margin_m: float = 0.0) -> NDArray[np.bool_]:
    """Cells of `grid` inside the isovist's polygon, grown by `margin_m` beyond each ray's end; (H, W)."""
    import cv2

    angles = 2 * np.pi * np.arange(len(view.ranges_m)) / len(view.ranges_m)
    reach = np.minimum(view.ranges_m + margin_m, view.sight_m + margin_m)
    x = (view.center_m[0] + reach * np.cos(angles) - grid.origin_m[0]) / grid.resolution_m - 0.5
    y = (view.center_m[1] + reach * np.sin(angles) - grid.origin_m[1]) / grid.resolution_m - 0.5
    shift = 4
    corners = np.round(np.column_stack((x, y)) * (1 << shift)).astype(np.int32)
    mask = np.zeros(grid.cells.shape, dtype=np.uint8)
    cv2.fillPoly(mask, [corners], 1, lineType=cv2.LINE_8, shift=shift)
    return mask.astype(bool)


def visible_submap(grid: OccupancyGrid, view: Isovist, submap_id: int) -> Submap:
    """The submap around the isovist's centre with all that is not seen from there set to unknown.

    The first cells of a wall that a ray ends on stay (0.15 m), the rest of the wall and what is behind it
    go. Free cells inside stay free; a ray that ends on a wall marks its last cell occupied.
    """
    crop = grid.crop(view.center_m, view.sight_m)
    inside = polygon_mask(view, crop, margin_m=0.15)
    cells = np.where(inside, crop.cells, np.int8(UNKNOWN)).astype(np.int8)
    hit = view.ends == WALL
    angles = 2 * np.pi * np.flatnonzero(hit) / len(view.ranges_m)
    ends_m = view.ranges_m[hit, None] * np.column_stack((np.cos(angles), np.sin(angles))) + view.center_m
    at = crop.to_cell(ends_m.astype(np.float64))
    ok = ((at >= 0) & (at < np.array(cells.shape))).all(axis=1)
    cells[at[ok, 0], at[ok, 1]] = OCCUPIED
    return Submap(
        submap_id=submap_id,
        center_m=view.center_m,
        radius_m=view.sight_m,
        grid=OccupancyGrid(cells=cells, resolution_m=crop.resolution_m, origin_m=crop.origin_m),
    )
