"""Depths in another unit than their encoding says, noticed by the floor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pc2grid.arrays import F32, F64

# In most scans of a camera on a robot that sees the floor, a tenth of the returns are on it. Chosen by hand;
# cameras whose unit is not the millimetre have one of 0.25, 0.2 or 0.1 mm.
_LOWEST_PERCENT = 10
_SAMPLE = 8  # of so many points one is looked at
_LEAST_HEIGHT_M, _LEAST_SCANS, _DEEP = 0.1, 5, 3.0


class FloorDepth:
    """Compares how far the floor lies under a camera with what tf says, over many scans."""

    def __init__(self) -> None:
        self._scans = 0
        self._deep: list[float] = []
        self._warned = False

    def warnings(self, points_m: F32, T_base_sensor: F64, unit_m: float) -> Iterator[str]:
        """A sentence for the user, once most scans so far show it.

        points_m : (N, 3) in the base frame. unit_m : the one that the depths were read in.
        """
        height_m = float(T_base_sensor[2, 3])
        if self._warned or height_m < _LEAST_HEIGHT_M or not len(points_m):
            return
        self._scans += 1
        times = 1.0 - float(np.percentile(points_m[::_SAMPLE, 2], _LOWEST_PERCENT)) / height_m
        if times > _DEEP:
            self._deep.append(times)
        if self._scans < _LEAST_SCANS or 2 * len(self._deep) <= self._scans:
            return
        self._warned, times = True, float(np.median(self._deep))
        yield (
            f"the floor lies {times:.1f} times as far under the camera as tf says ({height_m:.2f} m): unless "
            f"the base is far above the floor, the unit of the depths is not {unit_m:g} m; "
            f"--set read.depth_unit_m={unit_m / times:.2g} says which it is"
        )
