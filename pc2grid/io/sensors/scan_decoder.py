"""One message of the scan topic to one `Scan` in the base frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64
from pc2grid.config import ReadConfig
from pc2grid.errors import LimitExceeded, PointCloudError, UnsupportedSchema
from pc2grid.geometry import pose_from_xyz_quat
from pc2grid.io.messages.types import CameraInfo, ScanMessage, valid_pose
from pc2grid.io.sensors import depth, laserscan, pointcloud2
from pc2grid.io.sensors.floor_depth import FloorDepth
from pc2grid.io.sensors.pointcloud2 import FARTHEST_HALF_M, LONGEST_SWEEP_S, Points, check_metres
from pc2grid.model import Scan, SensorKind
from pc2grid.sensor_model import SENSOR_MODELS

_LEVEL = math.cos(math.radians(60.0))  # more than that is no laser that was mounted a little askew
_UNIT_HINTS: dict[SensorKind, str] = {
    "depth": "32FC1 is in metres, 16UC1 in millimetres (REP 118); --set read.depth_unit_m=0.001 says another",
    "laser": laserscan.METRES_HINT,
    "lidar": "coordinates are in metres, in the sensor's frame: are these in a global frame such as UTM?",
}


class ScanDecoder:
    """Turns the messages of one sensor into scans; keeps the camera's calibration between them.

    notes : sentences for the user. empty : why the last scan without a return has none.
    """

    def __init__(
        self,
        topic: str,
        sensor: SensorKind,
        config: ReadConfig,
        *,
        camera_topic: str = "",
        camera: CameraInfo | None = None,
        depth_unit_m: float | None = None,
        fixed_frame: bool = False,
        longest_s: float = math.inf,
    ) -> None:
        """depth_unit_m : None: that of the encoding. fixed_frame : points are in one, not in the sensor's.
        longest_s : time from one scan to the next, in which the beams of a laser must fit."""
        self.camera = camera
        self._longest_s = min(longest_s, LONGEST_SWEEP_S)
        self.notes: list[str] = []
        self.empty = ""
        self._floor = FloorDepth()
        self._camera_topic = camera_topic
        self._depth_unit_m = depth_unit_m
        self._fixed_frame = fixed_frame
        self._sensor = sensor
        self._config = config
        self._rectified = "rect" in topic

    def returns(self, message: ScanMessage) -> int:
        """Return how many points a message holds; 0 if it cannot be used."""
        try:
            return len(self._points(message).xyz_m)
        except (PointCloudError, LimitExceeded, UnsupportedSchema):
            return 0

    def scan(self, message: ScanMessage, stamp_ns: int, T_base_sensor: F64, T_odom_base: F64 | None) -> Scan:
        """The whole scan. Raises PointCloudError, LimitExceeded or UnsupportedSchema."""
        found = self._points(message)
        origin = getattr(message, "origin", None)
        if origin is not None:
            if not valid_pose(origin):
                raise PointCloudError("the origin of the points is not finite")
            T_base_sensor = T_base_sensor @ pose_from_xyz_quat(origin[:3], origin[3:])
        self._check_plane(message.header.frame, T_base_sensor)
        self._note(found)
        xyz, offsets = found.xyz_m, found.offsets_s
        near = self._near(xyz)
        if near is not None:
            xyz, offsets = xyz[near], None if offsets is None else offsets[near]
        points = _to_base(xyz, T_base_sensor)
        if SENSOR_MODELS[self._sensor].image:
            self.notes += self._floor.warnings(points, T_base_sensor, found.unit_m)
        return Scan(
            stamp_ns=stamp_ns,
            points_m=points,
            T_base_sensor=T_base_sensor,
            sensor=self._sensor,
            offsets_s=offsets,
            T_odom_base=T_odom_base,
            dropped=found.dropped + len(found.xyz_m) - len(points),
        )

    def _note(self, found: Points) -> None:
        notes = found.notes
        if not len(found.xyz_m):
            self.empty = found.empty
            notes = (*notes, f"some scans hold no returns at all: {found.empty}")
        self.notes += [note for note in notes if note not in self.notes]

    def _check_plane(self, frame: str, T_base_sensor: F64) -> None:
        """Raise PointCloudError for a laser whose plane cuts no floor plan."""
        if SENSOR_MODELS[self._sensor].planar and abs(T_base_sensor[2, 2]) < _LEVEL:
            raise PointCloudError(
                f"tf says that the plane of the laser stands upright: x-y of frame {frame or '(empty)'}",
                hint="the frame of a LaserScan is the one in whose x-y plane the beams are: no optical frame",
            )

    def _near(self, xyz: F32 | F64) -> I64 | None:
        """Which points (N, 3) are within range; None if all are.

        Raises PointCloudError if none is, or if they cannot be metres.
        """
        limit, hint = self._config.max_range_m, _UNIT_HINTS[self._sensor]
        if not len(xyz) or max(float(xyz.max()), -float(xyz.min())) <= min(limit, FARTHEST_HALF_M) / 3**0.5:
            return None
        # Rare, so the exact distance is computed only here; in float64, as 1e30 squared overflows float32.
        ranges = np.sqrt(np.einsum("ij,ij->i", xyz, xyz, dtype=np.float64))
        near = np.flatnonzero(ranges <= limit)
        if not len(near):
            raise PointCloudError(f"every point is farther than {limit:g} m from the sensor", hint=hint)
        if not self._fixed_frame:
            check_metres(ranges[near], hint)
        return None if len(near) == len(xyz) else near

    def _points(self, message: Any) -> Points:
        limit = self._config.max_points
        if self._sensor == "lidar":
            return pointcloud2.decode(message, unit=self._config.point_time, max_points=limit)
        if self._sensor == "laser":
            return laserscan.decode(message, max_points=limit, longest_s=self._longest_s)
        if self.camera is None:
            raise PointCloudError("no CameraInfo was recorded for the depth image")
        return depth.decode(
            message,
            self.camera,
            rectified=self._rectified,
            stride=self._config.depth_stride,
            max_points=limit,
            unit_m=self._depth_unit_m,
            camera=self._camera_topic,
        )


def _to_base(xyz: F32 | F64, T_base_sensor: F64) -> F32:
    """Points (N, 3) of the sensor in the base frame."""
    # float32 is kept: half the memory, and a rounding of micrometres.
    kind: type = np.float32 if xyz.dtype == np.float32 else np.float64
    T: NDArray[Any] = T_base_sensor.astype(kind)
    points: F32 = (xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32, copy=False)
    return points
