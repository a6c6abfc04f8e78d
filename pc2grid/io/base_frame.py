"""The base of the robot: the frame in which its scans are put together, and how the sensors sit on it."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, TopicError
from pc2grid.io import topics
from pc2grid.io.first_messages import First, FirstMessages
from pc2grid.io.found_sensors import FoundSensors, Sensor
from pc2grid.io.message_source import TopicInfo
from pc2grid.io.robots import BASE_FRAMES, diverge, prefix, shared_parts, two_robots
from pc2grid.io.transforms import Transforms

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
    """Looks for the base by the settings, by names of frames, by odometry, and by what tf connects.

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
        """Return whether there is no tf, nor may it be among what is lost: a wrong base frame would shift
        every scan."""
        tally = self._first.tally
        of_tf = any(t.type in topics.TF for t in self._first.topics)
        lost = tally.topics_lost or self._frames.warnings or (tally.bytes_lost > 0 and of_tf)
        return not (self._frames.frames or self._config.base_frame is not None or lost)

    # --- how the sensors sit on it --------------------------------------------------------------------

    def _check_sensors(self, base: str | None) -> None:
        """Raise FrameError if the places of several sensors are not known, TopicError for the scans of one
        sensor that are published twice, and for those of two robots. In the frame of the base, sensors are
        not told apart."""
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
        """Raise FrameError for several sensors without tf, unless the user asks to read the first of those on
        one topic."""
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
