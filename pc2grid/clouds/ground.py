"""The floor and the ceiling in one scan.

The tf of a robot says where the floor should be; a hand-held sensor has no such knowledge. Both cases are
treated alike: the floor is the lowest large, roughly level plane of a scan. Planes are found by Open3D.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.clouds.parameters import CLOUD_PARAMETERS, CloudParameters
from pc2grid.clouds.sampling import random_subset
from pc2grid.geometry import leveling

Plane = tuple[F64, float]
"""Unit normal (3,) that points up, and offset: height = normal . p + offset."""


@dataclass(frozen=True, slots=True)
class Ground:
    """The floor plane of a scan and the ceiling above it, in the scan's frame.

    normal : (3,) unit vector that points up from the floor.
    offset_m : height of the frame's origin above the floor, so that height = normal . p + offset_m.
    ceiling_m : height of the ceiling above the floor, or None where none was seen.
    seen : whether the floor was measured (False: assumed from the mounting).
    """

    normal: F64
    offset_m: float
    ceiling_m: float | None = None
    seen: bool = True

    def heights(self, points_m: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the heights (N,) of points (N, 3) above the floor, in metres and in the points' type."""
        normal = self.normal.astype(points_m.dtype)
        heights: NDArray[np.floating] = points_m @ normal + points_m.dtype.type(self.offset_m)
        return heights

    def leveling(self) -> F64:
        """Return T_level_base (4, 4): the smallest rotation that turns the normal upright."""
        return leveling(self.normal)

    def toward(self, other: Ground, gain: float) -> Ground:
        """Return the mean of this ground and another one, weighted 1 - `gain` and `gain` (0..1)."""
        normal = (1.0 - gain) * self.normal + gain * other.normal
        offset = (1.0 - gain) * self.offset_m + gain * other.offset_m
        ceiling = other.ceiling_m if other.ceiling_m is not None else self.ceiling_m
        return Ground(normal / np.linalg.norm(normal), offset, ceiling, self.seen or other.seen)

    def moved(self, T_new_old: F64) -> Ground:
        """Return the same ground in another frame; T_new_old (4, 4) is the old frame's pose in it."""
        normal = T_new_old[:3, :3] @ self.normal
        return Ground(normal, self.offset_m - float(normal @ T_new_old[:3, 3]), self.ceiling_m, self.seen)


def find_ground(
    points_m: NDArray[np.floating],
    sensor_m: F64,
    expected: Ground | None = None,
    parameters: CloudParameters = CLOUD_PARAMETERS,
) -> Ground | None:
    """Find the floor in one scan; None if the scan shows none.

    points_m : (N, 3) returns. sensor_m : (3,) position of the sensor, same frame.
    expected : the floor as known so far. Only a plane within a few centimetres and degrees of it is
        accepted, so that a box or a table is not taken for the floor. Its ceiling is kept if this scan
        shows none.

    Without `expected`, Open3D's RANSAC takes planes out of the points below the sensor, the largest first,
    until one is tilted by at most 35 degrees and has next to no points below it. The last condition
    separates a floor from a table. The seed is fixed.
    """
    p = parameters
    points = _downsample(points_m, p)
    if len(points) < p.ground_min_points:
        return None
    if expected is None:
        plane = _search(points, sensor_m, p)
    else:
        slab = np.abs(points @ expected.normal + expected.offset_m) < 2.0 * p.plane_tolerance_m
        fitted = _largest_plane(points[slab], 2.0 * p.plane_tolerance_m, p.expected_iterations, p)
        plane = None if fitted is None else _as_floor(points, fitted[0], p)
    if plane is None:
        return None
    normal, offset = plane
    if expected is not None and (
        normal @ expected.normal < np.cos(p.step_tilt_rad)
        or abs(offset - expected.offset_m) > p.step_height_m
    ):
        return None
    ceiling = _find_ceiling(points @ normal + offset)
    if ceiling is None and expected is not None:
        ceiling = expected.ceiling_m
    return Ground(normal, offset, ceiling)


def assumed_ground(T_base_sensor: F64) -> Ground:
    """Return the floor that is assumed where none is seen.

    It is z = 0 of the base if the sensor is mounted above that, else 1 m below the base's origin.
    """
    mounted = float(T_base_sensor[2, 3]) > 0.05
    return Ground(np.array([0.0, 0.0, 1.0]), 0.0 if mounted else 1.0, None, seen=False)


def _downsample(points_m: NDArray[np.floating], p: CloudParameters) -> F64:
    """Return at most `ground_points` points (N, 3), one a voxel, so that near surfaces count no more."""
    from pc2grid.open3d_core import o3d

    sample = points_m[random_subset(len(points_m), p.ground_sample)].astype(np.float64)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(sample))
    points: F64 = np.array(cloud.voxel_down_sample(p.ground_voxel_m).points)
    return points[random_subset(len(points), p.ground_points)]


def _search(points: F64, sensor_m: F64, p: CloudParameters) -> Plane | None:
    """Return the first of the largest planes below the sensor that can be a floor."""
    below = points[points[:, 2] < sensor_m[2] - 0.05]
    for _ in range(p.search_planes):
        found = _largest_plane(below, p.plane_tolerance_m, p.search_iterations, p)
        if found is None:
            return None
        plane, inliers = found
        floor = _as_floor(points, plane, p)
        if floor is not None:
            # A level cut through walls holds no more points than the cut above it.
            heights = points @ floor[0] + floor[1]
            at_floor = (np.abs(heights) < p.plane_tolerance_m).sum()
            above = (np.abs(heights - 3.0 * p.plane_tolerance_m) < p.plane_tolerance_m).sum()
            if at_floor > 1.5 * above:
                return floor
        below = np.delete(below, inliers, axis=0)
    return None


def _largest_plane(
    points: F64, tolerance_m: float, iterations: int, p: CloudParameters
) -> tuple[Plane, NDArray[np.intp]] | None:
    """Return the plane that holds the most points, least squares of these, and their indices."""
    from pc2grid.open3d_core import o3d

    if len(points) < p.min_plane_points:
        return None
    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    # With probability 1 every iteration is run, so that the result does not depend on the threads.
    model, inliers = cloud.segment_plane(tolerance_m, 3, iterations, probability=1.0)
    if len(inliers) < p.min_plane_points:
        return None
    up = 1.0 if model[2] >= 0.0 else -1.0
    length = float(np.linalg.norm(model[:3]))
    return (up * model[:3] / length, up * float(model[3]) / length), np.asarray(inliers)


def _as_floor(points: F64, plane: Plane, p: CloudParameters) -> Plane | None:
    """Return the plane fitted to all points near it, or None if that cannot be a floor."""
    normal, offset = plane
    near = points[np.abs(points @ normal + offset) < p.plane_tolerance_m]
    if len(near) < max(p.min_plane_points, p.min_plane_share * len(points)):
        return None
    center = near.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov((near - center).T))
    if variances[1] < p.min_plane_extent_m**2 or abs(axes[2, 0]) < np.cos(p.max_tilt_rad):
        return None
    normal = axes[:, 0] * np.sign(axes[2, 0])
    offset = -float(normal @ center)
    beneath = (points @ normal + offset < -p.beneath_m).mean()
    return (normal, offset) if beneath <= p.max_beneath_share else None


def _find_ceiling(heights: F64) -> float | None:
    """Return the height of the topmost level slab with a few percent of a scan and hardly any above it."""
    lowest_m, highest_m, step_m = 1.9, 12.0, 0.05
    high = heights[heights > lowest_m]
    if len(high) < 0.02 * len(heights):
        return None
    counts, edges = np.histogram(high, bins=np.arange(lowest_m, highest_m, step_m))
    above = len(high) - np.cumsum(counts)
    slabs = np.flatnonzero((counts > 0.015 * len(heights)) & (above < 0.02 * len(heights)))
    for slab in slabs:
        # A slab of a wall holds as many points as those below it, a ceiling at least twice as many.
        if counts[slab] > 2.0 * counts[max(slab - 6, 0) : max(slab - 2, 1)].mean():
            return float(edges[slab] + 0.5 * step_m)
    return None
