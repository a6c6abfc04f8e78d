"""The points in space of a session: those of its keyframes, kept until the loops are closed.

A keyframe is reduced to one point a voxel and kept in a `Spool`, six bytes a point. When its final pose is
known, it is added to the voxels of the session. So memory grows with the surfaces that were seen, and
the file with the travel: 0.4 GB for an hour of a lidar at 0.5 m/s.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator

import numpy as np

from pc2grid.arrays import F32, F64, BoolGrid
from pc2grid.clouds.voxel_cloud import VoxelCloud
from pc2grid.geometry import transform_points
from pc2grid.mapping.spool import Spool
from pc2grid.model import PointMap, Scan
from pc2grid.sensor_model import SENSOR_MODELS

_STEPS = 32767  # of int16, from the origin of the base to the farthest point
_MOUNTED_M = 3.0  # farthest place of a sensor on its base


class KeyframePoints:
    """The points of keyframes; a sequence that only grows.

    voxel_m : edge of a voxel. max_range_m : returns farther than this from the sensor are left out.
    """

    def __init__(self, voxel_m: float, max_range_m: float) -> None:
        self._voxel_m, self._max_range_m = voxel_m, max_range_m
        self._step_m = (max_range_m + _MOUNTED_M) / _STEPS
        self._clouds = Spool("points")
        self._scans = array("q")

    def append(self, index: int, scan: Scan) -> None:
        """Add a deskewed scan, number `index` of the session. Raises OutputError if the disk is full."""
        # A camera measures farther surfaces with a noise that is larger than a voxel.
        range_m = min(self._max_range_m, SENSOR_MODELS[scan.sensor].range_of_noise_m(self._voxel_m))
        away = scan.points_m - scan.T_base_sensor[:3, 3].astype(np.float32)
        near = np.einsum("ij,ij->i", away, away) < range_m**2
        cloud = VoxelCloud(self._voxel_m)
        cloud.add(scan.points_m[near])
        steps = np.rint(cloud.points_m() / self._step_m)
        within = (np.abs(steps) <= _STEPS).all(axis=1)
        self._clouds.append(steps[within].astype("<i2").tobytes())
        self._scans.append(index)

    def __getitem__(self, number: int) -> tuple[int, F32]:
        """The number of a scan in the session, and its points (N, 3) in the base frame."""
        steps = np.frombuffer(self._clouds[number], "<i2").reshape(-1, 3)
        return self._scans[number], steps * np.float32(self._step_m)

    def __iter__(self) -> Iterator[tuple[int, F32]]:
        return (self[number] for number in range(len(self._scans)))

    def around(self, number: int, most: int, T_session_base: F64) -> F64:
        """The points (M, 3) of a keyframe and some on either side, at the poses (N, 4, 4) of their scans."""
        near = range(max(number - most, 0), min(number + most + 1, len(self._scans)))
        return np.concatenate(
            [transform_points(T_session_base[k], m) for k, m in map(self.__getitem__, near)]
        )

    def registered(self, T_session_base: F64, chosen: BoolGrid | None = None) -> PointMap | None:
        """The points at the poses (N, 4, 4) of their scans, one a voxel; None if there are none.

        chosen : (N,) the scans to use; by default all.
        """
        cloud = VoxelCloud(self._voxel_m)
        for index, points_m in self:
            if chosen is None or chosen[index]:
                cloud.add(transform_points(T_session_base[index], points_m))
        if not len(cloud):
            return None
        return PointMap.of(cloud.points_m(), self._voxel_m, cloud.corner_m)

    def close(self) -> None:
        """Remove the temporary file."""
        self._clouds.close()
