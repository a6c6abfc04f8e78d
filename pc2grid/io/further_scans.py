"""Scans of further sensors, taken at about the same time as those of the first: two lasers, four cameras.

Each has a frame and a place on the robot of its own, and mostly a topic. Their points become part of the
first sensor's scan that is nearest in time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.errors import PointCloudError
from pc2grid.geometry import invert_pose
from pc2grid.io.messages.types import ScanMessage
from pc2grid.io.sensors.scan_decoder import ScanDecoder
from pc2grid.model import Scan

_MOST_APART_NS = 100_000_000
"""Stamps of scans that are put together differ by no more: a period of a usual lidar."""
_KEPT = 50
"""Messages of a topic that wait for the first sensor's; chosen by hand."""


class Received(NamedTuple):
    """A scan as it was received. size_bytes : of the message as it was recorded."""

    stamp_ns: int
    log_time_ns: int
    size_bytes: int
    message: ScanMessage


class FurtherScans:
    """The scans of one further sensor, decoded when the first sensor's scan needs them.

    name : for the user. silent : whether they are left out as long as they hold no return, see `Sensor`.
    """

    def __init__(self, name: str, decoder: ScanDecoder, *, silent: bool = False) -> None:
        self.name, self.decoder, self.silent = name, decoder, silent
        self.newest_ns = self._used_ns = 0
        self._received: deque[Received] = deque(maxlen=_KEPT)

    def take(self, received: Received) -> None:
        """Take in a scan."""
        if self.silent and not self.decoder.returns(received.message):
            return
        self.newest_ns = max(self.newest_ns, received.stamp_ns)
        self._received.append(received)

    def unused(self) -> list[Received]:
        """Return the scans after those that became part of another sensor's, of those that are kept."""
        return [received for received in self._received if received.stamp_ns > self._used_ns]

    def near(
        self,
        stamp_ns: int,
        pose_of: Callable[[str, int], F64],
        odometry_at: Callable[[int], F64 | None],
    ) -> Scan | None:
        """The scan nearest to a stamp; None if there is none of a silent sensor.

        pose_of : `T_base_sensor` of a frame at a time.

        Raises PointCloudError if none is near, Pc2GridError if it cannot be decoded.
        """
        nearest = min(self._received, key=lambda r: abs(r.stamp_ns - stamp_ns), default=None)
        if nearest is None or abs(nearest.stamp_ns - stamp_ns) > _MOST_APART_NS:
            if self.silent:
                return None
            raise PointCloudError("no scan near the first sensor's")
        while self._received[0] is not nearest:
            self._received.popleft()
        self._used_ns = own_ns = nearest.stamp_ns
        message = nearest.message
        return self.decoder.scan(message, own_ns, pose_of(message.header.frame, own_ns), odometry_at(own_ns))


def together(first: Scan, further: Sequence[Scan]) -> Scan:
    """One scan with the points of all, at the stamp of the first.

    Points are moved by odometry from the time of their scan to that of the first. Without odometry their
    times tell when they were taken, and registration moves them. Rays begin in the middle of the sensors.
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
    """Points (N, 3) of a scan and their times, as seen from where the base was at the first."""
    if scan.T_odom_base is None or first.T_odom_base is None:
        apart_s = np.float32((scan.stamp_ns - first.stamp_ns) * 1e-9)
        return scan.points_m, _offsets_s(scan.points_m, scan.offsets_s) + apart_s
    T = (invert_pose(first.T_odom_base) @ scan.T_odom_base).astype(np.float32)
    return scan.points_m @ T[:3, :3].T + T[:3, 3], scan.offsets_s


def _offsets_s(points_m: F32, offsets_s: F32 | None) -> F32:
    return np.zeros(len(points_m), np.float32) if offsets_s is None else offsets_s
