"""Scans of further sensors, taken at about the same time as those of the first: two lasers, four cameras.

Each has a topic and a place on the robot of its own. Their points become part of the first sensor's scan that
is nearest in time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.errors import PointCloudError
from pc2grid.geometry import invert_pose
from pc2grid.io.message_source import TopicInfo
from pc2grid.io.messages.types import ScanMessage
from pc2grid.io.sensors.scan_decoder import ScanDecoder
from pc2grid.model import Scan

_MOST_APART_NS = 100_000_000
"""Stamps of scans that are put together differ by no more: a period of a usual lidar."""
_KEPT = 50
"""Messages of a topic that wait for the first sensor's; chosen by hand."""


class FurtherScans:
    """The scans of one further topic, decoded when the first sensor's scan needs them."""

    def __init__(self, topic: TopicInfo, decoder: ScanDecoder) -> None:
        self.topic, self._decoder = topic, decoder
        self.newest_ns = 0
        self._messages: deque[ScanMessage] = deque(maxlen=_KEPT)

    def take(self, data: Any) -> None:
        """Take in a message. Raises what the decoder raises."""
        message = self._decoder.message(data)
        self.newest_ns = max(self.newest_ns, message.header.stamp_ns)
        self._messages.append(message)

    def near(
        self,
        stamp_ns: int,
        pose_of: Callable[[str, int], F64],
        odometry_at: Callable[[int], F64 | None],
    ) -> Scan:
        """The scan nearest to a stamp.

        pose_of : `T_base_sensor` of a frame at a time.

        Raises PointCloudError if none is near, Pc2GridError if it cannot be decoded.
        """
        message = min(self._messages, key=lambda m: abs(m.header.stamp_ns - stamp_ns), default=None)
        if message is None or abs(message.header.stamp_ns - stamp_ns) > _MOST_APART_NS:
            raise PointCloudError("no scan near the first sensor's")
        while self._messages[0] is not message:
            self._messages.popleft()
        own_ns = message.header.stamp_ns
        return self._decoder.scan(message, own_ns, pose_of(message.header.frame, own_ns), odometry_at(own_ns))


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
