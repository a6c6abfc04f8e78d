"""Scans of further sensors, taken at about the same time as those of the first: two lasers, four cameras.

Each has a topic and a place on the robot of its own. Their points become part of the first sensor's scan that
is nearest in time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.geometry import invert_pose
from pc2grid.io.message_source import TopicInfo
from pc2grid.io.messages.types import ScanMessage
from pc2grid.io.sensors.scan_decoder import ScanDecoder
from pc2grid.model import Scan


@dataclass(frozen=True, slots=True)
class FurtherScansParameters:
    """Which scans belong together; chosen by hand.

    most_apart_ns : stamps of scans that are put together differ by no more: a period of a usual lidar.
    kept : messages of a topic that wait for the first sensor's.
    """

    most_apart_ns: int = 100_000_000
    kept: int = 50


FURTHER_SCANS = FurtherScansParameters()


class FurtherScans:
    """The scans of one further topic, decoded when the first sensor's scan needs them."""

    def __init__(self, topic: TopicInfo, camera: TopicInfo | None, decoder: ScanDecoder) -> None:
        """camera : the topic of the calibration, of a depth camera."""
        self.topic, self.camera = topic, camera
        self.decoder = decoder
        self.newest_ns = 0
        self._messages: deque[ScanMessage] = deque(maxlen=FURTHER_SCANS.kept)

    def take(self, data: Any) -> None:
        """Take in a message. Raises what the decoder raises."""
        message = self.decoder.message(data)
        self.newest_ns = max(self.newest_ns, message.header.stamp_ns)
        self._messages.append(message)

    def nearest_ns(self, stamp_ns: int) -> int:
        """The stamp of the scan nearest to a stamp; 0 if none has arrived."""
        message = self._nearest(stamp_ns)
        return 0 if message is None else message.header.stamp_ns

    def _nearest(self, stamp_ns: int) -> ScanMessage | None:
        return min(self._messages, key=lambda m: abs(m.header.stamp_ns - stamp_ns), default=None)

    def near(
        self,
        stamp_ns: int,
        pose_of: Callable[[str, int], F64],
        odometry_at: Callable[[int], F64 | None],
    ) -> Scan | None:
        """The scan nearest to a stamp; None if none is near.

        pose_of : `T_base_sensor` of a frame at a time.

        Raises Pc2GridError if the scan cannot be decoded.
        """
        message = self._nearest(stamp_ns)
        if message is None or abs(message.header.stamp_ns - stamp_ns) > FURTHER_SCANS.most_apart_ns:
            return None
        while self._messages[0] is not message:
            self._messages.popleft()
        own_ns = message.header.stamp_ns
        return self.decoder.scan(message, own_ns, pose_of(message.header.frame, own_ns), odometry_at(own_ns))


def together(first: Scan, further: Sequence[Scan]) -> Scan:
    """One scan with the points of all, at the stamp of the first.

    Points are moved by odometry from the time of their scan to that of the first. Without odometry their
    times tell when they were taken, and registration moves them. Rays begin in the middle of the sensors.
    """
    points: list[F32] = [first.points_m]
    offsets = [_offsets_s(first)]
    timed = first.offsets_s is not None
    for scan in further:
        apart_s = (scan.stamp_ns - first.stamp_ns) * 1e-9
        if scan.T_odom_base is not None and first.T_odom_base is not None:
            T = (invert_pose(first.T_odom_base) @ scan.T_odom_base).astype(np.float32)
            points.append(scan.points_m @ T[:3, :3].T + T[:3, 3])
            offsets.append(_offsets_s(scan))
            timed = timed or scan.offsets_s is not None
        else:
            points.append(scan.points_m)
            offsets.append(_offsets_s(scan) + np.float32(apart_s))
            timed = True
    T_base_sensor = first.T_base_sensor.copy()
    T_base_sensor[:3, 3] = np.mean([scan.T_base_sensor[:3, 3] for scan in (first, *further)], axis=0)
    return replace(
        first,
        points_m=np.concatenate(points),
        offsets_s=np.concatenate(offsets) if timed else None,
        T_base_sensor=T_base_sensor,
        dropped=first.dropped + sum(scan.dropped for scan in further),
    )


def _offsets_s(scan: Scan) -> F32:
    return np.zeros(len(scan.points_m), np.float32) if scan.offsets_s is None else scan.offsets_s
