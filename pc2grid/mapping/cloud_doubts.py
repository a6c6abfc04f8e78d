"""What a levelled cloud shows of being mapped wrongly: upside down, on its side, or one floor of several."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64, BoolGrid
from pc2grid.io.building_file import axis_of_file
from pc2grid.mapping.cloud_map import CLOUD_MAP, possible_floors

_CELL_M = 0.2
"""Edge of the cells and voxels in which a building is judged: a door is four of them wide."""
_SLICE_M = 0.05  # of heights, in which level surfaces are looked for
_NEAR_M = 0.15  # points this near to a surface belong to it
_BAND_M = 0.5  # what stands within this from a floor separates its rooms
_LEAST_HEIGHT_M = 1.9  # of a ceiling, or of another floor, above the floor
_PASSAGE_M = 1.6  # free height above a floor on which nothing stands
_AROUND_SLICES = 10  # half a metre: a level surface has more points than the heights around it
_CEILING_SHARE = 0.4  # of the points of the floor, at least, that a ceiling has
_FLOOR_SHARE = 0.25  # the same of another floor
_OVERHEAD_SHARE = 0.02  # of the cells of a floor, at least, that have walls or a ceiling above head height
_CERTAIN = 0.2
"""Evidence above which a cloud is said to be upside down. Chosen by hand; tried on 20 made clouds and a real
one: at most 0.18 for all that are upright, at least 0.3 for those turned with doors or much furniture."""
_LIES = 2.0
"""A plane so many times as likely to be the floor, by `possible_floors`, as that at z = 0 says that the cloud
lies on its side. 3.4 in rooms of 5 m."""


class OtherFloor(NamedTuple):
    """A floor above that which is mapped: its height above that, and how much of it was seen."""

    height_m: float
    area_m2: float


def is_upside_down(level_points_m: NDArray[np.floating]) -> bool:
    """Whether the floor of a levelled cloud (V, 3), at z = 0, is rather a ceiling.

    Doors reach the floor, so that it is in one piece where the ceiling is in as many as there are rooms. And
    more stands on a floor than hangs from a ceiling. Without a ceiling nothing is judged.
    """
    points = np.asarray(level_points_m, np.float64)
    ceiling_m = _ceiling_m(points)
    if ceiling_m is None:
        return False
    points = points[(points[:, 2] > -_NEAR_M) & (points[:, 2] < ceiling_m + _NEAR_M)]
    below, above = points[:, 2], ceiling_m - points[:, 2]
    cells = _cells(points)
    floor, ceiling = (_free(cells, heights) for heights in (below, above))
    if not floor.any() or not ceiling.any():
        return False
    doors = math.log2(_largest_share(ceiling) / _largest_share(floor))
    standing, hanging = _things(cells, below, above)
    furniture = (hanging - standing) / (hanging + standing + 0.5 * float(floor.sum()))
    return doors + furniture > _CERTAIN


def side_that_is_up(level_points_m: NDArray[np.floating]) -> F64 | None:
    """The direction (3,) that is rather up than z in a levelled cloud (V, 3) of a single storey, if any.

    A wall may be taken for a floor. The cloud is then higher than a storey, and its floor stands upright.
    """
    points = np.asarray(level_points_m, np.float64)
    if np.quantile(points[:, 2], 0.99) < CLOUD_MAP.ceiling_m or other_floors(points):
        return None
    floors = list(possible_floors(points - np.median(points, axis=0)))
    upright = [size for ground, size in floors if axis_of_file(ground.normal, "z") == "z"]
    best, size = max(floors, key=lambda one: one[1])
    return best.normal if upright and size > _LIES * max(upright) else None


def other_floors(level_points_m: NDArray[np.floating]) -> list[OtherFloor]:
    """The floors above that of a levelled cloud (V, 3), from below: free to pass on, with walls around."""
    points = np.asarray(level_points_m, np.float64)
    found = []
    for height_m in _surfaces(points, _FLOOR_SHARE):
        heights, cells = points[:, 2] - height_m, _cells(points)
        on_it = np.abs(heights) < 0.5 * _NEAR_M
        seen = _mask(cells, on_it)
        in_the_way = _mask(cells, _between(heights, _NEAR_M, _PASSAGE_M))
        overhead = _mask(cells, _between(heights, _PASSAGE_M, CLOUD_MAP.ceiling_m))
        area = int(seen.sum())
        if (seen & ~in_the_way).sum() > 0.5 * area and (seen & overhead).sum() > _OVERHEAD_SHARE * area:
            found.append(OtherFloor(float(np.median(points[on_it, 2])), area * _CELL_M**2))
    return found


def _surfaces(points: F64, least_share: float) -> list[float]:
    """Heights of the level surfaces above the floor with at least a share of its points, from below."""
    edges = np.arange(-_NEAR_M, max(points[:, 2].max(), _LEAST_HEIGHT_M) + 1.0, _SLICE_M)
    counts, _ = np.histogram(points[:, 2], edges)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(counts, _AROUND_SLICES), 2 * _AROUND_SLICES + 1)
    level = np.convolve(counts, np.ones(3), "same") - 3.0 * np.median(around, axis=1)
    middle_m = edges[:-1] + 0.5 * _SLICE_M
    floor = level[np.abs(middle_m) < _NEAR_M].max()
    highest = np.lib.stride_tricks.sliding_window_view(np.pad(level, 2), 5).max(axis=1)
    chosen = (middle_m > _LEAST_HEIGHT_M) & (level == highest) & (level > max(least_share * floor, 0.0))
    return [float(height_m) for height_m in middle_m[chosen]]


def _ceiling_m(points: F64) -> float | None:
    """Height of the ceiling of the storey at z = 0, None if it shows none."""
    ceilings = [height_m for height_m in _surfaces(points, _CEILING_SHARE) if height_m < CLOUD_MAP.ceiling_m]
    return ceilings[0] if ceilings else None


def _cells(points: F64) -> I64:
    """The cell (V, 2) of each point, from (0, 0)."""
    cells = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    first: I64 = cells - cells.min(axis=0)
    return first


def _mask(cells: I64, chosen: NDArray[np.bool_]) -> BoolGrid:
    """The cells (R, C) in which some of the chosen points lie."""
    mask = np.zeros(cells.max(axis=0) + 1, np.bool_)
    mask[tuple(cells[chosen].T)] = True
    return mask


def _between(heights: F64, low_m: float, high_m: float) -> NDArray[np.bool_]:
    return (heights > low_m) & (heights < high_m)


def _free(cells: I64, distances: F64) -> BoolGrid:
    """The cells (R, C) of a floor or ceiling near to which nothing is, and nothing beside them.

    distances : (V,) of the points from it.
    """
    free = _mask(cells, np.abs(distances) < _NEAR_M) & ~_mask(cells, _between(distances, _NEAR_M, _BAND_M))
    return cv2.erode(free.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _grown(mask: BoolGrid) -> BoolGrid:
    """The cells (R, C) and their neighbours."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _largest_share(free: BoolGrid) -> float:
    """The share of the free cells that lie in the largest piece."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(free.astype(np.uint8), connectivity=4)
    return float(stats[1:, cv2.CC_STAT_AREA].max() / free.sum())


def _things(cells: I64, below: F64, above: F64) -> tuple[int, int]:
    """Voxels of what stands on the floor, and of what hangs from the ceiling; walls, which do both, left out.

    below, above : (V,) distances of the points from the floor and from the ceiling.
    """
    from scipy import ndimage

    ends = [_between(distances, _NEAR_M, _BAND_M) for distances in (below, above)]
    low, high = (_mask(cells, end) for end in ends)
    # A wall that leans by a hair may have its ends in neighbouring cells.
    wall = (low & _grown(high)) | (high & _grown(low))
    kept = (below > _NEAR_M) & (above > _NEAR_M) & ~wall[tuple(cells.T)]
    at = (*cells[kept].T, (below[kept] / _CELL_M).astype(np.int64))
    voxels = np.zeros((*wall.shape, int(below.max() / _CELL_M) + 1), np.bool_)
    voxels[at] = True
    labels, count = ndimage.label(voxels, np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    stands, hangs = (np.bincount(labels[at][end[kept]], minlength=count + 1) > 0 for end in ends)
    return int(sizes[stands & ~hangs].sum()), int(sizes[hangs & ~stands].sum())
