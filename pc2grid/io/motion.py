"""Where the odometry of the robot comes from, and without it the direction of gravity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, UnsupportedSchema
from pc2grid.io import topics
from pc2grid.io.first_messages import First, FirstMessages, delay_ns
from pc2grid.io.found_sensors import FoundSensors
from pc2grid.io.message_source import GAP_NS, TopicInfo
from pc2grid.io.robots import Robot, prefix
from pc2grid.io.transforms import Transforms
from pc2grid.sensor_model import SENSOR_MODELS


class Motion(NamedTuple):
    """Where odometry comes from: a topic; of tf, the transform from a frame in it. None if there is none."""

    topic: TopicInfo | None
    frame: str | None
    reason: str


class MotionSearch:
    """Looks for the odometry and the IMU of a robot whose base is known. base : None: the sensor's frame."""

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
        """Return the odometry of the best topic, or that which tf holds; warns if there is a choice.

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
        """Return the best topic of the robot; None if there is none. Raises TopicError if that cannot be
        told."""
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
        """Return the odometry that tf holds. Raises TopicError if it may be of another robot."""
        frame = None if self._base is None else self._tf.read_odometry(self._base)
        if frame is None or not self._tf.moving:
            return Motion(None, None, "no odometry topic")
        topic = self._tf.moving[0]
        if self._config.odometry is None and not prefix(frame) and self._robot.serves_several(topic):
            raise self._robot.unsure([topic])
        return Motion(topic, frame, f"odometry from tf, {frame} -> {self._base}")

    def _said(self, motion: Motion) -> Motion:
        """Return the odometry with a reason that names the others; of these the user is told."""
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
        """Return the odometry unless its stamps are of another clock than the scans' and nobody asked for
        it."""
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
        """Return the IMU, and why; beside odometry, and with a laser, none is looked for.

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
        """Raise FrameError if it is not known how the IMU sits on the base, UnsupportedSchema."""
        there, frames = self._sensors.frame if self._base is None else self._base, self._tf.frames
        frame = next((m.frame for m in self._first.of(imu)), "")
        known = frame == there or (self._base is not None and frames.connected(there, frame))
        if not known or frames.moving(there, frame):
            raise frames.missing(frame, there)
