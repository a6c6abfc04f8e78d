"""The message types that every encoding is decoded to: ROS 2, ROS 1, Foxglove, and files of clouds; and the
points that are made of them.

Large arrays stay views of the log's bytes. Lengths are in metres, angles in radians, times in seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from pc2grid.geometry import F32, F64

Bytes = memoryview | bytes
Seven = tuple[float, float, float, float, float, float, float]
"""A pose as messages hold it: x y z in metres, then the quaternion x y z w."""

HEADER_BYTES = 1 << 16
"""No text that describes data is longer: the header of a cloud, a map.yaml, the definition of a message (of
those known up to 15,000 characters, with all comments)."""
MOST_PARTS = 1000
"""No real message has so many fields, cloud so many columns, camera so many numbers of distortion, and
recording so many frames. The known types flatten to some tens of fields; the limit bounds the time for a
crafted text to half a second."""
# Coordinates beyond this are a mistake: it is twice the circumference of the earth, and floats are far from
# overflowing.
FARTHEST_M = 1e8
# Least and largest edge of a cell or voxel: submaps are some metres wide.
EDGES_M = (1e-3, 100.0)
# The squared length of a quaternion within which it has a direction; writers do not always normalise it.
_QUATERNION_SQUARED = (1e-12, 1e12)


def valid_pose(pose: Seven) -> bool:
    """Return True if a pose is finite, within `FARTHEST_M`, and its quaternion has a direction."""
    if not all(map(math.isfinite, pose)) or max(map(abs, pose[:3])) > FARTHEST_M:
        return False
    return _QUATERNION_SQUARED[0] < sum(v * v for v in pose[3:]) < _QUATERNION_SQUARED[1]


@dataclass(frozen=True, slots=True)
class Header:
    """std_msgs/Header."""

    stamp_ns: int
    frame: str


@dataclass(frozen=True, slots=True)
class PointCloud2:
    """sensor_msgs/PointCloud2; fields as (name, offset, datatype, count).

    origin : pose of the points' frame in the header's frame; None if they are the same.
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


@dataclass(frozen=True, slots=True)
class CompressedImage:
    """sensor_msgs/CompressedImage."""

    header: Header
    format: str
    data: Bytes


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

    lasting : the pose is valid until a newer one is published, and not only near its stamp.
    """

    header: Header
    child: str
    pose: Seven
    lasting: bool = False


@dataclass(frozen=True, slots=True)
class StampedPose:
    """nav_msgs/Odometry without twist, geometry_msgs/PoseStamped or PoseWithCovarianceStamped.

    child : the frame whose pose in `header.frame` it is; empty if the type names none. covariance : 36
    numbers, row-major over x, y, z, roll, pitch, yaw; None: unknown.
    """

    header: Header
    pose: Seven
    child: str = ""
    covariance: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Imu:
    """sensor_msgs/Imu: each of the three is None if its covariance marks it as not measured (-1).

    orientation : quaternion x y z w in a frame whose z axis is up. turn_rate_rps : (3,) of the gyroscope.
    acceleration_mps2 : (3,) specific force: at rest it points up.
    """

    header: Header
    orientation: tuple[float, float, float, float] | None
    turn_rate_rps: tuple[float, float, float] | None
    acceleration_mps2: tuple[float, float, float] | None


NO_RETURN = "nothing came back (0, NaN or inf)"


@dataclass(frozen=True, slots=True)
class Points:
    """Returns of one scan in the sensor's frame.

    xyz_m : (N, 3) finite. offsets_s : (N,) relative to the stamp, or None. dropped : returns left out.
    notes : sentences for the user on how the message was interpreted. empty : why there is no point at all,
    if there is none. unit_m : of the numbers in the message.
    """

    xyz_m: F32 | F64
    offsets_s: F32 | None
    dropped: int
    notes: tuple[str, ...] = ()
    empty: str = NO_RETURN
    unit_m: float = 1.0
