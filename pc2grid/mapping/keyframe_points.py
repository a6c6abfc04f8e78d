"""The points in space of a session: those of its keyframes, kept until the loops are closed.

A keyframe is reduced to one point a voxel and written to a temporary file, six bytes a point. When its final
pose is known, it is added to the voxels of the session. So memory grows with the surfaces that were seen, and
the file with the travel: 0.4 GB for an hour of a lidar at 0.5 m/s.
"""

from __future__ import annotations

import tempfile
from array import array
from collections.abc import Iterator

import numpy as np

from pc2grid.arrays import F32, F64, BoolGrid
from pc2grid.clouds.voxel_cloud import VoxelCloud
from pc2grid.errors import OutputError
from pc2grid.geometry import transform_points
from pc2grid.model import PointMap, Scan
from pc2grid.sensor_model import SENSOR_MODELS

_STEPS = 32767  # of int16, from the origin of the base to the farthest point
_MOUNTED_M = 3.0  # farthest place of a sensor on its base
_IN_MEMORY_BYTES = 32 << 20


class KeyframePoints:
    """The points of keyframes; a sequence that only grows.

    voxel_m : edge of a voxel. max_range_m : returns farther than this from the sensor are left out.
    """

    def __init__(self, voxel_m: float, max_range_m: float) -> None:
        self._voxel_m, self._max_range_m = voxel_m, max_range_m
        self._step_m = (max_range_m + _MOUNTED_M) / _STEPS
        self._file = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY_BYTES)  # noqa: SIM115
        self._index, self._ends = array("q"), array("q", [0])

    def append(self, index: int, scan: Scan) -> None:
        """Add a deskewed scan, number `index` of the session. Raises OutputError if the disk is full."""
        # A camera measures farther surfaces with a noise that is larger than a voxel.
        range_m = min(self._max_range_m, SENSOR_MODELS[scan.sensor].range_of_noise_m(self._voxel_m))
        away = scan.points_m - scan.T_base_sensor[:3, 3].astype(np.float32)
        near = np.einsum("ij,ij->i", away, away) < range_m**2
        cloud = VoxelCloud(self._voxel_m)
        cloud.add(scan.points_m[near])
        steps = np.rint(cloud.points_m() / self._step_m)
        data = steps[(np.abs(steps) <= _STEPS).all(axis=1)].astype("<i2").tobytes()
        try:
            self._file.seek(self._ends[-1])
            self._file.write(data)
        except OSError as error:
            raise OutputError(
                f"{tempfile.gettempdir()}: no room for the points of the map: {error.strerror}",
                hint="set TMPDIR to a folder on a larger disk",
            ) from error
        self._index.append(index)
        self._ends.append(self._ends[-1] + len(data))

    def __iter__(self) -> Iterator[tuple[int, F32]]:
        for number, index in enumerate(self._index):
            begin, end = self._ends[number], self._ends[number + 1]
            self._file.seek(begin)
            steps = np.frombuffer(self._file.read(end - begin), "<i2").reshape(-1, 3)
            yield index, steps * np.float32(self._step_m)

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
        self._file.close()
