"""Small recordings of every kind, for the tests of reading.

Messages are encoded by `rosbags`, which shares no code with pc2grid's own decoders: what is read back is
compared with what an independent implementation wrote.
"""

import functools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from mcap.writer import Writer
from numpy.typing import ArrayLike
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pc2grid.io.export import LogWriter
from pc2grid.io.recording import open_log
from pc2grid.model import ReadReport, Scan
from pc2grid.settings import ReadConfig

T0 = 1_700_000_000_000_000_000
STEP = 100_000_000
Dialect = Literal["ros1", "ros2"]


class Message(NamedTuple):
    """A message of a recording, as it is written into the file."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes


def read(
    path: Path, config: ReadConfig | None = None, *, recover: bool = False
) -> tuple[list[Scan], ReadReport]:
    """All scans of a recording, and the report of its reading."""
    with open_log(path, config, recover=recover) as log:
        scans = list(log.scans())
        return scans, log.report()


class Ros:
    """Encoder of ROS messages, of either dialect."""

    def __init__(self, dialect: Dialect = "ros2") -> None:
        self.dialect = dialect
        self.store = get_typestore(Stores.ROS2_HUMBLE if dialect == "ros2" else Stores.ROS1_NOETIC)
        if dialect == "ros1":
            edges = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(edges, "tf2_msgs/msg/TFMessage"))

    def make(self, name: str, *fields: Any) -> Any:
        """An instance of `package/Type`, fields in their order."""
        package, kind = name.split("/")
        return self.store.types[f"{package}/msg/{kind}"](*fields)

    def schema(self, name: str) -> bytes:
        """The definition as a log carries it."""
        package, kind = name.split("/")
        version = 2 if self.dialect == "ros2" else 1
        return self.store.generate_msgdef(f"{package}/msg/{kind}", ros_version=version)[0].encode()

    def message(self, topic: str, stamp_ns: int, content: Any) -> Message:
        """A message recorded at its stamp."""
        name = content.__msgtype__
        write = self.store.serialize_cdr if self.dialect == "ros2" else self.store.serialize_ros1
        return Message(topic, name.replace("/msg/", "/"), stamp_ns, bytes(write(content, name)))

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/Time", *divmod(stamp_ns, 10**9))
        return self.make("std_msgs/Header", *([0] if self.dialect == "ros1" else []), stamp, frame)

    def cloud(self, topic: str, stamp_ns: int, points: ArrayLike, frame: str = "lidar") -> Message:
        xyz = np.asarray(points, np.float32).reshape(-1, 3)
        fields = [self.make("sensor_msgs/PointField", n, 4 * i, 7, 1) for i, n in enumerate("xyz")]
        data = xyz.view(np.uint8).reshape(-1)
        header, size = self.header(stamp_ns, frame), len(xyz)
        content = self.make(
            "sensor_msgs/PointCloud2", header, 1, size, fields, False, 12, 12 * size, data, True
        )
        return self.message(topic, stamp_ns, content)

    def laser(
        self,
        topic: str,
        stamp_ns: int,
        ranges: ArrayLike,
        frame: str = "laser",
        *,
        angles: tuple[float, float] = (-np.pi / 2, 0.01),
        angle_max: float | None = None,
        limits_m: tuple[float, float] = (0.1, 30.0),
    ) -> Message:
        """angles : of the first beam, and from beam to beam. angle_max : None: that of the last beam."""
        values = np.asarray(ranges, np.float32)
        first, step = angles
        end = first + step * (len(values) - 1) if angle_max is None else angle_max
        content = self.make(
            "sensor_msgs/LaserScan", self.header(stamp_ns, frame), first, end, step, 0.0, 0.1, *limits_m,
            values, np.zeros(0, np.float32),
        )  # fmt: skip
        return self.message(topic, stamp_ns, content)

    def image(
        self, topic: str, stamp_ns: int, pixels: np.ndarray, encoding: str, frame: str = "camera_optical"
    ) -> Message:
        height, width = pixels.shape
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        header, step = self.header(stamp_ns, frame), pixels.itemsize * width
        big = int(pixels.dtype.byteorder == ">")
        content = self.make("sensor_msgs/Image", header, height, width, encoding, big, step, data)
        return self.message(topic, stamp_ns, content)

    def compressed(
        self, topic: str, stamp_ns: int, data: bytes, format_name: str, frame: str = "camera_optical"
    ) -> Message:
        header, content = self.header(stamp_ns, frame), np.frombuffer(data, np.uint8)
        return self.message(
            topic, stamp_ns, self.make("sensor_msgs/CompressedImage", header, format_name, content)
        )

    def camera(
        self,
        topic: str,
        stamp_ns: int,
        width: int,
        height: int,
        focal: float,
        *,
        d: ArrayLike = (0.0,) * 5,
        k: ArrayLike | None = None,
        p: ArrayLike | None = None,
        model: str = "plumb_bob",
        frame: str = "camera_optical",
    ) -> Message:
        """A camera whose axis meets pixel (1, 1), unless k and p say otherwise."""
        usual = [[focal, 0, 1, 0], [0, focal, 1, 0], [0, 0, 1, 0]]
        k, p = (np.array(usual, float)[:, :n] if m is None else m for m, n in ((k, 3), (p, 4)))
        roi = self.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        header, k, p = self.header(stamp_ns, frame), np.ravel(k).astype(float), np.ravel(p)
        content = self.make(
            "sensor_msgs/CameraInfo", header, height, width, model, np.asarray(d), k,
            np.eye(3).reshape(-1), p, 0, 0, roi,
        )  # fmt: skip
        return self.message(topic, stamp_ns, content)

    def tf(
        self,
        stamp_ns: int,
        parent: str,
        child: str,
        x_m: float,
        *,
        z_m: float = 0.0,
        quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        topic: str = "/tf",
        late_ns: int = 0,
    ) -> Message:
        """One transform; recorded `late_ns` after its stamp."""
        transform = self.make(
            "geometry_msgs/Transform",
            self.make("geometry_msgs/Vector3", x_m, 0.0, z_m),
            self.make("geometry_msgs/Quaternion", *quaternion),
        )
        edge = self.make("geometry_msgs/TransformStamped", self.header(stamp_ns, parent), child, transform)
        return self.message(topic, stamp_ns + late_ns, self.make("tf2_msgs/TFMessage", [edge]))

    def odometry(self, topic: str, stamp_ns: int, x_m: float, child: str = "base_link") -> Message:
        make = self.make
        pose = make(
            "geometry_msgs/Pose",
            make("geometry_msgs/Point", x_m, 0.0, 0.0),
            make("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0),
        )
        zero = make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        content = make(
            "nav_msgs/Odometry",
            self.header(stamp_ns, "odom"),
            child,
            make("geometry_msgs/PoseWithCovariance", pose, np.zeros(36)),
            make("geometry_msgs/TwistWithCovariance", make("geometry_msgs/Twist", zero, zero), np.zeros(36)),
        )
        return self.message(topic, stamp_ns, content)

    def imu(self, topic: str, stamp_ns: int, felt_mps2: Sequence[float], frame: str = "imu") -> Message:
        """An IMU that does not turn, and does not tell its orientation."""
        make, vector = self.make, functools.partial(self.make, "geometry_msgs/Vector3")
        unknown, known = np.zeros(9), np.zeros(9)
        unknown[0] = -1.0
        content = make(
            "sensor_msgs/Imu", self.header(stamp_ns, frame),
            make("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0), unknown,
            vector(0.0, 0.0, 0.0), known, vector(*felt_mps2), known,
        )  # fmt: skip
        return self.message(topic, stamp_ns, content)


@functools.cache
def ros(dialect: Dialect = "ros2") -> Ros:
    """The encoder of a dialect; made once, as its type store takes a while."""
    return Ros(dialect)


def write_mcap(path: Path, messages: Iterable[Message], dialect: Dialect = "ros2", **options: Any) -> Path:
    """The messages as an MCAP, in the order given."""
    encoder = ros(dialect)
    encoding, schema_encoding = ("cdr", "ros2msg") if dialect == "ros2" else ("ros1", "ros1msg")
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile=dialect)
        channels: dict[tuple[str, str], int] = {}
        for topic, kind, log_time_ns, data in messages:
            if (topic, kind) not in channels:
                name = kind.replace("/", "/msg/") if dialect == "ros2" else kind
                schema = writer.register_schema(name, schema_encoding, encoder.schema(kind))
                channels[topic, kind] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic, kind], log_time_ns, data, log_time_ns)
        writer.finish()
    return path


def write_bag(
    path: Path, messages: Iterable[Message], compression: str = "", chunk_bytes: int = 1 << 20
) -> Path:
    """The messages (of dialect ros1) as a ROS 1 bag; compression: "", "bz2" or "lz4"."""
    from rosbags.rosbag1 import Writer as BagWriter

    bag = BagWriter(path)
    bag.chunk_threshold = chunk_bytes
    if compression:
        bag.set_compression(BagWriter.CompressionFormat[compression.upper()])
    with bag as out:
        connections: dict[tuple[str, str], Any] = {}
        for topic, kind, log_time_ns, data in messages:
            if (topic, kind) not in connections:
                name = kind.replace("/", "/msg/")
                connections[topic, kind] = out.add_connection(topic, name, typestore=ros("ros1").store)
            out.write(connections[topic, kind], log_time_ns, data)
    return path


def write_rosbag2(
    folder: Path,
    messages: Iterable[Message],
    storage: Literal["mcap", "sqlite3"] = "sqlite3",
    compression: Literal["", "message", "file"] = "",
    version: int = 9,
) -> Path:
    """The messages (of dialect ros2) as a rosbag2 folder with its metadata.yaml."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer as FolderWriter

    out = FolderWriter(folder, version=version, storage_plugin=StoragePlugin[storage.upper()])
    if compression:
        out.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with out:
        connections: dict[tuple[str, str], Any] = {}
        for topic, kind, log_time_ns, data in messages:
            if (topic, kind) not in connections:
                name = kind.replace("/", "/msg/")
                connections[topic, kind] = out.add_connection(topic, name, typestore=ros().store)
            out.write(connections[topic, kind], log_time_ns, data)
    return folder


def raw_log(
    path: Path, records: Sequence[tuple[str, str, str, bytes, bytes]], encoding: str = "cdr", **options: Any
) -> Path:
    """(topic, type, schema encoding, schema text, payload) as an MCAP; a channel and schema per record."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2")
        for i, (topic, type_name, schema_encoding, text, payload) in enumerate(records):
            schema = writer.register_schema(type_name, schema_encoding, text)
            channel = writer.register_channel(topic, encoding, schema)
            if payload:
                writer.add_message(channel, T0 + i * STEP, payload, T0 + i * STEP)
        writer.finish()
    return path


def write_clouds(path: Path, scans: int = 40, points: int = 4000) -> Path:
    """A small lidar log of several chunks by LogWriter, with tf and odometry that moves 0.1 m a scan."""
    rng = np.random.default_rng(7)
    mount = np.eye(4)
    mount[:3, 3] = 0.2, 0.0, 0.5
    with LogWriter.to(path) as out:
        out.tf_static(T0, "base_link", "lidar", mount)
        for i in range(scans):
            pose = np.eye(4)
            pose[0, 3] = 0.1 * i
            stamp = T0 + i * STEP
            out.point_cloud("/points", stamp, "lidar", rng.uniform(1, 9, (points, 3)).astype(np.float32))
            out.odometry("/odom", stamp + 10_000_000, pose)
    return path


def drive(dialect: Dialect = "ros2", scans: int = 12) -> list[Message]:
    """Clouds with tf (0.2 m ahead of the base) and odometry (0.1 m a scan): scan i holds i + 1 points."""
    to = ros(dialect)
    rng = np.random.default_rng(3)
    found = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    for i in range(scans):
        stamp = T0 + i * STEP
        found.append(to.odometry("/odom", stamp, 0.1 * i))
        found.append(to.cloud("/points", stamp, rng.uniform(1, 9, (i + 1, 3))))
    return found


def check_drive(scans: Sequence[Scan], count: int = 12) -> None:
    """Whether the scans are those of `drive`, to the last bit of float32."""
    rng = np.random.default_rng(3)
    assert len(scans) == count
    for i, scan in enumerate(scans):
        assert scan.stamp_ns == T0 + i * STEP
        expected = rng.uniform(1, 9, (i + 1, 3)).astype(np.float32) + np.float32([0.2, 0, 0])
        np.testing.assert_array_equal(scan.points_m, expected)
        assert scan.T_odom_base is not None
        np.testing.assert_allclose(scan.T_odom_base[:3, 3], [0.1 * i, 0, 0], atol=1e-12)


def laser_drive(count: int = 120, step_ns: int = 100_000_000) -> list[Message]:
    """A laser that moves 0.05 m a scan, with odometry between the scans, and static tf at the beginning
    only."""
    from tests.helpers.recordings import T0

    to = ros()
    messages = [to.tf(T0, "base_link", "laser", 0.2, topic="/tf_static")]
    for i in range(count):
        stamp = T0 + i * step_ns
        messages.append(to.laser("/scan", stamp, [1.0 + 0.01 * ((i + k) % 7) for k in range(30)]))
        messages.append(to.odometry("/odom", stamp, 0.05 * i))
        messages.append(to.odometry("/odom", stamp + step_ns // 2, 0.05 * i + 0.025))
    return messages
