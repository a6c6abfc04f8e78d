"""What to read of a log and how, decided from its first messages: topics, base frame, odometry, IMU."""

from __future__ import annotations

import contextlib
import functools
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
from pc2grid.io.sensors.scan_decoder import ScanDecoder
from pc2grid.model import SensorKind
from pc2grid.sensor_model import SENSOR_MODELS

LOOK_AHEAD_NS = 60_000_000_000
"""Log time behind the first scans within which tf must connect the sensor to the base; chosen by hand."""
_FIRST, _FIRST_SCANS = 5, 20
"""So many messages of a topic are looked at: a few may have a stray time, or be unreadable; and of scans, so
that each of several sensors on one topic is among them. By hand."""
_LAST_FLOAT = struct.Struct("<f")
_BASE_FRAMES = ("base_link", "base_footprint")  # REP-105 and REP-120
_LIDARS = ("lidar", "laser", "velodyne", "livox", "ouster", "os_sensor", "hesai", "pandar", "rslidar")
"""Parts of the names of frames of lidars."""


class Sensor(NamedTuple):
    """The scans of one topic and frame.

    camera, calibration : of depth images: the topic of its CameraInfo, and the first.
    frame : None if no scan could be decoded. silent : whether its first scans hold no return beside those of
    another sensor; it is left out until they do.
    """

    topic: TopicInfo
    kind: SensorKind
    camera: TopicInfo | None = None
    calibration: CameraInfo | None = None
    frame: str | None = None
    silent: bool = False

    def decoder(self, config: ReadConfig, **more: Any) -> ScanDecoder:
        """Return what decodes its scans. more : see ScanDecoder."""
        return ScanDecoder(
            self.topic.topic,
            self.kind,
            config,
            camera_topic="" if self.camera is None else self.camera.topic,
            camera=self.calibration,
            **more,
        )


@dataclass(frozen=True, slots=True)
class Plan:
    """What to read and how, decided once per log.

    sensors : the first one, and more of the same kind, whose scans are put together with those of the first;
    each has a topic and a frame of its own. left_out : topics and frames of scans that are not used.
    odometry : None if there is none, or if it is in tf. odometry_frame : the parent frame of the odometry in
    tf; None if it is not there.
    imu : None if there is none, or none is needed.
    moving_tf : the topics of tf that must be read along with the scans.
    sensor_is_base : whether the log has no tf, so that the sensor's frame serves as the base.
    stampless : whether the first scans have stamps of zero, so that the time of recording is used instead.
    mounted : None, unless the points of the scans are in a fixed frame already; then the frame of the sensor.
    period_ns : the longest time between two of the first scans; 0 if there is only one.
    depth_unit_m : that of the depth images, as the settings or the log say it; None: that of their encoding.
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


def published_once(topic: TopicInfo) -> bool:
    """Whether the messages of a topic may be published only once, when the robot starts."""
    return topic.type in topics.CAMERA_INFOS or (topic.type in topics.TF and topics.is_static(topic))


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


def _two_robots(what: str, one: str) -> TopicError:
    return TopicError(f"{what} are of two robots", hint=f"choose one, e.g. {one}")


def _of_several(scans: TopicInfo, odometry: Sequence[TopicInfo]) -> TopicError:
    return TopicError(
        f"it cannot be told whether this odometry is of the robot of {scans.topic}: "
        f"{topics.listed(odometry)}",
        hint=f"choose, e.g. --odometry {odometry[0].topic}, or --odometry none goes without",
    )


def _prefix(frame: str) -> str:
    """The robot's name in the name of a frame, such as robot1/base_link; empty if there is none."""
    base = next((name for name in _BASE_FRAMES if frame.endswith(name)), None)
    return frame.rpartition("/")[0] if base is None else frame.removesuffix(base).rstrip("/_.-")


def _diverge(frame: str, other: str) -> bool:
    """Whether two frames have prefixes of which none is part of the other."""
    a, b = _prefix(frame), _prefix(other)
    return a != "" != b and topics.shared_parts(f"{a}/", f"{b}/") <= min(a.count("/"), b.count("/"))


class _Motion(NamedTuple):
    """Where odometry comes from: a topic; of tf, the transform from a frame in it. None if there is none."""

    topic: TopicInfo | None
    frame: str | None
    reason: str


class _Planner:
    """Looks at the first messages of the topics, one kind after another.

    What is found is kept for what is decided next: the sensors and the first scans, the frame of the first
    scan (empty if none can be decoded; the stream counts them), the topics that may hold odometry and the
    first of it, the moving transforms.
    """

    def __init__(self, source: MessageSource, config: ReadConfig, frames: FrameTree) -> None:
        self._source, self._config, self._frames = source, config, frames
        self._topics = source.info.topics
        self._first_scans: dict[tuple[TopicInfo, str], list[_First]] = {}
        self._left_out: list[tuple[TopicInfo, str]] = []
        self._sensors, self._reason = self._found_sensors()
        self._topic = self._sensors[0].topic
        self._frame: str = self._sensors[0].frame or ""
        self._scans = self._first_scans.get((self._topic, self._frame), [])
        self._candidates = topics.odometry_topics(self._topic, self._topics, config.odometry)
        self._tf = self._own_tf()
        self._moving = [t for t in self._tf if not topics.is_static(t)]
        self._edges: list[_First] = []
        self._later: Iterator[list[_First]] = iter(())
        self._read: dict[TopicInfo, list[_First]] = {}

    def plan(self) -> Plan:
        """The plan; to be called once."""
        base = self._base()
        self._check_sensors(base)
        motion = self._of_one_clock(self._motion(base))
        imu, gravity = self._imu(base, motion)
        stamps_ns = [scan.content.header.stamp_ns for scan in self._scans]
        return Plan(
            choice=Choice(
                topic=self._topic.topic,
                sensor=self._sensors[0].kind,
                odometry_topic=motion.topic.topic if motion.topic else None,
                base_frame=base or self._frame or self._config.base_frame or "sensor",
                sensor_frame=self._frame or None,
                further_frames=tuple(s.frame for s in self._sensors[1:] if s.frame and not s.silent),
                reason="; ".join(filter(None, (self._reason, motion.reason, gravity))),
                imu_topic=imu.topic if imu else None,
            ),
            sensors=self._sensors,
            left_out=frozenset(self._left_out),
            odometry=motion.topic if motion.frame is None else None,
            odometry_frame=motion.frame,
            imu=imu,
            moving_tf=tuple(self._moving if motion.frame is not None or self._sensor_moves(base) else ()),
            sensor_is_base=base is None,
            stampless=any(self._scans) and not any(stamps_ns),
            mounted=self._mounted(base),
            period_ns=max((b - a for a, b in itertools.pairwise(stamps_ns)), default=0),
            depth_unit_m=self._config.depth_unit_m or self._recorded_depth_unit_m(),
        )

    def _first(self, topic: TopicInfo, count: int = _FIRST) -> list[_First]:
        """The first messages of a topic, without those that cannot be decoded. Raises UnsupportedSchema."""
        decode = decoder_for(topic)
        of_topic = (m for m in self._source.messages({topic.topic}) if m.channel == topic)
        first = itertools.islice(of_topic, count)
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
        for topic in found[1:]:
            if topics.belongs(topic, found[0], self._topics) is False:
                raise _two_robots(f"{found[0].topic} and {topic.topic}", f"--topic {found[0].topic}")
        sensors = [sensor for topic in found for sensor in self._of_frames(self._with_camera(topic))]
        of_topic = [s.frame for s in sensors if s.topic == sensors[0].topic and not s.silent]
        if len(of_topic) > 1:
            reason += f", of {len(of_topic)} sensors by their frames: {', '.join(map(str, of_topic))}"
        return tuple(sensors), reason

    def _of_frames(self, sensor: Sensor) -> list[Sensor]:
        """The sensors whose scans are on the topic, one of each frame; warns of those that are left out."""
        of_frame: dict[str, list[_First]] = {}
        for scan in self._first(sensor.topic, _FIRST_SCANS):
            of_frame.setdefault(scan.content.header.frame, []).append(scan)
        self._first_scans.update({(sensor.topic, f): scans[:_FIRST] for f, scans in of_frame.items()})
        if len(of_frame) < 2:
            return [sensor._replace(frame=frame) for frame in of_frame] or [sensor]
        base, topic, found = self._config.base_frame or "", sensor.topic, []
        returns = sensor.decoder(self._config).returns
        empty = {frame for frame, scans in of_frame.items() if not any(returns(s.content) for s in scans)}
        # Stamps of zero are another clock's, too.
        delays_ns = {
            frame: statistics.median_low(s.log_time_ns - s.content.header.stamp_ns for s in scans)
            for frame, scans in of_frame.items()
        }
        first = min(of_frame, key=lambda f: (_diverge(f, base), f in empty, abs(delays_ns[f]) // GAP_NS))
        for frame in of_frame:
            apart_ns = abs(delays_ns[frame] - delays_ns[first])
            silent, why = frame in empty - {first}, []
            if silent and first not in empty:
                why.append(f"beside frame {first}, its scans hold no return")
            if _diverge(frame, base) > _diverge(first, base):
                why.append(f"read.base_frame is {base}")
            elif apart_ns > GAP_NS:
                why.append(f"its stamps are {apart_ns * 1e-9:,.0f} s apart from those of frame {first}")
            elif silent or not why:
                infos = [] if sensor.camera is None else self._first(sensor.camera, _FIRST_SCANS)
                own = (info.content for info in infos if info.content.header.frame == frame)
                calibration = next(own, sensor.calibration)
                found.append(sensor._replace(frame=frame, silent=silent, calibration=calibration))
            if why:
                self._source.tally.warn(f"frame {frame} of {topic.topic} is left out: {'; '.join(why)}")
        self._left_out += [(topic, f) for f in of_frame if f not in [sensor.frame for sensor in found]]
        return sorted(found, key=lambda sensor: sensor.frame != first)

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
        measured = [t for t in found if t in measured] or list(found[:1])
        frame_of = {topic: frame for frame, topic in of_sensor.items()}
        of_one = [
            t
            for t in measured
            if topics.belongs(t, measured[0], self._topics) is not False
            and not _diverge(frame_of.get(t, ""), frame_of.get(measured[0], ""))
        ]
        return topics.several(found, of_one)

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

    def _check_sensors(self, base: str | None) -> None:
        """Raise FrameError if the places of several sensors are not known, TopicError for the scans of one
        sensor that are published twice, and for those of two robots. In the frame of the base, sensors are
        not told apart."""
        first, *further = (sensor for sensor in self._sensors if not sensor.silent)
        if further and base is None and not (self._config.assume_identity and self._of_one_topic()):
            names = ", ".join(
                f"{s.topic.topic} in frame {s.frame}" if self._of_one_topic() else s.topic.topic
                for s in (first, *further)
            )
            raise FrameError(
                f"{names}: without tf their places on the robot are not known",
                hint="record /tf_static too, or choose one: "
                + (
                    f"--set read.assume_identity=true takes frame {self._frame} alone"
                    if self._of_one_topic()
                    else f"--topic {first.topic.topic}"
                ),
            )
        for sensor in further:
            frame, name = sensor.frame, sensor.topic.topic
            if sensor.topic != first.topic and frame == self._frame != base:
                raise TopicError(
                    f"{name} is in frame {self._frame} of the first topic: one sensor is not put "
                    "together with itself",
                    hint="name a topic of each sensor, such as --topic /front,/rear, or only one",
                )
        if base is not None:
            self._check_robots(base)
            if (apart := self._apart(base)) is not None:
                raise self._frames.missing(apart, base)
            self._check_places(base)

    def _check_robots(self, base: str) -> None:
        """Raise TopicError if the sensors are on several robots, each with a base of its own."""
        for sensor in self._sensors[1:]:
            other = None if sensor.silent else self._base_frame(sensor.frame or "")
            if other is not None and _prefix(other) != _prefix(base):
                first, name = self._topic.topic, sensor.topic.topic
                raise _two_robots(
                    f"{first} in frame {self._frame} and {name} in frame {sensor.frame}",
                    f"--set read.base_frame={base}" if self._of_one_topic() else f"--topic {first}",
                )

    def _check_places(self, base: str) -> None:
        """Raise TopicError if static transforms put a sensor in several places, and may be of several robots;
        otherwise warn."""
        for frame in (sensor.frame or "" for sensor in self._sensors if not sensor.silent):
            if not self._frames.ambiguous(base, frame):
                continue
            twins = ", ".join(t.topic for t in self._twins(frame))
            if twins:
                raise TopicError(
                    f"static transforms put frame {frame} in two places, and {twins} has scans in a frame of "
                    "that name, too: these may be of two robots",
                    hint="record the transforms of each robot in its namespace, or its name before its "
                    f"frames; --odometry none --set read.base_frame={frame} goes without",
                )
            self._source.tally.warn(
                f"static transforms put frame {frame} in two places on {base}: the latest counts"
            )

    def _of_one_topic(self) -> bool:
        return all(sensor.topic == self._topic for sensor in self._sensors)

    def _twins(self, frame: str) -> list[TopicInfo]:
        """The other topics whose scans are in a frame of this name."""
        mine = {sensor.topic for sensor in self._sensors}
        others = [t for t in topics.usable(self._topics, None) if t not in mine]
        return [t for t in others if frame in self._frames_of(t)]

    def _frames_of(self, topic: TopicInfo) -> set[str]:
        """The frames of the first messages of a topic; empty if there is none."""
        try:
            return {m.content.header.frame for m in self._first(topic)}
        except UnsupportedSchema:
            return set()

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

    def _own_tf(self) -> list[TopicInfo]:
        """The topics of the transforms. Raises TopicError if these may be of several robots."""
        found = topics.tf_topics(self._topic, self._topics)
        beside = [t for t in found if topics.belongs(t, self._topic, self._topics) is None]
        beside = [t for t in beside if not topics.is_above(t, self._topic)]
        robots = {t.topic.rpartition("/")[0] for t in beside}
        if len(robots) < 2 and not any(map(self._beside_twins, beside)):
            return found
        if self._config.assume_identity:
            return []
        raise TopicError(
            f"it cannot be told whether these transforms are of the robot of {self._topic.topic}: "
            f"{topics.listed(beside)}",
            hint="record the scans in the namespace of their robot's transforms; or "
            "--set read.assume_identity=true goes without",
        )

    def _beside_twins(self, topic: TopicInfo) -> bool:
        """Whether a topic stands beside scans in a frame of the name of the first sensor's, or it may."""
        found = map(self._frames_of, topics.rivals(topic, self._topic, self._topics))
        return any(not frames or self._frame in frames for frames in found)

    def _base(self) -> str | None:
        """The base frame; None if the log has no tf, so that the sensor's frame serves as the base.

        Raises FrameError if tf does not connect the base to the sensor.
        """
        for _ in self._transforms([t for t in self._tf if topics.is_static(t)], None):
            pass
        last_ns = max((m.log_time_ns for m in self._scans), default=self._source.info.end_ns)
        self._later = self._transforms(self._moving, last_ns + LOOK_AHEAD_NS)
        base = self._connected_base()
        while base is None and self._read_on():
            base = self._connected_base()
        return base if base is not None else self._base_without_tf()

    def _read_on(self) -> bool:
        """Take in the next message of moving transforms; returns whether there is one."""
        found = next(self._later, None)
        self._edges += found or ()
        return found is not None

    def _holds_odometry(self, base: str) -> bool:
        """Whether enough of the tf that holds odometry was read to know its clock."""
        return len(self._edges) >= _FIRST and self._odometry_frame(base) is not None

    def _transforms(self, tf: list[TopicInfo], end_ns: int | None) -> Iterator[list[_First]]:
        """Take in the transforms of some topics; yields those of each message."""
        decoders = {t: decoder_for(t) for t in tf}
        for message in self._source.messages({t.topic for t in tf}, end_ns=end_ns):
            if message.channel in decoders:
                at_ns, edges = message.log_time_ns, tolerant(decoders[message.channel], message.data)
                self._frames.add_all(edges, static=topics.is_static(message.channel), log_time_ns=at_ns)
                yield [_First(at_ns, edge) for edge in edges or ()]

    def _connected_base(self) -> str | None:
        base = self._base_frame(self._frame)
        return base if base is not None and self._apart(base) is None else None

    def _apart(self, base: str) -> str | None:
        """The frame of a sensor that tf does not connect to the base; None if there is none."""
        frames = (sensor.frame or "" for sensor in self._sensors if not sensor.silent)
        return next((frame for frame in frames if not self._frames.connected(base, frame)), None)

    def _base_frame(self, frame: str) -> str | None:
        """The frame that is the base of a sensor's frame by its name, by the settings, or by the odometry."""
        if self._config.base_frame is not None:
            return self._config.base_frame.lstrip("/")
        known, rigid = self._frames.frames, functools.partial(self._frames.rigid, frame)
        named = [f for f in known if f.rpartition("/")[2] in _BASE_FRAMES]
        most = max((topics.shared_parts(f, frame) for f in named), default=0)
        alike = [f for f in named if topics.shared_parts(f, frame) == most and not _diverge(f, frame)]
        named = list(filter(rigid, named)) or alike
        for name in _BASE_FRAMES:
            found = [f for f in named if f == name] or [f for f in named if f.endswith("/" + name)]
            if len(found) == 1:
                return found[0]
        moved = (self._readings(t) for t in self._candidates if t.type not in topics.TF)
        children = [m.content.child for first in moved for m in first if m.content.child in known]
        return next(filter(rigid, children), next((f for f in children if not _diverge(f, frame)), None))

    def _base_without_tf(self) -> str | None:
        """The base frame where tf does not connect one to the sensor; None: the sensor's frame is the base.

        Raises FrameError unless the log never had tf or the user asks for this.
        """
        frames, warn = self._frames, self._source.tally.warn
        base, as_asked = self._base_frame(self._frame), self._config.assume_identity
        if self._sensors[0].kind == "lidar" and self._is_fixed(base) and not as_asked:
            raise registered(self._frame)
        root = frames.static_root() if base is None else None
        above = frames.static_root_of(self._frame)
        if base is None and above != self._frame and self._odometry_frame(above) is not None:
            root = above
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
            if base is not None:
                self._check_robots(base)
            raise frames.missing(self._frame if base is None else self._apart(base) or "", base or "the base")
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
        if topics.is_fixed(frame) or frame in self._odometry_frames():
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
        if sum(not s.silent for s in self._sensors) > 1 or self._sensors[0].kind != "lidar":
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

    def _readings(self, topic: TopicInfo) -> list[_First]:
        """The first messages of a topic of odometry; of tf, the transforms that were read."""
        if topic.type in topics.TF:
            return self._edges
        if topic not in self._read:
            self._read[topic] = []
            with contextlib.suppress(UnsupportedSchema):  # raised when it is chosen
                self._read[topic] = self._first(topic)
        return self._read[topic]

    def _odometry_frames(self) -> set[str]:
        """The frames in which the topics of odometry tell where the robot is."""
        found = (self._readings(t) for t in self._candidates if t.type not in topics.TF)
        return {m.content.header.frame for first in found for m in first}

    def _motion(self, base: str | None) -> _Motion:
        """The odometry of a topic, or that which tf holds, if it does.

        Raises TopicError if it may be of another robot.
        """
        wanted, is_ours = self._config.odometry, functools.partial(self._is_ours, base=base)
        if wanted is not None and not self._candidates:
            return _Motion(None, None, "odometry is ignored as asked")
        ours = [t for t in self._candidates if wanted or is_ours(t)]
        topic = next((t for t in ours if not self._is_elsewhere(t, base)), ours[0] if ours else None)
        if topic is not None and topic.type not in topics.TF:
            return self._chosen(_Motion(topic, None, f"odometry from {topic.topic}"))
        if unsure := [t for t in self._candidates if topic is None and is_ours(t) is None]:
            raise _of_several(self._topic, unsure)
        while base is not None and not self._holds_odometry(base) and self._read_on():
            pass
        frame = self._odometry_frame(base)
        if frame is None or not self._moving:
            return self._chosen(_Motion(None, None, "no odometry topic"))
        if wanted is None and not _prefix(frame) and self._serves_several(self._moving[0]):
            raise _of_several(self._topic, self._moving[:1])
        return self._chosen(_Motion(self._moving[0], frame, f"odometry from tf, {frame} -> {base}"))

    def _chosen(self, motion: _Motion) -> _Motion:
        """Where odometry comes from, with a reason that names the others; of these the user is told."""
        if (wanted := self._config.odometry) is not None:
            return motion if motion.frame else motion._replace(reason=f"odometry from {wanted} as asked")
        rest = ", ".join(t.topic for t in topics.with_odometry(self._topics) if t != motion.topic)
        if not rest:
            return motion
        reason = f"{motion.reason} (also there: {rest}; --odometry chooses)"
        self._source.tally.warn(reason)
        return motion._replace(reason=reason)

    def _is_ours(self, topic: TopicInfo, base: str | None) -> bool | None:
        """Whether a topic of odometry or of an IMU is of the robot of the scans; None: it cannot be told."""
        if topic.type in topics.TF:
            return True
        named = topics.belongs(topic, self._topic, self._topics)
        if named and self._serves_several(topic):
            named = None
        first = self._readings(topic)
        frame = "" if not first else getattr(first[0].content, "child", first[0].content.header.frame)
        mine, frames = base or self._frame, self._frames
        apart = not frames.rigid(mine, frame)
        foreign = frame in frames and frame.endswith(_BASE_FRAMES) and _prefix(frame) != _prefix(mine)
        if apart and (foreign or _diverge(mine, frame)):
            return False
        if named is not None or apart:
            return named
        if _prefix(mine):
            return True
        beside = topics.rivals(topic, self._topic, self._topics)
        return True if beside and not self._beside_twins(topic) else None

    def _is_elsewhere(self, odometry: TopicInfo, base: str | None) -> bool:
        """Whether tf has the frame that a topic of odometry moves, but not in one piece with the base."""
        children = {m.content.child for m in self._readings(odometry)} & {*self._frames.frames}
        return base is not None and not all(self._frames.rigid(base, child) for child in children)

    def _serves_several(self, topic: TopicInfo) -> bool:
        """Whether a topic stands above the scans, and above others that only the name of their robot tells
        apart."""
        usable = topics.usable(self._topics, None) if topics.is_above(topic, self._topic) else []
        alike = (t for t in usable if topics.are_namesakes(t, self._topic) and topics.is_above(topic, t))
        return any(self._frame in self._frames_of(t) for t in alike)

    def _of_one_clock(self, motion: _Motion) -> _Motion:
        """The odometry, unless its stamps are of another clock than the scans' and nobody asked for it."""
        if motion.topic is None:
            return motion
        apart_ns = abs(_delay_ns(self._scans) - _delay_ns(self._readings(motion.topic)))
        if apart_ns <= GAP_NS:
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
        found = topics.imu_topics(self._topic, self._topics, wanted)
        if wanted is None and (SENSOR_MODELS[self._sensors[0].kind].planar or motion.topic is not None):
            return None, ""
        why = []
        for imu in found:
            try:
                self._check_imu(imu, base)
            except (FrameError, UnsupportedSchema) as error:
                if wanted is not None:
                    raise
                why.append(f"{imu.topic} is not used: {error.message}")
                continue
            if wanted is not None or self._is_ours(imu, base):
                return imu, f"gravity from {imu.topic}"
            why.append(f"{imu.topic} is not used: it may be of another robot")
        return None, "; ".join(why)

    def _check_imu(self, imu: TopicInfo, base: str | None) -> None:
        """Raise FrameError if it is not known how the IMU sits on the base, UnsupportedSchema."""
        frames, there, first = self._frames, self._frame if base is None else base, self._first(imu)
        frame = first[0].content.header.frame if first else ""
        known = frame == there or (base is not None and frames.connected(there, frame))
        if not known or frames.moving(there, frame):
            raise frames.missing(frame, there)
