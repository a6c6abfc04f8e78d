"""The floor that rises ahead: a ramp is no wall.

Before a ramp, its surface is as high as an obstacle, all over and not along a line, and what a camera sees of
it moves with every error of the floor's tilt. A floor is what a robot can drive on: it rises gently all the
way from where the robot stands.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, I64
from pc2grid.clouds.ground import Ground
from pc2grid.clouds.parameters import CLOUD_PARAMETERS, CloudParameters


def flatten_slopes(
    points_m: F32,
    sensor_m: NDArray[np.floating],
    ground: Ground,
    band_m: tuple[float, float],
    parameters: CloudParameters = CLOUD_PARAMETERS,
) -> F32:
    """Return points (N, 3) of which those on a gently rising floor are laid on the floor's plane.

    points_m : of a sensor that sees the floor densely, a depth camera. sensor_m : (3,) its position, same
    frame. band_m : lowest and highest height of an obstacle above the floor.

    Along each bearing, from the sensor outward, floor is all that rises by no more than
    `steepest_floor_rad` from every point before it. The first point that does ends it, and so does a gap:
    behind it, floor begins again where it is as low as the robot stands.
    """
    p = parameters
    gentle, low_m = math.tan(p.steepest_floor_rad), band_m[0]
    heights = ground.heights(points_m)
    ranges = np.hypot(points_m[:, 0] - np.float32(sensor_m[0]), points_m[:, 1] - np.float32(sensor_m[1]))
    # No floor is higher than this so far away.
    within = np.flatnonzero(heights <= np.minimum(gentle * ranges + p.floor_noise_m, band_m[1]))
    if not (heights[within] > low_m).any():
        return points_m
    away = points_m[within, :2] - sensor_m[:2].astype(np.float32)
    bearing = np.rint(np.arctan2(away[:, 1], away[:, 0]) * np.float32(p.slope_bearings / (2.0 * np.pi)))
    farthest_m = ranges[within].max() + 1.0
    outward = np.argsort(bearing * farthest_m + ranges[within])
    within, bearing = within[outward], bearing[outward]
    height = heights[within]
    first = np.ones(len(within), dtype=bool)
    first[1:] = (bearing[1:] != bearing[:-1]) | (np.diff(ranges[within]) > p.floor_gap_m)
    # By how much a point lies above the steepest floor that begins at the sensor; less with each stretch, so
    # that the least so far is always one of the same stretch.
    above = height - gentle * ranges[within] - 100.0 * np.cumsum(first)
    steep = height > low_m
    steep[1:] = np.where(
        first[1:], steep[1:], above[1:] > np.minimum.accumulate(above)[:-1] + p.floor_noise_m
    )
    # Floor is what has no steep step before it.
    steps = np.cumsum(steep)
    before: I64 = (steps - steep)[first][np.cumsum(first) - 1]
    raised = within[(steps == before) & (height > low_m)]
    if not len(raised):
        return points_m
    flattened = points_m.copy()
    flattened[raised] -= heights[raised, None] * ground.normal.astype(np.float32)
    return flattened
