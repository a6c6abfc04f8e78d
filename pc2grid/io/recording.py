"""A recording as a stream of scans, in whatever container it is stored."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np

from pc2grid.config import ReadConfig
from pc2grid.display import html_table, short
from pc2grid.errors import ConfigError
from pc2grid.io.containers.detect import open_source
from pc2grid.io.error_translation import guarded, guarded_stream
from pc2grid.io.frames import FrameTree
from pc2grid.io.map_pose import MapPose, last_map_pose
from pc2grid.io.message_source import Choice, LogInfo, MessageSource
from pc2grid.io.read_plan import Plan, make_plan
from pc2grid.io.scan_stream import Stream
from pc2grid.model import ReadReport, Scan


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
    """An open recording. Use as a context manager.

    info : the facts that are known without decoding a message.
    """

    def __init__(self, source: MessageSource, config: ReadConfig) -> None:
        self.info: LogInfo = source.info
        self._source = source
        self._config = config
        self._plan: Plan | None = None
        self._frames = FrameTree()
        self._digest: str | None = None

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

    def digest(self) -> str:
        """SHA-256 (hex) of the file, or of all files of a folder one after another, in reading order."""
        if self._digest is None:
            total = hashlib.sha256()
            for path in self._source.files:
                with path.open("rb") as file:
                    while block := file.read(1 << 20):
                        total.update(block)
            self._digest = total.hexdigest()
        return self._digest

    def report(self) -> ReadReport:
        """Counts of what was read and of what was lost, so far."""
        return self._source.tally.report(self._frames.warnings)

    def choose(self) -> Choice:
        """The topic that the scans come from, and why.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        if self._plan is None:
            self._plan = guarded(self.info.path, lambda: make_plan(self._source, self._config, self._frames))
        return self._plan.choice

    def map_pose(self, topic: str, end_s: float | None = None) -> MapPose:
        """The last pose in a map that localization on the robot published, at most `end_s` seconds after the
        log's start.

        topic : of a pose, an odometry in the map frame, or tf, of which map -> base is taken.

        Raises TopicError, UnsupportedSchema, FrameError, NoScans if there is no such pose.
        """
        base_frame = self.choose().base_frame
        end_ns = None if end_s is None else self.info.start_ns + round(end_s * 1e9)
        return guarded(self.info.path, lambda: last_map_pose(self._source, topic, base_frame, end_ns))

    def scans(self, start_s: float = 0.0, duration_s: float | None = None) -> Iterator[Scan]:
        """Stream the scans from `start_s` seconds after the log's start on, for `duration_s` seconds.

        Stamps increase strictly. Scans that cannot be decoded are skipped and counted in `report`.

        Raises what `choose` does; NoScans if there is no scan in that part; LogCorrupt if more than a tenth
        of the scans cannot be decoded.
        """
        if not np.isfinite(start_s) or start_s < 0:
            raise ConfigError(f"start: expected seconds >= 0, found {start_s:g}")
        if duration_s is not None and not duration_s > 0:
            raise ConfigError(f"duration: expected seconds > 0, found {duration_s:g}")
        self.choose()
        plan = self._plan
        assert plan is not None
        stream = guarded(
            self.info.path,
            lambda: Stream(self._source, self._config, self._frames, plan, start_s, duration_s),
        )
        return guarded_stream(self.info.path, stream.run())
