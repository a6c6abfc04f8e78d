"""The topics of the robot of the scans, by their namespaces, by the prefixes of their frames, and by tf.

`Robot.owns` combines the three; before the frames are known, `Namespaces.owns` decides by the names alone.
Each answer is True, False (of another robot), or None: unknown.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from pc2grid.errors import TopicError
from pc2grid.io import topics
from pc2grid.io.frames import FrameTree
from pc2grid.io.source import TopicInfo
from pc2grid.io.topics import FirstMessages

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
        self._with_tf = {_namespace(t) for t in there if t.type in topics.TF and t.message_count != 0}
        with_scans = {_namespace(t) for t in there if topics.holds_scans(t, there)}
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
        found = self.nearest([t for t in self.topics if t.type in topics.TF and t.message_count != 0])
        own = {topics.is_static(t) for t in found if self.owns(t)}
        return [t for t in found if self.owns(t) or topics.is_static(t) not in own]

    def odometry_topics(self, wanted: str | None) -> list[TopicInfo]:
        """Return the topics that may hold the odometry of the robot, the best first; tf only if it is
        `wanted`.

        Raises TopicError if `wanted` is missing.
        """
        if wanted is not None:
            return topics.named_of(self.topics, wanted, "odometry", topics.ODOMETRY, topics.TF)

        def rank(topic: TopicInfo) -> tuple[bool, int, str]:
            name = topic.topic.strip("/").split("/")[shared_parts(topic.topic, self.scans.topic) :]
            return name not in (["odom"], ["odometry"]), len(topic.topic), topic.topic

        return self.nearest(sorted(topics.with_odometry(self.topics), key=rank))

    def imu_topics(self, wanted: str | None) -> list[TopicInfo]:
        """Return the topics of IMUs that may be on the robot, the best first.

        Raises TopicError if `wanted` is missing.
        """
        if wanted is not None:
            return topics.named_of(self.topics, wanted, "imu", topics.IMU)
        found = [t for t in self.topics if t.message_count != 0 and t.type in topics.IMU]
        return self.nearest(sorted(found, key=lambda t: (len(t.topic), t.topic)))

    def scans_beside(self, topic: TopicInfo) -> list[TopicInfo]:
        """Return the topics of scans beside a topic, in a namespace without the scans of this robot."""
        branch = self._branch(topic)
        beside = [t for t in self.topics if branch and _namespace(t)[: len(branch)] == branch]
        return [t for t in beside if topics.holds_scans(t, self.topics)]

    def namesakes_below(self, topic: TopicInfo) -> list[TopicInfo]:
        """Return the topics of scans below a topic that differ from the scans by the name of their robot
        alone.

        There are none unless the scans are below the topic, too.
        """
        usable = topics.usable(self.topics, None) if self.is_above(topic) else []
        space = _namespace(topic)
        return [t for t in usable if _are_namesakes(t, self.scans) and _namespace(t)[: len(space)] == space]

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
            f"{topics.listed(beside)}",
            hint="record the scans in the namespace of their robot's transforms; or "
            "--set read.assume_identity=true goes without",
        )

    def unsure(self, odometry: Sequence[TopicInfo]) -> TopicError:
        """Return the error for odometry that may be of another robot."""
        return TopicError(
            f"it cannot be told whether this odometry is of the robot of {self._scans.topic}: "
            f"{topics.listed(odometry)}",
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
    infos = sorted((t for t in there if t.type in topics.CAMERA_INFOS), key=lambda t: t.topic, reverse=True)
    infos.sort(key=lambda t: "depth" not in t.topic)
    names = Namespaces(image, there)
    own = next(filter(names.owns, names.nearest(infos)), None)
    if own is None:
        raise topics.no_camera_info(image)
    return own
