"""The floor and the ceiling, found in the data.

A robot's tf says where the floor should be; a hand-held sensor has none. Both cases are treated alike:
the floor is the lowest large, roughly level plane that a scan shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, pose_from_rotation_vector

MAX_TILT_RAD = np.radians(35.0)
FLOOR_THICKNESS_M = 0.04
BENEATH_M = 0.12  # a floor has nothing farther than this below it
STEP_TILT_RAD = np.radians(3.0)  # from one scan to the next
STEP_HEIGHT_M = 0.06
_SAMPLE = 2500
_HYPOTHESES = 300


@dataclass(frozen=True, slots=True)
class Ground:
    """The floor plane of a scan and what is known above it, in the scan's frame.

    normal : (3,) unit vector away from the floor.
    offset_m : height above the floor of the frame's origin, so that height = normal . p + offset_m.
    ceiling_m : height of the ceiling above the floor, or None where none was seen.
    seen : whether the floor was measured (False: assumed from the mounting).
    """

    normal: F64
    offset_m: float
    ceiling_m: float | None = None
    seen: bool = True

    def heights(self, points_m: NDArray[np.floating]) -> NDArray[np.floating]:
        """Height (N,) above the floor of points (N, 3), in metres and in the points' own type."""
        normal = self.normal.astype(points_m.dtype)
        heights: NDArray[np.floating] = points_m @ normal + points_m.dtype.type(self.offset_m)
        return heights

    def leveling(self) -> F64:
        """(4, 4) T_level_base: the smallest rotation that turns the normal upright. No translation."""
        axis = np.cross(self.normal, (0.0, 0.0, 1.0))
        sine = float(np.linalg.norm(axis))
        if sine < 1e-9:
            return np.eye(4)
        return pose_from_rotation_vector(axis / sine * np.arctan2(sine, float(self.normal[2])))

    def toward(self, other: Ground, gain: float) -> Ground:
        """This ground moved towards another one by a share of the way."""
        normal = (1.0 - gain) * self.normal + gain * other.normal
        offset = (1.0 - gain) * self.offset_m + gain * other.offset_m
        ceiling = other.ceiling_m if other.ceiling_m is not None else self.ceiling_m
        return Ground(normal / np.linalg.norm(normal), offset, ceiling, self.seen or other.seen)

    def moved(self, T_new_old: F64) -> Ground:
        """The same ground in another frame, given the pose (4, 4) of the old frame in the new one."""
        normal = T_new_old[:3, :3] @ self.normal
        return Ground(normal, self.offset_m - float(normal @ T_new_old[:3, 3]), self.ceiling_m, self.seen)


def find_ground(
    points_m: NDArray[np.floating], sensor_m: F64, expected: Ground | None = None
) -> Ground | None:
    """The floor in one scan, or None if it shows none.

    points_m : (N, 3) returns. sensor_m : (3,) where the sensor is, same frame.
    expected : what is known already; only a plane close to it will do (a few centimetres, a few degrees),
        lest a box or a table be taken for the floor. Its ceiling is kept if this scan shows none.

    Without an expectation: RANSAC over planes tilted by at most 35 degrees that hold many points and
    have hardly any below them, which is what tells a floor from a table. The seed is fixed.
    """
    points = _thin(np.asarray(points_m, dtype=np.float64), _SAMPLE)
    if len(points) < 50:
        return None
    if expected is None:
        plane = _search(points, sensor_m)
    else:
        plane = _refine(points, expected.normal, expected.offset_m, tolerance_m=2 * FLOOR_THICKNESS_M)
    if plane is None or (points @ plane[0] + plane[1] < -BENEATH_M).mean() > 0.05:
        return None
    normal, offset = plane
    if expected is not None and (
        normal @ expected.normal < np.cos(STEP_TILT_RAD) or abs(offset - expected.offset_m) > STEP_HEIGHT_M
    ):
        return None
    ceiling = _find_ceiling(points @ normal + offset)
    if ceiling is None and expected is not None:
        ceiling = expected.ceiling_m
    return Ground(normal, offset, ceiling)


def assumed_ground(T_base_sensor: F64) -> Ground:
    """The floor where none is seen: z = 0 of the base if the sensor is mounted above it, else 1 m down."""
    mounted = float(T_base_sensor[2, 3]) > 0.05
    return Ground(np.array([0.0, 0.0, 1.0]), 0.0 if mounted else 1.0, None, seen=False)


def _thin(points: F64, count: int) -> F64:
    if len(points) <= count:
        return points
    return points[np.random.default_rng(0).integers(0, len(points), count)]


def _search(points: F64, sensor_m: F64) -> tuple[F64, float] | None:
    below = points[points[:, 2] < sensor_m[2] - 0.05]
    if len(below) < 50:
        return None
    rng = np.random.default_rng(1)
    a, b, c = (below[rng.integers(0, len(below), _HYPOTHESES)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > 1e-3
    normals = normals[good] / lengths[good, None]
    normals *= np.sign(normals[:, 2:3]) + (normals[:, 2:3] == 0)
    a = a[good]
    level = normals[:, 2] > np.cos(MAX_TILT_RAD)
    normals, a = normals[level], a[level]
    if not len(normals):
        return None
    offsets = -np.einsum("ij,ij->i", normals, a)
    heights = points @ normals.T + offsets
    inliers = (np.abs(heights) < FLOOR_THICKNESS_M).sum(axis=0)
    beneath = (heights < -BENEATH_M).sum(axis=0)
    best = int(np.argmax(inliers - 3 * beneath))
    if inliers[best] < 0.02 * len(points) or beneath[best] > 0.1 * len(points):
        return None
    plane = _refine(points, normals[best], float(offsets[best]), tolerance_m=2 * FLOOR_THICKNESS_M)
    if plane is None:
        return None
    # A level cut through walls holds no more points than the cut above it.
    heights_m = points @ plane[0] + plane[1]
    slab = (np.abs(heights_m) < FLOOR_THICKNESS_M).sum()
    above = (np.abs(heights_m - 3 * FLOOR_THICKNESS_M) < FLOOR_THICKNESS_M).sum()
    return plane if slab > 1.5 * above else None


def _refine(points: F64, normal: F64, offset: float, tolerance_m: float) -> tuple[F64, float] | None:
    """Total least squares of the points near a plane, with a shrinking tolerance."""
    for tolerance in (tolerance_m, 0.7 * tolerance_m, FLOOR_THICKNESS_M):
        near = points[np.abs(points @ normal + offset) < tolerance]
        if len(near) < max(30, 0.01 * len(points)):
            return None
        center = near.mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov((near - center).T))
        if values[1] < 0.15**2 or vectors[2, 0] ** 2 < np.cos(MAX_TILT_RAD) ** 2:
            return None  # a line on a wall's foot, or no floor at all, says nothing of the tilt
        normal = vectors[:, 0] * np.sign(vectors[2, 0])
        offset = -float(normal @ center)
    return normal, offset


def _find_ceiling(heights: F64) -> float | None:
    """The topmost level slab that holds a few percent of a scan and has next to nothing above it."""
    high = heights[heights > 1.9]
    if len(high) < 0.02 * len(heights):
        return None
    counts, edges = np.histogram(high, bins=np.arange(1.9, 12.0, 0.05))
    above = len(high) - np.cumsum(counts)
    slabs = np.flatnonzero((counts > 0.015 * len(heights)) & (above < 0.02 * len(heights)))
    # The same slab is allowed to hold points on a wall: demand a peak over its lower neighbours.
    for slab in slabs:
        if counts[slab] > 2.0 * counts[max(slab - 6, 0) : max(slab - 2, 1)].mean():
            return float(edges[slab] + 0.025)
    return None
