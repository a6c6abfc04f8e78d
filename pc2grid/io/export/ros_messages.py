"""ROS 2 messages of what pc2grid writes and publishes, and their bytes in CDR.

Messages are serialised, and their definitions written, by the type store of `rosbags` for ROS 2 Humble. Large
arrays are handed to it as numpy arrays, which it copies as a whole.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from pc2grid.arrays import F64
from pc2grid.geometry import SE2, quat_xyzw_from_pose
from pc2grid.model import MapOf, OccupancyGrid

_UNOBSERVED = 1e6
"""Variance of z, roll and pitch of a planar pose, as drivers of robots on wheels write it. nav2 takes 1e9 at
most."""

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


@functools.cache
def typestore() -> Typestore:
    """The message types of ROS 2 Humble; loading them takes 0.1 s, so only a writer does."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def new(name: str, *fields: Any) -> Any:
    """A message of type `package/Name` from its fields, in the order of its definition."""
    return typestore().types[name.replace("/", "/msg/")](*fields)


def time(stamp_ns: int) -> Any:
    """builtin_interfaces/Time."""
    return new("builtin_interfaces/Time", *divmod(int(stamp_ns), 1_000_000_000))


def header(stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    return new("std_msgs/Header", time(stamp_ns), frame)


def vector(x: float, y: float, z: float) -> Any:
    """geometry_msgs/Vector3."""
    return new("geometry_msgs/Vector3", float(x), float(y), float(z))


def quaternion(T: F64) -> Any:
    """geometry_msgs/Quaternion of a (4, 4) pose."""
    return new("geometry_msgs/Quaternion", *(float(v) for v in quat_xyzw_from_pose(T)))


def pose(T: F64) -> Any:
    """geometry_msgs/Pose of a (4, 4) pose."""
    point = new("geometry_msgs/Point", *(float(v) for v in T[:3, 3]))
    return new("geometry_msgs/Pose", point, quaternion(T))


def transform(T: F64) -> Any:
    """geometry_msgs/Transform of a (4, 4) pose."""
    return new("geometry_msgs/Transform", vector(*T[:3, 3]), quaternion(T))


def definition(type_name: str) -> str:
    """The definition, in the .msg language, of a type such as `nav_msgs/msg/OccupancyGrid`."""
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def serialized(message: Any) -> bytes:
    """A message in CDR, little endian."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__, little_endian=True))


# --- whole messages -----------------------------------------------------------------------------------


def pose_with_covariance(stamp_ns: int, planar: SE2, covariance: ArrayLike, frame: str = "map") -> Any:
    """geometry_msgs/PoseWithCovarianceStamped of a planar pose; covariance (3, 3) of x, y, yaw.

    Its 36 numbers are row by row of x, y, z, roll, pitch, yaw; what a plane does not show is `_UNOBSERVED`.
    """
    full = np.diag([0.0, 0.0, _UNOBSERVED, _UNOBSERVED, _UNOBSERVED, 0.0])
    full[np.ix_((0, 1, 5), (0, 1, 5))] = np.asarray(covariance, dtype=np.float64).reshape(3, 3)
    content = new("geometry_msgs/PoseWithCovariance", pose(planar.lift()), full.reshape(-1))
    return new("geometry_msgs/PoseWithCovarianceStamped", header(stamp_ns, frame), content)


def initialpose(stamp_ns: int, planar: SE2, covariance: ArrayLike, frame: str = "map") -> Any:
    """The same as nav2 takes it on /initialpose: with variances alone.

    nav2 refuses the message if one of its 36 numbers is negative (`validateMsg` of nav2_ros_common), and a
    covariance of x, y and yaw mostly is. AMCL reads the variances and, of all others, that of x with y.
    """
    variances = np.diag(np.diagonal(np.asarray(covariance, dtype=np.float64)))
    return pose_with_covariance(stamp_ns, planar, variances, frame)


def occupancy_grid(stamp_ns: int, grid: OccupancyGrid, frame: str = "map", of: MapOf = "everything") -> Any:
    """nav_msgs/OccupancyGrid; row 0 has the smallest y, as in `OccupancyGrid`. of : see its `told`."""
    height, width = grid.cells.shape
    origin = pose(SE2(*grid.origin_m).lift())
    info = new("nav_msgs/MapMetaData", time(stamp_ns), grid.resolution_m, width, height, origin)
    cells = np.ascontiguousarray(grid.told(of)).reshape(-1)
    return new("nav_msgs/OccupancyGrid", header(stamp_ns, frame), info, cells)


def transforms(stamp_ns: int, edges: Sequence[tuple[str, str, F64]]) -> Any:
    """tf2_msgs/TFMessage of edges (parent, child, T_parent_child), with T (4, 4)."""
    stamped = [
        new("geometry_msgs/TransformStamped", header(stamp_ns, parent), child, transform(T))
        for parent, child, T in edges
    ]
    return new("tf2_msgs/TFMessage", stamped)
