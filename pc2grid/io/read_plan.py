"""What to read of a log and how, decided from its first messages: topics, base frame, odometry, IMU."""

from __future__ import annotations

import itertools
import statistics
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, NoScans, PointCloudError, TopicError, UnsupportedSchema
from pc2grid.io import topics
from pc2grid.io.frames import FrameTree
from pc2grid.io.message_source import GAP_NS, Choice, MessageSource, TopicInfo
from pc2grid.io.messages.decoders import decoder_for
from pc2grid.io.messages.types import CameraInfo
from pc2grid.io.sensors.depth import holds_depths
from pc2grid.model import SensorKind
from pc2grid.sensor_model import SENSOR_MODELS

LOOK_AHEAD_NS = 60_000_000_000
"""Log time behind the first scans within which tf must connect the sensor to the base; chosen by hand."""
_FIRST = 5
"""So many messages of a topic are looked at: a few may have a stray time, or be unreadable; by hand."""
_LAST_FLOAT = struct.Struct("<f")
_BASE_FRAMES = ("base_link", "base_footprint")  # REP-105 and REP-120
_LIDARS = ("lidar", "laser", "velodyne", "livox", "ouster", "os_sensor", "hesai", "pandar", "rslidar")
"""Parts of the names of frames of lidars."""


class Sensor(NamedTuple):
    """A topic of scans. camera, calibration : of depth images: the topic of its CameraInfo, and the first."""

    topic: TopicInfo
    kind: SensorKind
    camera: TopicInfo | None = None
    calibration: CameraInfo | None = None


@dataclass(frozen=True, slots=True)
class Plan:
    """What to read and how, decided once per log.

    sensors : the first one, and more of the same kind, whose scans are put together with those of the first.
    odometry : None if there is none, or if it is in tf. odometry_frame : the parent frame of the odometry in
    tf; None if it is not there.
    imu : None if there is none, or none is needed.
    tf_moves : whether tf must be read along with the scans.
    sensor_is_base : whether the log has no tf, so that the sensor's frame serves as the base.
    stampless : whether the first scans have stamps of zero, so that the time of recording is used instead.
    mounted : None, unless the points of the scans are in a fixed frame already; then the frame of the sensor.
    period_ns : the longest time between two of the first scans; 0 if there is only one.
    depth_unit_m : that of the depth images, as the settings or the log say it; None: that of their encoding.
    """

    choice: Choice
    sensors: tuple[Sensor, ...]
    odometry: TopicInfo | None
    odometry_frame: str | None
    imu: TopicInfo | None
    tf_moves: bool
    sensor_is_base: bool
    stampless: bool
    mounted: str | None
    period_ns: int
    depth_unit_m: float | None


def make_plan(source: MessageSource, config: ReadConfig, frames: FrameTree) -> Plan:
    """Decide what to read; fills `frames` with the static transforms and the first of the moving ones.

    Raises TopicError, NoScans, UnsupportedSchema or FrameError.
    """
    return _Planner(source, config, frames).plan()


def registered(frame: str) -> FrameError:
    """The error for points that cannot be taken back from a fixed frame to the sensor."""
    return FrameError(
        f"the scans are registered already, in the fixed frame {frame}: where the sensor was is not known",
        hint=f"use what the sensor itself measured (--topic), or record tf from {frame} to the robot's base "
        "and /tf_static with the sensor; for a sensor whose own frame is named so: "
        "--set read.assume_identity=true",
    )


def is_static(topic: TopicInfo) -> bool:
    """Whether a tf topic holds transforms that never change (tf2: `tf_static`)."""
    return topic.topic.endswith("tf_static")


def published_once(topic: TopicInfo) -> bool:
    """Whether the messages of a topic may be published only once, when the robot starts."""
    return topic.type in topics.CAMERA_INFOS or (topic.type in topics.TF and is_static(topic))


def tolerant(decode: Callable[[Any], Any], data: Any, otherwise: Any = None) -> Any:
    """Decode a message that is of use but not needed (tf, odometry); `otherwise` if it cannot be decoded."""
    try:
        return decode(data)
    except PointCloudError:
        return otherwise


class _First(NamedTuple):
    """One of the first messages of a topic. content : with a header."""

    log_time_ns: int
    content: Any


def _delay_ns(first: Sequence[_First]) -> int:
    """How long after their stamps messages were recorded, one with another; 0 for messages without stamps."""
    delays_ns = [m.log_time_ns - (m.content.header.stamp_ns or m.log_time_ns) for m in first]
    return statistics.median_low(delays_ns) if delays_ns else 0


class _Motion(NamedTuple):
    """Where odometry comes from: a topic; of tf, the transform from a frame in it. None if there is none."""

    topic: TopicInfo | None
    frame: str | None
    reason: str


class _Planner:
    """Looks at the first messages of the topics, one kind after another.

    What is found is kept for what is decided next: the sensors and the first scans, the frame of the first
    scan (empty if none can be decoded; the stream counts them), the first odometry, the moving transforms.
    """

    def __init__(self, source: MessageSource, config: ReadConfig, frames: FrameTree) -> None:
        self._source, self._config, self._frames = source, config, frames
        self._topics = source.info.topics
        self._sensors, self._reason = self._found_sensors()
        self._scans = self._first(self._sensors[0].topic)
        self._frame: str = self._scans[0].content.header.frame if self._scans else ""
        self._readings: list[_First] = []
        self._moving = [t for t in self._tf_topics() if not is_static(t)]
        self._edges: list[_First] = []

    def plan(self) -> Plan:
        """The plan; to be called once."""
        odometry, why, in_tf = self._odometry_topic()
        base = self._base(in_tf)
        self._check_further(base)
        motion = self._of_one_clock(self._motion(odometry, why, base, in_tf))
        imu, gravity = self._imu(base, motion)
        stamps_ns = [scan.content.header.stamp_ns for scan in self._scans]
        return Plan(
            choice=Choice(
                topic=self._sensors[0].topic.topic,
                sensor=self._sensors[0].kind,
                odometry_topic=motion.topic.topic if motion.topic else None,
                base_frame=base or self._frame or self._config.base_frame or "sensor",
                sensor_frame=self._frame or None,
                reason="; ".join(filter(None, (self._reason, motion.reason, gravity))),
                imu_topic=imu.topic if imu else None,
            ),
            sensors=self._sensors,
            odometry=motion.topic if motion.frame is None else None,
            odometry_frame=motion.frame,
            imu=imu,
            tf_moves=motion.frame is not None or self._sensor_moves(base),
            sensor_is_base=base is None,
            stampless=any(self._scans) and not any(stamps_ns),
            mounted=self._mounted(base),
            period_ns=max((b - a for a, b in itertools.pairwise(stamps_ns)), default=0),
            depth_unit_m=self._config.depth_unit_m or self._recorded_depth_unit_m(),
        )

    def _odometry_topic(self) -> tuple[TopicInfo | None, str, bool]:
        """A topic, why, and whether odometry is looked for in tf. Reads the first of its messages."""
        topic, why = topics.odometry_topic(self._topics, self._config.odometry)
        if topic is None:
            return None, why, self._config.odometry is None
        if topic.type in topics.TF:
            return None, why, True
        self._readings = self._first(topic)
        return topic, why, False

    def _tf_topics(self) -> list[TopicInfo]:
        return [t for t in self._topics if t.type in topics.TF and t.message_count != 0]

    def _first(self, topic: TopicInfo) -> list[_First]:
        """The first messages of a topic, without those that cannot be decoded. Raises UnsupportedSchema."""
        decode = decoder_for(topic)
        of_topic = (m for m in self._source.messages({topic.topic}) if m.channel == topic)
        first = itertools.islice(of_topic, _FIRST)
        found = [_First(m.log_time_ns, tolerant(decode, m.data)) for m in first]
        return [message for message in found if message.content is not None]

    # --- sensors --------------------------------------------------------------------------------------

    def _found_sensors(self) -> tuple[tuple[Sensor, ...], str]:
        """The topics to read scans from, and a sentence that says why."""
        try:
            found, reason = topics.scan_topics(self._topics, self._config.topic)
        except NoScans:
            image = None if self._config.topic else self._unnamed_depth()
            if image is None:
                raise
            raise topics.proposed(image, self._topics) from None
        if len(found) > 1 and self._config.topic is None:
            raise self._several(found)
        return tuple(map(self._with_camera, found)), reason

    def _several(self, found: Sequence[TopicInfo]) -> TopicError:
        """The error where several topics hold scans; it proposes one of them, or one of each sensor.

        Topics of one frame hold the scans of one sensor, filtered or delayed: the first one is proposed. What
        is in a fixed frame is no longer as it was measured.
        """
        firsts = {topic: self._first(topic) for topic in found}
        of_sensor: dict[str, TopicInfo] = {}
        for topic in sorted(found, key=lambda t: _delay_ns(firsts[t])):
            frame = firsts[topic][0].content.header.frame if firsts[topic] else ""
            of_sensor.setdefault(frame, topic)
        measured = [t for frame, t in of_sensor.items() if not topics.is_fixed(frame)]
        return topics.several(found, [t for t in found if t in measured] or found[:1])

    def _unnamed_depth(self) -> TopicInfo | None:
        """A topic of depth images whose name does not say so; None if there is none."""
        images = (t for t in self._topics if topics.is_image(t) and t.message_count != 0)
        return next((t for t in images if any(holds_depths(m.content) for m in self._first(t))), None)

    def _with_camera(self, topic: TopicInfo) -> Sensor:
        """A sensor. Raises NoScans for a depth camera without a calibration."""
        kind = topics.SENSORS[topic.type]
        if not SENSOR_MODELS[kind].image:
            return Sensor(topic, kind)
        camera = topics.camera_info_topic(topic, self._topics)
        # It may have been published only once, at the beginning.
        found = self._first(camera)
        if not found:
            raise NoScans(f"{camera.topic}: no message in the log, but the depth images need it")
        return Sensor(topic, kind, camera, found[0].content)

    def _check_further(self, base: str | None) -> None:
        """Raise FrameError if the places of several sensors are not known, TopicError for the scans of one
        sensor that are published twice. In the frame of the base, sensors are not told apart."""
        first, *further = (sensor.topic for sensor in self._sensors)
        if further and base is None:
            raise FrameError(
                f"{first.topic}, {further[0].topic}: without tf their places on the robot are not known",
                hint=f"record /tf_static too, or choose one: --topic {first.topic}",
            )
        for topic in further:
            if self._frame != base and self._frame in [m.content.header.frame for m in self._first(topic)]:
                raise TopicError(
                    f"{topic.topic} is in frame {self._frame} of the first topic: one sensor is not put "
                    "together with itself",
                    hint="name a topic of each sensor, such as --topic /front,/rear, or only one",
                )

    def _recorded_depth_unit_m(self) -> float | None:
        """The unit that librealsense writes into its recordings, as a std_msgs/Float32; None if it is not."""
        unit = topics.depth_unit_topic(self._topics)
        message = None if unit is None else next(self._source.messages({unit.topic}), None)
        value = 0.0 if message is None else _LAST_FLOAT.unpack(bytes(message.data)[-_LAST_FLOAT.size :])[0]
        if unit is None or not 0 < value <= 1:
            return None
        self._source.tally.warn(f"depths are in units of {value:.3g} m, as {unit.topic} says")
        return float(value)

    # --- frames ---------------------------------------------------------------------------------------

    def _base(self, in_tf: bool) -> str | None:
        """The base frame; None if the log has no tf, so that the sensor's frame serves as the base.

        in_tf : whether odometry is looked for in tf. Raises FrameError if tf does not connect the base to the
        sensor.
        """
        for _ in self._transforms([t for t in self._tf_topics() if is_static(t)], None):
            pass
        last_ns = max((m.log_time_ns for m in self._scans), default=self._source.info.end_ns)
        moving = self._transforms(self._moving, last_ns + LOOK_AHEAD_NS)
        base = self._connected_base()
        while base is None or (in_tf and not self._holds_odometry(base)):
            found = next(moving, None)
            if found is None:
                break
            self._edges += found
            base = self._connected_base()
        return base if base is not None else self._base_without_tf()

    def _holds_odometry(self, base: str) -> bool:
        """Whether enough of the tf that holds odometry was read to know its clock."""
        return len(self._edges) >= _FIRST and self._odometry_frame(base) is not None

    def _transforms(self, tf: list[TopicInfo], end_ns: int | None) -> Iterator[list[_First]]:
        """Take in the transforms of some topics; yields those of each message."""
        decoders = {t: decoder_for(t) for t in tf}
        for message in self._source.messages({t.topic for t in tf}, end_ns=end_ns):
            if message.channel in decoders:
                at_ns, edges = message.log_time_ns, tolerant(decoders[message.channel], message.data)
                self._frames.add_all(edges, static=is_static(message.channel), log_time_ns=at_ns)
                yield [_First(at_ns, edge) for edge in edges or ()]

    def _connected_base(self) -> str | None:
        base = self._base_frame()
        return base if base is not None and self._frames.connected(base, self._frame) else None

    def _base_frame(self) -> str | None:
        """The frame that is the base by its name, by the settings, or by the odometry."""
        if self._config.base_frame is not None:
            return self._config.base_frame.lstrip("/")
        known = self._frames.frames
        for name in _BASE_FRAMES:
            named = [f for f in known if f == name] or [f for f in known if f.endswith("/" + name)]
            if len(named) == 1:
                return named[0]
        return next((m.content.child for m in self._readings if m.content.child in known), None)

    def _base_without_tf(self) -> str | None:
        """The base frame where tf does not connect one to the sensor; None: the sensor's frame is the base.

        Raises FrameError unless the log never had tf or the user asks for this.
        """
        frames, warn = self._frames, self._source.tally.warn
        base, as_asked = self._base_frame(), self._config.assume_identity
        if self._sensors[0].kind == "lidar" and self._is_fixed(base) and not as_asked:
            raise registered(self._frame)
        root = frames.static_root() if base is None else None
        if root is not None and frames.connected(root, self._frame):
            warn(f"tf has no {_BASE_FRAMES[0]}: {root}, the root of its static transforms, is taken for it")
            return root
        name = self._frame or "(empty)"
        if not frames.frames and self._config.base_frame is None and not self._tf_may_be_lost():
            self._source.tally.warn(
                f"the log has no tf: frame {name} of the scans is taken for the robot's base"
            )
        elif as_asked:
            self._source.tally.warn(f"tf does not connect frame {name}: it is taken for the base, as asked")
        else:
            raise frames.missing(self._frame, base or "the base")
        return None

    def _tf_may_be_lost(self) -> bool:
        """Whether tf may be among what is lost: a wrong base frame would shift every scan."""
        tally = self._source.tally
        of_tf = any(t.type in topics.TF for t in self._topics)
        return tally.topics_lost or bool(self._frames.warnings) or (tally.bytes_lost > 0 and of_tf)

    def _is_fixed(self, base: str | None) -> bool:
        """Whether the frame of the scans does not move with the robot: by its name, by the odometry, or as it
        is above the base in tf."""
        frames, frame = self._frames, self._frame
        if topics.is_fixed(frame) or frame in [m.content.header.frame for m in self._readings]:
            return bool(frame)
        if base is None or frame not in frames.chain(base)[1:]:
            return False
        return frames.moving(base, frame) and frame.rpartition("/")[2] not in _BASE_FRAMES

    def _mounted(self, base: str | None) -> str | None:
        """The frame of the sensor, if its points are in a fixed frame; None if they are in its own.

        Raises FrameError if they cannot be taken back to the sensor.
        """
        if base is None or self._frame == base or not self._is_fixed(base):
            return None
        if len(self._sensors) > 1 or self._sensors[0].kind != "lidar":
            raise registered(self._frame)
        leaves = self._frames.static_leaves(base)
        named = [leaf for leaf in leaves if any(word in leaf.lower() for word in _LIDARS)] or leaves
        if len(named) == 1:
            return named[0]
        self._source.tally.warn(f"tf does not say where on {base} the sensor sits: its rays begin at {base}")
        return base

    def _sensor_moves(self, base: str | None) -> bool:
        """Whether the sensor moves on the robot."""
        frames = self._frames
        return base is not None and frames.connected(base, self._frame) and frames.moving(base, self._frame)

    # --- motion ---------------------------------------------------------------------------------------

    def _motion(self, odometry: TopicInfo | None, why: str, base: str | None, in_tf: bool) -> _Motion:
        """The odometry of a topic, or that which tf holds, if it does."""
        frame = self._odometry_frame(base) if in_tf else None
        if frame is None or not self._moving:
            return _Motion(odometry, None, why)
        return _Motion(self._moving[0], frame, f"odometry from tf, {frame} -> {base}")

    def _of_one_clock(self, motion: _Motion) -> _Motion:
        """The odometry, unless its stamps are of another clock than the scans' and nobody asked for it."""
        apart_ns = abs(_delay_ns(self._scans) - _delay_ns(self._readings or self._edges))
        if motion.topic is None or apart_ns <= GAP_NS:
            return motion
        name = motion.topic.topic
        self._source.tally.warn(
            f"the clocks of the scans and of the odometry from {name} are {apart_ns * 1e-9:,.0f} s apart and "
            "never meet: that odometry says nothing of the scans; record both by one clock"
        )
        if self._config.odometry is not None:
            return motion
        return _Motion(None, None, f"odometry from {name} is of another clock")

    def _odometry_frame(self, base: str | None) -> str | None:
        """The frame above the base in which tf holds its odometry."""
        above = [] if base is None else self._frames.chain(base)[1:]
        return next((f for f in above if f == "odom" or f.endswith(("/odom", "_odom"))), None)

    def _imu(self, base: str | None, motion: _Motion) -> tuple[TopicInfo | None, str]:
        """The IMU, and why; beside odometry, and with a laser, none is looked for.

        Raises TopicError, FrameError for one that the user names.
        """
        wanted = self._config.imu
        imu = topics.imu_topic(self._topics, wanted)
        if imu is None or (
            wanted is None and (SENSOR_MODELS[self._sensors[0].kind].planar or motion.topic is not None)
        ):
            return None, ""
        try:
            self._check_imu(imu, base)
        except (FrameError, UnsupportedSchema) as error:
            if wanted is not None:
                raise
            return None, f"{imu.topic} is not used: {error.message}"
        return imu, f"gravity from {imu.topic}"

    def _check_imu(self, imu: TopicInfo, base: str | None) -> None:
        """Raise FrameError if it is not known how the IMU sits on the base, UnsupportedSchema."""
        frames, there, first = self._frames, self._frame if base is None else base, self._first(imu)
        frame = first[0].content.header.frame if first else ""
        known = frame == there or (base is not None and frames.connected(there, frame))
        if not known or frames.moving(there, frame):
            raise frames.missing(frame, there)
