"""The floor in a map of surfaces.

A single view of a tilted camera may show a table only. In what several views have shown together, walls
stand, floors and table tops lie, and the floor is the lowest large level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelParameters:
    """Numbers of the search. Chosen by hand.

    flat : least information along the vertical of a voxel of a level surface.
    level : cosine of its normal with the vertical above which it lies.
    least_m2 : smallest floor.
    share : of the largest level that the floor must have: less below it are reflections.
    radius_m : around the sensor. bin_m : height of a slab. below_m : the floor is so far below the sensor.
    """

    flat: float = 0.3
    level: float = 0.97
    least_m2: float = 0.4
    share: float = 0.15
    radius_m: float = 5.0
    bin_m: float = 0.1
    below_m: float = 0.3


LEVEL = LevelParameters()


def floor_height(
    shapes: F64, edge_m: float, sensor_m: F64, parameters: LevelParameters = LEVEL
) -> float | None:
    """z of the floor below a sensor at (3,), in a map whose z axis is up; None if it was not seen.

    The floor is the lowest large level around the sensor: tables lie above it, reflections below are small.
    """
    p = parameters
    means = shapes[:, :3]
    near = (np.abs(means[:, :2] - sensor_m[:2]) < p.radius_m).all(axis=1) & (
        means[:, 2] < sensor_m[2] - p.below_m
    )
    # Of a plane, each column of the information points along the normal.
    _, _, xz, _, yz, zz = shapes[near, 3:].T
    lying = (zz > p.flat) & (zz > p.level * np.sqrt(xz**2 + yz**2 + zz**2))
    heights = means[near, 2][lying]
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
