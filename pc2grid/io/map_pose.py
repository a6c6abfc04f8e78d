"""The pose of the base in the map by the robot's own localization: the newest on a topic, or in a file.

Files are as nav2 takes a pose for /initialpose.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pc2grid.errors import ConfigError, FrameError, NoScans, TopicError
from pc2grid.geometry import F64, SE2, pose_from_xyz_quat
from pc2grid.io import export, topics
from pc2grid.io.atomic import replace_file
from pc2grid.io.frames import FrameTree
from pc2grid.io.messages.types import StampedPose, valid_pose
from pc2grid.io.source import MessageSource, RawMessage, TopicInfo
from pc2grid.io.topics import Namespaces, decoder_for, tolerant

_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""x, y and yaw among x, y, z, roll, pitch, yaw."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapPose:
    """A pose of the base in a map frame. covariance : (3, 3) of x, y, yaw; None if it is not known."""

    stamp_ns: int
    T_map_base: SE2
    covariance: F64 | None = None


def last_map_pose(source: MessageSource, topic: str, base_frame: str, end_ns: int) -> MapPose:
    """Return the last pose on a topic of a pose, an odometry or tf, recorded before `end_ns`.

    Raises TopicError, UnsupportedSchema, FrameError, or NoScans if there is no pose.
    """
    believed = BelievedPose(topic)
    believed.find(source.info.topics, base_frame)
    for message in source.messages(believed.topics, None, end_ns):
        believed.keep(message)
    return believed.at(end_ns)


class BelievedPose:
    """The newest pose on a topic of a pose, an odometry or tf, as messages come.

    newest : None before the first. problem : why the last message gave none, such as tf that lacks the map.
    topics : whose messages are used; empty until `find` has found the topic.

    In tf it is map -> base at the newest time at which all transforms between them are known. The transform
    map -> odom is published ahead of time or rarely, so each one is valid until the next.
    """

    def __init__(self, topic: str) -> None:
        self.newest: MapPose | None = None
        self.problem: FrameError | None = None
        self._topic, self._base_frame, self._is_tf = topic, "", False
        self._decoders: dict[tuple[str, str], Callable[[Any], Any]] = {}
        self._last: tuple[StampedPose, int] | None = None
        self._tree = FrameTree()
        self._newest_ns: dict[str, int] = {}

    @property
    def topics(self) -> frozenset[str]:
        """See above."""
        return frozenset(topic for topic, _ in self._decoders)

    def find(self, known: Sequence[TopicInfo], base_frame: str) -> None:
        """Look for the topic. Raises TopicError, UnsupportedSchema."""
        channel, self._base_frame = _channel(known, self._topic), base_frame
        self._is_tf = channel.type in topics.TF
        channels = Namespaces(channel, known).tf_topics() if self._is_tf else [channel]
        self._decoders = {(t.topic, t.type): decoder_for(t) for t in channels}

    def take(self, message: RawMessage) -> None:
        """Update with a message; those of other topics are ignored."""
        if not self.keep(message):
            return
        self.problem = None
        try:
            self.newest = self.at(message.log_time_ns)
        except NoScans:
            return
        except FrameError as error:
            self.problem = error

    def keep(self, message: RawMessage) -> bool:
        """Keep what a message says, and return whether it is of the topic."""
        decode = self._decoders.get((message.channel.topic, message.channel.type))
        if decode is None:
            return False
        found, static = tolerant(decode, message.data), topics.is_static(message.channel)
        for edge in (found or ()) if self._is_tf else ():
            self._tree.add(replace(edge, lasting=True), static=static, log_time_ns=message.log_time_ns)
            if not static:
                self._newest_ns[edge.child] = edge.header.stamp_ns or message.log_time_ns
        if not self._is_tf and found is not None and valid_pose(found.pose):
            self._last = found, message.log_time_ns
        return True

    def at(self, now_ns: int) -> MapPose:
        """Return the newest pose. now_ns : its time if all transforms are static.

        Raises FrameError, or NoScans if there is none yet.
        """
        if self._is_tf:
            return self._in_tf(now_ns)
        if self._last is None:
            raise NoScans(f"{self._topic}: no pose in the part asked for")
        found, log_time_ns = self._last
        if found.header.frame and not _is_map(found.header.frame):
            raise FrameError(
                f"{self._topic}: its poses are in frame {found.header.frame}, not in a map",
                hint="name a topic of localization, such as /amcl_pose or /tf",
            )
        return MapPose(
            stamp_ns=found.header.stamp_ns or log_time_ns,
            T_map_base=SE2.from_matrix(pose_from_xyz_quat(found.pose[:3], found.pose[3:])),
            covariance=None if found.covariance is None else np.reshape(found.covariance, (6, 6))[_PLANAR],
        )

    def _in_tf(self, now_ns: int) -> MapPose:
        tree, base_frame = self._tree, self._base_frame
        above = tree.chain(base_frame) if base_frame in tree else [base_frame]
        map_frame = next((frame for frame in above[1:] if _is_map(frame)), None)
        if map_frame is None:
            there = ", ".join(tree.frames[:12]) or "nothing"
            raise FrameError(
                f"tf has no frame map above {base_frame}; there is: {there}",
                hint="name a topic of localization, such as /amcl_pose",
            )
        moving = [self._newest_ns[f] for f in above[: above.index(map_frame)] if f in self._newest_ns]
        stamp_ns = min(moving, default=now_ns)
        T_map_base = tree.lookup(map_frame, base_frame, stamp_ns)
        if T_map_base is None:
            raise NoScans(
                f"tf: {map_frame} -> {base_frame} is not known at any one time in the part asked for"
            )
        return MapPose(stamp_ns=stamp_ns, T_map_base=SE2.from_matrix(T_map_base))


def _channel(known: Sequence[TopicInfo], topic: str) -> TopicInfo:
    usable = [t for t in known if t.type in (*topics.POSES, *topics.ODOMETRY, *topics.TF)]
    for channel in known:
        if channel.topic == topic:
            if channel not in usable:
                raise TopicError(f"{topic}: is of type {channel.type or 'unknown'}, which holds no pose")
            return channel
    raise topics.missing(usable, topic, f"topics with poses: {topics.listed(usable) or 'none'}")


def _is_map(frame: str) -> bool:
    """Return True if a frame is a map by its name (REP-105), also of one robot of several."""
    name = frame.rsplit("/", 1)[-1]
    return name == "map" or name.endswith("_map")


_MOST_BYTES = 1 << 20
"""A file above this is no single message."""


def write_initialpose(path: Path, stamp_ns: int, T_map_base: SE2, covariance: F64) -> None:
    """Write a pose as JSON that `ros2 topic pub --once /initialpose` takes.

    covariance : (3, 3) of x, y, yaw.
    """
    message = initialpose(stamp_ns, T_map_base, covariance)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(message, indent=1) + "\n", encoding="utf-8")


def initialpose(stamp_ns: int, T_map_base: SE2, covariance: F64, frame: str = "map") -> dict[str, Any]:
    """Return geometry_msgs/PoseWithCovarianceStamped in plain types.

    covariance : (3, 3) of x, y, yaw; of these the variances, see `pc2grid.io.export.initialpose`.
    """
    found = export.initialpose(stamp_ns, T_map_base, covariance, frame)
    # What rosbags keeps beside the fields of a message are their types.
    message = dataclasses.asdict(
        found, dict_factory=lambda items: {k: v for k, v in items if k != "__msgtype__"}
    )
    message["pose"]["covariance"] = message["pose"]["covariance"].tolist()
    return message


def read_pose(path: Path) -> MapPose:
    """Read a pose with covariance from a file: JSON as `write_initialpose` writes it, or YAML as `ros2 topic
    echo` prints it.

    Raises ConfigError if the file cannot be read or holds no such message.
    """
    advice = "`pc2grid relocalize --initialpose OUT.json` writes one; --near X Y RADIUS needs none"
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ConfigError(f"{path}: larger than one message can be", hint=advice)
        # `ros2 topic echo` ends each message with "---".
        message: Any = next(iter(yaml.safe_load_all(path.read_text(encoding="utf-8"))), None)
        stamp, whole = message["header"]["stamp"], message["pose"]
        position, q = whole["pose"]["position"], whole["pose"]["orientation"]
        yaw = math.atan2(2.0 * (q["w"] * q["z"] + q["x"] * q["y"]), 1.0 - 2.0 * (q["y"] ** 2 + q["z"] ** 2))
        covariance = np.asarray(whole["covariance"], np.float64).reshape(6, 6)
        return MapPose(
            stamp_ns=int(stamp["sec"]) * 1_000_000_000 + int(stamp["nanosec"]),
            T_map_base=SE2(float(position["x"]), float(position["y"]), yaw),
            covariance=covariance[_PLANAR],
        )
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}", hint=advice) from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: neither JSON nor YAML", hint=advice) from error
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ConfigError(f"{path}: not a PoseWithCovarianceStamped message", hint=advice) from error
