"""The plan of what to read of a log and how, made from its first messages: sensors, base frame, odometry,
IMU.

The sensors are found first: the topics of scans, then the frames on each of them. Then the base of the robot,
in which the scans are put together, and the places of the sensors on it; then the odometry, and without it an
IMU for the direction of gravity.
"""

from __future__ import annotations

import functools
import itertools
import statistics
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from pc2grid.errors import FrameError, NoScans, TopicError, UnsupportedSchema
from pc2grid.io import topics
from pc2grid.io.frames import FrameTree
from pc2grid.io.messages.types import CameraInfo
from pc2grid.io.sensors.decode import ScanDecoder
from pc2grid.io.sensors.depth import holds_depths
from pc2grid.io.source import GAP_NS, Choice, MessageSource, TopicInfo
from pc2grid.io.topics import (
    BASE_FRAMES,
    FIRST,
    First,
    FirstMessages,
    Namespaces,
    Robot,
    camera_info_topic,
    decoder_for,
    delay_ns,
    diverge,
    prefix,
    shared_parts,
    tolerant,
    two_robots,
)
from pc2grid.model import SENSOR_MODELS, SensorKind
from pc2grid.settings import ReadConfig

LOOK_AHEAD_NS = 60_000_000_000
"""Log time behind the first scans within which tf must connect the sensor to the base; chosen by hand."""
_LAST_FLOAT = struct.Struct("<f")


@dataclass(frozen=True, slots=True)
class Plan:
    """What to read and how, decided once per log.

    sensors : the first one, and more of the same kind, whose scans are put together with those of the first;
    each has a topic and a frame of its own. left_out : topics and frames of scans that are not used. odometry
    : None if there is none, or if it is in tf. odometry_frame : the parent frame of the odometry in tf; None
    if it is not there. imu : None if there is none, or none is needed. moving_tf : the topics of tf that must
    be read along with the scans. sensor_is_base : True if the log has no tf, so that the sensor's frame
    serves as the base. stampless : True if the first scans have stamps of zero, so that the time of recording
    is used instead. mounted : None, unless the points of the scans are in a fixed frame already; then the
    frame of the sensor. period_ns : the longest time between two of the first scans; 0 if there is only one.
    depth_unit_m : that of the depth images, by the settings or the log; None: that of their encoding.
    """

    choice: Choice
    sensors: tuple[Sensor, ...]
    left_out: frozenset[tuple[TopicInfo, str]]
    odometry: TopicInfo | None
    odometry_frame: str | None
    imu: TopicInfo | None
    moving_tf: tuple[TopicInfo, ...]
    sensor_is_base: bool
    stampless: bool
    mounted: str | None
    period_ns: int
    depth_unit_m: float | None


def make_plan(source: MessageSource, config: ReadConfig, frames: FrameTree) -> Plan:
    """Make the plan; fills `frames` with the static transforms and the first of the moving ones.

    Raises TopicError, NoScans, UnsupportedSchema or FrameError.
    """
    first = FirstMessages(source)
    found = find_sensors(config, first)
    robot = Robot(found.topic, found.frame, first)
    candidates = robot.names.odometry_topics(config.odometry)
    end_ns = max((scan.log_time_ns for scan in found.first_scans), default=source.info.end_ns) + LOOK_AHEAD_NS
    tf = Transforms(source, robot.tf(none_if_unsure=config.assume_identity), frames, end_ns)
    bases = BaseSearch(config, first, found, tf, candidates)
    base = bases.found()
    motions = MotionSearch(config, first, found, robot, tf, base)
    motion = motions.odometry(candidates)
    imu, gravity = motions.imu(motion)
    needs_tf = motion.frame is not None or bases.sensor_moves(base)
    stampless, period_ns = _stamps(found.first_scans)
    return Plan(
        choice=Choice(
            topic=found.topic.topic,
            sensor=found.sensors[0].kind,
            odometry_topic=motion.topic.topic if motion.topic else None,
            base_frame=base or found.frame or config.base_frame or "sensor",
            sensor_frame=found.frame or None,
            further_frames=tuple(s.frame for s in found.seen[1:] if s.frame),
            reason="; ".join(filter(None, (found.reason, motion.reason, gravity))),
            imu_topic=imu.topic if imu else None,
        ),
        sensors=found.sensors,
        left_out=found.left_out,
        odometry=motion.topic if motion.frame is None else None,
        odometry_frame=motion.frame,
        imu=imu,
        moving_tf=tuple(tf.moving) if needs_tf else (),
        sensor_is_base=base is None,
        stampless=stampless,
        mounted=bases.mounted(base),
        period_ns=period_ns,
        depth_unit_m=config.depth_unit_m or _recorded_depth_unit_m(source),
    )


def _stamps(scans: Sequence[First]) -> tuple[bool, int]:
    """Return whether all stamps of the first scans are zero, and the longest time between two of them."""
    stamps_ns = [scan.content.header.stamp_ns for scan in scans]
    longest_ns = max((b - a for a, b in itertools.pairwise(stamps_ns)), default=0)
    return bool(stamps_ns) and not any(stamps_ns), longest_ns


def _recorded_depth_unit_m(source: MessageSource) -> float | None:
    """Return the unit that librealsense writes into its recordings, as a std_msgs/Float32; None without
    it."""
    unit = topics.depth_unit_topic(source.info.topics)
    message = None if unit is None else next(source.messages({unit.topic}), None)
    value = 0.0 if message is None else _LAST_FLOAT.unpack(bytes(message.data)[-_LAST_FLOAT.size :])[0]
    if unit is None or not 0 < value <= 1:
        return None
    source.tally.warn(f"depths are in units of {value:.3g} m, as {unit.topic} says")
    return float(value)


# --- the sensors --------------------------------------------------------------------------------------


class Sensor(NamedTuple):
    """The scans of one topic and frame.

    camera, calibration : of depth images: the topic of its CameraInfo, and the first. frame : None if no scan
    could be decoded. silent : True if its first scans hold no return, unlike those of another sensor; it is
    left out until they do.
    """

    topic: TopicInfo
    kind: SensorKind
    camera: TopicInfo | None = None
    calibration: CameraInfo | None = None
    frame: str | None = None
    silent: bool = False

    def decoder(self, config: ReadConfig, **more: Any) -> ScanDecoder:
        """Return the decoder of its scans. more : see ScanDecoder."""
        return ScanDecoder(
            self.topic.topic,
            self.kind,
            config,
            camera_topic="" if self.camera is None else self.camera.topic,
            camera=self.calibration,
            **more,
        )


@dataclass(frozen=True, slots=True)
class FoundSensors:
    """The sensors that are read, the first one first, and why.

    left_out : topics and frames of scans that are not used. first_scans : of the first sensor.
    """

    sensors: tuple[Sensor, ...]
    left_out: frozenset[tuple[TopicInfo, str]]
    first_scans: tuple[First, ...]
    reason: str

    @property
    def topic(self) -> TopicInfo:
        """Return the topic of the first sensor."""
        return self.sensors[0].topic

    @property
    def frame(self) -> str:
        """Return the frame of the first sensor; empty if no scan can be decoded (the stream counts them)."""
        return self.sensors[0].frame or ""

    @property
    def seen(self) -> list[Sensor]:
        """Return the sensors that are not silent."""
        return [sensor for sensor in self.sensors if not sensor.silent]

    @property
    def of_one_topic(self) -> bool:
        """Return whether all sensors are on one topic and differ by their frames alone."""
        return all(sensor.topic == self.topic for sensor in self.sensors)


def find_sensors(config: ReadConfig, first: FirstMessages) -> FoundSensors:
    """Return the sensors to read; warns of frames that are left out.

    Raises TopicError, NoScans or UnsupportedSchema.
    """
    found, reason = _scan_topics(config.topic, first)
    sensors = [sensor for topic in found for sensor in _of_frames(_with_camera(topic, first), config, first)]
    lead, used = sensors[0], {(sensor.topic, sensor.frame or "") for sensor in sensors}
    frames = [str(s.frame) for s in sensors if s.topic == lead.topic and not s.silent]
    if len(frames) > 1:
        reason += f", of {len(frames)} sensors by their frames: {', '.join(frames)}"
    left_out = {(t, scan.frame) for t in found for scan in first.of(t)} - used
    scans = [s for s in first.of(lead.topic) if s.frame == lead.frame]
    return FoundSensors(tuple(sensors), frozenset(left_out), tuple(scans), reason)


# --- the topics -------------------------------------------------------------------------------------------


def _scan_topics(wanted: str | None, first: FirstMessages) -> tuple[list[TopicInfo], str]:
    """Return the topics to read scans from, and a sentence with the reason."""
    try:
        found, reason = topics.scan_topics(first.topics, wanted)
    except NoScans:
        image = None if wanted else _unnamed_depth(first)
        if image is None:
            raise
        raise topics.proposed(image, first.topics) from None
    if len(found) > 1 and wanted is None:
        raise _several(found, first)
    names = Namespaces(found[0], first.topics)
    for topic in found[1:]:
        if names.owns(topic) is False:
            raise two_robots(f"{found[0].topic} and {topic.topic}", f"--topic {found[0].topic}")
    return found, reason


def _unnamed_depth(first: FirstMessages) -> TopicInfo | None:
    """Return a topic of depth images whose name does not say so; None if there is none."""
    images = (t for t in first.topics if topics.is_image(t) and t.message_count != 0)
    return next((t for t in images if any(holds_depths(m.content) for m in first.of(t))), None)


def _several(found: Sequence[TopicInfo], first: FirstMessages) -> TopicError:
    """Return the error where several topics hold scans; it proposes one of them, or one of each sensor.

    Topics of one frame hold the scans of one sensor, filtered or delayed: the first one is proposed. Points
    in a fixed frame are no longer those of the sensor.
    """
    frame_of = {t: next((m.frame for m in first.of(t)), "") for t in found}
    latest_first = sorted(found, key=lambda t: delay_ns(first.of(t)))[::-1]
    of_sensor = {frame_of[t]: t for t in latest_first if not topics.is_fixed(frame_of[t])}
    lead, *more = [t for t in found if t in of_sensor.values()] or found[:1]
    names = Namespaces(lead, first.topics)
    own = (t for t in more if names.owns(t) is not False and not diverge(frame_of[t], frame_of[lead]))
    return topics.several(found, [lead, *own])


def _with_camera(topic: TopicInfo, first: FirstMessages) -> Sensor:
    """Return the sensor of a topic. Raises NoScans for a depth camera without a calibration."""
    kind = topics.SENSORS[topic.type]
    if not SENSOR_MODELS[kind].image:
        return Sensor(topic, kind)
    camera = camera_info_topic(topic, first.topics)
    # It may have been published only once, at the beginning.
    found = first.of(camera)
    if not found:
        raise NoScans(f"{camera.topic}: no message in the log, but the depth images need it")
    return Sensor(topic, kind, camera, found[0].content)


# --- the frames on a topic --------------------------------------------------------------------------------


class _Frame(NamedTuple):
    """The first scans of a topic in one frame.

    foreign : True if the frame is of another robot than the base in the settings. empty : True if no scan
    holds a return. delay_ns : time from their stamps to their recording; stamps of zero are another clock's,
    too.
    """

    name: str
    foreign: bool
    empty: bool
    delay_ns: int

    def silence(self, lead: _Frame) -> str:
        """Return the warning about a sensor without returns beside one with; empty if it is none."""
        return f"beside frame {lead.name}, its scans hold no return" if self.empty > lead.empty else ""

    def why_not(self, lead: _Frame, base: str | None) -> str:
        """Return why the scans are not used at all; empty if they are."""
        if self.foreign > lead.foreign:
            return f"read.base_frame is {base}"
        apart_ns = abs(self.delay_ns - lead.delay_ns)
        if apart_ns > GAP_NS:
            return f"its stamps are {apart_ns * 1e-9:,.0f} s apart from those of frame {lead.name}"
        return ""


def _of_frames(sensor: Sensor, config: ReadConfig, first: FirstMessages) -> list[Sensor]:
    """Return the sensors whose scans are on a topic, the best one first; warns of frames that are left out.

    sensor : that of the topic, as long as its frame is not known.
    """
    scans = first.of(sensor.topic)
    names = list(dict.fromkeys(scan.frame for scan in scans))
    if len(names) < 2:
        return [sensor._replace(frame=name) for name in names] or [sensor]
    frames = [_shown(sensor, config, name, [s for s in scans if s.frame == name]) for name in names]
    lead = min(frames, key=lambda f: (f.foreign, f.empty, abs(f.delay_ns) // GAP_NS))
    found = []
    for frame in sorted(frames, key=lambda f: f is not lead):
        why = frame.why_not(lead, config.base_frame)
        if told := "; ".join(filter(None, (frame.silence(lead), why))):
            first.tally.warn(f"frame {frame.name} of {sensor.topic.topic} is left out: {told}")
        if not why:
            silent = frame.empty and frame is not lead
            calibration = _calibration(sensor, frame.name, first)
            found.append(sensor._replace(frame=frame.name, silent=silent, calibration=calibration))
    return found


def _shown(sensor: Sensor, config: ReadConfig, name: str, scans: Sequence[First]) -> _Frame:
    returns = sensor.decoder(config).returns
    return _Frame(
        name,
        foreign=diverge(name, config.base_frame or ""),
        empty=not any(returns(scan.content) for scan in scans),
        delay_ns=statistics.median_low(s.log_time_ns - s.content.header.stamp_ns for s in scans),
    )


def _calibration(sensor: Sensor, frame: str, first: FirstMessages) -> CameraInfo | None:
    """Return the first calibration in the frame of the images, else the first one."""
    infos = [] if sensor.camera is None else first.of(sensor.camera)
    return next((info.content for info in infos if info.frame == frame), sensor.calibration)


# --- tf -----------------------------------------------------------------------------------------------


class Transforms:
    """Fills a tree of frames from the tf topics of a robot: all static transforms, and the moving ones on
    demand.

    frames : the tree. moving : the topics of moving transforms. edges : those of them that were read.
    """

    def __init__(
        self, source: MessageSource, tf: Sequence[TopicInfo], frames: FrameTree, end_ns: int
    ) -> None:
        """Read the static transforms of some topics. end_ns : up to which moving ones are read."""
        self._source, self.frames = source, frames
        self.moving = [t for t in tf if not topics.is_static(t)]
        self.edges: list[First] = []
        for _ in self._read([t for t in tf if topics.is_static(t)], None):
            pass
        self._later = self._read(self.moving, end_ns)

    def read_on(self) -> bool:
        """Read the next message of moving transforms; returns whether there is one."""
        found = next(self._later, None)
        self.edges += found or ()
        return found is not None

    def read_odometry(self, base: str) -> str | None:
        """Return the frame above the base that is its odometry frame in tf, after reading enough to know its
        clock."""
        while (len(self.edges) < FIRST or self.odometry_frame(base) is None) and self.read_on():
            pass
        return self.odometry_frame(base)

    def odometry_frame(self, base: str) -> str | None:
        """Return the frame above the base that is its odometry frame in tf, as far as tf was read."""
        above = self.frames.chain(base)[1:]
        return next((f for f in above if f == "odom" or f.endswith(("/odom", "_odom"))), None)

    def _read(self, tf: Sequence[TopicInfo], end_ns: int | None) -> Iterator[list[First]]:
        """Read the transforms of some topics into the tree; yield those of each message."""
        decoders = {t: decoder_for(t) for t in tf}
        for message in self._source.messages({t.topic for t in tf}, end_ns=end_ns):
            if message.channel in decoders:
                at_ns, edges = message.log_time_ns, tolerant(decoders[message.channel], message.data)
                self.frames.add_all(edges, static=topics.is_static(message.channel), log_time_ns=at_ns)
                yield [First(at_ns, edge) for edge in edges or ()]


# --- the base of the robot ----------------------------------------------------------------------------

_LIDARS = ("lidar", "laser", "velodyne", "livox", "ouster", "os_sensor", "hesai", "pandar", "rslidar")
"""Parts of the names of frames of lidars."""


def registered(frame: str) -> FrameError:
    """Return the error for points that cannot be taken back from a fixed frame to the sensor."""
    return FrameError(
        f"the scans are registered already, in the fixed frame {frame}: where the sensor was is not known",
        hint=f"use what the sensor itself measured (--topic), or record tf from {frame} to the robot's base "
        "and /tf_static with the sensor; for a sensor whose own frame is named so: "
        "--set read.assume_identity=true",
    )


class BaseSearch:
    """Searches for the base by the settings, by names of frames, by odometry, and by the connections of tf.

    odometry : topics that may hold that of the robot.
    """

    def __init__(
        self,
        config: ReadConfig,
        first: FirstMessages,
        sensors: FoundSensors,
        tf: Transforms,
        odometry: Sequence[TopicInfo],
    ) -> None:
        self._config, self._first = config, first
        self._sensors, self._tf, self._frames = sensors, tf, tf.frames
        self._odometry = [t for t in odometry if t.type not in topics.TF]

    def found(self) -> str | None:
        """Return the base; None if the log has no tf, so that the sensor's frame serves as the base.

        Raises FrameError if tf does not connect the base to the sensors, TopicError if these are of two
        robots, or one sensor is named twice.
        """
        base = self._connected()
        while base is None and self._tf.read_on():
            base = self._connected()
        base = self._without_tf() if base is None else base
        self._check_sensors(base)
        return base

    def mounted(self, base: str | None) -> str | None:
        """Return the frame of the sensor, if its points are in a fixed frame; None if they are in its own.

        Raises FrameError if they cannot be taken back to the sensor.
        """
        frame = self._sensors.frame
        if base is None or frame == base or not self._is_fixed(base):
            return None
        if len(self._sensors.seen) > 1 or self._sensors.sensors[0].kind != "lidar":
            raise registered(frame)
        leaves = self._frames.static_leaves(base)
        named = [leaf for leaf in leaves if any(word in leaf.lower() for word in _LIDARS)] or leaves
        if len(named) == 1:
            return named[0]
        self._first.tally.warn(f"tf does not say where on {base} the sensor sits: its rays begin at {base}")
        return base

    def sensor_moves(self, base: str | None) -> bool:
        """Return whether the first sensor moves on the robot."""
        frames, frame = self._frames, self._sensors.frame
        return base is not None and frames.connected(base, frame) and frames.moving(base, frame)

    # --- which frame it is ----------------------------------------------------------------------------

    def _connected(self) -> str | None:
        """Return the base if tf connects it to all sensors."""
        base = self._of(self._sensors.frame)
        return base if base is not None and self._apart(base) is None else None

    def _apart(self, base: str) -> str | None:
        """Return the frame of a sensor that tf does not connect to the base; None if there is none."""
        frames = (sensor.frame or "" for sensor in self._sensors.seen)
        return next((frame for frame in frames if not self._frames.connected(base, frame)), None)

    def _of(self, frame: str) -> str | None:
        """Return the base of a sensor's frame, by the settings, by its name, or by the odometry."""
        if self._config.base_frame is not None:
            return self._config.base_frame.lstrip("/")
        return self._named(frame) or self._moved(frame)

    def _named(self, frame: str) -> str | None:
        """Return the base by its name, of several robots the one that tf or the names put nearest."""
        named = [f for f in self._frames.frames if f.rpartition("/")[2] in BASE_FRAMES]
        most = max((shared_parts(f, frame) for f in named), default=0)
        alike = [f for f in named if shared_parts(f, frame) == most and not diverge(f, frame)]
        named = list(filter(functools.partial(self._frames.rigid, frame), named)) or alike
        for name in BASE_FRAMES:
            found = [f for f in named if f == name] or [f for f in named if f.endswith("/" + name)]
            if len(found) == 1:
                return found[0]
        return None

    def _moved(self, frame: str) -> str | None:
        """Return the frame that the odometry moves, if tf knows it."""
        children = [m.content.child for m in self._readings() if m.content.child in self._frames.frames]
        rigid = filter(functools.partial(self._frames.rigid, frame), children)
        return next(rigid, next((f for f in children if not diverge(f, frame)), None))

    def _readings(self) -> list[First]:
        return [message for topic in self._odometry for message in self._first.if_known(topic)]

    def _is_fixed(self, base: str | None) -> bool:
        """Return whether the frame of the scans does not move with the robot: by its name, by the odometry,
        or as it is above the base in tf."""
        frames, frame = self._frames, self._sensors.frame
        if topics.is_fixed(frame) or frame in {m.frame for m in self._readings()}:
            return bool(frame)
        if base is None or frame not in frames.chain(base)[1:]:
            return False
        return frames.moving(base, frame) and frame.rpartition("/")[2] not in BASE_FRAMES

    # --- without a base in tf -------------------------------------------------------------------------

    def _without_tf(self) -> str | None:
        """Return the base where tf does not connect one to the sensor; None: the sensor's frame is the base.

        Raises FrameError unless the log never had tf or the user asks for this.
        """
        base, frame, asked = self._of(self._sensors.frame), self._sensors.frame, self._config.assume_identity
        if self._sensors.sensors[0].kind == "lidar" and self._is_fixed(base) and not asked:
            raise registered(frame)
        warn = self._first.tally.warn
        if base is None and (root := self._root()) is not None:
            warn(f"tf has no {BASE_FRAMES[0]}: {root}, the root of its static transforms, is taken for it")
            return root
        name = frame or "(empty)"
        if self._never_had_tf():
            warn(f"the log has no tf: frame {name} of the scans is taken for the robot's base")
        elif asked:
            warn(f"tf does not connect frame {name}: it is taken for the base, as asked")
        elif base is None:
            raise self._frames.missing(frame, "the base")
        else:
            self._check_robots(base)
            raise self._frames.missing(self._apart(base) or "", base or "the base")
        return None

    def _root(self) -> str | None:
        """Return the root of the static transforms, if there is one or the odometry moves it; None if the
        sensor is not below it."""
        frame = self._sensors.frame
        root, above = self._frames.static_root(), self._frames.static_root_of(frame)
        if above != frame and self._tf.odometry_frame(above) is not None:
            root = above
        return root if root is not None and self._frames.connected(root, frame) else None

    def _never_had_tf(self) -> bool:
        """Return whether there never was tf: it is not among lost data either, as a wrong base would shift
        every scan."""
        tally = self._first.tally
        of_tf = any(t.type in topics.TF for t in self._first.topics)
        lost = tally.topics_lost or self._frames.warnings or (tally.bytes_lost > 0 and of_tf)
        return not (self._frames.frames or self._config.base_frame is not None or lost)

    # --- how the sensors sit on it --------------------------------------------------------------------

    def _check_sensors(self, base: str | None) -> None:
        """Raise an error for sensors whose places on the base are not known, or that cannot be put together.

        FrameError: the places of several sensors are not known. TopicError: the scans of one sensor are
        published twice, or the sensors are of two robots. In the frame of the base, sensors cannot be
        distinguished.
        """
        lead, *further = self._sensors.seen
        if further and base is None:
            self._check_asked()
        for sensor in further:
            if sensor.topic != lead.topic and sensor.frame == self._sensors.frame != base:
                raise TopicError(
                    f"{sensor.topic.topic} is in frame {sensor.frame} of the first topic: one sensor is not "
                    "put together with itself",
                    hint="name a topic of each sensor, such as --topic /front,/rear, or only one",
                )
        if base is not None:
            self._check_robots(base)
            if (apart := self._apart(base)) is not None:
                raise self._frames.missing(apart, base)
            self._check_places(base)

    def _check_asked(self) -> None:
        """Raise FrameError for several sensors without tf, unless the user chooses the first of those on one
        topic."""
        lead, one = self._sensors.seen[0], self._sensors.of_one_topic
        if one and self._config.assume_identity:
            return

        def name(sensor: Sensor) -> str:
            return f"{sensor.topic.topic} in frame {sensor.frame}" if one else sensor.topic.topic

        alone = f"--set read.assume_identity=true takes frame {self._sensors.frame} alone"
        raise FrameError(
            f"{', '.join(map(name, self._sensors.seen))}: without tf their places on the robot are not known",
            hint=f"record /tf_static too, or choose one: {alone if one else f'--topic {lead.topic.topic}'}",
        )

    def _check_robots(self, base: str) -> None:
        """Raise TopicError if the sensors are on several robots, each with a base of its own."""
        topic, one = self._sensors.topic.topic, self._sensors.of_one_topic
        for sensor in self._sensors.sensors[1:]:
            other = None if sensor.silent else self._of(sensor.frame or "")
            if other is not None and prefix(other) != prefix(base):
                name = sensor.topic.topic
                raise two_robots(
                    f"{topic} in frame {self._sensors.frame} and {name} in frame {sensor.frame}",
                    f"--set read.base_frame={base}" if one else f"--topic {topic}",
                )

    def _check_places(self, base: str) -> None:
        """Raise TopicError if static transforms put a sensor in several places, and may be of several robots;
        otherwise warn."""
        frames = (sensor.frame or "" for sensor in self._sensors.seen)
        for frame in (f for f in frames if self._frames.ambiguous(base, f)):
            if twins := self._twins(frame):
                without = f"--odometry none --set read.base_frame={frame}"
                raise TopicError(
                    f"static transforms put frame {frame} in two places, and {twins} has scans in a frame of "
                    "that name, too: these may be of two robots",
                    hint="record the transforms of each robot in its namespace, or its name before its "
                    f"frames; without them: {without}",
                )
            self._first.tally.warn(
                f"static transforms put frame {frame} in two places on {base}: the latest counts"
            )

    def _twins(self, frame: str) -> str:
        """Return the names of the other topics whose scans are in a frame of this name."""
        mine = {sensor.topic for sensor in self._sensors.sensors}
        others = [t for t in topics.usable(self._first.topics, None) if t not in mine]
        return ", ".join(t.topic for t in others if frame in self._first.frames_of(t))


# --- odometry and IMU ---------------------------------------------------------------------------------


class Motion(NamedTuple):
    """Where odometry comes from: a topic; of tf, the transform from a frame in it. None if there is none."""

    topic: TopicInfo | None
    frame: str | None
    reason: str


class MotionSearch:
    """Searches for the odometry and the IMU of a robot whose base is known. base : None: the sensor's
    frame."""

    def __init__(
        self,
        config: ReadConfig,
        first: FirstMessages,
        sensors: FoundSensors,
        robot: Robot,
        tf: Transforms,
        base: str | None,
    ) -> None:
        self._config, self._first = config, first
        self._sensors, self._robot, self._tf, self._base = sensors, robot, tf, base

    # --- odometry -------------------------------------------------------------------------------------

    def odometry(self, candidates: Sequence[TopicInfo]) -> Motion:
        """Return the odometry of the best topic, or that in tf; warns if there is a choice.

        candidates : the topics that may hold it. Raises TopicError if it may be of another robot.
        """
        if self._config.odometry is not None and not candidates:
            return Motion(None, None, "odometry is ignored as asked")
        topic = self._best(candidates)
        if topic is None or topic.type in topics.TF:
            motion = self._in_tf()
        else:
            motion = Motion(topic, None, f"odometry from {topic.topic}")
        return self._of_one_clock(self._said(motion))

    def _best(self, candidates: Sequence[TopicInfo]) -> TopicInfo | None:
        """Return the best topic of the robot; None if there is none. Raises TopicError if its robot is
        unknown."""
        wanted = self._config.odometry is not None
        owned = {t: wanted or self._robot.owns(t, self._base, self._tf.frames) for t in candidates}
        ours = [t for t in candidates if owned[t]]
        if not ours and (unsure := [t for t in candidates if owned[t] is None]):
            raise self._robot.unsure(unsure)
        return next((t for t in ours if not self._is_elsewhere(t)), next(iter(ours), None))

    def _is_elsewhere(self, odometry: TopicInfo) -> bool:
        """Return whether tf has the frame that a topic moves, but not in one piece with the base."""
        base, frames = self._base, self._tf.frames
        children = {m.content.child for m in self._readings(odometry)} & {*frames.frames}
        return base is not None and not all(frames.rigid(base, child) for child in children)

    def _in_tf(self) -> Motion:
        """Return the odometry in tf. Raises TopicError if it may be of another robot."""
        frame = None if self._base is None else self._tf.read_odometry(self._base)
        if frame is None or not self._tf.moving:
            return Motion(None, None, "no odometry topic")
        topic = self._tf.moving[0]
        if self._config.odometry is None and not prefix(frame) and self._robot.serves_several(topic):
            raise self._robot.unsure([topic])
        return Motion(topic, frame, f"odometry from tf, {frame} -> {self._base}")

    def _said(self, motion: Motion) -> Motion:
        """Return the odometry with a reason that names the others, of which the user is warned."""
        if (wanted := self._config.odometry) is not None:
            return motion if motion.frame else motion._replace(reason=f"odometry from {wanted} as asked")
        there = topics.with_odometry(self._first.topics)
        rest = ", ".join(t.topic for t in there if t != motion.topic)
        if not rest:
            return motion
        reason = f"{motion.reason} (also there: {rest}; --odometry chooses)"
        self._first.tally.warn(reason)
        return motion._replace(reason=reason)

    def _of_one_clock(self, motion: Motion) -> Motion:
        """Return the odometry, or none if its stamps are of another clock than the scans' and the user did
        not name it."""
        if motion.topic is None:
            return motion
        apart_ns = abs(delay_ns(self._sensors.first_scans) - delay_ns(self._readings(motion.topic)))
        if apart_ns <= GAP_NS:
            return motion
        name = motion.topic.topic
        self._first.tally.warn(
            f"the clocks of the scans and of the odometry from {name} are {apart_ns * 1e-9:,.0f} s apart and "
            "never meet: that odometry says nothing of the scans; record both by one clock"
        )
        if self._config.odometry is not None:
            return motion
        return Motion(None, None, f"odometry from {name} is of another clock")

    def _readings(self, topic: TopicInfo) -> list[First]:
        """Return the first messages of a topic of odometry; of tf, the transforms that were read."""
        return self._tf.edges if topic.type in topics.TF else self._first.if_known(topic)

    # --- the IMU --------------------------------------------------------------------------------------

    def imu(self, motion: Motion) -> tuple[TopicInfo | None, str]:
        """Return the IMU, and why; beside odometry, and with a laser, none is searched for.

        Raises TopicError, FrameError for one that the user names.
        """
        wanted = self._config.imu
        found, why = self._robot.names.imu_topics(wanted), []
        planar = SENSOR_MODELS[self._sensors.sensors[0].kind].planar
        if wanted is None and (planar or motion.topic is not None):
            return None, ""
        for imu in found:
            try:
                self._check_imu(imu)
            except (FrameError, UnsupportedSchema) as error:
                if wanted is not None:
                    raise
                why.append(f"{imu.topic} is not used: {error.message}")
                continue
            if wanted is not None or self._robot.owns(imu, self._base, self._tf.frames):
                return imu, f"gravity from {imu.topic}"
            why.append(f"{imu.topic} is not used: it may be of another robot")
        return None, "; ".join(why)

    def _check_imu(self, imu: TopicInfo) -> None:
        """Raise FrameError if the place of the IMU on the base is not known, UnsupportedSchema."""
        there, frames = self._sensors.frame if self._base is None else self._base, self._tf.frames
        frame = next((m.frame for m in self._first.of(imu)), "")
        known = frame == there or (self._base is not None and frames.connected(there, frame))
        if not known or frames.moving(there, frame):
            raise frames.missing(frame, there)
