"""Where localization on the robot believed to be: the last pose in the map that a recording holds."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace

import numpy as np

from pc2grid.arrays import F64
from pc2grid.errors import FrameError, NoScans, TopicError
from pc2grid.geometry import SE2, pose_from_xyz_quat
from pc2grid.io import topics
from pc2grid.io.frames import FrameTree
from pc2grid.io.message_source import MessageSource, TopicInfo
from pc2grid.io.messages.decoders import decoder_for
from pc2grid.io.messages.types import Odometry, PoseStamped, Seven, valid_pose
from pc2grid.io.read_plan import is_static, tolerant

_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""x, y and yaw among x, y, z, roll, pitch, yaw."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapPose:
    """A pose of the base in a map frame. covariance : (3, 3) of x, y, yaw; None if it is not known."""

    stamp_ns: int
    T_map_base: SE2
    covariance: F64 | None = None


def last_map_pose(source: MessageSource, topic: str, base_frame: str, end_ns: int | None = None) -> MapPose:
    """The last pose on a topic of a pose, an odometry or tf, recorded before `end_ns` (None: of all).

    Raises TopicError, UnsupportedSchema, FrameError, or NoScans if there is no pose.
    """
    channel = _channel(source.info.topics, topic)
    if channel.type in topics.TF:
        return _from_tf(source, base_frame, end_ns)
    decode = decoder_for(channel)
    last: tuple[Odometry | PoseStamped, int] | None = None
    for message in source.messages({topic}, None, end_ns):
        if message.channel == channel:
            found = tolerant(decode, message.data, None)
            if found is not None and valid_pose(found.pose):
                last = found, message.log_time_ns
    if last is None:
        raise NoScans(f"{topic}: no pose in the part asked for")
    found, log_time_ns = last
    if found.header.frame and not _is_map(found.header.frame):
        raise FrameError(
            f"{topic}: its poses are in frame {found.header.frame}, not in a map",
            hint="name a topic of localization, such as /amcl_pose or /tf",
        )
    return MapPose(
        stamp_ns=found.header.stamp_ns or log_time_ns,
        T_map_base=_planar(found.pose),
        covariance=_covariance(found),
    )


def _channel(known: tuple[TopicInfo, ...], topic: str) -> TopicInfo:
    usable = [t for t in known if t.type in (*topics.POSES, *topics.ODOMETRY, *topics.TF)]
    for channel in known:
        if channel.topic == topic:
            if channel not in usable:
                raise TopicError(f"{topic}: is of type {channel.type or 'unknown'}, which holds no pose")
            return channel
    close = difflib.get_close_matches(topic, [t.topic for t in usable], n=1)
    guess = f"; did you mean {close[0]}?" if close else ""
    there = ", ".join(f"{t.topic} ({t.type})" for t in usable[:12])
    raise TopicError(f"no topic {topic} in the log{guess}", hint=f"topics with poses: {there or 'none'}")


def _from_tf(source: MessageSource, base_frame: str, end_ns: int | None) -> MapPose:
    """map -> base at the newest time that all transforms between them are known for.

    The transform map -> odom is published ahead of time or rarely, so each one holds until the next.
    """
    tf_topics = [t for t in source.info.topics if t.type in topics.TF]
    decoders = {t: decoder_for(t) for t in tf_topics}
    tree = FrameTree()
    newest_ns: dict[str, int] = {}
    for message in source.messages({t.topic for t in tf_topics}, None, end_ns):
        if message.channel not in decoders:
            continue
        static = is_static(message.channel)
        for edge in tolerant(decoders[message.channel], message.data, ()):
            tree.add(replace(edge, lasting=True), static=static, log_time_ns=message.log_time_ns)
            if not static:
                newest_ns[edge.child] = edge.header.stamp_ns or message.log_time_ns
    above = tree.chain(base_frame) if base_frame in tree else [base_frame]
    map_frame = next((frame for frame in above[1:] if _is_map(frame)), None)
    if map_frame is None:
        raise FrameError(
            f"tf has no frame map above {base_frame}; there is: {', '.join(tree.frames[:12]) or 'nothing'}",
            hint="name a topic of localization, such as /amcl_pose",
        )
    moving = [newest_ns[frame] for frame in above[: above.index(map_frame)] if frame in newest_ns]
    stamp_ns = min(moving, default=source.info.end_ns)
    T_map_base = tree.lookup(map_frame, base_frame, stamp_ns)
    if T_map_base is None:
        raise NoScans(f"tf: {map_frame} -> {base_frame} is not known at any one time in the part asked for")
    return MapPose(stamp_ns=stamp_ns, T_map_base=SE2.from_matrix(T_map_base))


def _is_map(frame: str) -> bool:
    """Whether a frame is a map by its name (REP-105), also of one robot of several."""
    name = frame.rsplit("/", 1)[-1]
    return name == "map" or name.endswith("_map")


def _planar(pose: Seven) -> SE2:
    return SE2.from_matrix(pose_from_xyz_quat(pose[:3], pose[3:]))


def _covariance(found: Odometry | PoseStamped) -> F64 | None:
    values = found.covariance if isinstance(found, PoseStamped) else None
    return None if values is None else np.asarray(np.reshape(values, (6, 6))[_PLANAR], np.float64)
