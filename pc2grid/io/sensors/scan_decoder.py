"""One message of the scan topic to one `Scan` in the base frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64
from pc2grid.config import ReadConfig
from pc2grid.errors import PointCloudError
from pc2grid.geometry import pose_from_xyz_quat
from pc2grid.io.messages.types import CameraInfo, ScanMessage, valid_pose
from pc2grid.io.sensors import depth, laserscan, pointcloud2
from pc2grid.io.sensors.pointcloud2 import Points
from pc2grid.model import Scan, SensorKind


class ScanDecoder:
    """Decodes scans of one topic; keeps the camera's calibration between them."""

    def __init__(
        self, topic: str, sensor: SensorKind, decode: Callable[[Any], Any], config: ReadConfig
    ) -> None:
        self.camera: CameraInfo | None = None
        self.notes: list[str] = []
        self._sensor = sensor
        self._decode = decode
        self._config = config
        self._rectified = "rect" in topic

    def message(self, data: Any) -> ScanMessage:
        """The decoded message, without points. Raises what the decoder raises."""
        message: ScanMessage = self._decode(data)
        return message

    def scan(self, message: ScanMessage, stamp_ns: int, T_base_sensor: F64, T_odom_base: F64 | None) -> Scan:
        """The whole scan. Raises PointCloudError, LimitExceeded or UnsupportedSchema."""
        found = self._points(message)
        origin = getattr(message, "origin", None)
        if origin is not None:
            if not valid_pose(origin):
                raise PointCloudError("the origin of the points is not finite")
            T_base_sensor = T_base_sensor @ pose_from_xyz_quat(origin[:3], origin[3:])
        if found.note and found.note not in self.notes:
            self.notes.append(found.note)
        points, near = _to_base(found, T_base_sensor, self._config.max_range_m)
        offsets = found.offsets_s
        if near is not None:
            points = points[near]
            offsets = None if offsets is None else offsets[near]
            if not len(near):
                raise PointCloudError(
                    f"every point is farther than {self._config.max_range_m:g} m from the sensor",
                    hint="are the coordinates in a global frame such as UTM?",
                )
        return Scan(
            stamp_ns=stamp_ns,
            points_m=points,
            T_base_sensor=T_base_sensor,
            sensor=self._sensor,
            offsets_s=offsets,
            T_odom_base=T_odom_base,
            dropped=found.dropped + len(found.xyz_m) - len(points),
        )

    def _points(self, message: Any) -> Points:
        limit = self._config.max_points
        if self._sensor == "lidar":
            return pointcloud2.decode(message, unit=self._config.point_time, max_points=limit)
        if self._sensor == "laser":
            return laserscan.decode(message, max_points=limit)
        if self.camera is None:
            raise PointCloudError("no CameraInfo was recorded for the depth image")
        return depth.decode(
            message,
            self.camera,
            rectified=self._rectified,
            stride=self._config.depth_stride,
            max_points=limit,
        )


def _to_base(found: Points, T_base_sensor: F64, max_range_m: float) -> tuple[F32, I64 | None]:
    """Points (N, 3) float32 in the base frame; and which are within range, None if all are."""
    xyz = found.xyz_m
    near: I64 | None = None
    limit = max_range_m / math.sqrt(3.0)
    if len(xyz) and max(float(xyz.max()), -float(xyz.min())) > limit:
        # Rare, so the exact distance is computed only here; in float64, as 1e30 squared overflows float32.
        squared = np.einsum("ij,ij->i", xyz, xyz, dtype=np.float64)
        if float(squared.max()) > max_range_m**2:
            near = np.flatnonzero(squared <= max_range_m**2)
            xyz = np.where((squared <= max_range_m**2)[:, None], xyz, 0)
    # float32 is kept: half the memory, and a rounding of micrometres.
    kind: type = np.float32 if xyz.dtype == np.float32 else np.float64
    T: NDArray[Any] = T_base_sensor.astype(kind)
    points: F32 = (xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32, copy=False)
    return points, near
