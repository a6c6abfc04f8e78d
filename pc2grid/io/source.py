"""What a container of messages is, whatever its format: the seam between formats and sensors.

A source knows topics, times and bytes; it does not know what a scan is. `pc2grid.io.log` turns the bytes
of any source into scans.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from pc2grid.model import SensorKind


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicInfo:
    """One topic of one type.

    type : as `sensor_msgs/PointCloud2`, without the `msg` in the middle.
    encoding : of the messages: `cdr`, `ros1`, `protobuf`, `json`, or a format of files such as `ply`.
    schema_encoding, schema : the definition that the log carries; empty if none.
    message_count : None if the log does not say without being read in full.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = field(default=b"", repr=False)
    message_count: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LogInfo:
    """What can be said of a recording without decoding it.

    format : `mcap/ros2`, `mcap/ros1`, `bag/ros1`, `db3/ros2`, `folder/ply`, ...
    start_ns, end_ns : first and last log time; 0 and 0 if there is no message.
    message_count : None if unknown.
    """

    path: Path
    format: str
    size_bytes: int
    start_ns: int
    end_ns: int
    message_count: int | None
    topics: tuple[TopicInfo, ...]
    warnings: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float:
        """Time between the first and the last message."""
        return (self.end_ns - self.start_ns) * 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Which topic the scans come from, and why.

    odometry_topic : None if there is none; a tf topic if the poses come from odom -> base there.
    base_frame : the frame that scans are expressed in.
    sensor_frame : frame of the scans as the log names it; None if the log names none.
    reason : one sentence for the user.
    """

    topic: str
    sensor: SensorKind
    odometry_topic: str | None
    base_frame: str
    sensor_frame: str | None
    reason: str


class RawMessage(NamedTuple):
    """A message as it stands in the log."""

    channel: TopicInfo
    log_time_ns: int
    data: memoryview | bytes


@dataclass(slots=True)
class Tally:
    """What has been read and what could not be, counted on the way.

    topics_lost : whether what was lost may have held topics that nothing else tells of.
    """

    scans_read: int = 0
    points_dropped: int = 0
    bytes_lost: int = 0
    topics_lost: bool = False
    skipped: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def warn(self, sentence: str) -> None:
        """Note a sentence for the user, once."""
        if sentence not in self.warnings:
            self.warnings.append(sentence)

    def skip(self, reason: str) -> None:
        """Count one more scan left out for `reason`."""
        self.skipped[reason] = self.skipped.get(reason, 0) + 1


class Source(Protocol):
    """A container of timed messages."""

    info: LogInfo
    tally: Tally
    files: tuple[Path, ...]

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Messages of the topics with start_ns <= log time < end_ns, by log time as far as the log allows."""
        ...

    def close(self) -> None:
        """Let go of the files."""
        ...
