"""One pass over a part of a log: scans in the order of their stamps, with mount and odometry at each."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from pc2grid.config import ReadConfig
from pc2grid.errors import (
    LimitExceeded,
    LogCorrupt,
    NoScans,
    Pc2GridError,
    PointCloudError,
    UnsupportedSchema,
)
from pc2grid.geometry import F64, invert_pose
from pc2grid.io import choose
from pc2grid.io.decoders import decoder_for
from pc2grid.io.depth import T_BODY_OPTICAL
from pc2grid.io.frames import FrameTree, PoseTrack
from pc2grid.io.messages import Odometry, ScanMessage, Transform
from pc2grid.io.plan import Plan, is_static, tolerant
from pc2grid.io.scan_decoder import ScanDecoder
from pc2grid.io.source import Source, TopicInfo
from pc2grid.model import Scan

# Scans wait this long (log time) for odometry and for scans that overtook each other.
_WAIT_NS = 500_000_000
_MAX_WAITING = 256
_MAX_WAITING_BYTES = 128_000_000
# tf and odometry around the part that is read.
_MARGIN_NS = 1_000_000_000
_CLOCK_JUMP_NS = 60_000_000_000
_GAP_NS = 5_000_000_000


class Stream:
    """A pass, to be run once. What is read and what is lost goes into the source's tally."""

    def __init__(
        self,
        source: Source,
        config: ReadConfig,
        frames: FrameTree,
        plan: Plan,
        start_s: float = 0.0,
        duration_s: float | None = None,
    ) -> None:
        self._source, self._frames, self._plan = source, frames, plan
        self._tally = source.tally
        self._start_ns = source.info.start_ns + round(start_s * 1e9)
        self._end_ns = None if duration_s is None else self._start_ns + round(duration_s * 1e9)
        self._part = f"from {start_s:g} s" + ("" if duration_s is None else f" for {duration_s:g} s")
        self._decoder = ScanDecoder(plan.scans.topic, plan.choice.sensor, decoder_for(plan.scans), config)
        self._track = PoseTrack()
        self._T_child_base: F64 | None = None
        self._waiting: list[tuple[int, int, int, int, ScanMessage]] = []
        self._waiting_bytes = 0
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
            for topic in self._source.info.topics:
                if topic.type in choose.TF and not is_static(topic):
                    on[topic] = self._take_tf(topic)
        low = max(self._start_ns - _MARGIN_NS, 0) if self._start_ns > self._source.info.start_ns else None
        high = None if self._end_ns is None else self._end_ns + _MARGIN_NS
        for message in self._source.messages({t.topic for t in on}, low, high):
            take = on.get(message.channel)
            if take is not None:
                take(message.data, message.log_time_ns)
            while self._waiting and (
                message.log_time_ns - self._waiting[0][2] > _WAIT_NS
                or len(self._waiting) > _MAX_WAITING
                or self._waiting_bytes > _MAX_WAITING_BYTES
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
            message = self._decoder.message(data)
        except Pc2GridError as error:
            self._skip(error)
            return
        stamp_ns = message.header.stamp_ns
        if self._plan.stampless:
            self._tally.warn("the stamps of the scans are zero: the time of recording is used instead")
            stamp_ns = log_time_ns
        elif stamp_ns <= 0:
            self._skip(PointCloudError("stamp is zero or negative"))
            return
        if stamp_ns >= 1 << 63:
            self._skip(PointCloudError("stamp is past the year 2262"))
            return
        size = max(len(data), message.size_bytes)
        heapq.heappush(self._waiting, (stamp_ns, self._count, log_time_ns, size, message))
        self._waiting_bytes += size

    def _take_odometry(self) -> Callable[[Any, int], None]:
        assert self._plan.odometry is not None
        decode = decoder_for(self._plan.odometry)

        def take(data: Any, log_time_ns: int) -> None:
            found: Odometry | None = tolerant(decode, data, None)
            if found is None or not self._track.add(found.header.stamp_ns or log_time_ns, found.pose):
                self._tally.warn("some odometry messages are unreadable or not finite, and were ignored")
            elif self._T_child_base is None:
                self._T_child_base = self._child_to_base(found.child)

        return take

    def _child_to_base(self, child: str) -> F64:
        """`T_child_base` of the odometry's child frame; identity if they are one, or tf does not say."""
        base, frames = self._plan.choice.base_frame, self._frames
        if not child or child == base or self._plan.sensor_is_base:
            return np.eye(4)
        known = child in frames and base in frames
        if known and frames.connected(child, base) and not frames.moving(child, base):
            found = frames.lookup(child, base, 0)
            return np.eye(4) if found is None else found
        self._tally.warn(f"the odometry is of frame {child}, which is taken for {base}")
        return np.eye(4)

    def _take_camera(self) -> Callable[[Any, int], None]:
        assert self._plan.camera is not None
        decode = decoder_for(self._plan.camera)

        def take(data: Any, log_time_ns: int) -> None:
            found = tolerant(decode, data, None)
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
            edges: tuple[Transform, ...] | None = tolerant(decode, data, None)
            self._frames.add_all(edges, log_time_ns=log_time_ns)

        return take

    # --- giving scans out -----------------------------------------------------------------------------

    def _release(self) -> Iterator[Scan]:
        stamp_ns, _, log_time_ns, size, message = heapq.heappop(self._waiting)
        self._waiting_bytes -= size
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
                self._tally.warn("the clock of the scans jumps forward within the log")
            elif stamp_ns - self._last_ns > _GAP_NS:
                self._tally.warn("the log has gaps of more than 5 s between scans")
        try:
            T_base_sensor = self._sensor_pose(message.header.frame, stamp_ns)
            scan = self._decoder.scan(message, stamp_ns, T_base_sensor, self._odometry_at(stamp_ns))
            scan = self._with_motion(scan)
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
        self._tally.scans_read += 1
        self._tally.points_dropped += scan.dropped
        for note in self._decoder.notes:
            self._tally.warn(note)
        if not len(scan.points_m):
            self._tally.warn("some scans hold no returns at all")
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

    def _with_motion(self, scan: Scan) -> Scan:
        """The scan with the motion within it, if odometry knows it."""
        if scan.T_odom_base is None or scan.offsets_s is None or not len(scan.offsets_s):
            return scan
        times_s = float(scan.offsets_s.min()), float(scan.offsets_s.max())
        first, last = (self._odometry_at(scan.stamp_ns + round(time_s * 1e9)) for time_s in times_s)
        if first is None or last is None:
            return scan
        return replace(scan, T_first_last=invert_pose(first) @ last)

    def _skip(self, error: Pc2GridError) -> None:
        self._bad += 1
        self._error = self._error or error
        self._tally.skip(error.message)
        if self._bad >= 10 and not self._good:
            raise self._mostly_bad()

    def _finish(self) -> None:
        topic = self._plan.scans.topic
        if self._count == 0:
            raise NoScans(
                f"{topic}: no scan {self._part}",
                hint=f"the log lasts {self._source.info.duration_s:.1f} s",
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
