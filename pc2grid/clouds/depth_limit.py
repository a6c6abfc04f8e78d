"""The far limit of a depth camera: hits near it are measured too short, and move along with the robot.

The noise of a depth grows with its square, and a camera reports nothing beyond its farthest depth. Of a wall
at this depth only those pixels are seen whose noise makes them nearer: their mean is several centimetres too
short, and stays so while the camera approaches. Matched with the scans before, such hits say that the robot
has moved less than it has (`docs/method.md`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.clouds.parameters import CLOUD_PARAMETERS, CloudParameters
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.sensor_model import SENSOR_MODELS


class DepthLimit:
    """The farthest depth that a camera has reported so far, and the hits that lie safely before it.

    Where nothing cuts depths off, the farthest pixel of a wall lies more than three standard deviations
    behind the mean of its pixels, because there are thousands. So a hit, which is a mean, is not left out.
    """

    def __init__(self, parameters: CloudParameters = CLOUD_PARAMETERS) -> None:
        self._parameters = parameters
        self._farthest_m = 0.0

    @property
    def unbiased_m(self) -> float:
        """Depth up to which the limit cuts off less than one pixel in forty."""
        noise_per_m2 = SENSOR_MODELS["depth"].noise_per_m2
        return self._farthest_m - self._parameters.limit_sigmas * noise_per_m2 * self._farthest_m**2

    def observe(self, points_m: NDArray[np.floating], T_base_sensor: F64) -> None:
        """Take in the points (N, 3) of a scan, base frame, of a camera at `T_base_sensor` (4, 4)."""
        if len(points_m):
            axis = T_base_sensor[:3, 2]
            farthest_m = float((points_m @ axis.astype(points_m.dtype)).max() - T_base_sensor[:3, 3] @ axis)
            self._farthest_m = max(self._farthest_m, farthest_m)

    def before(self, planar_scan: PlanarScan, T_level_sensor: F64) -> PlanarScan:
        """The planar scan without its hits at depths beyond `unbiased_m`.

        T_level_sensor : (4, 4) pose of the camera in the levelled base frame, optical axes (z forward). The
        depth of a hit is that at the height of the camera.
        """
        depth_m = (planar_scan.hits_m - planar_scan.origin_m) @ T_level_sensor[:2, 2]
        return planar_scan.only(depth_m <= self.unbiased_m)
