"""A recording as a stream of scans, whatever container it is in."""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from pc2grid.config import ReadConfig
from pc2grid.errors import (
    ConfigError,
    FrameError,
    LimitExceeded,
    LogCorrupt,
    NoScans,
    Pc2GridError,
    PointCloudError,
    UnsupportedSchema,
)
from pc2grid.geometry import F64
from pc2grid.io import choose as choosing
from pc2grid.io.containers import open_source
from pc2grid.io.decoders import decoder_for
from pc2grid.io.depth import T_BODY_OPTICAL
from pc2grid.io.frames import FrameTree, PoseTrack
from pc2grid.io.ros_messages import Odometry, Transform
from pc2grid.io.scan_decoder import ScanDecoder
from pc2grid.io.source import Choice, LogInfo, Source, TopicInfo
from pc2grid.model import ReadReport, Scan

# Scans wait this long (log time) for odometry and for scans that overtook each other.
_WAIT_NS = 500_000_000
_MAX_WAITING = 256
# tf and odometry around the part that is read.
_MARGIN_NS = 1_000_000_000
# tf that connects the sensor must come within this time of the first scan.
_TF_SEARCH_NS = 60_000_000_000
_CLOCK_JUMP_NS = 60_000_000_000
_GAP_NS = 5_000_000_000
_BASE_FRAMES = ("base_link", "base_footprint")


def open_log(path: Path, config: ReadConfig | None = None, *, recover: bool = False) -> Log:
    """Open a recording: an MCAP (ROS 2 or ROS 1), a ROS 1 bag, a rosbag2 folder or db3, a folder of clouds.

    recover : read what is whole of a damaged file and count the rest, instead of refusing it.

    Raises LogNotFound, NotALog, LogTruncated, LogCorrupt, LimitExceeded.
    """
    config = config or ReadConfig()
    path = Path(path)
    source = _guarded(path, lambda: open_source(path, config, recover=recover))
    return Log(source, config)


@dataclass(frozen=True, slots=True)
class _Plan:
    """What to read and how, decided once per log."""

    choice: Choice
    scans: TopicInfo
    camera: TopicInfo | None
    odometry: TopicInfo | None
    odometry_frame: str | None  # of tf, if the odometry comes from there
    tf_moves: bool  # whether /tf is needed while streaming
    sensor_is_base: bool


class Log:
    """An open recording. Use as a context manager.

    info : what it holds.
    """

    def __init__(self, source: Source, config: ReadConfig) -> None:
        self.info: LogInfo = source.info
        self._source = source
        self._config = config
        self._plan: _Plan | None = None
        self._frames = FrameTree()
        self._digest: str | None = None
        self._scans_read = 0
        self._points_dropped = 0
        self._notes: list[str] = []

    def __enter__(self) -> Log:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._source.close()

    def digest(self) -> str:
        """sha256 (hex) of the file, or of all files of a folder in the order of their names."""
        if self._digest is None:
            total = hashlib.sha256()
            for path in self._source.files:
                with path.open("rb") as file:
                    while block := file.read(1 << 20):
                        total.update(block)
            self._digest = total.hexdigest()
        return self._digest

    def report(self) -> ReadReport:
        """What has been read and lost so far."""
        losses = self._source.losses
        warnings = dict.fromkeys((*losses.warnings, *self._notes, *self._frames.warnings))
        return ReadReport(
            scans_read=self._scans_read,
            points_dropped=self._points_dropped,
            scans_skipped=dict(losses.skipped),
            bytes_lost=losses.bytes_lost,
            warnings=tuple(warnings),
        )

    def choose(self) -> Choice:
        """The topic that the scans come from, and why.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        if self._plan is None:
            self._plan = _guarded(self.info.path, self._make_plan)
        return self._plan.choice

    def scans(self, start_s: float = 0.0, duration_s: float | None = None) -> Iterator[Scan]:
        """Stream the scans from `start_s` seconds after the log's start on, for `duration_s` seconds.

        Stamps increase strictly. Scans that cannot be decoded are skipped and counted in `report`.

        Raises what `choose` does; NoScans if nothing is in that part; LogCorrupt if more than a tenth of
        the scans is unreadable.
        """
        if not np.isfinite(start_s) or start_s < 0:
            raise ConfigError(f"start: expected seconds >= 0, found {start_s:g}")
        if duration_s is not None and not duration_s > 0:
            raise ConfigError(f"duration: expected seconds > 0, found {duration_s:g}")
        self.choose()
        assert self._plan is not None
        return _guarded_stream(self.info.path, _Stream(self, self._plan, start_s, duration_s).run())

    def note(self, sentence: str) -> None:
        """Add a warning to the report, once."""
        if sentence not in self._notes:
            self._notes.append(sentence)

    # --- planning -------------------------------------------------------------------------------------

    def _make_plan(self) -> _Plan:
        config, topics = self._config, self.info.topics
        scans, reason = choosing.scan_topic(topics, config.topic)
        sensor = choosing.SENSORS[scans.type]
        decode = decoder_for(scans)
        camera = choosing.camera_info_topic(scans, topics) if sensor == "depth" else None
        odometry, why_odometry = choosing.odometry_topic(topics, config.odometry)
        tf_topics = [t for t in topics if t.type in choosing.TF and t.message_count != 0]
        self._read_static([t for t in tf_topics if _is_static(t)])

        first = next(iter(self._source.messages({scans.topic})), None)
        if first is None:
            raise NoScans(f"{scans.topic}: no message in the log")
        try:
            sensor_frame = ScanDecoder(scans.topic, sensor, decode, config).header(first.data).frame
        except PointCloudError:
            sensor_frame = ""  # the first message is broken; the stream will count it
        child = self._odometry_child(odometry)
        moving = [t.topic for t in tf_topics if not _is_static(t)]
        base = self._search_tf(moving, sensor_frame, child, first.log_time_ns)

        sensor_is_base = base is None
        if base is None:
            base = sensor_frame or config.base_frame or "sensor"
        odometry_frame = None
        if odometry is not None and odometry.type in choosing.TF:
            odometry, odometry_frame = None, self._odometry_frame(base)
        elif odometry is None and config.odometry is None and not sensor_is_base:
            odometry_frame = self._odometry_frame(base)
        if odometry_frame is not None:
            why_odometry = f"odometry from tf, {odometry_frame} -> {base}"
        moves = odometry_frame is not None or (
            not sensor_is_base
            and sensor_frame in self._frames
            and self._frames.connected(base, sensor_frame)
            and self._frames.moving(base, sensor_frame)
        )
        named = odometry.topic if odometry else (moving[0] if odometry_frame and moving else None)
        choice = Choice(
            topic=scans.topic,
            sensor=sensor,
            odometry_topic=named,
            base_frame=base,
            sensor_frame=sensor_frame or None,
            reason=f"{reason}; {why_odometry}",
        )
        return _Plan(choice, scans, camera, odometry, odometry_frame, moves, sensor_is_base)

    def _read_static(self, topics: list[TopicInfo]) -> None:
        decoders = {t: decoder_for(t) for t in topics}
        for message in self._source.messages({t.topic for t in topics}):
            if message.channel in decoders:
                for edge in _tolerant(decoders[message.channel], message.data, ()):
                    self._frames.add(edge, static=True)

    def _odometry_child(self, odometry: TopicInfo | None) -> str | None:
        if odometry is None or odometry.type in choosing.TF:
            return None
        decode = decoder_for(odometry)
        for message in self._source.messages({odometry.topic}):
            found = _tolerant(decode, message.data, None)
            return found.child if found else None
        return None

    def _search_tf(
        self, moving: list[str], sensor_frame: str, child: str | None, first_ns: int
    ) -> str | None:
        """Read tf until it connects the sensor to a base; returns the base, None if the log has no tf.

        Raises FrameError if it never does.
        """
        frames = self._frames
        decoders = {t: decoder_for(t) for t in self.info.topics if t.topic in moving}
        base = self._base_frame(child)
        if base is None or sensor_frame not in frames or not frames.connected(base, sensor_frame):
            end_ns = first_ns + _TF_SEARCH_NS
            for message in self._source.messages(set(moving), end_ns=end_ns):
                if message.channel not in decoders:
                    continue
                size = len(frames.frames)
                for edge in _tolerant(decoders[message.channel], message.data, ()):
                    frames.add(edge, static=False, log_time_ns=message.log_time_ns)
                if len(frames.frames) > size:
                    base = self._base_frame(child)
                    if base and sensor_frame in frames and frames.connected(base, sensor_frame):
                        break
        if base is not None and (sensor_frame == base or frames.connected(base, sensor_frame)):
            return base
        # Where parts of the file are lost, tf may be among them: a guess would shift every scan.
        lost = self._source.losses.bytes_lost and any(t.type in choosing.TF for t in self.info.topics)
        if not frames.frames and self._config.base_frame is None and not lost:
            self.note(
                f"the log has no tf: frame {sensor_frame or '(empty)'} of the scans "
                "is taken for the robot's base"
            )
            return None
        if self._config.assume_identity:
            self.note(
                f"tf does not connect frame {sensor_frame or '(empty)'}: it is taken for the base, as asked"
            )
            return None
        if base is None and frames.frames:
            raise FrameError(
                f"tf has none of the frames {', '.join(_BASE_FRAMES)}; "
                f"there is: {', '.join(frames.frames[:12])}",
                hint="--set read.base_frame=NAME says which is the robot's base",
            )
        raise frames.missing(sensor_frame, base or "the base")

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


class _Stream:
    """One pass over a part of a log: scans in the order of their stamps, with their odometry."""

    def __init__(self, log: Log, plan: _Plan, start_s: float, duration_s: float | None) -> None:
        self._log, self._plan = log, plan
        self._source, self._frames = log._source, log._frames
        info = log.info
        self._start_ns = info.start_ns + round(start_s * 1e9)
        self._end_ns = None if duration_s is None else self._start_ns + round(duration_s * 1e9)
        self._part = f"from {start_s:g} s" + ("" if duration_s is None else f" for {duration_s:g} s")
        self._decoder = ScanDecoder(
            plan.scans.topic, plan.choice.sensor, decoder_for(plan.scans), log._config
        )
        self._track = PoseTrack()
        self._T_child_base: F64 | None = None
        self._waiting: list[tuple[int, int, int, str, Any]] = []
        self._count = self._bad = self._good = 0
        self._last_ns: int | None = None
        self._last_log_ns: int | None = None
        self._error: Pc2GridError | None = None

    def run(self) -> Iterator[Scan]:
        """Yield the scans. Raises as `Log.scans` says."""
        plan = self._plan
        on: dict[TopicInfo, Callable[[Any, int], None]] = {plan.scans: self._take_scan}
        if plan.odometry is not None:
            on[plan.odometry] = self._take_odometry()
        if plan.camera is not None:
            on[plan.camera] = self._take_camera()
            self._first_camera(plan.camera, on[plan.camera])
        if plan.tf_moves:
            for topic in self._log.info.topics:
                if topic.type in choosing.TF and not _is_static(topic):
                    on[topic] = self._take_tf(topic)
        low = max(self._start_ns - _MARGIN_NS, 0) if self._start_ns > self._log.info.start_ns else None
        high = None if self._end_ns is None else self._end_ns + _MARGIN_NS
        for message in self._source.messages({t.topic for t in on}, low, high):
            take = on.get(message.channel)
            if take is not None:
                take(message.data, message.log_time_ns)
            while self._waiting and (
                message.log_time_ns - self._waiting[0][2] > _WAIT_NS or len(self._waiting) > _MAX_WAITING
            ):
                yield from self._release()
        while self._waiting:
            yield from self._release()
        self._finish()

    # --- taking messages up ---------------------------------------------------------------------------

    def _take_scan(self, data: Any, log_time_ns: int) -> None:
        if log_time_ns < self._start_ns or (self._end_ns is not None and log_time_ns >= self._end_ns):
            return
        self._count += 1
        try:
            header = self._decoder.header(data)
        except Pc2GridError as error:
            self._skip(error)
            return
        stamp_ns = header.stamp_ns
        if stamp_ns <= 0:
            if self._good or any(entry[0] != entry[2] for entry in self._waiting):
                self._skip(PointCloudError("stamp is zero or negative"))
                return
            self._log.note("the stamps of the scans are zero: the time of recording is used instead")
            stamp_ns = log_time_ns
        heapq.heappush(self._waiting, (stamp_ns, self._count, log_time_ns, header.frame, data))

    def _take_odometry(self) -> Callable[[Any, int], None]:
        assert self._plan.odometry is not None
        decode = decoder_for(self._plan.odometry)

        def take(data: Any, log_time_ns: int) -> None:
            found: Odometry | None = _tolerant(decode, data, None)
            if found is None or not self._track.add(found.header.stamp_ns or log_time_ns, found.pose):
                self._log.note("some odometry messages are unreadable or not finite, and were ignored")
            elif self._T_child_base is None:
                self._T_child_base = self._child_to_base(found.child)

        return take

    def _child_to_base(self, child: str) -> F64:
        """`T_child_base` of the odometry's child frame; identity if they are one, or unconnected."""
        base, frames = self._plan.choice.base_frame, self._frames
        if child == base or self._plan.sensor_is_base or child not in frames or base not in frames:
            return np.eye(4)
        if frames.connected(child, base) and not frames.moving(child, base):
            found = frames.lookup(child, base, 0)
            return np.eye(4) if found is None else found
        self._log.note(f"the odometry is of frame {child}, which is taken for {base}")
        return np.eye(4)

    def _take_camera(self) -> Callable[[Any, int], None]:
        assert self._plan.camera is not None
        decode = decoder_for(self._plan.camera)

        def take(data: Any, log_time_ns: int) -> None:
            found = _tolerant(decode, data, None)
            if found is not None:
                self._decoder.camera = found

        return take

    def _first_camera(self, camera: TopicInfo, take: Callable[[Any, int], None]) -> None:
        """CameraInfo may have been published once, long before the part that is read."""
        for message in self._source.messages({camera.topic}):
            if message.channel == camera:
                take(message.data, message.log_time_ns)
                return
        raise NoScans(f"{camera.topic}: no message in the log, but the depth images need it")

    def _take_tf(self, topic: TopicInfo) -> Callable[[Any, int], None]:
        decode = decoder_for(topic)

        def take(data: Any, log_time_ns: int) -> None:
            edges: tuple[Transform, ...] = _tolerant(decode, data, ())
            for edge in edges:
                self._frames.add(edge, static=False, log_time_ns=log_time_ns)

        return take

    # --- giving scans out -----------------------------------------------------------------------------

    def _release(self) -> Iterator[Scan]:
        stamp_ns, _, log_time_ns, frame, data = heapq.heappop(self._waiting)
        if self._last_ns is not None and self._last_log_ns is not None:
            if stamp_ns == self._last_ns:
                self._skip(PointCloudError("stamp is a duplicate"))
                return
            if stamp_ns < self._last_ns:
                self._skip(PointCloudError("stamp goes back in time"))
                return
            ahead_ns = (stamp_ns - self._last_ns) - (log_time_ns - self._last_log_ns)
            if ahead_ns > _CLOCK_JUMP_NS:
                if not self._confirmed(stamp_ns):
                    self._skip(PointCloudError("stamp jumps"))
                    return
                self._log.note("the clock of the scans jumps forward within the log")
            elif stamp_ns - self._last_ns > _GAP_NS:
                self._log.note("the log has gaps of more than 5 s between scans")
        try:
            T_base_sensor = self._sensor_pose(frame, stamp_ns)
            scan = self._decoder.scan(data, stamp_ns, T_base_sensor, self._odometry_at(stamp_ns))
        except (PointCloudError, LimitExceeded) as error:
            self._skip(error)
            return
        except UnsupportedSchema as error:
            if self._good:
                self._skip(error)
                return
            raise UnsupportedSchema(f"{self._plan.scans.topic}: {error.message}", hint=error.hint) from error
        self._last_ns, self._last_log_ns = stamp_ns, log_time_ns
        self._good += 1
        self._log._scans_read += 1
        self._log._points_dropped += scan.dropped
        for note in self._decoder.notes:
            self._log.note(note)
        if not len(scan.points_m):
            self._log.note("some scans hold no returns at all")
        yield scan

    def _confirmed(self, stamp_ns: int) -> bool:
        """Whether the next scan is near `stamp_ns`, too: a clock that was set, not one wrong stamp."""
        return any(0 <= entry[0] - stamp_ns < _GAP_NS for entry in self._waiting)

    def _sensor_pose(self, frame: str, stamp_ns: int) -> F64:
        plan = self._plan
        if plan.sensor_is_base:
            # REP-103: what a camera sees is in optical axes; without tf nobody else turns them.
            optical = plan.choice.sensor == "depth" or frame.endswith("_optical") or "_optical_" in frame
            return T_BODY_OPTICAL if optical else np.eye(4)
        base = plan.choice.base_frame
        if frame != base and frame not in self._frames:
            raise self._frames.missing(frame, base)
        found = self._frames.lookup(base, frame, stamp_ns)
        if found is None:
            raise PointCloudError("tf is unknown at the stamp")
        return found

    def _odometry_at(self, stamp_ns: int) -> F64 | None:
        plan = self._plan
        if plan.odometry_frame is not None:
            return self._frames.lookup(plan.odometry_frame, plan.choice.base_frame, stamp_ns)
        if plan.odometry is None:
            return None
        found = self._track.at(stamp_ns)
        if found is None or self._T_child_base is None:
            return found
        return found @ self._T_child_base

    def _skip(self, error: Pc2GridError) -> None:
        self._bad += 1
        self._error = self._error or error
        self._source.losses.skip(error.message)
        if self._bad >= 10 and not self._good:
            raise self._mostly_bad()

    def _finish(self) -> None:
        topic = self._plan.scans.topic
        if self._count == 0:
            raise NoScans(
                f"{topic}: no scan {self._part}",
                hint=f"the log lasts {self._log.info.duration_s:.1f} s",
            )
        if self._good == 0 or 10 * self._bad > self._count:
            raise self._mostly_bad()

    def _mostly_bad(self) -> Pc2GridError:
        assert self._error is not None
        kind = PointCloudError if self._good == 0 else LogCorrupt
        return kind(
            f"{self._plan.scans.topic}: {self._bad} of {self._count} scans are unreadable: "
            f"{self._error.message}",
            hint=self._error.hint,
        )


def _is_static(topic: TopicInfo) -> bool:
    return topic.topic.endswith("tf_static")


def _tolerant(decode: Callable[[Any], Any], data: Any, otherwise: Any) -> Any:
    """Decode a message that only helps (tf, odometry); one that is too short counts as not there."""
    try:
        return decode(data)
    except PointCloudError:
        return otherwise


def _adapted(path: Path, error: Exception) -> Pc2GridError:
    """The one place where exceptions of the reading stack become ours."""
    if isinstance(error, Pc2GridError):
        return error
    if isinstance(error, OSError):
        return LogCorrupt(f"{path}: cannot be read: {error.strerror or error}")
    return LogCorrupt(
        f"{path}: damaged ({type(error).__name__}: {' '.join(str(error).split())[:120]})",
        hint="--recover reads what is whole",
    )


def _guarded(path: Path, action: Callable[[], Any]) -> Any:
    try:
        return action()
    except MemoryError:
        raise
    except Exception as error:
        ours = _adapted(path, error)
        if ours is error:
            raise
        raise ours from error


def _guarded_stream(path: Path, stream: Iterator[Scan]) -> Iterator[Scan]:
    """The same for a generator; exceptions thrown in by its consumer never pass through here."""
    while True:
        try:
            scan = next(stream)
        except StopIteration:
            return
        except MemoryError:
            raise
        except Exception as error:
            ours = _adapted(path, error)
            if ours is error:
                raise
            raise ours from error
        yield scan
