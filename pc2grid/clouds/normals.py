"""Surface normals of the hits of a planar scan, in the plane.

A thin wall has two faces, a door post three. Seen from one side and then from the other, they are a few
centimetres apart. Scan matching that takes them for one surface has an error of half that distance at
every door, so every hit carries the direction of its surface.

The normals are estimated from the hits and not from the cloud: those of the cloud change more from scan to
scan where no surface is clear (`examples/map-quality.md`).
"""

from __future__ import annotations

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.clouds.parameters import CLOUD_PARAMETERS, CloudParameters


def planar_normals(hits_m: F32, origin_m: F64, parameters: CloudParameters = CLOUD_PARAMETERS) -> F32:
    """Return the direction (M,) in radians of the surface normal at hits (M, 2), on the sensor's side.

    origin_m : (2,) position of the sensor. The normal is the minor axis of the hits within a distance of
    `reach_m` + `reach_per_m` * range. Where these are fewer than three, the distance is `sparse_factor`
    times as large. Hits that do not lie along a line get the direction to the sensor.
    """
    from pc2grid.clouds._kernels import planar_normals as compiled

    p = parameters
    away = hits_m.astype(np.float64) - origin_m
    bearings = np.arctan2(away[:, 1], away[:, 0])
    order = np.argsort(bearings, kind="stable")
    return compiled(away, order, bearings, p.reach_m, p.reach_per_m, p.sparse_factor, p.max_flatness)


def planar_normals_plain(hits_m: F32, origin_m: F64, parameters: CloudParameters = CLOUD_PARAMETERS) -> F32:
    """`planar_normals` in plain numpy: its definition, and what tests compare the compiled form with."""
    p = parameters
    away = hits_m.astype(np.float64) - origin_m
    ranges = np.hypot(away[:, 0], away[:, 1])
    bearings = np.arctan2(away[:, 1], away[:, 0])
    turns = np.abs(bearings[:, None] - bearings)
    turns = np.minimum(turns, 2.0 * np.pi - turns)
    distances = np.linalg.norm(away[:, None] - away, axis=2)
    angles = np.arctan2(-away[:, 1], -away[:, 0])
    for k in range(len(angles)):
        for factor in (1.0, p.sparse_factor):
            reach = factor * (p.reach_m + p.reach_per_m * ranges[k])
            near = (distances[k] < reach) & (turns[k] <= reach / max(ranges[k], reach))
            near[k] = True
            if near.sum() < 3:
                continue
            variances, axes = np.linalg.eigh(np.cov(away[near].T, bias=True))
            if variances[0] < p.max_flatness * variances[1]:
                normal = axes[:, 0] * (1.0 if axes[:, 0] @ away[k] <= 0.0 else -1.0)
                angles[k] = np.arctan2(normal[1], normal[0])
            break
    return angles.astype(np.float32)
