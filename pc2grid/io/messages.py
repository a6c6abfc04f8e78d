"""The messages that matter here, whatever they were written in: ROS 2, ROS 1, Foxglove, or files of clouds.

Large arrays stay views of the log's bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

Bytes = memoryview | bytes
Seven = tuple[float, float, float, float, float, float, float]  # x y z, qx qy qz qw


@dataclass(frozen=True, slots=True)
class Header:
    """std_msgs/Header."""

    stamp_ns: int
    frame: str


@dataclass(frozen=True, slots=True)
class PointCloud2:
    """sensor_msgs/PointCloud2; fields as (name, offset, datatype, count).

    origin : of the points in the header's frame; None for the frame itself.
    """

    header: Header
    height: int
    width: int
    fields: tuple[tuple[str, int, int, int], ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: Bytes
    origin: Seven | None = None

    @property
    def size_bytes(self) -> int:
        """How much memory it keeps."""
        return len(self.data)


@dataclass(frozen=True, slots=True)
class LaserScan:
    """sensor_msgs/LaserScan without intensities; radians, seconds, metres. origin as in PointCloud2."""

    header: Header
    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment: float
    scan_time: float
    range_min: float
    range_max: float
    ranges: NDArray[Any]
    origin: Seven | None = None

    @property
    def size_bytes(self) -> int:
        """How much memory it keeps."""
        return self.ranges.nbytes


@dataclass(frozen=True, slots=True)
class Image:
    """sensor_msgs/Image."""

    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: bool
    step: int
    data: Bytes

    @property
    def size_bytes(self) -> int:
        """How much memory it keeps."""
        return len(self.data)


@dataclass(frozen=True, slots=True)
class CompressedImage:
    """sensor_msgs/CompressedImage."""

    header: Header
    format: str
    data: Bytes

    @property
    def size_bytes(self) -> int:
        """How much memory it keeps."""
        return len(self.data)


ScanMessage = PointCloud2 | LaserScan | Image | CompressedImage


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """sensor_msgs/CameraInfo: distortion d, intrinsics k (9 numbers), projection p (12 numbers)."""

    header: Header
    height: int
    width: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    p: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Transform:
    """One edge of tf: the pose of `child` in `header.frame`.

    lasting : holds until there is a newer one, and not for a moment only.
    """

    header: Header
    child: str
    pose: Seven
    lasting: bool = False


@dataclass(frozen=True, slots=True)
class Odometry:
    """nav_msgs/Odometry without covariance and twist: the pose of `child` in `header.frame`."""

    header: Header
    child: str
    pose: Seven
