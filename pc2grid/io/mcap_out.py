"""Recordings and results as standard ROS 2 MCAP (profile `ros2`, `cdr`, `ros2msg`): Foxglove opens them."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pc2grid import __version__
from pc2grid.geometry import F64, SE2
from pc2grid.io.atomic import refuse_existing, replace_file
from pc2grid.io.cdr import Cdr
from pc2grid.io.ros_definitions import schema_text
from pc2grid.model import F32, OccupancyGrid, Trajectory

if TYPE_CHECKING:
    from mcap.writer import Writer

_FLOAT32 = 7
_MARKER_TYPES = {"lines": 5, "spheres": 7}  # LINE_LIST, SPHERE_LIST of visualization_msgs/Marker


@dataclass(frozen=True, slots=True, kw_only=True)
class Marker:
    """Spheres at points, or lines between each two of them, to be drawn in one colour.

    points_m : (N, 3) in the frame they are written for. size_m : diameter or width.
    color : red, green, blue, opacity, 0..1.
    """

    name: str
    kind: Literal["spheres", "lines"]
    points_m: F64
    size_m: float
    color: tuple[float, float, float, float]


class LogWriter:
    """Write one MCAP. The file appears under its name only when the `with` block ends well.

    path : file to write; refused with OutputError if it exists, unless `force`.

    Log time and publish time of every message are its stamp. Calls may come in any order; players sort.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        self._target = Path(path)
        refuse_existing(self._target, force)
        self._stack = contextlib.ExitStack()
        self._writer: Writer | None = None
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence: dict[int, int] = {}

    def __enter__(self) -> LogWriter:
        import mcap
        from mcap.writer import CompressionType, Writer

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
            # A failing disk must reach replace_file as the reason, so that the temporary goes.
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
        cdr = Cdr().header(stamp_ns, frame).put("I", 1, len(columns), len(names))
        for index, name in enumerate(names):
            cdr.text(name).put("I", 4 * index).put("B", _FLOAT32).put("I", 1)
        step = 4 * len(names)
        cdr.put("?", False).put("I", step, step * len(columns))
        cdr.array(np.ascontiguousarray(columns, "<f4").view(np.uint8).reshape(-1)).put("?", True)
        self._add(topic, "sensor_msgs/msg/PointCloud2", stamp_ns, cdr)

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
        cdr = Cdr().header(stamp_ns, frame)
        cdr.put("f", angle_min, angle_max, angle_increment, time_increment, time_increment * len(values))
        cdr.put("f", range_min, range_max).array(values).array(np.empty(0, np.float32))
        self._add(topic, "sensor_msgs/msg/LaserScan", stamp_ns, cdr)

    def depth_image(self, topic: str, stamp_ns: int, frame: str, depth_m: ArrayLike) -> None:
        """sensor_msgs/Image of encoding 16UC1: millimetres, 0 where there is no return (or beyond 65 m)."""
        depth = np.asarray(depth_m, dtype=np.float64)
        millimetres = np.zeros(depth.shape, dtype=np.uint16)
        good = np.isfinite(depth) & (depth > 0) & (depth < 65.0)
        millimetres[good] = np.rint(depth[good] * 1000.0).astype(np.uint16)
        height, width = depth.shape
        cdr = Cdr().header(stamp_ns, frame).put("I", height, width).text("16UC1").put("B", 0)
        cdr.put("I", 2 * width).array(millimetres.astype("<u2").view(np.uint8).reshape(-1))
        self._add(topic, "sensor_msgs/msg/Image", stamp_ns, cdr)

    def camera_info(self, topic: str, stamp_ns: int, frame: str, K: ArrayLike, W: int, H: int) -> None:
        """sensor_msgs/CameraInfo of an undistorted camera with intrinsics K (3, 3) and W x H pixels."""
        k = np.asarray(K, dtype=np.float64).reshape(3, 3)
        cdr = Cdr().header(stamp_ns, frame).put("I", H, W).text("plumb_bob").array(np.zeros(5))
        cdr.array(k.reshape(-1), counted=False).array(np.eye(3).reshape(-1), counted=False)
        cdr.array(np.column_stack((k, np.zeros(3))).reshape(-1), counted=False)
        cdr.put("I", 0, 0).put("I", 0, 0, 0, 0).put("?", False)
        self._add(topic, "sensor_msgs/msg/CameraInfo", stamp_ns, cdr)

    # --- poses ----------------------------------------------------------------------------------------

    def odometry(
        self, topic: str, stamp_ns: int, T_odom_base: F64, frame: str = "odom", child: str = "base_link"
    ) -> None:
        """nav_msgs/Odometry with a pose (4, 4); covariance and twist zero (unknown)."""
        cdr = Cdr().header(stamp_ns, frame).text(child).pose(T_odom_base)
        cdr.array(np.zeros(36), counted=False).put("d", *[0.0] * 6).array(np.zeros(36), counted=False)
        self._add(topic, "nav_msgs/msg/Odometry", stamp_ns, cdr)

    def tf(self, stamp_ns: int, parent: str, child: str, T_parent_child: F64) -> None:
        """One transform (4, 4) on /tf."""
        self._transforms("/tf", stamp_ns, [(parent, child, T_parent_child)])

    def tf_static(self, stamp_ns: int, parent: str, child: str, T_parent_child: F64) -> None:
        """One transform (4, 4) on /tf_static: valid always."""
        self._transforms("/tf_static", stamp_ns, [(parent, child, T_parent_child)])

    def path(
        self, topic: str, trajectory: Trajectory, frame: str = "map", *, stamp_ns: int | None = None
    ) -> None:
        """nav_msgs/Path of a whole trajectory, stamped with its first pose, so that it is seen all along.

        stamp_ns : another stamp, for a path that was driven at another time.
        """
        if not len(trajectory):
            return
        at_ns = int(trajectory.stamps_ns[0]) if stamp_ns is None else stamp_ns
        cdr = Cdr().header(at_ns, frame).put("I", len(trajectory))
        for pose_ns, T_map_base in zip(trajectory.stamps_ns, trajectory.T_map_base, strict=True):
            cdr.header(int(pose_ns), frame).pose(T_map_base)
        self._add(topic, "nav_msgs/msg/Path", at_ns, cdr)

    def pose_with_covariance(
        self, topic: str, stamp_ns: int, pose: SE2, covariance: ArrayLike, frame: str = "map"
    ) -> None:
        """geometry_msgs/PoseWithCovarianceStamped of a planar pose; covariance (3, 3) of x, y, yaw."""
        full = np.zeros((6, 6))
        full[np.ix_((0, 1, 5), (0, 1, 5))] = np.asarray(covariance, dtype=np.float64).reshape(3, 3)
        cdr = Cdr().header(stamp_ns, frame).pose(pose.lift()).array(full.reshape(-1), counted=False)
        self._add(topic, "geometry_msgs/msg/PoseWithCovarianceStamped", stamp_ns, cdr)

    # --- maps and notes -------------------------------------------------------------------------------

    def occupancy_grid(self, topic: str, stamp_ns: int, grid: OccupancyGrid, frame: str = "map") -> None:
        """nav_msgs/OccupancyGrid; row 0 is the smallest y, as in the grid itself."""
        height, width = grid.cells.shape
        origin = SE2(*grid.origin_m).lift()
        seconds, rest = divmod(int(stamp_ns), 1_000_000_000)
        cdr = Cdr().header(stamp_ns, frame).put("i", seconds).put("I", rest)
        cdr.put("f", grid.resolution_m).put("I", width, height).pose(origin).array(grid.cells.reshape(-1))
        self._add(topic, "nav_msgs/msg/OccupancyGrid", stamp_ns, cdr)

    def markers(self, topic: str, stamp_ns: int, markers: Sequence[Marker], frame: str = "map") -> None:
        """visualization_msgs/MarkerArray, of the layout since ROS 2 Humble; they stay until replaced."""
        cdr = Cdr().put("I", len(markers))
        for number, marker in enumerate(markers):
            points = np.asarray(marker.points_m, np.float64).reshape(-1, 3)
            size = (marker.size_m, marker.size_m, marker.size_m)
            cdr.header(stamp_ns, frame).text(marker.name)
            cdr.put("i", number, _MARKER_TYPES[marker.kind], 0).pose(np.eye(4)).put("d", *size)
            cdr.put("f", *marker.color).put("i", 0).put("I", 0).put("?", False)
            cdr.put("I", len(points)).array(points.reshape(-1), counted=False)
            cdr.put("I", 0).text("")  # colours of single points, texture
            cdr.header(0, "").text("").put("I", 0, 0)  # the texture's image, its coordinates
            cdr.text("").text("").text("").put("I", 0).put("?", False)  # text, mesh, its file
        self._add(topic, "visualization_msgs/msg/MarkerArray", stamp_ns, cdr)

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """An MCAP metadata record: the configuration, the digest of the input, and the like."""
        self._open().add_metadata(name, values)

    def _transforms(self, topic: str, stamp_ns: int, edges: Sequence[tuple[str, str, F64]]) -> None:
        cdr = Cdr().put("I", len(edges))
        for parent, child, T_parent_child in edges:
            cdr.header(stamp_ns, parent).text(child).pose(T_parent_child)
        self._add(topic, "tf2_msgs/msg/TFMessage", stamp_ns, cdr)

    def _open(self) -> Writer:
        if self._writer is None:
            raise RuntimeError("LogWriter is used outside of its with block")
        return self._writer

    def _add(self, topic: str, type_name: str, stamp_ns: int, cdr: Cdr) -> None:
        writer = self._open()
        if type_name not in self._schemas:
            self._schemas[type_name] = writer.register_schema(
                name=type_name, encoding="ros2msg", data=schema_text(type_name).encode()
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
            data=bytes(cdr),
        )
