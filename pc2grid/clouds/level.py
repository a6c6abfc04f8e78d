"""The floor in a map of surfaces, and how high it lies from scan to scan.

A single view of a tilted camera may show a table only. In what several views have shown together, walls
stand, floors and table tops lie, and the floor is the lowest large level. From there it is followed: one
recording is one floor, and a floor is level, so that what rises is the pose by which it is seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64, BoolGrid


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelParameters:
    """Numbers of the search. Chosen by hand.

    flat : least information along the vertical of a voxel of a level surface.
    level : cosine of its normal with the vertical above which it lies.
    least_m2 : smallest floor.
    share : of the largest level that the floor must have: less below it are reflections.
    radius_m : around the sensor. bin_m : height of a slab. below_m : the floor is so far below the sensor.

    Of the floor that is followed:

    near_m : a level so near to where it is expected, beside three standard deviations, is the floor: a seat
        lies higher.
    seen_m : standard deviation of the height that one view tells.
    drift_per_m : variance that the height of a pose gains on a metre of travel, m2: 2 cm on the first, 10 cm
        on 25 m, where the odometry of a phone drifts by half a percent.
    """

    flat: float = 0.3
    level: float = 0.97
    least_m2: float = 0.4
    share: float = 0.15
    radius_m: float = 5.0
    bin_m: float = 0.1
    below_m: float = 0.3
    near_m: float = 0.2
    seen_m: float = 0.03
    drift_per_m: float = 0.02**2


LEVEL = LevelParameters()


def floor_height(
    shapes: F64, edge_m: float, sensor_m: F64, parameters: LevelParameters = LEVEL
) -> float | None:
    """z of the floor below a sensor at (3,), in a map whose z axis is up; None if it was not seen.

    The floor is the lowest large level around the sensor: tables lie above it, reflections below are small.
    """
    p = parameters
    heights = shapes[_lying_below(shapes, sensor_m, p), 2]
    if not len(heights):
        return None
    slab = np.floor((heights - heights.min()) / p.bin_m).astype(np.int64)
    counts = np.bincount(slab, minlength=2)
    # A floor on the border of two slabs is in both.
    pairs = np.append(counts[:-1] + counts[1:], counts[-1]) * edge_m**2
    large = np.flatnonzero(pairs > max(p.least_m2, p.share * pairs.max()))
    if not len(large):
        return None
    lowest = int(large[0])
    if lowest + 1 < len(pairs) and pairs[lowest + 1] > pairs[lowest]:
        lowest += 1
    return float(np.median(heights[(slab == lowest) | (slab == lowest + 1)]))


def _lying_below(shapes: F64, sensor_m: F64, p: LevelParameters) -> BoolGrid:
    """The shapes (V, 9) of level surfaces around and below a sensor at (3,)."""
    near = (np.abs(shapes[:, :2] - sensor_m[:2]) < p.radius_m).all(axis=1)
    # Of a plane, each column of the information points along the normal.
    _, _, xz, _, yz, zz = shapes[:, 3:].T
    lying = (zz > p.flat) & (zz > p.level * np.sqrt(xz**2 + yz**2 + zz**2))
    below: BoolGrid = near & lying & (shapes[:, 2] < sensor_m[2] - p.below_m)
    return below


class FloorBelow:
    """z of the floor below a sensor in the hand, by poses whose height drifts.

    z_m : None as long as none was seen. sigma_m : its standard deviation.
    risen_m : how far the poses have risen since the floor was first seen.
    """

    def __init__(self, parameters: LevelParameters = LEVEL) -> None:
        self._parameters = parameters
        self.z_m: float | None = None
        self.sigma_m = self.risen_m = 0.0

    def follow(self, travel_m: float, view: F64, surfaces: F64, edge_m: float, sensor_m: F64) -> float | None:
        """Go on after some travel; returns z of the floor by a view alone, None if that does not show it.

        view : (V, 9) the shapes that it shows by itself; surfaces : (W, 9) those of all views.
        """
        p = self._parameters
        variance = self.sigma_m**2 + p.drift_per_m * travel_m
        self.sigma_m = math.sqrt(variance)
        near_m = p.near_m + 3.0 * self.sigma_m
        # A view may show a reflection, and all views the floor of another pass; a lower floor is in both.
        if self.z_m is None or self._lower(view, near_m, edge_m, sensor_m) is not None:
            lowest_m = self._lower(surfaces, near_m, edge_m, sensor_m)
            if lowest_m is not None:
                self.z_m, self.sigma_m = lowest_m, p.seen_m
        if self.z_m is None:
            return None
        heights_m = view[_lying_below(view, sensor_m, p), 2]
        heights_m = heights_m[np.abs(heights_m - self.z_m) < near_m]
        if len(heights_m) * edge_m**2 < p.least_m2:
            return None
        seen_m = float(np.median(heights_m))
        gain = variance / (variance + p.seen_m**2)
        rise_m = gain * (seen_m - self.z_m)
        self.z_m, self.risen_m = self.z_m + rise_m, self.risen_m + rise_m
        self.sigma_m = math.sqrt((1.0 - gain) * variance)
        return seen_m

    def _lower(self, surfaces: F64, near_m: float, edge_m: float, sensor_m: F64) -> float | None:
        """z of the floor in surfaces (V, 9), if it lies far below what was taken for it, such as a table, or
        none is known; else None."""
        lowest_m = floor_height(surfaces, edge_m, sensor_m, self._parameters)
        if lowest_m is not None and self.z_m is not None and lowest_m > self.z_m - near_m:
            return None
        return lowest_m
