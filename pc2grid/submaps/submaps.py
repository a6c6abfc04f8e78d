"""The division of a map into submaps around the junctions of its free space (paper III-A), and isovists.

An isovist is the area that is visible from a place (Benedikt 1979, "To take hold of space"). Two recordings
of one place agree only on the area that is visible in both: the area behind a wall may be known in one of
them only. Both are therefore cut down to the isovist of a common centre, which makes them comparable whatever
the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64, SUBPIXEL_BITS, BoolGrid, cells_of, frozen_arrays, polygon_corners
from pc2grid.libraries import compiled
from pc2grid.model import OCCUPIED, OCCUPIED_FROM, UNKNOWN, OccupancyGrid, Submap
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.junction_graph import clearance_of, graph_of_skeleton, map_skeleton, sample_evenly

if TYPE_CHECKING:
    import networkx as nx


def partition(grid: OccupancyGrid, config: PartitionConfig = PartitionConfig()) -> tuple[Submap, ...]:
    """Divide a map into submaps of `config.radius_m` around the junctions of its junction graph (III-A).

    With `config.spacing_m`, points of the skeleton that far apart become centres as well. Submaps are
    numbered from 0 by (y, x) of their centre. A map with free space but without any junction (one room, one
    corridor) has a centre where it is widest; a map without free space has no submaps.

    >>> import pc2grid
    >>> submaps = partition(pc2grid.load_map("map.yaml"), PartitionConfig(radius_m=4.0))
    >>> [submap.submap_id for submap in submaps] == list(range(len(submaps)))
    True
    """
    return divide(grid, config)[1]


def divide(grid: OccupancyGrid, config: PartitionConfig) -> tuple[nx.Graph, tuple[Submap, ...]]:
    """Return the junction graph of a map, and the submaps of `partition`, which are made around its nodes."""
    skeleton = map_skeleton(grid, config)
    graph = graph_of_skeleton(skeleton, grid, config)
    centers_m = _centers(graph, skeleton, grid, config)
    return graph, tuple(
        view_at(grid, (x, y), config, submap_id=number) for number, (x, y) in enumerate(centers_m.tolist())
    )


def view_at(
    grid: OccupancyGrid, center_m: tuple[float, float], config: PartitionConfig, *, submap_id: int = 0
) -> Submap:
    """Return the submap around `center_m` (map frame) as `config.view` defines it: the whole disc, or its
    isovist. Other cells become unknown.

    In an isovist, of a wall that a ray ends on the first `WALL_MARGIN_M` are kept. Free cells inside stay
    free; the last cell of a ray that ends on a wall becomes occupied.

    The views of a query are made by this function, too, because only views of one kind are comparable.
    """
    crop = grid.crop(center_m, config.radius_m)
    if config.view == "disc":
        n = crop.cells.shape[0] // 2
        steps = np.arange(-n, n + 1) ** 2
        inside = steps[:, None] + steps <= (config.radius_m / grid.resolution_m) ** 2 + 1e-9
        cells = np.where(inside, crop.cells, np.int8(UNKNOWN))
    else:
        view = isovist(grid, center_m, config.radius_m)
        cells = np.where(polygon_mask(view, crop, margin_m=WALL_MARGIN_M), crop.cells, np.int8(UNKNOWN))
        at = crop.to_cell(center_m + ray_ends(view.ranges_m[None])[0, view.ends == WALL])
        ok = ((at >= 0) & (at < np.array(cells.shape))).all(axis=1)
        cells[at[ok, 0], at[ok, 1]] = OCCUPIED
    return Submap(
        submap_id=submap_id,
        center_m=center_m,
        radius_m=config.radius_m,
        grid=OccupancyGrid(cells=cells, resolution_m=crop.resolution_m, origin_m=crop.origin_m),
    )


def submap_centers(grid: OccupancyGrid, config: PartitionConfig) -> F64:
    """Return the centres (N, 2) of the submaps in the map frame, metres, sorted by (y, x)."""
    skeleton = map_skeleton(grid, config)
    return _centers(graph_of_skeleton(skeleton, grid, config), skeleton, grid, config)


def _centers(graph: nx.Graph, skeleton: BoolGrid, grid: OccupancyGrid, config: PartitionConfig) -> F64:
    """Return the centres of the submaps, from the junction graph and the skeleton that it was made from."""
    if not grid.ground.any():
        return np.empty((0, 2))
    points_m = [node["center_m"] for _, node in graph.nodes(data=True) if node["kind"] == "junction"]
    centers = grid.to_cell(np.array(points_m).reshape(-1, 2))
    if not len(centers):
        clearance_m = clearance_of(grid.ground, grid.resolution_m)
        centers = np.array([np.unravel_index(int(np.argmax(clearance_m)), clearance_m.shape)])
    if config.spacing_m is not None:
        # Junctions come first, so they are kept; the skeleton fills the gaps between them.
        candidates = np.concatenate((centers, cells_of(skeleton)))
        more = sample_evenly(candidates, config.spacing_m / grid.resolution_m)
        centers = np.unique(np.concatenate((centers, more)), axis=0)
    return grid.to_point(centers[np.lexsort(centers.T[::-1])])


# --- isovists -----------------------------------------------------------------------------------------

BEARINGS = 360
"""Rays of an isovist, by default."""
WALL, OPEN, HIDDEN = 1, 0, -1
"""How a ray ends: on an occupied cell, at the limit of sight, or where nothing is known."""
_STEP_CELLS = 0.5
"""Length of the steps of a ray."""
PATIENCE_M = 0.1
"""A ray passes this much of unknown cells: two cells of 5 cm that lay between the beams (chosen by hand)."""
WALL_MARGIN_M = 0.15
"""Depth of a wall that stays in a visible submap: three cells of 5 cm (chosen by hand)."""


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(ranges_m=(np.float32, "B"), ends=(np.int8, "B"))
class Isovist:
    """The area that is visible from `center_m` up to `sight_m`.

    ranges_m : (B,) float32, length of ray b; its bearing is 2 pi b / B from the map's x axis.
    ends : (B,) int8, WALL, OPEN (nothing within sight) or HIDDEN (reached unknown cells).
    """

    center_m: tuple[float, float]
    sight_m: float
    ranges_m: F32
    ends: NDArray[np.int8]


def isovist(
    grid: OccupancyGrid, center_m: tuple[float, float], sight_m: float, *, bearings: int = BEARINGS
) -> Isovist:
    """Cast `bearings` rays from a point of the map frame.

    A ray ends at the first occupied cell, at `sight_m`, or after more than `PATIENCE_M` of unknown cells
    (single unobserved cells between beams do not hide what lies behind them).
    """
    ranges_m, ends = look_around(grid, np.array([center_m]), sight_m, bearings=bearings)
    return Isovist(center_m=center_m, sight_m=sight_m, ranges_m=ranges_m[0], ends=ends[0])


def look_around(
    grid: OccupancyGrid, centers_m: F64, sight_m: float, *, bearings: int = BEARINGS
) -> tuple[F32, NDArray[np.int8]]:
    """Return ranges (N, B) in metres and ends (N, B) of the isovists of many points (N, 2); see `isovist`."""
    columns, rows = ((centers_m - np.asarray(grid.origin_m)) / grid.resolution_m).T
    ranges, ends = cast_rays(
        np.ascontiguousarray(grid.cells),
        np.ascontiguousarray(rows, np.float64),
        np.ascontiguousarray(columns, np.float64),
        sight_m / grid.resolution_m,
        bearings,
        int(PATIENCE_M / grid.resolution_m / _STEP_CELLS),
    )
    return ranges * np.float32(grid.resolution_m), ends


def ray_ends(ranges_m: NDArray[np.floating]) -> F64:
    """Return the ends (N, B, 2) of the rays of isovists (N, B), relative to their centres."""
    bearings_rad = 2.0 * np.pi * np.arange(ranges_m.shape[1]) / ranges_m.shape[1]
    directions = np.stack((np.cos(bearings_rad), np.sin(bearings_rad)), axis=-1)
    return np.asarray(ranges_m[..., None] * directions, np.float64)


def polygon_mask(view: Isovist, grid: OccupancyGrid, *, margin_m: float = 0.0) -> NDArray[np.bool_]:
    """Return a mask (H, W) of the cells of `grid` inside the isovist's polygon; each ray is longer by
    `margin_m`."""
    reach_m = np.minimum(view.ranges_m, view.sight_m) + margin_m
    corners = (view.center_m + ray_ends(reach_m[None])[0] - grid.origin_m) / grid.resolution_m
    mask = np.zeros(grid.cells.shape, dtype=np.uint8)
    cv2.fillPoly(mask, [polygon_corners(corners)], 1, shift=SUBPIXEL_BITS)
    return mask.astype(bool)


@compiled(nogil=True)
def cast_rays(
    cells: NDArray[np.int8], rows: F64, columns: F64, limit: float, bearings: int, patience: int
) -> tuple[F32, NDArray[np.int8]]:
    """Follow the rays of each place (N,) in steps of half a cell; all lengths in cells. Returns (N, B) each.

    cells : (H, W). rows, columns : (N,) where the rays start, in cells from the grid's corner. limit : length
    of a ray. patience : steps through unknown cells after which a ray is HIDDEN.

    Returns the range up to which each ray is known to be free (or its wall), and how it ends.

    Measured: 20 times as fast as the numpy form at 78 places of fr079 (4 against 87 ms); every described view
    and every query casts rays.
    """
    height, width = cells.shape
    ranges = np.empty((len(rows), bearings), dtype=np.float32)
    ends = np.empty((len(rows), bearings), dtype=np.int8)
    for b in range(bearings):
        angle = 2.0 * math.pi * b / bearings
        dc, dr = math.cos(angle) * _STEP_CELLS, math.sin(angle) * _STEP_CELLS
        for n in range(len(rows)):
            r, c, length = rows[n], columns[n], 0.0
            end = OPEN
            known = 0.0
            unknown_run = 0
            while length < limit:
                r += dr
                c += dc
                length += _STEP_CELLS
                if not (0.0 <= r < height and 0.0 <= c < width):
                    end = HIDDEN
                    break
                value = cells[np.uint64(r), np.uint64(c)]
                if value >= OCCUPIED_FROM:
                    end = WALL
                    known = length
                    break
                if value < 0:
                    unknown_run += 1
                    if unknown_run > patience:
                        end = HIDDEN
                        break
                else:
                    unknown_run = 0
                    known = length
            ranges[n, b] = known
            ends[n, b] = end
    return ranges, ends
