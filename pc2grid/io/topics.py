"""The topics of a log by types and names: which hold scans, their decoders and first messages, and which are
of the robot of the scans.

The last is told by their namespaces, by the prefixes of their frames, and by tf. `Robot.owns` combines the
three; before the frames are known, `Namespaces.owns` decides by the names alone. Each answer is True, False
(of another robot), or None: unknown.
"""

from __future__ import annotations

import contextlib
import difflib
import itertools
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from pc2grid.errors import NoScans, PointCloudError, TopicError, UnsupportedSchema
from pc2grid.io.frames import FrameTree
from pc2grid.io.messages import clouds, foxglove, ros
from pc2grid.io.source import MessageSource, TopicInfo
from pc2grid.model import SENSOR_MODELS, SensorKind

SENSORS: dict[str, SensorKind] = {
    "sensor_msgs/PointCloud2": "lidar",
    "sensor_msgs/LaserScan": "laser",
    "sensor_msgs/Image": "depth",
    "sensor_msgs/CompressedImage": "depth",
    "foxglove.PointCloud": "lidar",
    "cloud/pcd": "lidar",
    "cloud/ply": "lidar",
    "cloud/bin": "lidar",
    "foxglove.LaserScan": "laser",
    "foxglove.RawImage": "depth",
    "foxglove.CompressedImage": "depth",
}
CAMERA_INFOS = ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration")
ODOMETRY = ("nav_msgs/Odometry", "foxglove.Odometry", "foxglove.PoseInFrame", "cloud/pose")
POSES = ("geometry_msgs/PoseWithCovarianceStamped", "geometry_msgs/PoseStamped")
"""Of the base in a map, as localization publishes them."""
IMU = ("sensor_msgs/Imu",)
_FIXED = ("odom", "map", "world", "earth", "camera_init")  # REP-105; the last one in LOAM and FAST-LIO
TF = ("tf2_msgs/TFMessage", "tf/tfMessage", "foxglove.FrameTransform", "foxglove.FrameTransforms")

_SCANS_ARE = "scans are PointCloud2, LaserScan, or a depth Image with a CameraInfo"
# What drivers publish instead of one of these, by a part of the type's name; and what to do about it.
_ADVICE = {
    "livox": "with xfer_format 0 the livox driver publishes PointCloud2: record that; or play this recording "
    "through a converter from CustomMsg to PointCloud2, and record its topic",
    "MultiEchoLaserScan": "laser_proc makes LaserScan of it: record /first, or play the recording through it",
    "Packet": "these are raw packets: play the recording through the sensor's driver, and record PointCloud2",
    "VelodyneScan": "these are raw packets: play the recording through velodyne_pointcloud, and record "
    "/velodyne_points",
    "sensor_msgs/PointCloud": "point_cloud_converter makes PointCloud2 of it: play the recording through it",
}


def scan_topics(topics: Sequence[TopicInfo], wanted: str | None) -> tuple[list[TopicInfo], str]:
    """Return the topics that hold scans, only those that `wanted` names if it does; and a sentence why.

    Raises TopicError if one is missing or of another kind of sensor than the first, NoScans if none holds
    scans, UnsupportedSchema if one is of a type that holds none.
    """
    fitting = [t for t in topics if holds_scans(t, topics)]
    if names := names_in(wanted):
        found = [_named(topics, fitting, name) for name in names]
        for other in found:
            kinds = SENSORS[found[0].type], SENSORS[other.type]
            if kinds[0] != kinds[1]:
                raise TopicError(
                    f"{found[0].topic} ({kinds[0]}) and {other.topic} ({kinds[1]}) cannot be put together",
                    hint=f"choose one, e.g. --topic {found[0].topic}",
                )
        others = "".join(f", {t.topic}" for t in found[1:])
        return found, "named by the user" + others.replace(",", ", with", 1)
    full = [t for t in fitting if t.message_count != 0]
    if not full:
        raise _no_scans(topics, fitting)
    # An image and its compressed copy come from the same camera: take the uncompressed one.
    distinct = [t for t in full if not _is_copy(t, full)]
    return distinct, f"the only topic with scans ({distinct[0].type})"


def several(found: Sequence[TopicInfo], measured: Sequence[TopicInfo]) -> TopicError:
    """Return the error where several topics hold scans. measured : those to propose, one of each sensor."""
    alike = [t.topic for t in measured if t.type == measured[0].type]
    both = f", or one of each sensor: --topic {','.join(alike[:4])}" if len(alike) > 1 else ""
    return TopicError(
        f"several topics hold scans: {listed(found)}", hint=f"choose one, e.g. --topic {alike[0]}{both}"
    )


def is_fixed(frame: str) -> bool:
    """Return whether a frame has the name of one that does not move with the robot."""
    return frame.rpartition("/")[2] in _FIXED


def _no_scans(topics: Sequence[TopicInfo], fitting: Sequence[TopicInfo]) -> NoScans:
    if fitting:
        return NoScans(f"{listed(fitting)}: no message in the log")
    if image := next((t for t in topics if _is_depth_image(t)), None):
        return no_camera_info(image)
    there = listed(topics) if topics else "the log has no topics at all"
    return NoScans(f"no topic with scans; there is: {there}", hint=_advice_on(topics))


def _advice_on(topics: Sequence[TopicInfo]) -> str:
    """Return what to do to get scans from topics that hold none."""
    found = ((t, advice) for t in topics for part, advice in _ADVICE.items() if part in t.type)
    topic, advice = next(found, (None, _SCANS_ARE))
    return advice if topic is None else f"{topic.topic} is {topic.type}: {advice}"


def proposed(image: TopicInfo, topics: Sequence[TopicInfo]) -> NoScans:
    """Return the error for a log whose only scans are depth images on a topic whose name does not say so."""
    if not any(t.type in CAMERA_INFOS for t in topics):
        return no_camera_info(image)
    return NoScans(
        f"no topic with scans by its name, but {image.topic} ({image.type}) holds depth images",
        hint=f"--topic {image.topic} uses them",
    )


def names_in(wanted: str | None) -> list[str]:
    """Return the topics of a list such as `/front,/rear`; no topic of ROS has a comma in its name."""
    return list(dict.fromkeys(name.strip() for name in (wanted or "").split(",") if name.strip()))


def usable(topics: Sequence[TopicInfo], wanted: str | None) -> list[TopicInfo]:
    """Return the topics that scans may be read from, silent ones among them; only those that `wanted` names
    if it does."""
    names = names_in(wanted)
    fitting = [t for t in topics if (t.topic in names if names else holds_scans(t, topics))]
    return [t for t in fitting if t.type in SENSORS]


def may_be_used(topic: TopicInfo, topics: Sequence[TopicInfo], wanted: str | None) -> bool:
    """Return whether the messages of a topic may be of use, before the first message is known.

    wanted : the topic that scans are to be read from; None: any.
    """
    return topic.type in (*TF, *ODOMETRY, *IMU, *CAMERA_INFOS) or topic in usable(topics, wanted)


def is_static(topic: TopicInfo) -> bool:
    """Return whether a tf topic holds transforms that never change (tf2: `tf_static`)."""
    return topic.topic.endswith("tf_static")


def no_camera_info(image: TopicInfo) -> NoScans:
    """Return the error for a depth image without a calibration."""
    return NoScans(
        f"{image.topic}: a depth image without a CameraInfo topic",
        hint="record the camera_info topic next to the image",
    )


def with_odometry(topics: Sequence[TopicInfo]) -> list[TopicInfo]:
    """Return the topics that hold the odometry of any robot."""
    return [t for t in topics if t.message_count != 0 and _holds_odometry(t)]


def named_of(
    topics: Sequence[TopicInfo], wanted: str, what: str, types: Sequence[str], also: Sequence[str] = ()
) -> list[TopicInfo]:
    """Return the topic that is wanted, of one of the types; none for "none". `also` : not proposed.

    Raises TopicError if it is missing.
    """
    if wanted.lower() == "none":
        return []
    if found := [t for t in topics if t.topic == wanted and t.type in (*types, *also)]:
        return found[:1]
    there = listed([t for t in topics if t.type in types])
    raise TopicError(
        f"no {what} topic {wanted}; there is: {there or 'none'}", hint=f"--{what} none goes without"
    )


def _holds_odometry(topic: TopicInfo) -> bool:
    # A PoseInFrame may also be a goal or a landmark, so its topic must contain `odom`.
    return topic.type in ODOMETRY and (topic.type != "foxglove.PoseInFrame" or "odom" in topic.topic.lower())


def holds_scans(topic: TopicInfo, topics: Sequence[TopicInfo]) -> bool:
    """Return whether a topic of a log holds scans, by its type and name."""
    if is_image(topic):
        return _is_depth_image(topic) and any(t.type in CAMERA_INFOS for t in topics)
    return topic.type in SENSORS


def _is_depth_image(topic: TopicInfo) -> bool:
    return is_image(topic) and "depth" in topic.topic.lower()


def is_image(topic: TopicInfo) -> bool:
    """Return whether a topic holds images, of depths or of colours."""
    kind = SENSORS.get(topic.type)
    return kind is not None and SENSOR_MODELS[kind].image


def depth_unit_topic(topics: Sequence[TopicInfo]) -> TopicInfo | None:
    """Return the topic on which librealsense records the unit of its depth images, if there is one."""
    named = (t for t in topics if "/option/depth_units/value" in t.topic.lower().replace(" ", "_"))
    return next((t for t in named if t.type == "std_msgs/Float32" and t.message_count != 0), None)


def _named(topics: Sequence[TopicInfo], fitting: Sequence[TopicInfo], wanted: str) -> TopicInfo:
    same = [t for t in topics if t.topic == wanted]
    if not same:
        there = listed(fitting) if fitting else f"none with scans, but {listed(topics)}"
        raise missing(topics, wanted, f"topics with scans: {there}")
    usable = [t for t in same if t.type in SENSORS]
    if not usable:
        raise UnsupportedSchema(
            f"{wanted}: is of type {same[0].type or 'unknown'}",
            hint=_advice_on(same[:1]),
        )
    if usable[0].message_count == 0:
        raise NoScans(f"{wanted}: no message in the log")
    return usable[0]


def missing(topics: Sequence[TopicInfo], wanted: str, hint: str) -> TopicError:
    """Return the error for a topic that is not there; it proposes the one with the most similar name."""
    close = difflib.get_close_matches(wanted, [t.topic for t in topics], n=1, cutoff=0.5)
    guess = f"; did you mean {close[0]}?" if close else ""
    return TopicError(f"no topic {wanted} in the log{guess}", hint=hint)


def listed(topics: Sequence[TopicInfo]) -> str:
    """Return topics and their types, of many the first ones."""
    shown = [f"{t.topic} ({t.type or 'no type'})" for t in topics[:20]]
    return ", ".join(shown) + (f" and {len(topics) - 20} more" if len(topics) > 20 else "")


def _is_copy(topic: TopicInfo, full: Sequence[TopicInfo]) -> bool:
    """Return whether a topic holds the images of another one, compressed."""
    return topic.type.endswith("CompressedImage") and any(
        topic.topic.startswith(t.topic + "/") for t in full if not t.type.endswith("CompressedImage")
    )


def decoder_for(channel: TopicInfo) -> Callable[[Any], Any]:
    """Return a function from the bytes of a topic's messages to one of the classes of `messages.types`.

    Raises UnsupportedSchema for a type or encoding that is not supported.
    """
    if channel.encoding in ("protobuf", "json"):
        return foxglove.decoder_for(channel)
    if channel.type.startswith("cloud/"):
        return clouds.decoder_for(channel)
    return ros.decoder_for(channel)


FIRST = 20
"""So many messages of a topic are looked at: a few may have a stray time, or be unreadable, and each of
several sensors on it must be among them. By hand."""


class First(NamedTuple):
    """One of the first messages of a topic. content : with a header."""

    log_time_ns: int
    content: Any

    @property
    def frame(self) -> str:
        """Return the frame in its header."""
        return str(self.content.header.frame)


class FirstMessages:
    """Reads the first messages of the topics of a log, those of each topic once.

    topics : all of the log. tally : of its source, for warnings.
    """

    def __init__(self, source: MessageSource) -> None:
        self.topics, self.tally = source.info.topics, source.tally
        self._source = source
        self._read: dict[TopicInfo, list[First]] = {}

    def of(self, topic: TopicInfo) -> list[First]:
        """Return the first messages of a topic, without those that cannot be decoded.

        Raises UnsupportedSchema.
        """
        if topic not in self._read:
            decode = decoder_for(topic)
            of_topic = (m for m in self._source.messages({topic.topic}) if m.channel == topic)
            read = (First(m.log_time_ns, tolerant(decode, m.data)) for m in itertools.islice(of_topic, FIRST))
            self._read[topic] = [message for message in read if message.content is not None]
        return self._read[topic]

    def if_known(self, topic: TopicInfo) -> list[First]:
        """Return the first messages of a topic; none if they are of a type that cannot be decoded."""
        with contextlib.suppress(UnsupportedSchema):
            return self.of(topic)
        return []

    def frames_of(self, topic: TopicInfo) -> set[str]:
        """Return the frames of the first messages of a topic; none if there is no such message."""
        return {message.frame for message in self.if_known(topic)}


def tolerant(decode: Callable[[Any], Any], data: Any, otherwise: Any = None) -> Any:
    """Decode a message that is of use but not needed (tf, odometry); `otherwise` if it cannot be decoded."""
    try:
        return decode(data)
    except PointCloudError:
        return otherwise


def delay_ns(first: Sequence[First]) -> int:
    """Return the median time from the stamps of messages to their recording; 0 for messages without
    stamps."""
    delays_ns = [m.log_time_ns - (m.content.header.stamp_ns or m.log_time_ns) for m in first]
    return statistics.median_low(delays_ns) if delays_ns else 0


# --- the robot ----------------------------------------------------------------------------------------

BASE_FRAMES = ("base_link", "base_footprint")  # REP-105 and REP-120


def prefix(frame: str) -> str:
    """Return the robot's name in the name of a frame, such as robot1 in robot1/base_link; empty if there is
    none."""
    base = next((name for name in BASE_FRAMES if frame.endswith(name)), None)
    return frame.rpartition("/")[0] if base is None else frame.removesuffix(base).rstrip("/_.-")


def diverge(frame: str, other: str) -> bool:
    """Return whether two frames have prefixes of which none is part of the other."""
    a, b = prefix(frame), prefix(other)
    return a != "" != b and shared_parts(f"{a}/", f"{b}/") <= min(a.count("/"), b.count("/"))


def shared_parts(name: str, other: str) -> int:
    """Return the number of parts that two names share from the beginning on, without the last part of each.

    It is 1 for robot1/odom and robot1/camera/depth.
    """
    parts = (n.lstrip("/").split("/")[:-1] for n in (name, other))
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(*parts, strict=False)))


def two_robots(what: str, one: str) -> TopicError:
    """Return the error for scans of two robots. one : what to type to choose one of them."""
    return TopicError(f"{what} are of two robots", hint=f"choose one, e.g. {one}")


def _namespace(topic: TopicInfo) -> tuple[str, ...]:
    return tuple(topic.topic.lstrip("/").split("/")[:-1])


def _are_namesakes(topic: TopicInfo, other: TopicInfo) -> bool:
    """Return whether two topics have the same name in two sibling namespaces."""
    shared = shared_parts(topic.topic, other.topic)
    a, b = (t.topic.lstrip("/").split("/")[shared:] for t in (topic, other))
    return len(a) > 1 and a[0] != b[0] and a[1:] == b[1:]


class Namespaces:
    """The evidence of the names: the namespaces of the topics of a log, relative to one topic of scans.

    A namespace with transforms is a robot's if others with transforms stand beside it; but one above it
    without scans is shared by all. In a namespace without transforms, topics beside other scans may be of
    their robot.
    """

    def __init__(self, scans: TopicInfo, there: Sequence[TopicInfo]) -> None:
        self.scans, self.topics = scans, there
        self._with_tf = {_namespace(t) for t in there if t.type in TF and t.message_count != 0}
        with_scans = {_namespace(t) for t in there if holds_scans(t, there)}
        self._above_scans = {space[:k] for space in with_scans for k in range(1, len(space) + 1)}
        self._home = self._root(_namespace(scans))
        home = self._home or ()
        above_home = {home[:k] for k in range(len(home))}
        shared = above_home - {*map(self._root, with_scans)}
        self._others = set() if self._home is None else self._with_tf - {self._home} - shared

    def _root(self, space: tuple[str, ...]) -> tuple[str, ...] | None:
        """Return the nearest namespace at or above this one that has transforms."""
        return next((space[:k] for k in range(len(space), -1, -1) if space[:k] in self._with_tf), None)

    def owns(self, topic: TopicInfo) -> bool | None:
        """Return whether a topic is of the robot of the scans; None: it may as well be of another robot."""
        root = self._root(_namespace(topic))
        if root in self._others:
            return False
        unsure = root != self._home and (self._others or (self._home is None and len(self._with_tf) > 1))
        return None if unsure or self._branch(topic) in self._above_scans else True

    def is_above(self, topic: TopicInfo) -> bool:
        """Return whether the scans are in the namespace of a topic, or in one below it."""
        return len(_namespace(topic)) == shared_parts(topic.topic, self.scans.topic)

    def tf_topics(self) -> list[TopicInfo]:
        """Return the topics of the transforms that may be of the robot.

        Of several robots' transforms, a robot's own go before those that all of them share, which may have
        frames of the same names.
        """
        found = self.nearest([t for t in self.topics if t.type in TF and t.message_count != 0])
        own = {is_static(t) for t in found if self.owns(t)}
        return [t for t in found if self.owns(t) or is_static(t) not in own]

    def odometry_topics(self, wanted: str | None) -> list[TopicInfo]:
        """Return the topics that may hold the odometry of the robot, the best first; tf only if it is
        `wanted`.

        Raises TopicError if `wanted` is missing.
        """
        if wanted is not None:
            return named_of(self.topics, wanted, "odometry", ODOMETRY, TF)

        def rank(topic: TopicInfo) -> tuple[bool, int, str]:
            name = topic.topic.strip("/").split("/")[shared_parts(topic.topic, self.scans.topic) :]
            return name not in (["odom"], ["odometry"]), len(topic.topic), topic.topic

        return self.nearest(sorted(with_odometry(self.topics), key=rank))

    def imu_topics(self, wanted: str | None) -> list[TopicInfo]:
        """Return the topics of IMUs that may be on the robot, the best first.

        Raises TopicError if `wanted` is missing.
        """
        if wanted is not None:
            return named_of(self.topics, wanted, "imu", IMU)
        found = [t for t in self.topics if t.message_count != 0 and t.type in IMU]
        return self.nearest(sorted(found, key=lambda t: (len(t.topic), t.topic)))

    def scans_beside(self, topic: TopicInfo) -> list[TopicInfo]:
        """Return the topics of scans beside a topic, in a namespace without the scans of this robot."""
        branch = self._branch(topic)
        beside = [t for t in self.topics if branch and _namespace(t)[: len(branch)] == branch]
        return [t for t in beside if holds_scans(t, self.topics)]

    def namesakes_below(self, topic: TopicInfo) -> list[TopicInfo]:
        """Return the topics of scans below a topic that differ from the scans by the name of their robot
        alone.

        There are none unless the scans are below the topic, too.
        """
        below = usable(self.topics, None) if self.is_above(topic) else []
        space = _namespace(topic)
        return [t for t in below if _are_namesakes(t, self.scans) and _namespace(t)[: len(space)] == space]

    def _branch(self, topic: TopicInfo) -> tuple[str, ...]:
        """Return the namespace of a topic up to the part that differs from that of the scans; empty if none
        does."""
        shared = shared_parts(topic.topic, self.scans.topic)
        return () if self.is_above(topic) else _namespace(topic)[: shared + 1]

    def nearest(self, found: Sequence[TopicInfo]) -> list[TopicInfo]:
        """Return the topics that are not another robot's, the most likely first.

        First come those of the robot of the scans, and of these those that share most of its namespace;
        otherwise the order stays.
        """
        own = (t for t in found if self.owns(t) is not False)
        return sorted(own, key=lambda t: (self.owns(t) is None, -shared_parts(t.topic, self.scans.topic)))


class Robot:
    """The robot of the scans of a topic and frame."""

    def __init__(self, scans: TopicInfo, frame: str, first: FirstMessages) -> None:
        self.names = Namespaces(scans, first.topics)
        self._scans, self._frame, self._first = scans, frame, first

    def owns(self, topic: TopicInfo, base: str | None, frames: FrameTree) -> bool | None:
        """Return whether a topic of odometry or of an IMU is of the robot; None: unknown.

        A frame that tf does not connect rigidly to the base is of another robot if it has another prefix.
        Else the namespace decides; then whether frames have a prefix, or other scans are in a frame of the
        same name.
        """
        first, mine = self._first.if_known(topic), base or self._frame
        frame = getattr(first[0].content, "child", first[0].frame) if first else ""
        named, apart = self._by_name(topic), not frames.rigid(mine, frame)
        if apart and (diverge(mine, frame) or _is_other_base(frame, mine, frames)):
            return False
        if named is not None or apart:
            return named
        told = prefix(mine) or (self.names.scans_beside(topic) and not self._stands_beside_twins(topic))
        return True if told else None

    def tf(self, *, none_if_unsure: bool) -> list[TopicInfo]:
        """Return the topics of its transforms. Raises TopicError if these may be of several robots."""
        found = self.names.tf_topics()
        beside = [t for t in found if self.names.owns(t) is None and not self.names.is_above(t)]
        spaces = {_namespace(t) for t in beside}
        if len(spaces) < 2 and not any(map(self._stands_beside_twins, beside)):
            return found
        if none_if_unsure:
            return []
        raise TopicError(
            f"it cannot be told whether these transforms are of the robot of {self._scans.topic}: "
            f"{listed(beside)}",
            hint="record the scans in the namespace of their robot's transforms; or "
            "--set read.assume_identity=true goes without",
        )

    def unsure(self, odometry: Sequence[TopicInfo]) -> TopicError:
        """Return the error for odometry that may be of another robot."""
        return TopicError(
            f"it cannot be told whether this odometry is of the robot of {self._scans.topic}: "
            f"{listed(odometry)}",
            hint=f"choose, e.g. --odometry {odometry[0].topic}, or --odometry none goes without",
        )

    def serves_several(self, topic: TopicInfo) -> bool:
        """Return whether a topic stands above the scans, and above others that differ by the name of their
        robot alone."""
        return any(self._frame in self._first.frames_of(t) for t in self.names.namesakes_below(topic))

    def _by_name(self, topic: TopicInfo) -> bool | None:
        """Return whether a topic is of the robot by its namespace; None: unknown."""
        named = self.names.owns(topic)
        return None if named and self.serves_several(topic) else named

    def _stands_beside_twins(self, topic: TopicInfo) -> bool:
        """Return whether a topic stands beside scans in a frame of the same name, or it may."""
        found = map(self._first.frames_of, self.names.scans_beside(topic))
        return any(not frames or self._frame in frames for frames in found)


def _is_other_base(frame: str, mine: str, frames: FrameTree) -> bool:
    """Return whether tf knows a frame as the base of a robot of another name."""
    return frame in frames and frame.endswith(BASE_FRAMES) and prefix(frame) != prefix(mine)


def camera_info_topic(image: TopicInfo, there: Sequence[TopicInfo]) -> TopicInfo:
    """Return the CameraInfo that belongs to a depth image: the one that shares most of its namespace.

    Raises NoScans if there is none.
    """
    infos = sorted((t for t in there if t.type in CAMERA_INFOS), key=lambda t: t.topic, reverse=True)
    infos.sort(key=lambda t: "depth" not in t.topic)
    names = Namespaces(image, there)
    own = next(filter(names.owns, names.nearest(infos)), None)
    if own is None:
        raise no_camera_info(image)
    return own
