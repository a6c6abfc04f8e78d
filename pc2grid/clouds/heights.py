"""At which heights a scan has seen what stands somewhere, and at which it has looked past it.

A laser at 0.3 m sees the legs of a table, a camera at 1 m its top, a lidar both and the wall behind it. So
that they can be compared, each obstacle of a planar scan keeps the slices of heights (`SLICES`) in which the
scan has a return from it, and those in which a ray went on behind it.
"""

from __future__ import annotations

import numpy as np

from pc2grid.arrays import F32, F64, U8
from pc2grid.model import SLICE_BORDERS_M

_BEARINGS = 720
"""Bearings that the returns are sorted by; as many as are fast."""


def heights_seen(
    at_m: F32,
    points_m: F32,
    sensor_m: F64,
    plane: F64,
    band_m: tuple[float, float],
    depths: tuple[float, float],
) -> U8:
    """The heights (K,) that a scan tells of what stands at (K, 2), see `pc2grid.model.SLICES`.

    points_m : (N, 3) all returns of the scan, also of floor and ceiling. sensor_m : (3,).
    plane : (4,) with height = plane[:3] . p + plane[3]. band_m : lowest and highest height of an obstacle.
    depths : (d, q), a return belongs to what stands at the range r if it is within d of its bearing, and
    within d + q * r**2 of its range; behind that, its ray has passed by, if it is within d / 4 of the
    bearing: along a wall rays pass beside it.
    """
    from pc2grid.clouds._kernels import heights_seen as compiled

    return compiled(at_m, points_m, sensor_m, plane, band_m, depths, np.array(SLICE_BORDERS_M), _BEARINGS)
