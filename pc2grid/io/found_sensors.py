"""The sensors whose scans are read: first the topics of scans, then the frames on each of them."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from pc2grid.config import ReadConfig
from pc2grid.errors import NoScans, TopicError
from pc2grid.io import topics
from pc2grid.io.first_messages import FIRST, First, FirstMessages, delay_ns
from pc2grid.io.message_source import GAP_NS, TopicInfo
from pc2grid.io.messages.types import CameraInfo
from pc2grid.io.robots import Namespaces, camera_info_topic, diverge, two_robots
from pc2grid.io.sensors.depth import holds_depths
from pc2grid.io.sensors.scan_decoder import ScanDecoder
from pc2grid.model import SensorKind
from pc2grid.sensor_model import SENSOR_MODELS

_FIRST_SCANS = 20
"""So many scans of a topic are looked at, so that each of several sensors on it is among them. By hand."""


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
        """The topic of the first sensor."""
        return self.sensors[0].topic

    @property
    def frame(self) -> str:
        """The frame of the first sensor; empty if no scan can be decoded (the stream counts them)."""
        return self.sensors[0].frame or ""

    @property
    def stampless(self) -> bool:
        """Whether there are first scans, and all of their stamps are zero."""
        return bool(self.first_scans) and not any(self._stamps_ns)

    @property
    def period_ns(self) -> int:
        """The longest time between two of the first scans; 0 if there is only one."""
        return max((b - a for a, b in itertools.pairwise(self._stamps_ns)), default=0)

    @property
    def _stamps_ns(self) -> list[int]:
        return [scan.content.header.stamp_ns for scan in self.first_scans]

    @property
    def seen(self) -> list[Sensor]:
        """The sensors that are not silent."""
        return [sensor for sensor in self.sensors if not sensor.silent]

    @property
    def of_one_topic(self) -> bool:
        """Whether all sensors are told apart by their frames alone."""
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
    left_out = {(t, scan.frame) for t in found for scan in first.of(t, _FIRST_SCANS)} - used
    scans = [s for s in first.of(lead.topic, _FIRST_SCANS) if s.frame == lead.frame]
    return FoundSensors(tuple(sensors), frozenset(left_out), tuple(scans[:FIRST]), reason)


# --- the topics -------------------------------------------------------------------------------------------


def _scan_topics(wanted: str | None, first: FirstMessages) -> tuple[list[TopicInfo], str]:
    """Return the topics to read scans from, and a sentence that says why."""
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

    Topics of one frame hold the scans of one sensor, filtered or delayed: the first one is proposed. What
    is in a fixed frame is no longer as it was measured.
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
    """What the first scans of a topic in one frame show.

    foreign : whether the frame is of another robot than the base that the settings name. empty : whether no
    scan holds a return. delay_ns : how long after their stamps they were recorded; stamps of zero are another
    clock's, too.
    """

    name: str
    foreign: bool
    empty: bool
    delay_ns: int

    def silence(self, lead: _Frame) -> str:
        """Return what is said of a sensor without returns beside one with; empty if it is none."""
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
    scans = first.of(sensor.topic, _FIRST_SCANS)
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
    infos = [] if sensor.camera is None else first.of(sensor.camera, _FIRST_SCANS)
    return next((info.content for info in infos if info.frame == frame), sensor.calibration)
