"""Results as files: clouds, pose graphs, and standard ROS 2 MCAP (profile `ros2`, `cdr`, `ros2msg`).

Clouds are PLY or PCD files, as Open3D, CloudCompare and PCL read them: binary, little-endian, float32. PLY:
https://paulbourke.net/dataformats/ply. PCD: version 0.7, see `pc2grid.io.messages.clouds`. They are not
written by Open3D 0.19: when the disk is full, its PLY writer reports success for a file that ends in the
middle; it refuses clouds without points; and it takes 0.6 s to load for a header of ten lines.

The pose graph of a session is a g2o text file (g2o, GTSAM, Ceres and SE-Sync read it): `VERTEX_SE2 id x y
yaw` and `EDGE_SE2 from to dx dy dyaw`, followed by the upper triangle of the information matrix, row by row.
Poses are planar, because loops are closed in the plane. The junction graph of a map is GraphML (Gephi, yEd,
networkx).

ROS 2 messages are serialised, and their definitions written, by the type store of `rosbags` for ROS 2 Humble.
Large arrays are handed to it as numpy arrays, which it copies as a whole. Foxglove opens the MCAP files.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import mcap
import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import ArrayLike, NDArray

from pc2grid._version import __version__
from pc2grid.errors import OutputError
from pc2grid.geometry import F32, F64, SE2, quat_xyzw_from_pose
from pc2grid.io.atomic import refuse_existing, replace_file
from pc2grid.model import Health, Loop, MapOf, OccupancyGrid, Trajectory

if TYPE_CHECKING:
    import networkx as nx
    from rosbags.typesys.store import Typestore


# --- clouds -------------------------------------------------------------------------------------------

_PLY = """ply
format binary_little_endian 1.0
element vertex {n}
property float x
property float y
property float z
end_header
"""
_PCD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA binary
"""
_HEADERS = {".ply": _PLY, ".pcd": _PCD}


def write_cloud(path: str | Path, points_m: ArrayLike) -> None:
    """Write points (N, 3), metres, as `.ply` or `.pcd`, by the suffix; an existing file is replaced.

    Raises OutputError for another suffix or if the file cannot be written.

    >>> write_cloud("corner.ply", [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    """
    suffix = Path(path).suffix.lower()
    header = _HEADERS.get(suffix)
    if header is None:
        raise OutputError(f"{path}: not a kind of cloud file", hint="end its name in .ply or .pcd")
    points = np.asarray(points_m, "<f4").reshape(-1, 3)
    with replace_file(path) as temporary:
        temporary.write_bytes(header.format(n=len(points)).encode("ascii") + points.tobytes())


# --- graphs -------------------------------------------------------------------------------------------

# Standard deviation of tracking as a random walk, of the order that loop closure assumes; chosen by hand.
_WALK_M, _WALK_RAD = 0.03, math.radians(0.5)  # after one metre
_LEAST_M, _LEAST_RAD = 1e-3, 1e-3  # without motion
_LOST = 1e-3  # factor on the information of a step where registration was lost; chosen by hand
_UPPER = np.triu_indices(3)


def write_g2o(path: str | Path, trajectory: Trajectory, loops: Iterable[Loop]) -> None:
    """Write the trajectory and the accepted loops.

    Vertex k is pose k of the trajectory after loop closure. The edges between consecutive vertices are the
    steps of this trajectory; their uncertainty grows with the distance and is large where registration was
    lost. The edges of loops are the measured relative poses with their own information. Raises OutputError if
    the file cannot be written.
    """
    poses = list(trajectory.poses())
    health = trajectory.health or (Health.FINE,) * len(poses)
    lines = [_line("VERTEX_SE2", [k], pose) for k, pose in enumerate(poses)]
    for k in range(1, len(poses)):
        step = poses[k - 1].inverse() @ poses[k]
        trust = _LOST if Health.LOST in health[k - 1 : k + 1] else 1.0
        lines.append(_line("EDGE_SE2", [k - 1, k], step, trust * _information_of(step)))
    lines += [
        _line("EDGE_SE2", [loop.older, loop.newer], loop.T_older_newer, loop.information)
        for loop in loops
        if loop.accepted
    ]
    with replace_file(path) as temporary:
        temporary.write_text("".join(lines), encoding="ascii")


def _information_of(step: SE2) -> F64:
    """Return the information (3, 3) of x, y, yaw of one step."""
    root = math.sqrt(math.hypot(step.x, step.y))
    sigma_m, sigma_rad = _LEAST_M + _WALK_M * root, _LEAST_RAD + _WALK_RAD * root
    return np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])


def _line(tag: str, ids: list[int], pose: SE2, information: F64 | None = None) -> str:
    numbers = [f"{value:.9f}" for value in (pose.x, pose.y, pose.yaw)]
    if information is not None:
        numbers += [f"{value:.9g}" for value in information[_UPPER]]
    return " ".join([tag, *map(str, ids), *numbers]) + "\n"


def write_graph(path: str | Path, graph: nx.Graph) -> None:
    """Write a graph of `pc2grid.submaps.junction_graph`.

    GraphML holds plain numbers and text only: `center_m` becomes `x_m` and `y_m`, and the pixels of the edges
    (`path_m`) are left out. Raises OutputError if the file cannot be written.
    """
    import networkx as nx

    flat = nx.Graph(**graph.graph)
    for node, about in graph.nodes(data=True):
        x_m, y_m = about["center_m"]
        flat.add_node(node, kind=about["kind"], pixels=about["pixels"], x_m=x_m, y_m=y_m)
    flat.add_weighted_edges_from(graph.edges(data="length_m"), weight="length_m")
    with replace_file(path) as temporary:
        nx.write_graphml_xml(flat, temporary)


# --- recordings ---------------------------------------------------------------------------------------

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
    """Writes messages into one MCAP, which `LogWriter.to` opens.

    Log time and publish time of every message are its stamp. Messages may be written in any order of time.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence: Counter[int] = Counter()

    @classmethod
    @contextlib.contextmanager
    def to(cls, path: Path, *, overwrite: bool = False) -> Iterator[LogWriter]:
        """Open a file, which gets its name when the `with` block ends without an error.

        Raises OutputError if it cannot be written, or exists, unless `overwrite` is set.
        """
        refuse_existing(path, overwrite)
        with replace_file(path) as temporary, temporary.open("wb") as stream:
            writer = Writer(stream, chunk_size=1 << 20, compression=CompressionType.ZSTD, enable_crcs=True)
            writer.start(profile="ros2", library=f"pc2grid/{__version__} mcap-python/{mcap.__version__}")
            yield cls(writer)
            writer.finish()  # type: ignore[no-untyped-call]

    # --- sensors --------------------------------------------------------------------------------------

    def point_cloud(
        self,
        topic: str,
        stamp_ns: int,
        frame: str,
        points: F32,
        offsets_s: NDArray[np.floating] | None = None,
    ) -> None:
        """Write a sensor_msgs/PointCloud2 with float32 x y z (N, 3), and `time` (s after the stamp) if
        given."""
        names = ["x", "y", "z"] + (["time"] if offsets_s is not None else [])
        columns = np.asarray(points, dtype=np.float32).reshape(-1, 3)
        if offsets_s is not None:
            columns = np.column_stack((columns, np.asarray(offsets_s, dtype=np.float32)))
        field: Any = typestore().types["sensor_msgs/msg/PointField"]
        fields = [field(name, 4 * k, field.FLOAT32, 1) for k, name in enumerate(names)]
        count, step = len(columns), 4 * len(names)
        cloud = (1, count, fields, False, step, step * count, _bytes_of(columns, "<f4"), True)
        self.write(topic, stamp_ns, new("sensor_msgs/PointCloud2", header(stamp_ns, frame), *cloud))

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
        """Write a sensor_msgs/LaserScan; `inf` in ranges means no return."""
        values = np.asarray(ranges, dtype=np.float32).reshape(-1)
        angle_max = angle_min + angle_increment * (len(values) - 1)
        angles = (angle_min, angle_max, angle_increment)
        times = (time_increment, time_increment * len(values))
        intensities = np.empty(0, np.float32)
        scan = (*angles, *times, range_min, range_max, values, intensities)
        self.write(topic, stamp_ns, new("sensor_msgs/LaserScan", header(stamp_ns, frame), *scan))

    def depth_image(self, topic: str, stamp_ns: int, frame: str, depth_m: ArrayLike) -> None:
        """Write a sensor_msgs/Image of encoding 16UC1: millimetres; 0: no return, or from 65.535 m on."""
        depth = np.rint(np.asarray(depth_m, dtype=np.float64) * 1000.0)
        seen = (depth > 0) & (depth < np.iinfo(np.uint16).max)
        millimetres = np.where(seen, depth, 0)
        height, width = depth.shape
        image = (height, width, "16UC1", 0, 2 * width, _bytes_of(millimetres, "<u2"))
        self.write(topic, stamp_ns, new("sensor_msgs/Image", header(stamp_ns, frame), *image))

    def camera_info(self, topic: str, stamp_ns: int, frame: str, K: ArrayLike, W: int, H: int) -> None:
        """Write a sensor_msgs/CameraInfo of an undistorted camera with intrinsics K (3, 3) and W x H
        pixels."""
        k = np.asarray(K, dtype=np.float64).reshape(3, 3)
        distortion, rectification = np.zeros(5), np.eye(3).reshape(-1)
        projection = np.column_stack((k, np.zeros(3))).reshape(-1)
        whole_image = new("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        camera = (H, W, "plumb_bob", distortion, k.reshape(-1), rectification, projection, 0, 0, whole_image)
        self.write(topic, stamp_ns, new("sensor_msgs/CameraInfo", header(stamp_ns, frame), *camera))

    # --- poses ----------------------------------------------------------------------------------------

    def odometry(
        self, topic: str, stamp_ns: int, T_odom_base: F64, frame: str = "odom", child: str = "base_link"
    ) -> None:
        """Write a nav_msgs/Odometry with a pose (4, 4); covariance and twist zero (unknown)."""
        unknown = np.zeros(36)
        uncertain = new("geometry_msgs/PoseWithCovariance", pose(T_odom_base), unknown)
        zero = vector(0.0, 0.0, 0.0)
        twist = new("geometry_msgs/TwistWithCovariance", new("geometry_msgs/Twist", zero, zero), unknown)
        head = header(stamp_ns, frame)
        self.write(topic, stamp_ns, new("nav_msgs/Odometry", head, child, uncertain, twist))

    def tf(self, stamp_ns: int, parent: str, child: str, T_parent_child: F64) -> None:
        """Write one transform (4, 4) on /tf."""
        self.write("/tf", stamp_ns, transforms(stamp_ns, [(parent, child, T_parent_child)]))

    def tf_static(self, stamp_ns: int, parent: str, child: str, T_parent_child: F64) -> None:
        """Write one transform (4, 4) on /tf_static: valid at all times."""
        self.write("/tf_static", stamp_ns, transforms(stamp_ns, [(parent, child, T_parent_child)]))

    def path(
        self, topic: str, trajectory: Trajectory, frame: str = "map", *, stamp_ns: int | None = None
    ) -> None:
        """Write a nav_msgs/Path of a whole trajectory with the stamp of its first pose, so players always
        show it.

        stamp_ns : another stamp, for a path of another time.
        """
        if not len(trajectory):
            return
        at_ns = int(trajectory.stamps_ns[0]) if stamp_ns is None else stamp_ns
        poses = [
            new("geometry_msgs/PoseStamped", header(int(pose_ns), frame), pose(T))
            for pose_ns, T in zip(trajectory.stamps_ns, trajectory.T_session_base, strict=True)
        ]
        self.write(topic, at_ns, new("nav_msgs/Path", header(at_ns, frame), poses))

    # --- maps and metadata ----------------------------------------------------------------------------

    def markers(self, topic: str, stamp_ns: int, markers: Sequence[Marker], frame: str = "map") -> None:
        """Write a visualization_msgs/MarkerArray in the layout since ROS 2 Humble; shown until replaced."""
        drawn = [_marker(number, marker, header(stamp_ns, frame)) for number, marker in enumerate(markers)]
        self.write(topic, stamp_ns, new("visualization_msgs/MarkerArray", drawn))

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Write an MCAP metadata record: the configuration, the digest of the input, and the like."""
        self._writer.add_metadata(name, values)

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Write a message, such as `pose_with_covariance` makes."""
        writer = self._writer
        type_name: str = message.__msgtype__
        if type_name not in self._schemas:
            self._schemas[type_name] = writer.register_schema(
                name=type_name, encoding="ros2msg", data=definition(type_name).encode()
            )
        key = (topic, type_name)
        if key not in self._channels:
            self._channels[key] = writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=self._schemas[type_name]
            )
        channel = self._channels[key]
        writer.add_message(
            channel_id=channel,
            log_time=int(stamp_ns),
            publish_time=int(stamp_ns),
            sequence=self._sequence[channel],
            data=serialized(message),
        )
        self._sequence[channel] += 1


def _bytes_of(values: NDArray[Any], dtype: str) -> NDArray[np.uint8]:
    """Return the values, row by row, as the bytes of a numpy type."""
    return np.ascontiguousarray(values, dtype).view(np.uint8).reshape(-1)


def _marker(number: int, marker: Marker, head: Any) -> Any:
    """Make a visualization_msgs/Marker without lifetime: it is shown until it is replaced."""
    points = np.asarray(marker.points_m, np.float64).reshape(-1, 3).tolist()
    no_texture = new("sensor_msgs/CompressedImage", header(0, ""), "", np.empty(0, np.uint8))
    no_mesh = new("visualization_msgs/MeshFile", "", np.empty(0, np.uint8))
    return new(
        "visualization_msgs/Marker",
        head,
        marker.name,
        number,
        _MARKER_TYPES[marker.kind],
        0,  # action: add
        pose(np.eye(4)),
        vector(marker.size_m, marker.size_m, marker.size_m),
        new("std_msgs/ColorRGBA", *marker.color),
        new("builtin_interfaces/Duration", 0, 0),
        False,
        [new("geometry_msgs/Point", *point) for point in points],
        [],  # colours of single points
        "",
        no_texture,
        [],
        "",
        "",
        no_mesh,
        False,
    )


# --- messages of ROS 2 --------------------------------------------------------------------------------

_UNOBSERVED = 1e6
"""Variance of z, roll and pitch of a planar pose, as drivers of robots on wheels write it. nav2 takes 1e9 at
most."""


# --- whole messages -----------------------------------------------------------------------------------


def pose_with_covariance(stamp_ns: int, planar: SE2, covariance: ArrayLike, frame: str = "map") -> Any:
    """Make a geometry_msgs/PoseWithCovarianceStamped of a planar pose; covariance (3, 3) of x, y, yaw.

    Its 36 numbers are row by row of x, y, z, roll, pitch, yaw; directions outside of the plane have the
    variance `_UNOBSERVED`.
    """
    full = np.diag([0.0, 0.0, _UNOBSERVED, _UNOBSERVED, _UNOBSERVED, 0.0])
    full[np.ix_((0, 1, 5), (0, 1, 5))] = np.asarray(covariance, dtype=np.float64).reshape(3, 3)
    content = new("geometry_msgs/PoseWithCovariance", pose(planar.lift()), full.reshape(-1))
    return new("geometry_msgs/PoseWithCovarianceStamped", header(stamp_ns, frame), content)


def initialpose(stamp_ns: int, planar: SE2, covariance: ArrayLike, frame: str = "map") -> Any:
    """Make the message for /initialpose of nav2: the same, but with variances alone.

    nav2 refuses the message if one of its 36 numbers is negative (`validateMsg` of nav2_ros_common), and a
    covariance of x, y and yaw mostly is. AMCL reads the variances and, of all others, that of x with y.
    """
    variances = np.diag(np.diagonal(np.asarray(covariance, dtype=np.float64)))
    return pose_with_covariance(stamp_ns, planar, variances, frame)


def occupancy_grid(stamp_ns: int, grid: OccupancyGrid, frame: str = "map", of: MapOf = "everything") -> Any:
    """Make a nav_msgs/OccupancyGrid; row 0 has the smallest y, as in `OccupancyGrid`. of : see its `told`."""
    height, width = grid.cells.shape
    origin = pose(SE2(*grid.origin_m).lift())
    info = new("nav_msgs/MapMetaData", time(stamp_ns), grid.resolution_m, width, height, origin)
    cells = np.ascontiguousarray(grid.told(of)).reshape(-1)
    return new("nav_msgs/OccupancyGrid", header(stamp_ns, frame), info, cells)


def transforms(stamp_ns: int, edges: Sequence[tuple[str, str, F64]]) -> Any:
    """Make a tf2_msgs/TFMessage of edges (parent, child, T_parent_child), with T (4, 4)."""
    stamped = [
        new("geometry_msgs/TransformStamped", header(stamp_ns, parent), child, transform(T))
        for parent, child, T in edges
    ]
    return new("tf2_msgs/TFMessage", stamped)


@functools.cache
def typestore() -> Typestore:
    """Load the message types of ROS 2 Humble; it takes 0.1 s, so only a writer does."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def new(name: str, *fields: Any) -> Any:
    """Make a message of type `package/Name` from its fields, in the order of its definition."""
    return typestore().types[name.replace("/", "/msg/")](*fields)


def time(stamp_ns: int) -> Any:
    """Make a builtin_interfaces/Time."""
    return new("builtin_interfaces/Time", *divmod(int(stamp_ns), 1_000_000_000))


def header(stamp_ns: int, frame: str) -> Any:
    """Make a std_msgs/Header."""
    return new("std_msgs/Header", time(stamp_ns), frame)


def vector(x: float, y: float, z: float) -> Any:
    """Make a geometry_msgs/Vector3."""
    return new("geometry_msgs/Vector3", float(x), float(y), float(z))


def quaternion(T: F64) -> Any:
    """Make a geometry_msgs/Quaternion of a (4, 4) pose."""
    return new("geometry_msgs/Quaternion", *(float(v) for v in quat_xyzw_from_pose(T)))


def pose(T: F64) -> Any:
    """Make a geometry_msgs/Pose of a (4, 4) pose."""
    point = new("geometry_msgs/Point", *(float(v) for v in T[:3, 3]))
    return new("geometry_msgs/Pose", point, quaternion(T))


def transform(T: F64) -> Any:
    """Make a geometry_msgs/Transform of a (4, 4) pose."""
    return new("geometry_msgs/Transform", vector(*T[:3, 3]), quaternion(T))


def definition(type_name: str) -> str:
    """Return the definition, in the .msg language, of a type such as `nav_msgs/msg/OccupancyGrid`."""
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def serialized(message: Any) -> bytes:
    """Serialise a message in CDR, little endian."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__, little_endian=True))
