"""What to read of a log and how, decided from its first messages: topics, base frame, odometry, IMU."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from pc2grid.config import ReadConfig
from pc2grid.io import topics
from pc2grid.io.base_frame import BaseSearch
from pc2grid.io.first_messages import FirstMessages
from pc2grid.io.found_sensors import Sensor, find_sensors
from pc2grid.io.frames import FrameTree
from pc2grid.io.message_source import Choice, MessageSource, TopicInfo
from pc2grid.io.motion import MotionSearch
from pc2grid.io.robots import Robot
from pc2grid.io.transforms import Transforms

LOOK_AHEAD_NS = 60_000_000_000
"""Log time behind the first scans within which tf must connect the sensor to the base; chosen by hand."""
_LAST_FLOAT = struct.Struct("<f")


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
        stampless=found.stampless,
        mounted=bases.mounted(base),
        period_ns=found.period_ns,
        depth_unit_m=config.depth_unit_m or _recorded_depth_unit_m(source),
    )


def _recorded_depth_unit_m(source: MessageSource) -> float | None:
    """Return the unit that librealsense writes into its recordings, as a std_msgs/Float32; None if it is
    not."""
    unit = topics.depth_unit_topic(source.info.topics)
    message = None if unit is None else next(source.messages({unit.topic}), None)
    value = 0.0 if message is None else _LAST_FLOAT.unpack(bytes(message.data)[-_LAST_FLOAT.size :])[0]
    if unit is None or not 0 < value <= 1:
        return None
    source.tally.warn(f"depths are in units of {value:.3g} m, as {unit.topic} says")
    return float(value)


def published_once(topic: TopicInfo) -> bool:
    """Return whether the messages of a topic may be published only once, when the robot starts."""
    return topic.type in topics.CAMERA_INFOS or (topic.type in topics.TF and topics.is_static(topic))
