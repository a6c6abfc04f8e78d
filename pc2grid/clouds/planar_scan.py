"""A scan reduced to the plane, in one form for every sensor.

A beam of a laser, a ring of a lidar and a pixel of a camera give the same two facts about a floor plan:
where an obstacle is, and how far the floor is free before it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, U8, BoolGrid
from pc2grid.clouds.ground import Ground
from pc2grid.clouds.heights import heights_seen
from pc2grid.clouds.normals import planar_normals
from pc2grid.clouds.parameters import CLOUD_PARAMETERS, CloudParameters
from pc2grid.config import ProjectionConfig
from pc2grid.model import SensorKind
from pc2grid.sensor_model import SENSOR_MODELS

BEARINGS = 1440
"""Bearings of a planar scan: a quarter of a degree is one grid cell of 5 cm at a range of 12 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanarScan:
    """What one scan shows of the plane.

    All coordinates are in the levelled base frame: the base's origin and heading, z up.

    stamp_ns : stamp of the scan.
    hits_m : (M, 2) float32, obstacle points within the height band, about one per grid cell.
    normal_rad : (M,) float32, direction of the surface normal at each hit, on the side of the sensor.
    origin_m : (2,) float64, position of the sensor.
    free_m : (B,) float32, how far from `origin_m` the plane is known to be free, for B equal bearings
        around it (entry 0 looks along +x, counter-clockwise); 0 where nothing is known.
    low_m : (L, 2) float32, things on the floor that are no walls (tables, chairs), about one point per grid
        cell: the sensor looks over them, so they do not end what is free. Empty where heights are not known.
    height_m : of the plane that a planar laser sees, above the base; None of sensors that see all heights.
    above_floor_m : height of the base above the floor, where a sensor in the hand sees it; else None.
    heights : (M + L,) uint8, of the hits and then of the things, in which slices they were observed to be
        occupied and to be free (`pc2grid.model.SLICES`), 0 where that is not known; or empty.
    """

    stamp_ns: int
    hits_m: F32
    normal_rad: F32
    origin_m: F64
    free_m: F32
    low_m: F32 = field(default_factory=lambda: np.empty((0, 2), np.float32))
    height_m: float | None = None
    above_floor_m: float | None = None
    heights: U8 = field(default_factory=lambda: np.empty(0, np.uint8))

    @staticmethod
    def of_hits(*, stamp_ns: int, hits_m: F32, origin_m: F64, free_m: F32) -> PlanarScan:
        """Return a planar scan whose normals are estimated from its hits."""
        return PlanarScan(
            stamp_ns=stamp_ns,
            hits_m=hits_m,
            normal_rad=planar_normals(hits_m, origin_m),
            origin_m=origin_m,
            free_m=free_m,
        )

    def only(self, kept: BoolGrid) -> PlanarScan:
        """The scan with the hits (M,) that are `kept`."""
        things = np.ones(len(self.low_m), np.bool_)
        return replace(
            self,
            hits_m=self.hits_m[kept],
            normal_rad=self.normal_rad[kept],
            heights=self.heights[np.concatenate((kept, things))] if len(self.heights) else self.heights,
        )

    def free_polygon(self, limit_m: float = np.inf) -> F64:
        """Return the outline (B, 2) of the free space up to `limit_m`, metres, levelled base frame."""
        free_m = np.minimum(self.free_m, limit_m)
        outline: F64 = self.origin_m + free_m[:, None] * _directions(len(self.free_m))
        return outline


@lru_cache(maxsize=4)
def _directions(count: int) -> F64:
    """Return `count` equally spaced unit vectors (count, 2), the first along +x."""
    bearings = np.arange(count) * (2.0 * np.pi / count)
    directions: F64 = np.column_stack((np.cos(bearings), np.sin(bearings)))
    directions.flags.writeable = False
    return directions


def project_to_plane(
    points_m: NDArray[np.floating],
    *,
    stamp_ns: int,
    sensor_m: F64,
    ground: Ground | None,
    config: ProjectionConfig,
    sensor: SensorKind = "lidar",
    parameters: CloudParameters = CLOUD_PARAMETERS,
) -> PlanarScan:
    """Reduce the points of a scan to the plane.

    points_m : (N, 3) in the levelled base frame. sensor_m : (3,) position of the sensor in that frame.
    ground : the floor in that frame, or None for a planar laser, whose every return is an obstacle.

    A bearing is free up to its nearest obstacle. Without an obstacle it is free up to the farthest return
    on the floor or, for a ray that rises to a ceiling or an overhang, up to where the ray leaves the
    height band. Obstacle points of one bearing that are no farther apart than the noise of the `sensor`
    become one hit at their mean, which is more accurate than each of them.
    """
    from pc2grid.clouds._kernels import scan_bearings

    model = SENSOR_MODELS[sensor]
    origin = np.asarray(sensor_m, dtype=np.float64)
    points = np.asarray(points_m, dtype=np.float32)
    if ground is None:
        plane, band = np.zeros(4), (-np.inf, np.inf)
        cell_m = 0.5 * config.resolution_m  # a planar laser has few beams: nearly all of them are kept
    else:
        plane, band = np.array([*ground.normal, ground.offset_m]), (config.band_min_m, config.band_max_m)
        cell_m = config.resolution_m
    # Two standard deviations of the noise on either side of the mean.
    depths = (cell_m, 4.0 * model.noise_per_m2)
    nearest, reach, surfaces = scan_bearings(
        points, origin, plane, band, config.max_range_m, depths, BEARINGS
    )
    free = fill_gaps(np.where(np.isfinite(nearest), nearest, reach), parameters.max_gap_bins)
    hits = mean_per_cell(surfaces, cell_m)
    seen_at = np.empty(0, np.uint8)
    if ground is not None:
        seen_at = heights_seen(hits, points, origin, plane, band, depths)
    return PlanarScan(
        stamp_ns=stamp_ns,
        hits_m=hits,
        normal_rad=planar_normals(hits, origin[:2], parameters),
        origin_m=origin[:2].copy(),
        free_m=np.minimum(free, config.max_range_m).astype(np.float32),
        height_m=float(origin[2]) if ground is None else None,
        heights=seen_at,
    )


def mean_per_cell(sums: F64, cell_m: float) -> F32:
    """Return one point (M, 2) for each cell: the mean of all that falls into it, by first occurrence.

    sums : (N, 3), sums of x and of y, and the number of points in them; its mean decides on the cell.
    """
    column, row = np.floor(sums[:, :2] / sums[:, 2:] / cell_m).astype(np.int64).T
    _, first, cell = np.unique((column << 32) + row, return_index=True, return_inverse=True)
    total = np.column_stack([np.bincount(cell, weights) for weights in sums.T])[np.argsort(first)]
    means: F32 = (total[:, :2] / total[:, 2:]).astype(np.float32)
    return means


def fill_gaps(free_m: F64, max_gap_bins: int) -> F64:
    """Return free ranges (B,) in which narrow gaps, zeros between two ranges, take the shorter of the two."""
    filled = free_m.copy()
    right = np.flatnonzero(free_m > 0.0)
    left = np.roll(right, 1)
    gap = (right - left - 1) % len(free_m)
    shorter = np.minimum(free_m[left], free_m[right])
    for step in range(1, max_gap_bins + 1):
        inside = (gap >= step) & (gap <= max_gap_bins)
        filled[(left[inside] + step) % len(free_m)] = shorter[inside]
    return filled
