"""What can be seen from a place of a grid: its isovist (Benedikt 1979, "To take hold of space").

Two recordings of one place agree only on what both could see: an area behind a wall may be known in one of
them only. Both are therefore cut down to the isovist of a common centre, which makes them comparable
whatever the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, freeze
from pc2grid.model import OCCUPIED, UNKNOWN, OccupancyGrid, Submap

BEARINGS = 360

WALL, OPEN, HIDDEN = 1, 0, -1
"""How a ray ends: on an occupied cell, at the limit of sight, or where nothing is known."""

_STEP_CELLS = 0.5
PATIENCE_M = 0.1
"""A ray passes this much of unknown cells: two cells of 5 cm that lay between the beams (chosen by hand)."""
WALL_MARGIN_M = 0.15
"""Depth of a wall that stays in a visible submap: three cells of 5 cm (chosen by hand)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Isovist:
    """What is seen from `center_m` up to `sight_m`.

    ranges_m : (B,) float32, length of ray b; its bearing is 2 pi b / B from the map's x axis.
    ends : (B,) int8, WALL, OPEN (nothing within sight) or HIDDEN (reached unknown cells).
    """

    center_m: tuple[float, float]
    sight_m: float
    ranges_m: F32
    ends: NDArray[np.int8]

    def __post_init__(self) -> None:
        freeze(self, "ranges_m", np.float32, (None,))
        freeze(self, "ends", np.int8, (len(self.ranges_m),))

    @property
    def observed(self) -> float:
        """Share of the rays, 0..1, whose end is known (not HIDDEN)."""
        return float(np.mean(self.ends != HIDDEN))


def look_around(
    grid: OccupancyGrid,
    centers_m: F64,
    sight_m: float,
    *,
    bearings: int = BEARINGS,
    patience_m: float = PATIENCE_M,
) -> tuple[F32, NDArray[np.int8]]:
    """Ranges (N, B) in metres and ends (N, B) of the isovists of many points (N, 2); see `isovist`."""
    from pc2grid.submaps._kernels import cast_rays

    columns, rows = ((centers_m - np.asarray(grid.origin_m)) / grid.resolution_m).T
    ranges, ends = cast_rays(
        grid.cells,
        np.ascontiguousarray(rows, np.float64),
        np.ascontiguousarray(columns, np.float64),
        sight_m / grid.resolution_m,
        bearings,
        int(patience_m / grid.resolution_m / _STEP_CELLS),
    )
    return ranges * np.float32(grid.resolution_m), ends


def ray_ends(ranges_m: F32) -> F64:
    """The points (N, B, 2) where the rays of isovists (N, B) end, from the points that they are seen from."""
    bearings_rad = 2.0 * np.pi * np.arange(ranges_m.shape[1]) / ranges_m.shape[1]
    directions = np.stack((np.cos(bearings_rad), np.sin(bearings_rad)), axis=-1)
    return np.asarray(ranges_m[..., None] * directions, np.float64)


def isovist(
    grid: OccupancyGrid,
    center_m: tuple[float, float],
    sight_m: float,
    *,
    bearings: int = BEARINGS,
    patience_m: float = PATIENCE_M,
) -> Isovist:
    """Cast `bearings` rays from a point of the map frame.

    A ray ends at the first occupied cell, at `sight_m`, or after more than `patience_m` of unknown cells
    (single unobserved cells between beams do not hide what lies behind them).
    """
    ranges_m, ends = look_around(
        grid, np.array([center_m]), sight_m, bearings=bearings, patience_m=patience_m
    )
    return Isovist(center_m=center_m, sight_m=sight_m, ranges_m=ranges_m[0], ends=ends[0])


def polygon_mask(view: Isovist, grid: OccupancyGrid, *, margin_m: float = 0.0) -> NDArray[np.bool_]:
    """Cells (H, W) of `grid` inside the isovist's polygon; each ray is longer by `margin_m`."""
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
    """The submap around the isovist's centre; cells that are not seen from there become unknown.

    Of a wall that a ray ends on, the first `WALL_MARGIN_M` are kept. Free cells inside the isovist stay
    free; the last cell of a ray that ends on a wall becomes occupied.
    """
    crop = grid.crop(view.center_m, view.sight_m)
    inside = polygon_mask(view, crop, margin_m=WALL_MARGIN_M)
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
