"""A scan reduced to the plane: the one thing that every later stage sees, whatever the sensor.

A beam of a laser, a ring of a lidar and a pixel of a camera say the same two things about the floor
plan: there is something here, and there is nothing up to here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.config import ProjectionConfig
from pc2grid.floor import Ground
from pc2grid.geometry import F64
from pc2grid.model import F32

BEARINGS = 720
_GAP_BINS = 2  # beams up to 1.5 degrees apart count as looking in between


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """What one scan says about the plane.

    All coordinates are in the levelled base frame: the base's origin and heading, z up.

    stamp_ns : stamp of the scan.
    hits_m : (M, 2) float32, obstacle points within the height band, about one per grid cell.
    origin_m : (2,) float64, where the sensor is.
    free_m : (B,) float32, how far from `origin_m` the plane is known to be free, for B equal bearings
        around it (entry 0 looks along +x, counter-clockwise); 0 where nothing was learned.
    """

    stamp_ns: int
    hits_m: F32
    origin_m: F64
    free_m: F32

    def free_polygon(self, limit_m: float = np.inf) -> F64:
        """(B, 2) outline in the levelled base frame of the free space no farther than `limit_m`, metres."""
        bearings = np.arange(len(self.free_m)) * (2.0 * np.pi / len(self.free_m))
        free_m = np.minimum(self.free_m, limit_m)
        outline: F64 = self.origin_m + free_m[:, None] * np.column_stack((np.cos(bearings), np.sin(bearings)))
        return outline


def flatten(
    points_m: NDArray[np.floating],
    *,
    stamp_ns: int,
    sensor_m: F64,
    ground: Ground | None,
    config: ProjectionConfig,
) -> Sweep:
    """Reduce points to the plane.

    points_m : (N, 3) in the levelled base frame. sensor_m : (3,) the sensor in that frame.
    ground : the floor in that frame, or None for a planar laser, whose every return is an obstacle.

    A bearing is free up to its nearest obstacle; without an obstacle, as far as the farthest return on
    the floor or, for a ray that climbs to a ceiling or an overhang, to where it leaves the height band.
    """
    points = np.asarray(points_m, dtype=np.float32)
    sensor = np.asarray(sensor_m, dtype=np.float64)
    relative = points[:, :2] - sensor[:2].astype(np.float32)
    ranges = np.hypot(relative[:, 0], relative[:, 1])
    bins = _bearing_bins(relative)
    reach = np.zeros(BEARINGS, dtype=np.float32)
    nearest = np.full(BEARINGS, np.inf, dtype=np.float32)
    limit = np.float32(config.max_range_m)
    if ground is None:
        hit = ranges <= limit
        np.minimum.at(nearest, bins, ranges)
        cell_m = 0.5 * config.resolution_m  # a laser's beams are few: keep nearly all of them
    else:
        heights = ground.heights(points)
        in_band = (heights >= config.band_min_m) & (heights <= config.band_max_m)
        hit = in_band & (ranges <= limit)
        np.minimum.at(nearest, bins[in_band], ranges[in_band])
        low = heights < config.band_min_m
        np.maximum.at(reach, bins[low], ranges[low])
        high = heights > config.band_max_m
        sensor_height = np.float32(ground.heights(sensor[None, :])[0])
        if sensor_height < config.band_max_m:
            fraction = (config.band_max_m - sensor_height) / (heights[high] - sensor_height)
            np.maximum.at(reach, bins[high], ranges[high] * fraction)
        cell_m = config.resolution_m
    obstacle = np.isfinite(nearest)
    free = np.where(obstacle, nearest, reach)
    free = np.minimum(_fill_gaps(free), limit).astype(np.float32)
    return Sweep(
        stamp_ns=stamp_ns,
        hits_m=_one_per_cell(points[hit, :2], cell_m),
        origin_m=sensor[:2].copy(),
        free_m=free,
    )


def _bearing_bins(relative: F32) -> NDArray[np.int64]:
    turns = np.arctan2(relative[:, 1], relative[:, 0]) * np.float32(BEARINGS / (2.0 * np.pi))
    return np.rint(turns).astype(np.int64) % BEARINGS


def _fill_gaps(free: F32) -> F32:
    """Bearings between two that looked, at most `_GAP_BINS` wide, take the shorter of the two."""
    filled = free.copy()
    for width in range(1, _GAP_BINS + 1):
        for lead in range(width):
            left = np.roll(free, lead + 1)
            right = np.roll(free, -(width - lead))
            between = (filled == 0) & (left > 0) & (right > 0)
            filled[between] = np.minimum(left, right)[between]
    return filled


def _one_per_cell(points: F32, cell_m: float) -> F32:
    """The mean of the points (N, 2) in each cell, cells in a fixed order."""
    if not len(points):
        return points.reshape(0, 2)
    cells = np.floor(points / np.float32(cell_m)).astype(np.int64)
    keys = cells[:, 0] * (1 << 32) + cells[:, 1]
    _, index, counts = np.unique(keys, return_inverse=True, return_counts=True)
    means = np.column_stack([np.bincount(index, weights=points[:, axis]) / counts for axis in (0, 1)])
    return means.astype(np.float32)
