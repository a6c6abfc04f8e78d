"""What to read of a log and how: the topics, the base frame, and where the odometry comes from."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, NoScans, PointCloudError, TopicError, UnsupportedSchema
from pc2grid.io import topics
from pc2grid.io.frames import FrameTree
from pc2grid.io.message_source import Choice, MessageSource, TopicInfo
from pc2grid.io.messages.decoders import decoder_for
from pc2grid.io.messages.types import Header, Odometry
from pc2grid.io.sensors.depth import holds_depths
from pc2grid.sensor_model import SENSOR_MODELS

_LAST_FLOAT = struct.Struct("<f")
_BASE_FRAMES = ("base_link", "base_footprint")  # REP-105 and REP-120
_LIDARS = ("lidar", "laser", "velodyne", "livox", "ouster", "os_sensor", "hesai", "pandar", "rslidar")
"""Parts of the names of frames of lidars."""


@dataclass(frozen=True, slots=True)
class LookAheadParameters:
    """How much of a log is read to find out how to read it; chosen by hand.

    tf_ns : log time behind the first scan within which tf must connect the sensor to the base.
    clocks_ns : scans and odometry whose stamps differ by more, each from the time of its recording, are of
        two clocks.
    odometry_ns : log time behind the first scan within which odometry in tf must begin.
    scans : number of scans whose headers are read.
    """

    tf_ns: int = 60_000_000_000
    clocks_ns: int = 5_000_000_000
    odometry_ns: int = 5_000_000_000
    scans: int = 5


LOOK_AHEAD = LookAheadParameters()


@dataclass(frozen=True, slots=True)
class Plan:
    """What to read and how, decided once per log.

    camera : None unless the scans are depth images. odometry : None if there is none, or if it is in tf.
    odometry_frame : the parent frame of the odometry in tf; None if it is not there.
    imu : None if there is none, or none is needed.
    tf_moves : whether tf must be read along with the scans.
    sensor_is_base : whether the log has no tf, so that the sensor's frame serves as the base.
    further : topics of more sensors of the same kind, with the calibration of each, whose scans are put
    together with those of the first. stampless : whether the first scans have stamps of zero, so that the
    time of recording is used instead.
    mounted : None, unless the points of the scans are in a fixed frame already; then the frame of the sensor.
    period_ns : the longest time between two of the first scans; 0 if there is only one.
    depth_unit_m : that of the depth images, as the settings or the log say it; None: that of their encoding.
    """

    choice: Choice
    scans: TopicInfo
    camera: TopicInfo | None
    odometry: TopicInfo | None
    odometry_frame: str | None
    tf_moves: bool
    sensor_is_base: bool
    stampless: bool
    further: tuple[tuple[TopicInfo, TopicInfo | None], ...] = ()
    imu: TopicInfo | None = None
    mounted: str | None = None
    period_ns: int = 0
    depth_unit_m: float | None = None


def registered(frame: str) -> FrameError:
    """The error for points that cannot be taken back from a fixed frame to the sensor."""
    return FrameError(
        f"the scans are registered already, in the fixed frame {frame}: where the sensor was is not known",
        hint=f"use what the sensor itself measured (--topic), or record tf from {frame} to the robot's base "
        "and /tf_static with the sensor; for a sensor whose own frame is named so: "
        "--set read.assume_identity=true",
    )


def make_plan(source: MessageSource, config: ReadConfig, frames: FrameTree) -> Plan:
    """Decide what to read; fills `frames` with the static transforms and the first of the moving ones.

    Raises TopicError, NoScans, UnsupportedSchema or FrameError.
    """
    return _Planner(source, config, frames).plan()


def is_static(topic: TopicInfo) -> bool:
    """Whether a tf topic holds transforms that never change (tf2: `tf_static`)."""
    return topic.topic.endswith("tf_static")


def published_once(topic: TopicInfo) -> bool:
    """Whether the messages of a topic may be published only once, when the robot starts."""
    return topic.type in topics.CAMERA_INFOS or (topic.type in topics.TF and is_static(topic))


def tolerant(decode: Callable[[Any], Any], data: Any, otherwise: Any) -> Any:
    """Decode a message that is of use but not needed (tf, odometry); `otherwise` if it cannot be decoded."""
    try:
        return decode(data)
    except PointCloudError:
        return otherwise


class _Sensors(NamedTuple):
    """The topic of the scans, those of more sensors of its kind, and the calibration of each."""

    scans: TopicInfo
    more: tuple[TopicInfo, ...]
    cameras: list[TopicInfo | None]
    reason: str

    def need(self, base: str | None) -> None:
        """Raise FrameError if there are several sensors, and no tf that says where on the robot they are."""
        if self.more and base is None:
            first, second = self.scans.topic, self.more[0].topic
            raise FrameError(
                f"{first}, {second}: without tf their places on the robot are not known",
                hint=f"record /tf_static too, or choose one: --topic {first}",
            )


class _Motion(NamedTuple):
    """Where odometry, or an IMU, comes from: a topic, or the transform from a frame in tf; and the topic to
    name."""

    topic: TopicInfo | None
    named: TopicInfo | None
    frame: str | None
    reason: str

    @property
    def name(self) -> str | None:
        """The name of the topic to name."""
        return None if self.named is None else self.named.topic


class _Planner:
    def __init__(self, source: MessageSource, config: ReadConfig, frames: FrameTree) -> None:
        self._source, self._config, self._frames = source, config, frames
        self._topics = source.info.topics
        self._reading: Odometry | None = None  # the first one of the odometry's topic
        self._points = False  # whether the scans are clouds, which may be in any frame
        self._odometry_delay_ns = 0  # from the stamp of the odometry to its recording

    def plan(self) -> Plan:
        sensors = self._sensors()
        odometry, why = topics.odometry_topic(self._topics, self._config.odometry)
        self._read_static([t for t in self._tf_topics() if is_static(t)])
        first_ns, headers = self._first_headers(sensors.scans)
        sensor_frame = headers[0].frame if headers else ""  # none can be decoded: the stream counts them
        moving = [t for t in self._tf_topics() if not is_static(t)]
        in_tf = odometry.type in topics.TF if odometry else self._config.odometry is None
        self._points = topics.SENSORS[sensors.scans.type] == "lidar"
        self._reading = self._first_reading(odometry)
        child = None if self._reading is None else self._reading.child
        found = self._search_tf(moving, sensor_frame, child, first_ns, odometry_too=in_tf)
        sensors.need(found)
        self._check_joined(sensors.more, sensor_frame, found)
        mounted = self._mounted(sensors, sensor_frame, found)
        base = self._base_or_sensor(found, sensor_frame)
        motion = _Motion(odometry, odometry, None, why)
        if in_tf:
            motion = self._motion_in_tf(found, moving, why)
        motion = self._of_one_clock(motion, first_ns, headers)
        imu = self._imu(found, sensor_frame, sensors, motion)
        return Plan(
            choice=Choice(
                topic=sensors.scans.topic,
                sensor=topics.SENSORS[sensors.scans.type],
                odometry_topic=motion.name,
                base_frame=base,
                sensor_frame=sensor_frame or None,
                reason="; ".join(filter(None, (sensors.reason, motion.reason, imu.reason))),
                imu_topic=imu.name,
            ),
            scans=sensors.scans,
            camera=sensors.cameras[0],
            odometry=motion.topic,
            odometry_frame=motion.frame,
            tf_moves=motion.frame is not None or self._sensor_moves(found, sensor_frame),
            sensor_is_base=found is None,
            stampless=bool(headers) and not any(header.stamp_ns for header in headers),
            further=tuple(zip(sensors.more, sensors.cameras[1:], strict=True)),
            imu=imu.topic,
            mounted=mounted,
            period_ns=max((b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(headers)), default=0),
            depth_unit_m=self._config.depth_unit_m or self._recorded_depth_unit_m(),
        )

    def _check_joined(self, more: Sequence[TopicInfo], sensor_frame: str, base: str | None) -> None:
        """Raise TopicError for a topic with the scans of the first sensor, published again.

        In the frame of the base, sensors are not told apart.
        """
        for topic in more:
            if sensor_frame != base and self._source_of(topic).frame == sensor_frame:
                raise TopicError(
                    f"{topic.topic} is in frame {sensor_frame} of the first topic: one sensor is not put "
                    "together with itself",
                    hint="name a topic of each sensor, such as --topic /front,/rear, or only one",
                )

    def _mounted(self, sensors: _Sensors, sensor_frame: str, base: str | None) -> str | None:
        """The frame of the sensor, if its points are in a fixed frame; None if they are in its own.

        Raises FrameError if they cannot be taken back to the sensor.
        """
        frames = self._frames
        if base is None or sensor_frame == base or not self._is_fixed(sensor_frame, base):
            return None
        if sensors.more or not self._points:
            raise registered(sensor_frame)
        leaves = frames.static_leaves(base)
        named = [leaf for leaf in leaves if any(word in leaf.lower() for word in _LIDARS)] or leaves
        if len(named) == 1:
            return named[0]
        self._source.tally.warn(f"tf does not say where on {base} the sensor sits: its rays begin at {base}")
        return base

    def _recorded_depth_unit_m(self) -> float | None:
        """The unit that librealsense writes into its recordings, as a std_msgs/Float32; None if it is not."""
        unit = topics.depth_unit_topic(self._topics)
        if unit is None:
            return None
        message = next(self._source.messages({unit.topic}), None)
        value = 0.0 if message is None else _LAST_FLOAT.unpack(bytes(message.data)[-_LAST_FLOAT.size :])[0]
        if not 0 < value <= 1:
            return None
        self._source.tally.warn(f"depths are in units of {value:.3g} m, as {unit.topic} says")
        return float(value)

    def _imu(self, base: str | None, sensor_frame: str, sensors: _Sensors, motion: _Motion) -> _Motion:
        """The IMU; base : None if the log has no tf. Beside odometry, and with a laser, none is looked for.

        Raises TopicError, FrameError for one that the user names.
        """
        wanted, none = self._config.imu, _Motion(None, None, None, "")
        planar = SENSOR_MODELS[topics.SENSORS[sensors.scans.type]].planar
        imu = topics.imu_topic(self._topics, wanted)
        if imu is None or (wanted is None and (planar or motion.name is not None)):
            return none
        try:
            self._check_imu(imu, base, sensor_frame)
        except (FrameError, UnsupportedSchema) as error:
            if wanted is not None:
                raise
            return none._replace(reason=f"{imu.topic} is not used: {error.message}")
        return _Motion(imu, imu, None, f"gravity from {imu.topic}")

    def _check_imu(self, imu: TopicInfo, base: str | None, sensor_frame: str) -> None:
        """Raise FrameError if it is not known how the IMU sits on the base, UnsupportedSchema."""
        frames, there = self._frames, sensor_frame if base is None else base
        frame = self._first_frame(imu)
        known = frame == there or (base is not None and frames.connected(there, frame))
        if not known or frames.moving(there, frame):
            raise frames.missing(frame, there)

    def _first_frame(self, topic: TopicInfo) -> str:
        """The frame of the first message that can be decoded; empty if there is none."""
        found = self._first(topic)
        return "" if found is None else str(found.header.frame)

    def _first(self, topic: TopicInfo) -> Any:
        """The first message that can be decoded; None if there is none."""
        decode = decoder_for(topic)
        for message in self._source.messages({topic.topic}):
            found = tolerant(decode, message.data, None)
            if message.channel == topic and found is not None:
                return found
        return None

    def _source_of(self, topic: TopicInfo) -> topics.Source:
        """Where a topic of scans comes from."""
        log_time_ns, headers = self._first_headers(topic)
        if not headers:
            return topics.Source("", 0)
        return topics.Source(headers[0].frame, log_time_ns - headers[0].stamp_ns)

    def _base_or_sensor(self, found: str | None, sensor_frame: str) -> str:
        if found is not None:
            return found
        return sensor_frame or self._config.base_frame or "sensor"

    def _tf_topics(self) -> list[TopicInfo]:
        return [t for t in self._topics if t.type in topics.TF and t.message_count != 0]

    def _motion_in_tf(self, base: str | None, moving: list[TopicInfo], why: str) -> _Motion:
        """The odometry that tf holds, if it does; base : None if the log has no tf."""
        frame = None if base is None else self._odometry_frame(base)
        if frame is None:
            return _Motion(None, None, None, why)
        return _Motion(None, next(iter(moving), None), frame, f"odometry from tf, {frame} -> {base}")

    def _sensors(self) -> _Sensors:
        wanted = self._config.topic
        try:
            scans, reason = topics.scan_topic(self._topics, wanted, self._source_of)
        except NoScans:
            image = self._unnamed_depth() if wanted is None else None
            if image is None:
                raise
            raise topics.proposed(image, self._topics) from None
        more = topics.further_scan_topics(self._topics, wanted)
        if more:
            reason += f", with {', '.join(t.topic for t in more)}"
        cameras: list[TopicInfo | None] = [None] * (1 + len(more))
        if SENSOR_MODELS[topics.SENSORS[scans.type]].image:
            cameras = [topics.camera_info_topic(t, self._topics) for t in (scans, *more)]
        return _Sensors(scans, more, cameras, reason)

    def _unnamed_depth(self) -> TopicInfo | None:
        """A topic of depth images whose name does not say so; None if there is none."""
        images = [t for t in self._topics if topics.is_image(t) and t.message_count != 0]
        firsts = ((topic, self._first(topic)) for topic in images)
        return next((topic for topic, image in firsts if image is not None and holds_depths(image)), None)

    def _sensor_moves(self, base: str | None, sensor_frame: str) -> bool:
        """Whether the sensor moves on the robot. base : None if the log has no tf."""
        frames = self._frames
        if base is None or sensor_frame not in frames:
            return False
        return frames.connected(base, sensor_frame) and frames.moving(base, sensor_frame)

    def _first_headers(self, scans: TopicInfo) -> tuple[int, list[Header]]:
        """The log time of the first scan, and the headers of the first scans that can be decoded.

        Raises NoScans if there is none, UnsupportedSchema.
        """
        decode = decoder_for(scans)
        of_topic = (m for m in self._source.messages({scans.topic}) if m.channel == scans)
        first = list(itertools.islice(of_topic, LOOK_AHEAD.scans))
        if not first:
            raise NoScans(f"{scans.topic}: no message in the log")
        found = (tolerant(decode, message.data, None) for message in first)
        return first[0].log_time_ns, [scan.header for scan in found if scan is not None]

    def _read_static(self, topics: list[TopicInfo]) -> None:
        decoders = {t: decoder_for(t) for t in topics}
        for message in self._source.messages({t.topic for t in topics}):
            if message.channel in decoders:
                edges = tolerant(decoders[message.channel], message.data, None)
                self._frames.add_all(edges, static=True)

    def _is_fixed(self, frame: str, base: str | None) -> bool:
        """Whether a frame does not move with the robot: by its name, by the odometry, or above it in tf."""
        frames, reading = self._frames, self._reading
        if topics.is_fixed(frame) or (reading is not None and frame == reading.header.frame):
            return bool(frame)
        if base is None or base not in frames or frame not in frames.chain(base)[1:]:
            return False
        return frames.moving(base, frame) and frame.rpartition("/")[2] not in _BASE_FRAMES

    def _of_one_clock(self, motion: _Motion, first_ns: int, headers: list[Header]) -> _Motion:
        """The odometry, unless its stamps are of another clock than the scans' and nobody asked for it.

        first_ns, headers : of the first scans; the log time of the first one.
        """
        stamp_ns = headers[0].stamp_ns if headers else 0
        apart_ns = (first_ns - stamp_ns if stamp_ns else 0) - self._odometry_delay_ns
        if motion.name is None or abs(apart_ns) <= LOOK_AHEAD.clocks_ns:
            return motion
        self._source.tally.warn(
            f"the clocks of the scans and of the odometry from {motion.name} are {abs(apart_ns) * 1e-9:,.0f} "
            "s apart and never meet: that odometry says nothing of the scans; record both by one clock"
        )
        if self._config.odometry is not None:
            return motion
        return _Motion(None, None, None, f"odometry from {motion.name} is of another clock")

    def _first_reading(self, odometry: TopicInfo | None) -> Odometry | None:
        if odometry is None or odometry.type in topics.TF:
            return None
        decode = decoder_for(odometry)
        for message in self._source.messages({odometry.topic}):
            found: Odometry | None = tolerant(decode, message.data, None)
            if found is not None and found.header.stamp_ns:
                self._odometry_delay_ns = message.log_time_ns - found.header.stamp_ns
            return found
        return None

    def _search_tf(
        self, moving: list[TopicInfo], sensor_frame: str, child: str | None, first_ns: int, odometry_too: bool
    ) -> str | None:
        """Read tf until it connects the sensor to a base frame (`odometry_too`: and until it holds odometry).

        Returns the base frame; None if the log has no tf. Raises FrameError if tf does not connect them.
        """
        frames = self._frames
        decoders = {t: decoder_for(t) for t in moving}
        base = self._connected_base(sensor_frame, child)
        for message in self._source.messages({t.topic for t in moving}, end_ns=first_ns + LOOK_AHEAD.tf_ns):
            if base is not None and (
                not odometry_too
                or self._odometry_frame(base) is not None
                or message.log_time_ns > first_ns + LOOK_AHEAD.odometry_ns
            ):
                break
            if message.channel in decoders:
                size = len(frames.frames)
                edges = tolerant(decoders[message.channel], message.data, None)
                frames.add_all(edges, log_time_ns=message.log_time_ns)
                if odometry_too and edges and edges[-1].header.stamp_ns:
                    self._odometry_delay_ns = message.log_time_ns - edges[-1].header.stamp_ns
                if len(frames.frames) > size:
                    base = self._connected_base(sensor_frame, child)
        return base if base is not None else self._base_without_tf(sensor_frame, child)

    def _base_without_tf(self, sensor_frame: str, child: str | None) -> str | None:
        """The base frame where tf does not connect one to the sensor; None: the sensor's frame is the base.

        Raises FrameError unless the log never had tf or the user asks for this.
        """
        frames = self._frames
        base = self._base_frame(child)
        if base is not None and sensor_frame == base:
            return base
        if self._points and self._is_fixed(sensor_frame, base) and not self._config.assume_identity:
            return self._base_of_odometry(sensor_frame, base)
        root = frames.static_root() if base is None else None
        if root is not None and sensor_frame in frames and frames.connected(root, sensor_frame):
            self._source.tally.warn(
                f"tf has no {_BASE_FRAMES[0]}: {root}, the root of its static transforms, is taken for it"
            )
            return root
        name = sensor_frame or "(empty)"
        if not frames.frames and self._config.base_frame is None and not self._tf_may_be_lost():
            self._source.tally.warn(
                f"the log has no tf: frame {name} of the scans is taken for the robot's base"
            )
            return None
        if self._config.assume_identity:
            self._source.tally.warn(f"tf does not connect frame {name}: it is taken for the base, as asked")
            return None
        if base is None and frames.frames:
            raise FrameError(
                f"tf has none of the frames {', '.join(_BASE_FRAMES)}; "
                f"there is: {', '.join(frames.frames[:12])}",
                hint="--set read.base_frame=NAME says which is the robot's base",
            )
        raise frames.missing(sensor_frame, base or "the base")

    def _base_of_odometry(self, sensor_frame: str, base: str | None) -> str:
        """The base frame of points in a fixed frame that tf does not connect to it.

        Raises FrameError unless the odometry is in that frame.
        """
        reading = self._reading
        if reading is None or reading.header.frame != sensor_frame or not (base or reading.child):
            raise registered(sensor_frame)
        return base or reading.child

    def _tf_may_be_lost(self) -> bool:
        """Whether tf may be among what is lost: a wrong base frame would shift every scan."""
        tally = self._source.tally
        if tally.topics_lost or self._frames.warnings:
            return True
        return bool(tally.bytes_lost) and any(t.type in topics.TF for t in self._topics)

    def _connected_base(self, sensor_frame: str, child: str | None) -> str | None:
        base = self._base_frame(child)
        if base is None or sensor_frame not in self._frames:
            return None
        return base if self._frames.connected(base, sensor_frame) else None

    def _base_frame(self, child: str | None) -> str | None:
        if self._config.base_frame is not None:
            return self._config.base_frame.lstrip("/")
        known = self._frames.frames
        for name in _BASE_FRAMES:
            named = [f for f in known if f == name] or [f for f in known if f.endswith("/" + name)]
            if len(named) == 1:
                return named[0]
        return child if child in known else None

    def _odometry_frame(self, base: str) -> str | None:
        if base not in self._frames:
            return None
        above = self._frames.chain(base)[1:]
        return next((f for f in above if f == "odom" or f.endswith(("/odom", "_odom"))), None)
