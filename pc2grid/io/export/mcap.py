"""Recordings and results as standard ROS 2 MCAP (profile `ros2`, `cdr`, `ros2msg`): Foxglove opens them."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import mcap
import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import ArrayLike, NDArray

from pc2grid._version import __version__
from pc2grid.arrays import F32, F64
from pc2grid.geometry import SE2
from pc2grid.io.atomic import refuse_existing, replace_file
from pc2grid.io.export import ros_messages as ros
from pc2grid.model import MapOf, OccupancyGrid, Trajectory

_FLOAT32 = 7  # sensor_msgs/PointField
_FARTHEST_DEPTH_M = 65.0  # an image of 16UC1 ends at 65.535 m
_MARKER_TYPES = {"lines": 5, "spheres": 7}  # LINE_LIST, SPHERE_LIST of visualization_msgs/Marker


@dataclass(frozen=True, slots=True, kw_only=True)
class Marker:
    """Spheres at points, or lines between consecutive pairs of points, in one colour.

    points_m : (N, 3) in the frame given to `LogWriter.markers`. size_m : diameter of spheres, width of lines.
    color : red, green, blue, opacity, 0..1.
    """

    name: str
    kind: Literal["spheres", "lines"]
    points_m: F64
    size_m: float
    color: tuple[float, float, float, float]


class LogWriter:
    """Write one MCAP. The file gets its name only when the `with` block ends without an error.

    path : file to write; an existing one is refused with OutputError unless `overwrite` is set.

    Log time and publish time of every message are its stamp. Messages may be written in any order of time.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self._target = Path(path)
        refuse_existing(self._target, overwrite)
        self._stack = contextlib.ExitStack()
        self._writer: Writer | None = None
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence: dict[int, int] = {}

    def __enter__(self) -> LogWriter:
        with contextlib.ExitStack() as stack:
            temporary = stack.enter_context(replace_file(self._target))
            stream = stack.enter_context(temporary.open("wb"))
            self._writer = Writer(
                stream, chunk_size=1 << 20, compression=CompressionType.ZSTD, enable_crcs=True
            )
            self._writer.start(
                profile="ros2", library=f"pc2grid/{__version__} mcap-python/{mcap.__version__}"
            )
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None and self._writer is not None:
            # An error of `finish`, such as a full disk, must pass through replace_file, which cleans up.
            with self._stack:
                self._writer.finish()  # type: ignore[no-untyped-call]
        else:
            self._stack.__exit__(kind, error, trace)
        self._writer = None

    # --- sensors --------------------------------------------------------------------------------------

    def point_cloud(
        self,
        topic: str,
        stamp_ns: int,
        frame: str,
        points: F32,
        offsets_s: NDArray[np.floating] | None = None,
    ) -> None:
        """sensor_msgs/PointCloud2 with float32 x y z (N, 3), and `time` (s after the stamp) if given."""
        names = ["x", "y", "z"] + (["time"] if offsets_s is not None else [])
        columns = np.asarray(points, dtype=np.float32).reshape(-1, 3)
        if offsets_s is not None:
            columns = np.column_stack((columns, np.asarray(offsets_s, dtype=np.float32)))
        fields = [
            ros.new("sensor_msgs/PointField", name, 4 * index, _FLOAT32, 1)
            for index, name in enumerate(names)
        ]
        count, step = len(columns), 4 * len(names)
        cloud = (1, count, fields, False, step, step * count, _bytes_of(columns, "<f4"), True)
        self._add(topic, stamp_ns, ros.new("sensor_msgs/PointCloud2", ros.header(stamp_ns, frame), *cloud))

    def laser_scan(
        self,
        topic: str,
        stamp_ns: int,
        frame: str,
        ranges: ArrayLike,
        angle_min: float,
        angle_increment: float,
        range_min: float,
        range_max: float,
        time_increment: float = 0.0,
    ) -> None:
        """sensor_msgs/LaserScan; `inf` in ranges means no return."""
        values = np.asarray(ranges, dtype=np.float32).reshape(-1)
        angle_max = angle_min + angle_increment * (len(values) - 1)
        angles = (angle_min, angle_max, angle_increment)
        times = (time_increment, time_increment * len(values))
        intensities = np.empty(0, np.float32)
        scan = (*angles, *times, range_min, range_max, values, intensities)
        self._add(topic, stamp_ns, ros.new("sensor_msgs/LaserScan", ros.header(stamp_ns, frame), *scan))

    def depth_image(self, topic: str, stamp_ns: int, frame: str, depth_m: ArrayLike) -> None:
        """sensor_msgs/Image of encoding 16UC1: millimetres, 0 without a return or beyond 65 m."""
        depth = np.asarray(depth_m, dtype=np.float64)
        millimetres = np.zeros(depth.shape, dtype=np.uint16)
        good = np.isfinite(depth) & (depth > 0) & (depth < _FARTHEST_DEPTH_M)
        millimetres[good] = np.rint(depth[good] * 1000.0).astype(np.uint16)
        height, width = depth.shape
        image = (height, width, "16UC1", 0, 2 * width, _bytes_of(millimetres, "<u2"))
        self._add(topic, stamp_ns, ros.new("sensor_msgs/Image", ros.header(stamp_ns, frame), *image))

    def camera_info(self, topic: str, stamp_ns: int, frame: str, K: ArrayLike, W: int, H: int) -> None:
        """sensor_msgs/CameraInfo of an undistorted camera with intrinsics K (3, 3) and W x H pixels."""
        k = np.asarray(K, dtype=np.float64).reshape(3, 3)
        distortion, rectification = np.zeros(5), np.eye(3).reshape(-1)
        projection = np.column_stack((k, np.zeros(3))).reshape(-1)
        whole_image = ros.new("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        camera = (H, W, "plumb_bob", distortion, k.reshape(-1), rectification, projection, 0, 0, whole_image)
        self._add(topic, stamp_ns, ros.new("sensor_msgs/CameraInfo", ros.header(stamp_ns, frame), *camera))

    # --- poses ----------------------------------------------------------------------------------------

    def odometry(
        self, topic: str, stamp_ns: int, T_odom_base: F64, frame: str = "odom", child: str = "base_link"
    ) -> None:
        """nav_msgs/Odometry with a pose (4, 4); covariance and twist zero (unknown)."""
        unknown = np.zeros(36)
        pose = ros.new("geometry_msgs/PoseWithCovariance", ros.pose(T_odom_base), unknown)
        zero = ros.vector(0.0, 0.0, 0.0)
        twist = ros.new(
            "geometry_msgs/TwistWithCovariance", ros.new("geometry_msgs/Twist", zero, zero), unknown
        )
        header = ros.header(stamp_ns, frame)
        self._add(topic, stamp_ns, ros.new("nav_msgs/Odometry", header, child, pose, twist))

    def tf(self, stamp_ns: int, parent: str, child: str, T_parent_child: F64) -> None:
        """One transform (4, 4) on /tf."""
        self._transforms("/tf", stamp_ns, [(parent, child, T_parent_child)])

    def tf_static(self, stamp_ns: int, parent: str, child: str, T_parent_child: F64) -> None:
        """One transform (4, 4) on /tf_static: valid at all times."""
        self._transforms("/tf_static", stamp_ns, [(parent, child, T_parent_child)])

    def path(
        self, topic: str, trajectory: Trajectory, frame: str = "map", *, stamp_ns: int | None = None
    ) -> None:
        """nav_msgs/Path of a whole trajectory with the stamp of its first pose, so players always show it.

        stamp_ns : another stamp, for a path of another time.
        """
        if not len(trajectory):
            return
        at_ns = int(trajectory.stamps_ns[0]) if stamp_ns is None else stamp_ns
        poses = [
            ros.new("geometry_msgs/PoseStamped", ros.header(int(pose_ns), frame), ros.pose(T))
            for pose_ns, T in zip(trajectory.stamps_ns, trajectory.T_session_base, strict=True)
        ]
        self._add(topic, at_ns, ros.new("nav_msgs/Path", ros.header(at_ns, frame), poses))

    def pose_with_covariance(
        self, topic: str, stamp_ns: int, pose: SE2, covariance: ArrayLike, frame: str = "map"
    ) -> None:
        """geometry_msgs/PoseWithCovarianceStamped of a planar pose; covariance (3, 3) of x, y, yaw."""
        self._add(topic, stamp_ns, ros.pose_with_covariance(stamp_ns, pose, covariance, frame))

    def initialpose(self, stamp_ns: int, pose: SE2, covariance: ArrayLike, frame: str = "map") -> None:
        """The same on /initialpose, as nav2 takes it."""
        self._add("/initialpose", stamp_ns, ros.initialpose(stamp_ns, pose, covariance, frame))

    # --- maps and metadata ----------------------------------------------------------------------------

    def occupancy_grid(
        self, topic: str, stamp_ns: int, grid: OccupancyGrid, frame: str = "map", of: MapOf = "everything"
    ) -> None:
        """nav_msgs/OccupancyGrid; row 0 has the smallest y, as in `OccupancyGrid`. of : see its `told`."""
        self._add(topic, stamp_ns, ros.occupancy_grid(stamp_ns, grid, frame, of))

    def markers(self, topic: str, stamp_ns: int, markers: Sequence[Marker], frame: str = "map") -> None:
        """visualization_msgs/MarkerArray in the layout since ROS 2 Humble; shown until replaced."""
        drawn = [
            _marker(number, marker, ros.header(stamp_ns, frame)) for number, marker in enumerate(markers)
        ]
        self._add(topic, stamp_ns, ros.new("visualization_msgs/MarkerArray", drawn))

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """An MCAP metadata record: the configuration, the digest of the input, and the like."""
        self._open().add_metadata(name, values)

    def _transforms(self, topic: str, stamp_ns: int, edges: Sequence[tuple[str, str, F64]]) -> None:
        self._add(topic, stamp_ns, ros.transforms(stamp_ns, edges))

    def _open(self) -> Writer:
        if self._writer is None:
            raise RuntimeError("LogWriter is used outside of its with block")
        return self._writer

    def _add(self, topic: str, stamp_ns: int, message: Any) -> None:
        writer = self._open()
        type_name: str = message.__msgtype__
        if type_name not in self._schemas:
            self._schemas[type_name] = writer.register_schema(
                name=type_name, encoding="ros2msg", data=ros.definition(type_name).encode()
            )
        key = (topic, type_name)
        if key not in self._channels:
            self._channels[key] = writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=self._schemas[type_name]
            )
        channel = self._channels[key]
        sequence = self._sequence.get(channel, 0)
        self._sequence[channel] = sequence + 1
        writer.add_message(
            channel_id=channel,
            log_time=int(stamp_ns),
            publish_time=int(stamp_ns),
            sequence=sequence,
            data=ros.serialized(message),
        )


def _bytes_of(values: NDArray[Any], dtype: str) -> NDArray[np.uint8]:
    """The values, row by row, as the bytes of a numpy type."""
    return np.ascontiguousarray(values, dtype).view(np.uint8).reshape(-1)


def _marker(number: int, marker: Marker, header: Any) -> Any:
    """visualization_msgs/Marker without lifetime: it is shown until it is replaced."""
    points = np.asarray(marker.points_m, np.float64).reshape(-1, 3).tolist()
    no_texture = ros.new("sensor_msgs/CompressedImage", ros.header(0, ""), "", np.empty(0, np.uint8))
    no_mesh = ros.new("visualization_msgs/MeshFile", "", np.empty(0, np.uint8))
    return ros.new(
        "visualization_msgs/Marker",
        header,
        marker.name,
        number,
        _MARKER_TYPES[marker.kind],
        0,  # action: add
        ros.pose(np.eye(4)),
        ros.vector(marker.size_m, marker.size_m, marker.size_m),
        ros.new("std_msgs/ColorRGBA", *marker.color),
        ros.new("builtin_interfaces/Duration", 0, 0),
        False,
        [ros.new("geometry_msgs/Point", *point) for point in points],
        [],  # colours of single points
        "",
        no_texture,
        [],
        "",
        "",
        no_mesh,
        False,
    )
