"""A recording as a stream of scans, in whatever container it is stored."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np

from pc2grid.config import ReadConfig
from pc2grid.display import html_table, short
from pc2grid.errors import ConfigError, LogError
from pc2grid.io import topics
from pc2grid.io.containers.detect import open_source
from pc2grid.io.error_translation import guarded, guarded_stream
from pc2grid.io.frames import FrameTree
from pc2grid.io.map_pose import MapPose, last_map_pose
from pc2grid.io.message_source import Choice, LogInfo, MessageSource, RawMessage
from pc2grid.io.read_plan import Plan, make_plan
from pc2grid.io.scan_stream import Part, Stream
from pc2grid.model import ReadReport, Scan

_STEP_NS = 1_000_000_000
"""The last message is looked for in steps that begin with this; chosen by hand: a scanner is faster."""


def open_log(path: str | Path, config: ReadConfig | None = None, *, recover: bool = False) -> Log:
    """Open a recording: an MCAP (ROS 2 or ROS 1), a ROS 1 bag, a rosbag2 folder or db3, a folder of clouds.

    recover : read what is whole of a damaged MCAP file and count the rest, instead of refusing the file; of a
    split recording, go on without the files that are missing.

    Raises LogNotFound, NotALog, LogTruncated, LogCorrupt, LimitExceeded.

    >>> with open_log("monday.mcap") as log:
    ...     log.choose().topic, [t.topic for t in log.info.topics]
    ...     scan = next(log.scans())
    ('/scan', ['/odom', '/scan', '/tf', '/tf_static'])
    >>> scan.sensor, scan.points_m.shape[1]
    ('laser', 3)
    """
    config = config or ReadConfig()
    path = Path(path)
    source = guarded(path, lambda: open_source(path, config, recover=recover))
    return Log(source, config)


class Log:
    """An open recording. Use as a context manager."""

    def __init__(self, source: MessageSource, config: ReadConfig) -> None:
        self._source = source
        self._config = config
        self._frames = FrameTree()
        self._stream: Stream | None = None

    @functools.cached_property
    def info(self) -> LogInfo:
        """The facts that are known without decoding a message; its times are those of the scans."""
        try:
            return guarded(self._source.info.path, lambda: _with_scan_times(self._source, self._config.topic))
        except LogError:  # said again where the scans are read
            return self._source.info

    def __repr__(self) -> str:
        info = self.info
        name, topics = short(info.path.name, 120), len(info.topics)
        return f"Log({name}, {info.format}, {info.duration_s:.1f} s, {topics} topics)"

    def _repr_html_(self) -> str:
        rows = [
            (topic.topic, topic.type, "?" if topic.message_count is None else topic.message_count)
            for topic in self.info.topics
        ]
        title = f"{self.info.path.name}: {self.info.format}, {self.info.duration_s:.1f} s"
        return html_table(title, rows, ("topic", "type", "messages"))

    def __enter__(self) -> Log:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._source.close()

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """All messages of some topics as they stand in the recording, by log time. Raises LogError."""
        return guarded_stream(self._source.info.path, self._source.messages(topics))

    def digest(self) -> str:
        """SHA-256 (hex) of the file, or of all files of a folder one after another, in reading order."""
        total = hashlib.sha256()
        for path in self._source.files:
            with path.open("rb") as file:
                while block := file.read(1 << 20):
                    total.update(block)
        return total.hexdigest()

    def report(self) -> ReadReport:
        """Counts of what was read and of what was lost, so far."""
        return self._source.tally.report(self._frames.warnings)

    def choose(self) -> Choice:
        """The topic that the scans come from, and why.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        return self._plan.choice

    @functools.cached_property
    def _plan(self) -> Plan:
        read = self._source, self._config, self._frames
        return guarded(self._source.info.path, lambda: make_plan(*read))

    def map_pose(self, topic: str, end_s: float | None = None) -> MapPose:
        """The last pose in a map that localization on the robot published, at most `end_s` seconds after the
        log's start.

        topic : of a pose, an odometry in the map frame, or tf, of which map -> base is taken.

        Raises TopicError, UnsupportedSchema, FrameError, NoScans if there is no such pose.
        """
        base_frame, info = self.choose().base_frame, self.info
        end_ns = info.end_ns + 1 if end_s is None else info.start_ns + round(end_s * 1e9)
        return guarded(info.path, lambda: last_map_pose(self._source, topic, base_frame, end_ns))

    def scans(self, start_s: float = 0.0, duration_s: float | None = None) -> Iterator[Scan]:
        """Stream the scans from `start_s` seconds after the first one on, for `duration_s` seconds.

        Stamps increase strictly. Scans that cannot be decoded are skipped and counted in `report`.

        Raises what `choose` does; NoScans if there is no scan in that part; LogCorrupt if more than a tenth
        of the scans cannot be decoded.
        """
        if not np.isfinite(start_s) or start_s < 0:
            raise ConfigError(f"start: expected seconds >= 0, found {start_s:g}")
        if duration_s is not None and not duration_s > 0:
            raise ConfigError(f"duration: expected seconds > 0, found {duration_s:g}")
        path = self._source.info.path
        read = self._source, self._config, self._frames, self._plan, self._part(start_s, duration_s)
        self._stream = guarded(path, lambda: Stream(*read))
        return guarded_stream(path, self._stream.run())

    @property
    def last_scan_ns(self) -> int:
        """The log time of the last scan that `scans` has given; 0 before the first."""
        return 0 if self._stream is None else self._stream.stamps.last_log_ns

    def _part(self, start_s: float, duration_s: float | None) -> Part:
        if not start_s and duration_s is None:
            return Part()
        info = self.info
        start_ns = info.start_ns + round(start_s * 1e9)
        end_ns = None if duration_s is None else start_ns + round(duration_s * 1e9)
        name = f" from {start_s:g} s" + ("" if duration_s is None else f" for {duration_s:g} s")
        return Part(start_ns if start_s else None, end_ns, name, info.duration_s)


def _with_scan_times(source: MessageSource, wanted: str | None) -> LogInfo:
    """The facts about a recording, with the times of its scans in place of those of all messages.

    Other messages may lie far from the scans: odometry that was started first, a transform of a wrong clock.

    wanted : the topics of the scans; None: of all that hold scans. Without scans, the times are those of all
    messages.

    Raises LogError if damage is reached.
    """
    info = source.info
    names = {t.topic for t in topics.usable(info.topics, wanted) if t.message_count != 0}
    first_ns = next((message.log_time_ns for message in source.messages(names)), None)
    if first_ns is None:
        return info
    return replace(info, start_ns=first_ns, end_ns=_last_ns(source, names, first_ns))


def _last_ns(source: MessageSource, names: Collection[str], first_ns: int) -> int:
    """The last log time of messages of these topics, found from the end without reading all of them."""
    low_ns, high_ns = first_ns, source.info.end_ns + 1  # the last one is not before low, and before high
    step_ns = _STEP_NS
    while high_ns - low_ns > _STEP_NS:
        middle_ns = max(high_ns - step_ns, low_ns)
        if next(iter(source.messages(names, middle_ns, high_ns)), None) is None:
            high_ns, step_ns = middle_ns, 2 * step_ns
        else:
            low_ns, step_ns = middle_ns, _STEP_NS
    times_ns = (message.log_time_ns for message in source.messages(names, low_ns, high_ns))
    return max(times_ns, default=first_ns)
