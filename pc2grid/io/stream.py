"""One pass over a part of a log: scans sorted by stamp, each with the sensor's pose and the odometry.

Scans of further sensors, such as a second laser or three more cameras, are taken at about the same time as
those of the first. Each has a frame and a place on the robot of its own, and mostly a topic. Their points
become part of the first sensor's scan that is nearest in time (`FurtherScans`, `together`).
"""

from __future__ import annotations

import functools
import heapq
import itertools
import math
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pc2grid.errors import (
    LimitExceeded,
    LogCorrupt,
    NoScans,
    Pc2GridError,
    PointCloudError,
    UnsupportedSchema,
)
from pc2grid.geometry import F32, F64, invert_pose
from pc2grid.io.frames import PARAMETERS as FRAMES, Attitude, FrameTree, PoseTrack
from pc2grid.io.map_pose import BelievedPose
from pc2grid.io.messages.types import CameraInfo, Imu, ScanMessage, StampedPose, Transform
from pc2grid.io.plan import Plan, Sensor, registered
from pc2grid.io.sensors.decode import MOST_TURNS, ScanDecoder
from pc2grid.io.sensors.depth import T_BODY_OPTICAL
from pc2grid.io.source import GAP_NS, LIDAR_PERIOD_NS, MessageSource, RawMessage, Tally, TopicInfo
from pc2grid.io.topics import FIRST, decoder_for, tolerant
from pc2grid.model import SENSOR_MODELS, Scan
from pc2grid.settings import ReadConfig


@dataclass(frozen=True, slots=True)
class StreamParameters:
    """How scans are sorted, and when reading stops; chosen by hand.

    wait_ns : log time for which a scan waits for later odometry and for scans with earlier stamps.
    max_waiting, max_waiting_bytes : scans that wait at the same time.
    patience : number of undecodable scans, with no other before them, at which reading stops.
    max_bad_share : share of undecodable scans above which the log counts as damaged.
    eager : a scan waits no longer than until the odometry for all of its points is known.
    """

    wait_ns: int = 500_000_000
    max_waiting: int = 256
    max_waiting_bytes: int = 256_000_000
    patience: int = 10
    max_bad_share: float = 0.1
    eager: bool = False


PARAMETERS = StreamParameters()
_FLOOR_BELOW_M, _FLOOR_SHARE = 0.05, 0.01
"""At least this share of the points lies so far below the sensor, unless the floor is at its height; by
hand."""
_UP = math.cos(math.radians(45.0))  # an axis that points more upwards than this
_EMPTY_HINT = (
    "is the sensor covered, or the unit of its ranges wrong? metres are expected; another topic: --topic"
)


class Stream:
    """One pass, to be run once; it counts in the source's tally what is read and what is lost.

    poses : by what has been read so far. stamps : of the scans that were yielded. believed : gets all
    messages that are read, among them those of its topics, if there is one.
    """

    believed: BelievedPose | None = None

    def __init__(
        self,
        source: MessageSource,
        config: ReadConfig,
        frames: FrameTree,
        plan: Plan,
        part: LogPart | None = None,
        parameters: StreamParameters | None = None,
    ) -> None:
        """Prepare the pass. part : of the recording; None: all of it."""
        self._source, self._plan = source, plan
        self._parameters = parameters or PARAMETERS
        self._part = part or LogPart()
        self._config = config
        self._decode = {sensor.topic: decoder_for(sensor.topic) for sensor in plan.sensors}
        self._decoders: dict[_Of, ScanDecoder] = {}
        first, *further = plan.sensors
        self._lead: _Of = (first.topic, first.frame)
        self._alone_ns: int | None = None  # log time of the first scan of another sensor since the last of it
        self._further: dict[_Of, FurtherScans] = {}
        self._decoder_of(self._lead)
        for sensor in further:
            self._add((sensor.topic, sensor.frame), silent=sensor.silent)
        self.poses = Poses(plan, frames, source.tally)
        self.stamps = _Stamps(source.tally)
        self._waiting: list[Received] = []
        self._last_read_ns: int | None = None  # stamp of the last scan with odometry
        # From a stamp to the last point: until it is known, a lidar may turn until the next stamp.
        self._sweep_ns = 0 if SENSOR_MODELS[plan.choice.sensor].image else plan.period_ns
        self._handlers = self._make_handlers()

    def _make_handlers(self) -> dict[TopicInfo, Callable[[Any, int], None]]:
        """Return by topic the function that takes its messages."""
        plan, poses = self._plan, self.poses
        decoded: list[tuple[TopicInfo | None, Callable[[Any, int], None]]] = [
            (plan.odometry, poses.take_odometry),
            (plan.imu, poses.take_imu),
            *((s.camera, functools.partial(self._take_camera, s.camera)) for s in plan.sensors),
            *((topic, poses.take_tf) for topic in plan.moving_tf),
        ]
        return {
            **{topic: functools.partial(self._take_scan, topic) for topic in self._decode},
            **{topic: _decoding(topic, take) for topic, take in decoded if topic is not None},
        }

    @property
    def topics(self) -> frozenset[str]:
        """Return the topics whose messages are used."""
        used = {topic.topic for topic in self._handlers}
        return frozenset(used if self.believed is None else used | self.believed.topics)

    def run(self) -> Iterator[Scan]:
        """Yield the scans of the source. Raises as `Log.scans` says."""
        for message in self._source.messages(self.topics, *self._part.with_margin()):
            yield from self.take(message)
        yield from self.release_all()
        p = self._parameters
        self._part.finish(self._lead[0].topic, p.max_bad_share, self._decoder_of(self._lead).empty)
        if self._last_read_ns is None and self._plan.choice.odometry_topic is not None:
            self._source.tally.warn(
                f"no scan has odometry: that from {self._plan.choice.odometry_topic} is of other times"
            )

    def take(self, message: RawMessage) -> Iterator[Scan]:
        """Add one message, and yield the scans that need not wait any longer."""
        take = self._handlers.get(message.channel)
        if take is not None:
            take(message.data, message.log_time_ns)
        if self.believed is not None:
            self.believed.take(message)
        while self._waiting and self._is_due(self._waiting[0], message.log_time_ns):
            yield from self._release()

    def release_all(self) -> Iterator[Scan]:
        """Yield the scans that wait: nothing more will come."""
        while self._waiting:
            yield from self._release()

    def _is_due(self, first: Received, now_ns: int) -> bool:
        p, waiting = self._parameters, self._waiting
        return (
            now_ns - first.log_time_ns > p.wait_ns
            or len(waiting) > p.max_waiting
            or sum(entry.size_bytes for entry in waiting) > p.max_waiting_bytes
            or (p.eager and self._all_is_there(first.stamp_ns))
        )

    def _all_is_there(self, stamp_ns: int) -> bool:
        """Return whether everything that belongs to a scan has arrived: scans of further sensors, odometry,
        or an IMU."""
        further_ns = [further.newest_ns for further in self._placed() if not further.silent]
        known_ns = self.poses.complete_ns()
        needed_ns = max([stamp_ns + self._sweep_ns, *further_ns])
        return all(t >= stamp_ns for t in further_ns) and (known_ns is None or known_ns >= needed_ns)

    # --- decoding messages ----------------------------------------------------------------------------

    def _take_scan(self, topic: TopicInfo, data: Any, log_time_ns: int) -> None:
        leads = topic == self._lead[0]
        if leads and not self._part.holds(log_time_ns):
            return
        try:
            message: ScanMessage = self._decode[topic](data)
            sensor = topic, message.header.frame
            if sensor in self._plan.left_out:
                return
            if self._lead == (topic, None):
                self._lead = sensor
            leads = sensor == self._lead
            stamp_ns = self._stamp_of(message, log_time_ns)
            camera = self._decoder_of(sensor).camera
            scan = Received(stamp_ns, 0, log_time_ns, len(data), message, sensor, camera)
            if leads:
                self._queue(scan)
            else:
                self._take_further(scan)
        except Pc2GridError as error:
            if leads:
                self._part.count += 1
                self._skip(error)
            else:
                self._source.tally.skip(f"{topic.topic}: {error.message}")

    def _queue(self, scan: Received) -> None:
        """Add a scan of the first sensor to those that wait."""
        self._alone_ns = None
        self._part.count += 1
        heapq.heappush(self._waiting, scan._replace(number=self._part.count))

    def _take_further(self, scan: Received) -> None:
        """Keep a scan for the first sensor's; if that has none for long, this sensor takes its place."""
        sensor = scan.sensor
        if sensor not in self._further:
            if len(self._further) >= FIRST:  # against hostile files
                raise PointCloudError(f"scans in more than {FIRST + 1} frames")
            name = self._add(sensor).name
            if sensor not in ((s.topic, s.frame) for s in self._plan.sensors):
                self._source.tally.warn(f"{name}: scans that began later are of a further sensor")
        further = self._further[sensor]
        further.take(scan)
        if self._alone_ns is None:
            self._alone_ns = scan.log_time_ns
        if further.silent or scan.log_time_ns - self._alone_ns <= FRAMES.max_gap_ns:
            return
        self._source.tally.warn(f"{further.name}: these scans go on alone where the first sensor has none")
        self._lead = sensor
        for kept in self._further.pop(sensor).unused():
            self._queue(kept)

    def _placed(self) -> Collection[FurtherScans]:
        """Return the further sensors, if their places on the robot are known."""
        return () if self._plan.sensor_is_base else self._further.values()

    def _add(self, sensor: _Of, *, silent: bool = False) -> FurtherScans:
        """Add a sensor whose scans are put together with those of the first."""
        topic, frame = sensor
        self._further.pop((topic, None), None)
        of_topic = [s.topic for s in self._plan.sensors].count(topic) > 1 or topic == self._lead[0]
        name = topic.topic + (f" in frame {frame}" if of_topic else "")
        self._further[sensor] = FurtherScans(name, self._decoder_of(sensor), silent=silent)
        return self._further[sensor]

    def _sensor(self, of: _Of) -> Sensor:
        """Return the plan's entry for a sensor, or for another one on its topic if there is none."""
        alike = [sensor for sensor in self._plan.sensors if sensor.topic == of[0]]
        return next((sensor for sensor in alike if sensor.frame == of[1]), alike[0])

    def _decoder_of(self, of: _Of) -> ScanDecoder:
        if of not in self._decoders:
            self._decoders[of] = self._sensor(of).decoder(
                self._config,
                depth_unit_m=self._plan.depth_unit_m,
                fixed_frame=self._plan.mounted is not None,
                longest_s=MOST_TURNS * self._plan.period_ns * 1e-9 or math.inf,
            )
        return self._decoders[of]

    def _stamp_of(self, message: ScanMessage, log_time_ns: int) -> int:
        """Return the stamp of a scan. Raises PointCloudError for an invalid one."""
        stamp_ns = message.header.stamp_ns
        if self._plan.stampless:
            self._source.tally.warn("the stamps of the scans are zero: the time of recording is used instead")
            stamp_ns = log_time_ns
        if stamp_ns <= 0:
            raise PointCloudError("stamp is zero or negative")
        if stamp_ns >= 1 << 63:
            raise PointCloudError("stamp is past the year 2262")
        return stamp_ns

    def _take_camera(self, camera: TopicInfo | None, found: CameraInfo | None, log_time_ns: int) -> None:
        if found is None:
            return
        of_camera = {
            of: decoder for of, decoder in self._decoders.items() if self._sensor(of).camera == camera
        }
        frames = {frame for _, frame in of_camera}
        for (_, frame), decoder in of_camera.items():
            if found.header.frame == frame or found.header.frame not in frames:
                decoder.camera = found

    # --- yielding scans -------------------------------------------------------------------------------

    def _release(self) -> Iterator[Scan]:
        """Yield the waiting scan with the earliest stamp, unless it is skipped."""
        waiting = heapq.heappop(self._waiting)
        try:
            self.stamps.check(waiting.stamp_ns, waiting.log_time_ns, self._waiting)
            scan = self._scan(waiting)
        except UnsupportedSchema as error:
            if not self._part.good:
                raise UnsupportedSchema(f"{self._lead[0].topic}: {error.message}", hint=error.hint) from error
            self._skip(error)
            return
        except (PointCloudError, LimitExceeded) as error:
            self._skip(error)
            return
        self.stamps.used(waiting.stamp_ns, waiting.log_time_ns)
        if scan.T_odom_base is not None:
            self._last_read_ns = waiting.stamp_ns
        self._part.good += 1
        self._part.returns += len(scan.points_m)
        self._source.tally.scans_read += 1
        self._source.tally.points_dropped += scan.dropped
        for note in itertools.chain(*(decoder.notes for decoder in self._decoders.values())):
            self._source.tally.warn(note)
        yield scan

    def _scan(self, waiting: Received) -> Scan:
        """Return the scan with all that belongs to it. Raises as `ScanDecoder.scan` does, and FrameError."""
        stamp_ns, message = waiting.stamp_ns, waiting.message
        T_base_points = self.poses.sensor(message.header.frame, stamp_ns)
        decoder, T_odom_base = self._decoder_of(waiting.sensor), self.poses.odometry(stamp_ns)
        scan = decoder.scan(message, stamp_ns, T_base_points, T_odom_base, waiting.camera)
        if self._plan.mounted is not None:
            scan = self._measured(scan, self._plan.mounted)
        # Infinite before the first reading.
        gap_ns = math.inf
        if self._last_read_ns is not None:
            gap_ns = self.poses.longest_gap_ns(self._last_read_ns, stamp_ns)
        scan = replace(scan, T_level_base=self.poses.level(stamp_ns), odometry_gap_s=1e-9 * gap_ns)
        return self._with_motion(self._with_further(scan))

    def _measured(self, scan: Scan, mounted: str) -> Scan:
        """Return a scan with points in a fixed frame as one of the sensor with a frame.

        Raises FrameError if it cannot have been where tf puts it.
        """
        T_base_sensor = self.poses.sensor(mounted, scan.stamp_ns)
        seen = scan.points_m[:, 2] < T_base_sensor[2, 3] - _FLOOR_BELOW_M
        if len(seen) and not self._part.returns and np.mean(seen) < _FLOOR_SHARE:
            raise registered(self._plan.choice.sensor_frame or "")
        return replace(scan, T_base_sensor=T_base_sensor, offsets_s=None)

    def _with_further(self, scan: Scan) -> Scan:
        """Return the scan together with those of the further sensors that are near in time."""
        found = []
        for further in self._placed():
            try:
                near = further.near(scan.stamp_ns, self.poses.sensor, self.poses.odometry)
            except (PointCloudError, LimitExceeded) as error:
                self._source.tally.skip(f"{further.name}: {error.message}")
            else:
                found += [] if near is None else [near]
        return together(scan, found) if found else scan

    def _with_motion(self, scan: Scan) -> Scan:
        """Return the scan with the motion from its first to its last point.

        It is that of odometry, if there is any at both times, or the rotation by an IMU.
        """
        if scan.offsets_s is None or not len(scan.offsets_s):
            self._sweep_ns = 0
            return scan
        times_s = float(scan.offsets_s.min()), float(scan.offsets_s.max())
        self._sweep_ns = max(round(times_s[1] * 1e9), 0)
        if scan.T_odom_base is None and scan.T_level_base is None:
            return scan
        pose_at = self.poses.level if scan.T_odom_base is None else self.poses.odometry
        first, last = (pose_at(scan.stamp_ns + round(time_s * 1e9)) for time_s in times_s)
        if first is None or last is None:
            return scan
        return replace(scan, T_first_last=invert_pose(first) @ last)

    def _skip(self, error: Pc2GridError) -> None:
        self._source.tally.skip(error.message)
        self._part.skipped(error, self._lead[0].topic, self._parameters.patience)


_Of = tuple[TopicInfo, str | None]
"""Topic and frame of the scans of one sensor; None: a frame that is not known yet."""


def _decoding(topic: TopicInfo, take: Callable[[Any, int], None]) -> Callable[[Any, int], None]:
    """Return a function that decodes the messages of a topic and calls `take`; with None for undecodable
    ones."""
    decode = decoder_for(topic)
    return lambda data, log_time_ns: take(tolerant(decode, data), log_time_ns)


@dataclass(slots=True)
class LogPart:
    """A part of a log: log times of its scans; None: from the first one on, to the last one.

    name, log_s : for errors, which seconds of how many are wanted.
    count, good, bad, returns : number of scans that were found, that were yielded, that cannot be used;
    points of those yielded. error : why the first one cannot be used.
    """

    start_ns: int | None = None
    end_ns: int | None = None
    name: str = ""
    log_s: float = 0.0
    count: int = 0
    good: int = 0
    bad: int = 0
    returns: int = 0
    error: Pc2GridError | None = None

    def holds(self, log_time_ns: int) -> bool:
        """Return True if a scan recorded then is wanted."""
        return (self.start_ns or 0) <= log_time_ns and (self.end_ns is None or log_time_ns < self.end_ns)

    def with_margin(self) -> tuple[int | None, int | None]:
        """Return the log times between which odometry and tf are read: beyond these nothing is
        interpolated."""
        low_ns = None if self.start_ns is None else max(self.start_ns - FRAMES.max_gap_ns, 0)
        return low_ns, None if self.end_ns is None else self.end_ns + FRAMES.max_gap_ns

    def skipped(self, error: Pc2GridError, topic: str, patience: int) -> None:
        """Count a scan that cannot be used. Raises after too many from the beginning on."""
        self.bad += 1
        self.error = self.error or error
        if self.bad >= patience and not self.good:
            raise self._mostly_bad(topic, self.error)

    def finish(self, topic: str, max_bad_share: float, empty: str) -> None:
        """Raise NoScans, LogCorrupt or PointCloudError if the part is of no use.

        NoScans: there were no scans, or all were empty. LogCorrupt, PointCloudError: too many were bad. empty
        : reason of the last empty scan.
        """
        if self.count == 0:
            raise NoScans(f"{topic}: no scan{self.name}", hint=f"the log lasts {self.log_s:.1f} s")
        if self.error is not None and (self.good == 0 or self.bad > max_bad_share * self.count):
            raise self._mostly_bad(topic, self.error)
        if not self.returns:
            raise NoScans(f"{topic}: none of {self.good} scans holds a return: {empty}", hint=_EMPTY_HINT)

    def _mostly_bad(self, topic: str, error: Pc2GridError) -> Pc2GridError:
        kind = LogCorrupt if self.good else PointCloudError
        words = f"{topic}: {self.bad} of {self.count} scans are unreadable: {error.message}"
        return kind(words, hint=error.hint)


class _Stamps:
    """Checks whether stamps continue, by comparison with the time of recording.

    last_ns, last_log_ns : of the last scan that was used. out_of_time : number of scans in a row that were
    skipped because their stamps go back or jump.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self.last_ns: int | None = None
        self.last_log_ns = 0
        self.out_of_time = 0

    def used(self, stamp_ns: int, log_time_ns: int) -> None:
        """Set the times of the last scan that was used."""
        self.last_ns, self.last_log_ns = stamp_ns, log_time_ns
        self.out_of_time = 0

    def check(self, stamp_ns: int, log_time_ns: int, waiting: Sequence[Received]) -> None:
        """Compare a stamp with the one before. Raises PointCloudError for a scan to be skipped."""
        if self.last_ns is None:
            return
        since_ns = stamp_ns - self.last_ns
        if not since_ns:
            raise PointCloudError("stamp is a duplicate")
        # If the next scan is near this stamp, too, the clock was set; else this one stamp is wrong.
        jumps = since_ns - (log_time_ns - self.last_log_ns) > GAP_NS
        alone = not any(0 <= entry.stamp_ns - stamp_ns < GAP_NS for entry in waiting)
        if since_ns < 0 or (jumps and alone):
            self.out_of_time += 1
            raise PointCloudError(
                "stamp goes back in time" if since_ns < 0 else "stamp jumps",
                hint="the stamps in the headers must increase: a topic for each sensor, and a clock that is "
                "not set while it is recorded; a part in which they do: --start and --duration",
            )
        if jumps:
            self._tally.warn("the clock of the scans jumps forward within the log")
        elif since_ns > GAP_NS:
            self._tally.warn("the log has gaps of more than 5 s between scans")


class Poses:
    """The poses of the sensors on the robot, and of the robot in the odometry frame, by time.

    frame : the parent frame of the odometry, such as `odom`; None as long as it is not known.
    """

    def __init__(self, plan: Plan, frames: FrameTree, tally: Tally) -> None:
        self._plan, self._frames, self._tally = plan, frames, tally
        self._base = plan.choice.base_frame
        self._track = PoseTrack()
        self._T_child_base: F64 | None = None
        model = SENSOR_MODELS[plan.choice.sensor]
        self._images, self._planar = model.image, model.planar
        self._attitude = Attitude()
        self._imu_frame = ""
        self.frame = plan.odometry_frame

    def take_odometry(self, found: StampedPose | None, log_time_ns: int) -> None:
        """Add a message of the topic of the odometry; None: it cannot be decoded."""
        if found is None or not self._track.add(found.header.stamp_ns or log_time_ns, found.pose):
            self._tally.warn("some odometry messages are unreadable or not finite, and were ignored")
        elif self._T_child_base is None:
            self._T_child_base = self._child_to_base(found.child)
            self.frame = found.header.frame or None

    def take_imu(self, found: Imu | None, log_time_ns: int) -> None:
        """Add a message of the topic of the IMU."""
        if found is None:
            self._tally.warn("some IMU messages are unreadable or not finite, and were ignored")
            return
        self._imu_frame = found.header.frame
        self._attitude.add(found, found.header.stamp_ns or log_time_ns)

    def take_tf(self, edges: tuple[Transform, ...] | None, log_time_ns: int) -> None:
        """Add a message of moving transforms."""
        self._frames.add_all(edges, log_time_ns=log_time_ns)

    def _child_to_base(self, child: str) -> F64:
        """Return `T_child_base` of the odometry's child frame; identity if it is the base, or not in tf."""
        base, frames = self._base, self._frames
        if not child or child == base or self._plan.sensor_is_base:
            return np.eye(4)
        if frames.connected(child, base) and not frames.moving(child, base):
            found = frames.lookup(child, base, 0)
            assert found is not None  # nothing moves there
            return found
        self._tally.warn(f"the odometry is of frame {child}, which is taken for {base}")
        return np.eye(4)

    def newest_ns(self) -> int | None:
        """Return the stamp up to which odometry is known; 0 if none has arrived, None if there is none at
        all."""
        plan = self._plan
        if plan.odometry_frame is not None:
            return self._frames.newest_ns(plan.odometry_frame, self._base)
        return None if plan.odometry is None else self._track.newest_ns

    def complete_ns(self) -> int | None:
        """Return the stamp up to which odometry or, without it, the IMU is known; as `newest_ns`."""
        newest_ns = self.newest_ns()
        return self._attitude.newest_ns if newest_ns is None and self._plan.imu is not None else newest_ns

    def odometry(self, stamp_ns: int) -> F64 | None:
        """Return `T_odom_base` (4, 4) at a time; None if it is not known."""
        if self._plan.odometry_frame is not None:
            return self._frames.lookup(self._plan.odometry_frame, self._base, stamp_ns)
        found = self._track.at(stamp_ns)
        return found if found is None or self._T_child_base is None else found @ self._T_child_base

    def newest_odometry(self) -> tuple[int, F64] | None:
        """Return the newest stamp of the odometry and `T_odom_base` (4, 4) there; None if there is none."""
        newest_ns = self.newest_ns() or 0
        pose = self.odometry(newest_ns)
        return None if pose is None else (newest_ns, pose)

    def longest_gap_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return the longest time without a reading of odometry between two times."""
        frame = self._plan.odometry_frame
        if frame is None:
            return self._track.longest_gap_ns(begin_ns, end_ns)
        return self._frames.longest_gap_ns(frame, self._base, begin_ns, end_ns)

    def level(self, stamp_ns: int) -> F64 | None:
        """Return `T_level_base` (4, 4) at a time, see `Scan`; None if there is no IMU, or it does not measure
        it."""
        if not self._attitude.received:
            return None
        T_level_imu = self._attitude.at(stamp_ns)
        if T_level_imu is None:
            self._tally.warn(
                "the IMU does not say at all scans which way is up: it must measure accelerations of about "
                "9.81 m/s2 at their stamps"
            )
            return None
        T_imu_base = invert_pose(self._in_base(self._imu_frame, stamp_ns))
        T_imu_base[:3, 3] = 0.0
        return T_level_imu @ T_imu_base

    def sensor(self, frame: str, stamp_ns: int) -> F64:
        """Return `T_base_sensor` (4, 4) of the sensor with this frame. Raises FrameError, PointCloudError."""
        found = self._in_base(frame, stamp_ns)
        if self._images and not self._plan.sensor_is_base and "optical" not in frame and found[2, 2] > _UP:
            self._tally.warn(
                f"the images are in frame {frame}, whose z axis points up, where that of a camera points "
                "forward (REP-103): x is taken for forward; correct it to the camera's optical frame"
            )
            return found @ T_BODY_OPTICAL
        return found

    def _in_base(self, frame: str, stamp_ns: int) -> F64:
        """Return `T_base_frame` (4, 4); without tf, axes of cameras are rotated (REP-103).

        A LaserScan is by its definition in the x-y plane of its frame, whatever the name of the frame.
        """
        if self._plan.sensor_is_base:
            named = frame.endswith("_optical") or "_optical_" in frame
            return T_BODY_OPTICAL if self._images or (named and not self._planar) else np.eye(4)
        found = self._frames.lookup(self._base, frame, stamp_ns)
        if found is None:
            raise PointCloudError("tf is unknown at the stamp")
        return found


# --- scans of further sensors -------------------------------------------------------------------------

_KEPT = 50
"""Messages of a topic that wait for the first sensor's; chosen by hand."""


class Received(NamedTuple):
    """A scan as it was received; those that wait are sorted by stamp, equal ones by their number in the log.

    size_bytes : of the message as it was recorded; it takes at most four times that, if it is a text of
    numbers. camera : the calibration of an image when it was received: one that focuses changes it.
    """

    stamp_ns: int
    number: int
    log_time_ns: int
    size_bytes: int
    message: ScanMessage
    sensor: _Of
    camera: CameraInfo | None


class FurtherScans:
    """The scans of one further sensor, decoded when the first sensor's scan needs them.

    name : for the user. silent : True if they are left out as long as they hold no return, see `Sensor`.
    """

    def __init__(self, name: str, decoder: ScanDecoder, *, silent: bool = False) -> None:
        self.name, self.decoder, self.silent = name, decoder, silent
        self.newest_ns = self._used_ns = 0
        self._received: deque[Received] = deque(maxlen=_KEPT)

    def take(self, received: Received) -> None:
        """Add a scan."""
        if self.silent and not self.decoder.returns(received.message):
            return
        self.newest_ns = max(self.newest_ns, received.stamp_ns)
        self._received.append(received)

    def unused(self) -> list[Received]:
        """Return those of the kept scans that are later than the last one that was put together with
        another."""
        return [received for received in self._received if received.stamp_ns > self._used_ns]

    def near(
        self,
        stamp_ns: int,
        pose_of: Callable[[str, int], F64],
        odometry_at: Callable[[int], F64 | None],
    ) -> Scan | None:
        """Return the scan nearest to a stamp, within the period of a usual lidar; None if there is none of a
        silent sensor.

        pose_of : `T_base_sensor` of a frame at a time.

        Raises PointCloudError if none is near, Pc2GridError if it cannot be decoded.
        """
        nearest = min(self._received, key=lambda r: abs(r.stamp_ns - stamp_ns), default=None)
        if nearest is None or abs(nearest.stamp_ns - stamp_ns) > LIDAR_PERIOD_NS:
            if self.silent:
                return None
            raise PointCloudError("no scan near the first sensor's")
        while self._received[0] is not nearest:
            self._received.popleft()
        self._used_ns = own_ns = nearest.stamp_ns
        T_base_sensor = pose_of(nearest.message.header.frame, own_ns)
        return self.decoder.scan(nearest.message, own_ns, T_base_sensor, odometry_at(own_ns), nearest.camera)


def together(first: Scan, further: Sequence[Scan]) -> Scan:
    """Put scans together: one scan with the points of all, at the stamp of the first.

    Points are moved by odometry from the time of their scan to that of the first. Without odometry their
    times are kept, and deskewing moves them. Rays begin in the middle of the sensors.
    """
    points, offsets = zip(
        (first.points_m, first.offsets_s), *(_moved(scan, first) for scan in further), strict=True
    )
    timed = any(offset is not None for offset in offsets)
    T_base_sensor = first.T_base_sensor.copy()
    T_base_sensor[:3, 3] = np.mean([scan.T_base_sensor[:3, 3] for scan in (first, *further)], axis=0)
    return replace(
        first,
        points_m=np.concatenate(points),
        offsets_s=np.concatenate([*map(_offsets_s, points, offsets)]) if timed else None,
        T_base_sensor=T_base_sensor,
        dropped=first.dropped + sum(scan.dropped for scan in further),
    )


def _moved(scan: Scan, first: Scan) -> tuple[F32, F32 | None]:
    """Return the points (N, 3) of a scan and their times, relative to the pose of the base at the first
    scan."""
    if scan.T_odom_base is None or first.T_odom_base is None:
        apart_s = np.float32((scan.stamp_ns - first.stamp_ns) * 1e-9)
        return scan.points_m, _offsets_s(scan.points_m, scan.offsets_s) + apart_s
    T = (invert_pose(first.T_odom_base) @ scan.T_odom_base).astype(np.float32)
    return scan.points_m @ T[:3, :3].T + T[:3, 3], scan.offsets_s


def _offsets_s(points_m: F32, offsets_s: F32 | None) -> F32:
    return np.zeros(len(points_m), np.float32) if offsets_s is None else offsets_s
