"""Surface normals of the hits of a planar scan, in the plane.

A thin wall has two faces, a door post three. Seen from one side and then from the other, they are a few
centimetres apart. Scan matching that takes them for one surface has an error of half that distance at
every door, so every hit carries the direction of its surface.

The normals are estimated from the hits and not from the cloud: those of the cloud change more from scan to
scan where no surface is clear (`docs/method.md`).
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
