"""What to read of a log and how: the topics, the base frame, and where the odometry comes from."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, NoScans, PointCloudError
from pc2grid.io import choose
from pc2grid.io.decoders import decoder_for
from pc2grid.io.frames import FrameTree
from pc2grid.io.source import Choice, Source, TopicInfo

# tf that connects the sensor must come within this time of the first scan,
_TF_SEARCH_NS = 60_000_000_000
# and the odometry that is in tf, if it is, within this.
_ODOMETRY_SEARCH_NS = 5_000_000_000
# So many scans are looked at beforehand.
_LOOK_AHEAD = 5
_BASE_FRAMES = ("base_link", "base_footprint")


@dataclass(frozen=True, slots=True)
class Plan:
    """What to read and how, decided once per log.

    camera : None unless the scans are depth images. odometry : None if there is none, or it is in tf.
    odometry_frame : of tf, if the odometry comes from there. tf_moves : whether tf is needed while streaming.
    stampless : the first scans are all of stamp zero, so the time of recording has to do.
    """

    choice: Choice
    scans: TopicInfo
    camera: TopicInfo | None
    odometry: TopicInfo | None
    odometry_frame: str | None
    tf_moves: bool
    sensor_is_base: bool
    stampless: bool


def make_plan(source: Source, config: ReadConfig, frames: FrameTree) -> Plan:
    """Decide, and fill `frames` with the static transforms and the first of the moving ones.

    Raises TopicError, NoScans, UnsupportedSchema or FrameError.
    """
    return _Planner(source, config, frames).plan()


def is_static(topic: TopicInfo) -> bool:
    """Whether a tf topic is of transforms that never change."""
    return topic.topic.endswith("tf_static")


def tolerant(decode: Callable[[Any], Any], data: Any, otherwise: Any) -> Any:
    """Decode a message that only helps (tf, odometry); one that is too short counts as not there."""
    try:
        return decode(data)
    except PointCloudError:
        return otherwise


class _Planner:
    def __init__(self, source: Source, config: ReadConfig, frames: FrameTree) -> None:
        self._source, self._config, self._frames = source, config, frames
        self._topics = source.info.topics

    def plan(self) -> Plan:
        config, topics, frames = self._config, self._topics, self._frames
        scans, reason = choose.scan_topic(topics, config.topic)
        sensor = choose.SENSORS[scans.type]
        decode = decoder_for(scans)
        camera = choose.camera_info_topic(scans, topics) if sensor == "depth" else None
        odometry, why_odometry = choose.odometry_topic(topics, config.odometry)
        tf_topics = [t for t in topics if t.type in choose.TF and t.message_count != 0]
        self._read_static([t for t in tf_topics if is_static(t)])

        of_topic = (m for m in self._source.messages({scans.topic}) if m.channel == scans)
        first = list(itertools.islice(of_topic, _LOOK_AHEAD))
        if not first:
            raise NoScans(f"{scans.topic}: no message in the log")
        found = [s.header for m in first if (s := tolerant(decode, m.data, None)) is not None]
        sensor_frame = found[0].frame if found else ""  # all broken: the stream will count them
        child = self._odometry_child(odometry)
        moving = [t for t in tf_topics if not is_static(t)]
        in_tf = odometry.type in choose.TF if odometry else config.odometry is None
        base = self._search_tf(moving, sensor_frame, child, first[0].log_time_ns, odometry_too=in_tf)

        sensor_is_base = base is None
        if base is None:
            base = sensor_frame or config.base_frame or "sensor"
        odometry_frame = self._odometry_frame(base) if in_tf and not sensor_is_base else None
        if in_tf:
            odometry = None
        if odometry_frame is not None:
            why_odometry = f"odometry from tf, {odometry_frame} -> {base}"
        moves = odometry_frame is not None or (
            not sensor_is_base
            and sensor_frame in frames
            and frames.connected(base, sensor_frame)
            and frames.moving(base, sensor_frame)
        )
        named = odometry.topic if odometry else (moving[0].topic if odometry_frame and moving else None)
        choice = Choice(
            topic=scans.topic,
            sensor=sensor,
            odometry_topic=named,
            base_frame=base,
            sensor_frame=sensor_frame or None,
            reason=f"{reason}; {why_odometry}",
        )
        stampless = bool(found) and all(h.stamp_ns == 0 for h in found)
        return Plan(choice, scans, camera, odometry, odometry_frame, moves, sensor_is_base, stampless)

    def _read_static(self, topics: list[TopicInfo]) -> None:
        decoders = {t: decoder_for(t) for t in topics}
        for message in self._source.messages({t.topic for t in topics}):
            if message.channel in decoders:
                edges = tolerant(decoders[message.channel], message.data, None)
                self._frames.add_all(edges, static=True)

    def _odometry_child(self, odometry: TopicInfo | None) -> str | None:
        if odometry is None or odometry.type in choose.TF:
            return None
        decode = decoder_for(odometry)
        for message in self._source.messages({odometry.topic}):
            found = tolerant(decode, message.data, None)
            return found.child if found else None
        return None

    def _search_tf(
        self, moving: list[TopicInfo], sensor_frame: str, child: str | None, first_ns: int, odometry_too: bool
    ) -> str | None:
        """Read tf until it connects the sensor to a base; returns the base, None if the log has no tf.

        Raises FrameError if it never does.
        """
        frames = self._frames
        decoders = {t: decoder_for(t) for t in moving}
        base = self._connected_base(sensor_frame, child)
        for message in self._source.messages({t.topic for t in moving}, end_ns=first_ns + _TF_SEARCH_NS):
            if base is not None and (
                not odometry_too
                or self._odometry_frame(base) is not None
                or message.log_time_ns > first_ns + _ODOMETRY_SEARCH_NS
            ):
                break
            if message.channel in decoders:
                size = len(frames.frames)
                edges = tolerant(decoders[message.channel], message.data, None)
                frames.add_all(edges, log_time_ns=message.log_time_ns)
                if len(frames.frames) > size:
                    base = self._connected_base(sensor_frame, child)
        if base is not None:
            return base
        base = self._base_frame(child)
        if base is not None and sensor_frame == base:
            return base
        name = sensor_frame or "(empty)"
        # Where parts of the file or of tf are lost, a guess would shift every scan.
        tally = self._source.tally
        lost = tally.topics_lost or (tally.bytes_lost and any(t.type in choose.TF for t in self._topics))
        lost = lost or bool(frames.warnings)
        if not frames.frames and self._config.base_frame is None and not lost:
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
