"""One pass over a part of a log: scans sorted by stamp, each with the sensor's pose and the odometry."""

from __future__ import annotations

import functools
import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pc2grid.arrays import F64
from pc2grid.config import ReadConfig
from pc2grid.errors import (
    LimitExceeded,
    LogCorrupt,
    NoScans,
    Pc2GridError,
    PointCloudError,
    UnsupportedSchema,
)
from pc2grid.geometry import invert_pose
from pc2grid.io import topics
from pc2grid.io.attitude import Attitude
from pc2grid.io.frames import FrameTree, PoseTrack
from pc2grid.io.further_scans import FurtherScans, together
from pc2grid.io.message_source import MessageSource, RawMessage, Tally, TopicInfo
from pc2grid.io.messages.decoders import decoder_for
from pc2grid.io.messages.types import Imu, Odometry, ScanMessage, Transform
from pc2grid.io.read_plan import Plan, is_static, registered, tolerant
from pc2grid.io.sensors.depth import T_BODY_OPTICAL
from pc2grid.io.sensors.scan_decoder import ScanDecoder
from pc2grid.model import Scan
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True)
class StreamParameters:
    """How scans are sorted, and which stamps are reported or refused; chosen by hand.

    wait_ns : log time for which a scan waits for later odometry and for scans with earlier stamps.
    max_waiting, max_waiting_bytes : scans that wait at the same time.
    margin_ns : log time in front of and behind the wanted part, read for tf and odometry.
    clock_jump_ns : a stamp that runs ahead of the time of recording by more needs a second one near it.
    gap_ns : a longer time between two scans is reported.
    patience : number of undecodable scans, with no other before them, at which reading stops.
    max_bad_share : share of undecodable scans above which the log counts as damaged.
    eager : a scan waits no longer than until the odometry for all of its points is known.
    sweep_ns : time from the stamp of a scan to its last point, until a scan has times of its points; a lidar
    turns ten times a second.
    """

    wait_ns: int = 500_000_000
    max_waiting: int = 256
    max_waiting_bytes: int = 128_000_000
    margin_ns: int = 1_000_000_000
    clock_jump_ns: int = 60_000_000_000
    gap_ns: int = 5_000_000_000
    patience: int = 10
    max_bad_share: float = 0.1
    eager: bool = False
    sweep_ns: int = 100_000_000


PARAMETERS = StreamParameters()
_FLOOR_BELOW_M, _FLOOR_SHARE = 0.05, 0.01
"""A sensor sees so much of its points below itself, as far as the floor is not at its own height; by hand."""
_MOST_PERIODS = 1.1  # that the beams of a laser's scan take; stamps jitter
_UP = math.cos(math.radians(45.0))  # an axis that points more upwards than this
_EMPTY_HINT = (
    "is the sensor covered, or the unit of its ranges wrong? metres are expected; another topic: --topic"
)


class _Waiting(NamedTuple):
    """A scan that waits; scans with equal stamps are sorted by their number in the log."""

    stamp_ns: int
    number: int
    log_time_ns: int
    size_bytes: int
    message: ScanMessage


class Part:
    """The part of the log that is read, how many of its scans could be decoded, and their returns.

    start_ns, end_ns : log times of its scans; None: from the first one on, to the last one.
    """

    def __init__(
        self, start_ns: int | None = None, end_ns: int | None = None, name: str = "", length_s: float = 0.0
    ) -> None:
        """name, length_s : for errors, which seconds of how many are wanted."""
        self.start_ns, self.end_ns = start_ns, end_ns
        self._name, self._length_s = name, length_s
        self.count = self.good = self.returns = self._bad = 0
        self._error: Pc2GridError | None = None

    def holds(self, log_time_ns: int) -> bool:
        """Whether a scan recorded then is wanted."""
        return (self.start_ns is None or log_time_ns >= self.start_ns) and (
            self.end_ns is None or log_time_ns < self.end_ns
        )

    def skipped(self, error: Pc2GridError, topic: str, patience: int) -> None:
        """Count a scan that cannot be used. Raises after too many from the beginning on."""
        self._bad += 1
        self._error = self._error or error
        if self._bad >= patience and not self.good:
            raise self._mostly_bad(topic)

    def finish(self, topic: str, max_bad_share: float, empty: str) -> None:
        """Raises NoScans if there were none or all were empty, LogCorrupt or PointCloudError if too many were
        bad.

        empty : why the last empty scan was so.
        """
        if self.count == 0:
            hint = f"the log lasts {self._length_s:.1f} s"
            raise NoScans(f"{topic}: no scan {self._name}".rstrip(), hint=hint)
        if self.good == 0 or self._bad > max_bad_share * self.count:
            raise self._mostly_bad(topic)
        if not self.returns:
            raise NoScans(f"{topic}: none of {self.good} scans holds a return: {empty}", hint=_EMPTY_HINT)

    def _mostly_bad(self, topic: str) -> Pc2GridError:
        assert self._error is not None
        kind = PointCloudError if self.good == 0 else LogCorrupt
        return kind(
            f"{topic}: {self._bad} of {self.count} scans are unreadable: {self._error.message}",
            hint=self._error.hint,
        )


class _Queue:
    """Scans that wait, the earliest stamp first."""

    def __init__(self) -> None:
        self.scans: list[_Waiting] = []
        self.size_bytes = 0

    def push(self, scan: _Waiting) -> None:
        """Add a scan."""
        heapq.heappush(self.scans, scan)
        self.size_bytes += scan.size_bytes

    def pop(self) -> _Waiting:
        """Take the scan with the earliest stamp."""
        scan = heapq.heappop(self.scans)
        self.size_bytes -= scan.size_bytes
        return scan


class _Stamps:
    """Whether stamps go on; compared with the time of recording.

    last_ns, last_log_ns : of the last scan that was used. out_of_time : see Stream.
    """

    def __init__(self, parameters: StreamParameters, tally: Tally) -> None:
        self._parameters, self._tally = parameters, tally
        self.last_ns: int | None = None
        self.last_log_ns = 0
        self.out_of_time = 0

    def used(self, stamp_ns: int, log_time_ns: int) -> None:
        """A scan was used."""
        self.last_ns, self.last_log_ns = stamp_ns, log_time_ns
        self.out_of_time = 0

    def check(self, stamp_ns: int, log_time_ns: int, waiting: Sequence[_Waiting]) -> None:
        """Compare a stamp with the one before. Raises PointCloudError for a scan to be skipped."""
        if self.last_ns is None:
            return
        if stamp_ns == self.last_ns:
            raise PointCloudError("stamp is a duplicate")
        if stamp_ns < self.last_ns:
            self.out_of_time += 1
            raise PointCloudError(
                "stamp goes back in time",
                hint="the stamps in the headers must increase: a topic for each sensor, and a clock that is "
                "not set while it is recorded; a part in which they do: --start and --duration",
            )
        ahead_ns = (stamp_ns - self.last_ns) - (log_time_ns - self.last_log_ns)
        if ahead_ns > self._parameters.clock_jump_ns:
            # If the next scan is near this stamp, too, the clock was set; else this one stamp is wrong.
            if not any(0 <= entry.stamp_ns - stamp_ns < self._parameters.gap_ns for entry in waiting):
                self.out_of_time += 1
                raise PointCloudError("stamp jumps")
            self._tally.warn("the clock of the scans jumps forward within the log")
        elif stamp_ns - self.last_ns > self._parameters.gap_ns:
            self._tally.warn("the log has gaps of more than 5 s between scans")


class _Poses:
    """The poses of the sensors on the robot, and of the robot in the odometry frame, by time.

    frame : the parent frame of the odometry, such as `odom`; None as long as it is not known.
    """

    def __init__(self, plan: Plan, frames: FrameTree, tally: Tally) -> None:
        self._plan, self._frames, self._tally = plan, frames, tally
        self._track = PoseTrack()
        self._T_child_base: F64 | None = None
        model = SENSOR_MODELS[plan.choice.sensor]
        self._images, self._planar = model.image, model.planar
        self._attitude = Attitude()
        self._imu_frame = ""
        self.frame = plan.odometry_frame

    def take_odometry(self, topic: TopicInfo) -> Callable[[Any, int], None]:
        """What takes in the messages of the topic of the odometry."""
        decode = decoder_for(topic)

        def take(data: Any, log_time_ns: int) -> None:
            found: Odometry | None = tolerant(decode, data, None)
            if found is None or not self._track.add(found.header.stamp_ns or log_time_ns, found.pose):
                self._tally.warn("some odometry messages are unreadable or not finite, and were ignored")
            elif self._T_child_base is None:
                self._T_child_base = self._child_to_base(found.child)
                self.frame = found.header.frame or None

        return take

    def take_imu(self, topic: TopicInfo) -> Callable[[Any, int], None]:
        """What takes in the messages of the topic of the IMU."""
        decode = decoder_for(topic)

        def take(data: Any, log_time_ns: int) -> None:
            found: Imu | None = tolerant(decode, data, None)
            if found is None:
                self._tally.warn("some IMU messages are unreadable or not finite, and were ignored")
                return
            self._imu_frame = found.header.frame
            self._attitude.add(found, found.header.stamp_ns or log_time_ns)

        return take

    def take_tf(self, topic: TopicInfo) -> Callable[[Any, int], None]:
        """What takes in the messages of a topic of moving transforms."""
        decode = decoder_for(topic)

        def take(data: Any, log_time_ns: int) -> None:
            edges: tuple[Transform, ...] | None = tolerant(decode, data, None)
            self._frames.add_all(edges, log_time_ns=log_time_ns)

        return take

    def _child_to_base(self, child: str) -> F64:
        """`T_child_base` of the odometry's child frame; identity if it is the base, or not in tf."""
        base, frames = self._plan.choice.base_frame, self._frames
        if not child or child == base or self._plan.sensor_is_base:
            return np.eye(4)
        known = child in frames and base in frames
        if known and frames.connected(child, base) and not frames.moving(child, base):
            found = frames.lookup(child, base, 0)
            return np.eye(4) if found is None else found
        self._tally.warn(f"the odometry is of frame {child}, which is taken for {base}")
        return np.eye(4)

    def newest_ns(self) -> int | None:
        """The stamp up to which odometry is known; 0 if none has arrived, None if there is none at all."""
        plan = self._plan
        if plan.odometry_frame is not None:
            return self._frames.newest_ns(plan.odometry_frame, plan.choice.base_frame)
        return None if plan.odometry is None else self._track.newest_ns

    def complete_ns(self) -> int | None:
        """The stamp up to which odometry or, without it, the IMU is known; as `newest_ns`."""
        newest_ns = self.newest_ns()
        return self._attitude.newest_ns if newest_ns is None and self._plan.imu is not None else newest_ns

    def odometry(self, stamp_ns: int) -> F64 | None:
        """`T_odom_base` (4, 4) at a time; None if it is not known."""
        plan = self._plan
        if plan.odometry_frame is not None:
            return self._frames.lookup(plan.odometry_frame, plan.choice.base_frame, stamp_ns)
        if plan.odometry is None:
            return None
        found = self._track.at(stamp_ns)
        if found is None or self._T_child_base is None:
            return found
        return found @ self._T_child_base

    def longest_gap_ns(self, begin_ns: int, end_ns: int) -> int:
        """The longest time without a reading of odometry between two times."""
        plan = self._plan
        if plan.odometry_frame is None:
            return self._track.longest_gap_ns(begin_ns, end_ns)
        return self._frames.longest_gap_ns(plan.odometry_frame, plan.choice.base_frame, begin_ns, end_ns)

    def level(self, stamp_ns: int) -> F64 | None:
        """`T_level_base` (4, 4) at a time, see `Scan`; None if there is no IMU, or it does not tell."""
        if not self._attitude.received:
            return None
        T_level_imu = self._attitude.at(stamp_ns)
        if T_level_imu is None:
            self._tally.warn(
                "the IMU does not say at all scans which way is up: it must measure accelerations of about "
                "9.81 m/s2 at their stamps"
            )
            return None
        T_imu_base = invert_pose(self.sensor(self._imu_frame, stamp_ns))
        T_imu_base[:3, 3] = 0.0
        return T_level_imu @ T_imu_base

    def points(self, frame: str, stamp_ns: int) -> F64:
        """`T_base_points` (4, 4) of points in a frame: that of the sensor, or a fixed one.

        Raises FrameError, PointCloudError.
        """
        base, frames = self._plan.choice.base_frame, self._frames
        fixed = self._plan.mounted is not None
        if not fixed or (base in frames and frame in frames and frames.connected(base, frame)):
            return self.sensor(frame, stamp_ns)
        T_fixed_base = self.odometry(stamp_ns)
        if T_fixed_base is None:
            raise PointCloudError("odometry is unknown at the stamp")
        return invert_pose(T_fixed_base)

    def sensor(self, frame: str, stamp_ns: int) -> F64:
        """`T_base_sensor` (4, 4) of the sensor with this frame. Raises FrameError, PointCloudError."""
        if self._plan.sensor_is_base:
            # REP-103: images are in optical axes (z forward); without tf they are turned here. A LaserScan is
            # by its definition in the x-y plane of its frame, whatever the frame is called.
            named = frame.endswith("_optical") or "_optical_" in frame
            optical = self._images or (named and not self._planar)
            return T_BODY_OPTICAL if optical else np.eye(4)
        base = self._plan.choice.base_frame
        if frame != base and frame not in self._frames:
            raise self._frames.missing(frame, base)
        found = self._frames.lookup(base, frame, stamp_ns)
        if found is None:
            raise PointCloudError("tf is unknown at the stamp")
        of_images = self._images and frame != self._imu_frame
        if of_images and "optical" not in frame and found[2, 2] > _UP:
            self._tally.warn(
                f"the images are in frame {frame}, whose z axis points up, where that of a camera points "
                "forward (REP-103): x is taken for forward; correct it to the camera's optical frame"
            )
            return found @ T_BODY_OPTICAL
        return found


class Stream:
    """One pass, to be run once; it counts in the source's tally what is read and what is lost."""

    def __init__(
        self,
        source: MessageSource,
        config: ReadConfig,
        frames: FrameTree,
        plan: Plan,
        part: Part | None = None,
        parameters: StreamParameters | None = None,
    ) -> None:
        """part : of the recording; None: all of it."""
        self._source, self._plan = source, plan
        self._parameters = parameters = parameters or PARAMETERS
        self._part = part or Part()
        sensor = plan.choice.sensor
        self._decoder = self._decoder_of(plan.scans, plan.camera, config)
        self._further = [
            FurtherScans(t, camera, self._decoder_of(t, camera, config)) for t, camera in plan.further
        ]
        self._poses = _Poses(plan, frames, source.tally)
        self._stamps = _Stamps(parameters, source.tally)
        self._waiting = _Queue()
        self._last_read_ns: int | None = None  # stamp of the last scan with odometry
        self._sweep_ns = 0 if SENSOR_MODELS[sensor].image else parameters.sweep_ns
        self._handlers = self._make_handlers()

    def _decoder_of(self, topic: TopicInfo, camera: TopicInfo | None, config: ReadConfig) -> ScanDecoder:
        return ScanDecoder(
            topic.topic,
            self._plan.choice.sensor,
            decoder_for(topic),
            config,
            camera_topic="" if camera is None else camera.topic,
            depth_unit_m=self._plan.depth_unit_m,
            fixed_frame=self._plan.mounted is not None,
        )

    def _make_handlers(self) -> dict[TopicInfo, Callable[[Any, int], None]]:
        """By topic, what takes in its messages. Reads the first CameraInfo of the source."""
        plan = self._plan
        on: dict[TopicInfo, Callable[[Any, int], None]] = {plan.scans: self._take_scan}
        of_motion = (plan.odometry, self._poses.take_odometry), (plan.imu, self._poses.take_imu)
        on.update((topic, take(topic)) for topic, take in of_motion if topic is not None)
        on.update((f.topic, functools.partial(self._take_further, f)) for f in self._further)
        for camera, decoder in (
            (plan.camera, self._decoder),
            *((further.camera, further.decoder) for further in self._further),
        ):
            if camera is not None and camera not in on:
                on[camera] = _take_camera(camera, decoder)
                self._first_camera(camera, on[camera])
        if plan.tf_moves:
            tf = [t for t in self._source.info.topics if t.type in topics.TF and not is_static(t)]
            on.update((topic, self._poses.take_tf(topic)) for topic in tf)
        return on

    def run(self) -> Iterator[Scan]:
        """Yield the scans of the source. Raises as `Log.scans` says."""
        margin_ns, part = self._parameters.margin_ns, self._part
        low = None if part.start_ns is None else max(part.start_ns - margin_ns, 0)
        high = None if part.end_ns is None else part.end_ns + margin_ns
        for message in self._source.messages(self.topics, low, high):
            yield from self.take(message)
        yield from self.release_all()
        part.finish(self._plan.scans.topic, self._parameters.max_bad_share, self._decoder.empty)
        if self._last_read_ns is None and self._plan.choice.odometry_topic is not None:
            self._source.tally.warn(
                f"no scan has odometry: that from {self._plan.choice.odometry_topic} is of other times"
            )

    def take(self, message: RawMessage) -> Iterator[Scan]:
        """Take in one message, and yield the scans that need not wait any longer."""
        take = self._handlers.get(message.channel)
        if take is not None:
            take(message.data, message.log_time_ns)
        while self._waiting.scans and self._is_due(self._waiting.scans[0], message.log_time_ns):
            yield from self._release()

    def absorb(self, message: RawMessage) -> None:
        """Take in a message of odometry or tf before its turn; it may be given to `take` as well."""
        scans = (self._plan.scans, *(further.topic for further in self._further))
        if message.channel not in scans and message.channel in self._handlers:
            self._handlers[message.channel](message.data, message.log_time_ns)

    @property
    def out_of_time(self) -> int:
        """Number of scans in a row that were skipped because their stamps go back or jump."""
        return self._stamps.out_of_time

    @property
    def last_log_ns(self) -> int:
        """The log time of the last scan that was yielded; 0 before the first one."""
        return self._stamps.last_log_ns

    @property
    def topics(self) -> frozenset[str]:
        """The topics whose messages are used."""
        return frozenset(topic.topic for topic in self._handlers)

    def release_all(self) -> Iterator[Scan]:
        """Yield the scans that wait: nothing more will come."""
        while self._waiting.scans:
            yield from self._release()

    def _is_due(self, first: _Waiting, now_ns: int) -> bool:
        p = self._parameters
        return (
            now_ns - first.log_time_ns > p.wait_ns
            or len(self._waiting.scans) > p.max_waiting
            or self._waiting.size_bytes > p.max_waiting_bytes
            or (p.eager and self._all_is_there(first.stamp_ns))
        )

    def _all_is_there(self, stamp_ns: int) -> bool:
        """Whether what belongs to a scan has arrived: those of further sensors, and odometry or an IMU if
        there is any."""
        if any(further.newest_ns < stamp_ns for further in self._further):
            return False
        newest_ns = self._poses.complete_ns()
        needed_ns = [stamp_ns + self._sweep_ns, *(f.nearest_ns(stamp_ns) for f in self._further)]
        return newest_ns is None or newest_ns >= max(needed_ns)

    def newest_odometry_ns(self) -> int | None:
        """The stamp up to which odometry is known; 0 if none has arrived, None if there is none at all."""
        return self._poses.newest_ns()

    def newest_odometry(self) -> tuple[int, F64] | None:
        """The newest stamp of the odometry and `T_odom_base` (4, 4) there; None if there is none."""
        newest_ns = self._poses.newest_ns()
        pose = self._poses.odometry(newest_ns) if newest_ns else None
        return None if pose is None or newest_ns is None else (newest_ns, pose)

    @property
    def odometry_frame(self) -> str | None:
        """The parent frame of the odometry, such as `odom`; None as long as it is not known."""
        return self._poses.frame

    # --- decoding messages ----------------------------------------------------------------------------

    def _take_scan(self, data: Any, log_time_ns: int) -> None:
        if not self._part.holds(log_time_ns):
            return
        self._part.count += 1
        try:
            message = self._decoder.message(data)
            stamp_ns = self._stamp_of(message, log_time_ns)
        except Pc2GridError as error:
            self._skip(error)
            return
        size = max(len(data), message.size_bytes)
        self._waiting.push(_Waiting(stamp_ns, self._part.count, log_time_ns, size, message))

    def _stamp_of(self, message: ScanMessage, log_time_ns: int) -> int:
        """The stamp of a scan. Raises PointCloudError for one that is none."""
        stamp_ns = message.header.stamp_ns
        if self._plan.stampless:
            self._source.tally.warn("the stamps of the scans are zero: the time of recording is used instead")
            stamp_ns = log_time_ns
        elif stamp_ns <= 0:
            raise PointCloudError("stamp is zero or negative")
        if stamp_ns >= 1 << 63:
            raise PointCloudError("stamp is past the year 2262")
        return stamp_ns

    def _take_further(self, further: FurtherScans, data: Any, log_time_ns: int) -> None:
        try:
            further.take(data)
        except Pc2GridError as error:
            self._source.tally.skip(f"{further.topic.topic}: {error.message}")

    def _first_camera(self, camera: TopicInfo, take: Callable[[Any, int], None]) -> None:
        """Take the first CameraInfo of the log: it may have been published only once, at the beginning."""
        for message in self._source.messages({camera.topic}):
            if message.channel == camera:
                take(message.data, message.log_time_ns)
                return
        raise NoScans(f"{camera.topic}: no message in the log, but the depth images need it")

    # --- yielding scans -------------------------------------------------------------------------------

    def _release(self) -> Iterator[Scan]:
        """Yield the waiting scan with the earliest stamp, unless it is skipped."""
        stamp_ns, _, log_time_ns, _, message = self._waiting.pop()
        try:
            self._stamps.check(stamp_ns, log_time_ns, self._waiting.scans)
            T_base_points = self._poses.points(message.header.frame, stamp_ns)
            scan = self._decoder.scan(message, stamp_ns, T_base_points, self._poses.odometry(stamp_ns))
            scan = self._within_period(scan)
            if self._plan.mounted is not None:
                scan = self._measured(scan, self._plan.mounted)
            scan = replace(
                scan, T_level_base=self._poses.level(stamp_ns), odometry_gap_s=self._odometry_gap_s(stamp_ns)
            )
            scan = self._with_motion(self._with_further(scan))
        except (PointCloudError, LimitExceeded) as error:
            self._skip(error)
            return
        except UnsupportedSchema as error:
            if self._part.good:
                self._skip(error)
                return
            raise UnsupportedSchema(f"{self._plan.scans.topic}: {error.message}", hint=error.hint) from error
        self._stamps.used(stamp_ns, log_time_ns)
        if scan.T_odom_base is not None:
            self._last_read_ns = stamp_ns
        self._part.good += 1
        tally = self._source.tally
        tally.scans_read += 1
        tally.points_dropped += scan.dropped
        for note in self._decoder.notes:
            tally.warn(note)
        self._part.returns += len(scan.points_m)
        yield scan

    def _within_period(self, scan: Scan) -> Scan:
        """A scan of a laser without the times of its beams, if these last longer than until the next scan."""
        longest_s, offsets_s = _MOST_PERIODS * self._plan.period_ns * 1e-9, scan.offsets_s
        if not SENSOR_MODELS[scan.sensor].planar or offsets_s is None or not len(offsets_s) or not longest_s:
            return scan
        if np.ptp(offsets_s) <= longest_s:
            return scan
        self._source.tally.warn(
            "time_increment makes scans longer than the time from one to the next: it is ignored"
        )
        return replace(scan, offsets_s=None)

    def _measured(self, scan: Scan, mounted: str) -> Scan:
        """A scan whose points were in a fixed frame, as one that the sensor with a frame measured.

        Raises FrameError if it cannot have been where tf puts it.
        """
        T_base_sensor = self._poses.sensor(mounted, scan.stamp_ns)
        seen = scan.points_m[:, 2] < T_base_sensor[2, 3] - _FLOOR_BELOW_M
        if len(seen) and not self._part.returns and np.mean(seen) < _FLOOR_SHARE:
            raise registered(self._plan.choice.sensor_frame or "")
        return replace(scan, T_base_sensor=T_base_sensor, offsets_s=None)

    def _odometry_gap_s(self, stamp_ns: int) -> float:
        """The longest time without odometry since the last scan that has a reading; infinite if none has."""
        if self._last_read_ns is None:
            return math.inf
        return 1e-9 * self._poses.longest_gap_ns(self._last_read_ns, stamp_ns)

    def _with_further(self, scan: Scan) -> Scan:
        """The scan together with those of the further sensors that are near in time."""
        tally, found = self._source.tally, []
        for further in self._further:
            try:
                near = further.near(scan.stamp_ns, self._poses.sensor, self._poses.odometry)
            except (PointCloudError, LimitExceeded) as error:
                tally.skip(f"{further.topic.topic}: {error.message}")
                continue
            if near is None:
                tally.skip(f"{further.topic.topic}: no scan near the first sensor's")
            else:
                found.append(near)
        return together(scan, found) if found else scan

    def _with_motion(self, scan: Scan) -> Scan:
        """The scan with the motion from its first to its last point, if there is odometry at both, or with
        the turn by an IMU."""
        if scan.offsets_s is None or not len(scan.offsets_s):
            self._sweep_ns = 0
            return scan
        times_s = float(scan.offsets_s.min()), float(scan.offsets_s.max())
        self._sweep_ns = max(round(times_s[1] * 1e9), 0)
        if scan.T_odom_base is None and scan.T_level_base is None:
            return scan
        pose_at = self._poses.level if scan.T_odom_base is None else self._poses.odometry
        first, last = (pose_at(scan.stamp_ns + round(time_s * 1e9)) for time_s in times_s)
        if first is None or last is None:
            return scan
        return replace(scan, T_first_last=invert_pose(first) @ last)

    def _skip(self, error: Pc2GridError) -> None:
        self._source.tally.skip(error.message)
        self._part.skipped(error, self._plan.scans.topic, self._parameters.patience)


def _take_camera(camera: TopicInfo, decoder: ScanDecoder) -> Callable[[Any, int], None]:
    """What takes in the calibrations of a camera."""
    decode = decoder_for(camera)

    def take(data: Any, log_time_ns: int) -> None:
        found = tolerant(decode, data, None)
        if found is not None:
            decoder.camera = found

    return take
