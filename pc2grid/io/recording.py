"""A recording as a stream of scans, in whatever container it is stored; its first bytes decide which, not its
name."""

from __future__ import annotations

import functools
import hashlib
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from pc2grid.display import html_table, short
from pc2grid.errors import ConfigError, LogError, LogNotFound, LogTruncated, NotALog
from pc2grid.io import topics
from pc2grid.io.containers import bags, cloud_folder
from pc2grid.io.containers.bags import RosbagsFile
from pc2grid.io.containers.mcap import MAGIC, McapSource
from pc2grid.io.frames import FrameTree
from pc2grid.io.map_pose import BelievedPose, MapPose, last_map_pose
from pc2grid.io.plan import Plan, make_plan
from pc2grid.io.source import (
    GAP_NS,
    LFS_HINT,
    SQLITE,
    Choice,
    LogInfo,
    MessageSource,
    RawMessage,
    first_bytes,
    guarded,
    guarded_stream,
    is_lfs_pointer,
    is_submap_database,
)
from pc2grid.io.stream import LogPart, Stream, StreamParameters
from pc2grid.model import ReadReport, Scan
from pc2grid.settings import ReadConfig


def open_log(path: str | Path, config: ReadConfig | None = None, *, recover: bool = False) -> Log:
    """Open a recording: an MCAP (ROS 2 or ROS 1), a ROS 1 bag, a rosbag2 folder or db3, a folder of clouds.

    recover : read the undamaged part of an MCAP file and count the rest, instead of refusing the file; of a
    split recording, continue without missing files.

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


SourceT = TypeVar("SourceT", bound="ScanSource")


class ScanSource(ABC):
    """Scans of a recording (`Log`), or of a running robot (`LiveLog`). Use as a context manager.

    name : for the user. tally : what was read so far. on_poll : called several times a second while scans of
    a robot are awaited and with each scan; if it returns True, no more scans follow. lag_s : time from the
    arrival of the last scan of a robot to the end of its use.
    """

    lag_s = 0.0

    def __init__(
        self, source: MessageSource, config: ReadConfig, parameters: StreamParameters | None = None
    ) -> None:
        self._source, self._config, self._stream_parameters = source, config, parameters
        self._path = source.info.path
        self.name, self.tally = str(self._path), source.tally
        self.on_poll: Callable[[], bool] = lambda: False
        self._frames = FrameTree()
        self._plan: Plan | None = None
        self._stream: Stream | None = None
        self._believed: BelievedPose | None = None

    def __enter__(self: SourceT) -> SourceT:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the source of the messages."""
        self._source.close()

    def report(self) -> ReadReport:
        """Return the counts of what was read and of what was lost, so far."""
        return self.tally.report(self._frames.warnings)

    def choose(self) -> Choice:
        """Choose the topics to read, and say why; of a robot, by its first seconds.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        return self._planned().choice

    def _planned(self) -> Plan:
        if self._plan is None:
            read = self._source, self._config, self._frames
            self._plan = guarded(self._path, lambda: make_plan(*read))
        return self._plan

    def _begin(self, plan: Plan, part: LogPart | None = None) -> Stream:
        read = self._source, self._config, self._frames, plan, part, self._stream_parameters
        self._stream = guarded(self._path, lambda: Stream(*read))
        self._stream.believed = self._believed
        return self._stream

    @abstractmethod
    def parts(self) -> Iterator[Iterator[Scan]]:
        """Yield one iterator of scans per uninterrupted segment."""

    @abstractmethod
    def listen_to_pose(self, topic: str) -> BelievedPose:
        """Return the pose in the map by the robot's own localization, which `parts` keeps up to date.

        It is called before the scans are read, of a robot before `choose`.

        topic : of a pose, an odometry or tf. Raises TopicError for one that a recording does not have.
        """


class Log(ScanSource):
    """An open recording. Use as a context manager."""

    @functools.cached_property
    def info(self) -> LogInfo:
        """Return the facts that are known without decoding a message; its times are those of the scans."""
        try:
            return guarded(self._path, lambda: _with_scan_times(self._source, self._config.topic))
        except LogError:  # raised again where the scans are read
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

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield all messages of some topics as they stand in the recording, by log time. Raises LogError."""
        return guarded_stream(self._path, self._source.messages(topics))

    def digest(self) -> str:
        """Return the SHA-256 (hex) of the file, or of all files of a folder one after another, in reading
        order."""
        total = hashlib.sha256()
        for path in self._source.files:
            with path.open("rb") as file:
                while block := file.read(1 << 20):
                    total.update(block)
        return total.hexdigest()

    def map_pose(self, topic: str, end_s: float | None = None) -> MapPose:
        """Return the last pose in a map that localization on the robot published.

        topic : of a pose, an odometry in the map frame, or tf, of which map -> base is taken. end_s : it was
        published at most so many seconds after the log's start; None: at any time.

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
        return guarded_stream(self._path, self._begin(self._planned(), self._part(start_s, duration_s)).run())

    def parts(self) -> Iterator[Iterator[Scan]]:
        """Yield the scans of the whole recording."""
        yield self.scans()
        if self._believed is not None and self._believed.problem is not None:
            self.tally.tell(str(self._believed.problem))

    def listen_to_pose(self, topic: str) -> BelievedPose:
        """See `ScanSource`."""
        self._believed = BelievedPose(topic)
        self._believed.find(self._source.info.topics, self.choose().base_frame)
        return self._believed

    def _part(self, start_s: float, duration_s: float | None) -> LogPart:
        if not start_s and duration_s is None:
            return LogPart()
        info = self.info
        start_ns = info.start_ns + round(start_s * 1e9)
        end_ns = None if duration_s is None else start_ns + round(duration_s * 1e9)
        name = f" from {start_s:g} s" + ("" if duration_s is None else f" for {duration_s:g} s")
        return LogPart(start_ns if start_s else None, end_ns, name, info.duration_s)


def _with_scan_times(source: MessageSource, wanted: str | None) -> LogInfo:
    """Return the facts about a recording, with the times of its scans in place of those of all messages.

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
    """Return the last log time of messages of these topics, searched from the end without reading all of
    them."""
    low_ns, high_ns = first_ns, source.info.end_ns + 1  # the last one is not before low, and before high
    step_ns = GAP_NS
    while high_ns - low_ns > GAP_NS:
        middle_ns = max(high_ns - step_ns, low_ns)
        if next(iter(source.messages(names, middle_ns, high_ns)), None) is None:
            high_ns, step_ns = middle_ns, 2 * step_ns
        else:
            low_ns, step_ns = middle_ns, GAP_NS
    times_ns = (message.log_time_ns for message in source.messages(names, low_ns, high_ns))
    return max(times_ns, default=first_ns)


_BAG = b"#ROSBAG V2.0\n"
_READ = "pc2grid reads MCAP, ROS 1 bags, rosbag2 folders and .db3"
_OTHERS = (
    (
        b"#ROSBAG V",
        "a ROS 1 bag of an old format",
        "`rosbag migrate` or `rosbag fix` makes it one of format 2.0",
    ),
    (b"\x89PNG", "a PNG image", "of a map, give the .yaml that names this image"),
    (b"P5", "a PGM image", "of a map, give the .yaml that names this image"),
    (b"\x1f\x8b", "a gzip archive", "unpack it first"),
    (b"PK\x03\x04", "a zip archive", "unpack it first"),
    (b"\x28\xb5\x2f\xfd", "a zstd-compressed file", "unpack it first"),
    (b"\x04\x22\x4d\x18", "an lz4-compressed file", "unpack it first"),
    (b"# .PCD", "a PCD cloud", "name the folder of the clouds, one file per scan"),
    (b"ply", "a PLY cloud", "name the folder of the clouds, one file per scan"),
)
"""How other files begin, what they are, and what helps."""
_RECORDED = "of a running robot, or a recording that comes through a pipe: pc2grid watch"


def open_source(path: Path, config: ReadConfig, *, recover: bool) -> MessageSource:
    """Open the container at a path.

    recover : read the undamaged part of an MCAP file, and continue without missing files of a folder.

    Raises LogNotFound, NotALog, LogTruncated, or what the container's reader raises.
    """
    try:
        if path.name == bags.METADATA and path.is_file():
            path = path.parent
        if path.is_dir():
            return _open_folder(path, config, recover)
        if not path.exists():
            stream = "://" in str(path) or re.match(r"\w+:/", str(path)) or str(path) == "-"
            raise LogNotFound(f"{path}: no such file", hint=_RECORDED if stream else "check the path")
        if not path.is_file():
            raise LogNotFound(f"{path}: not a regular file", hint=_RECORDED)
        head = first_bytes(path)
    except OSError as error:
        raise LogNotFound(f"{path}: {error.strerror}") from error
    return _open_file(path, head, config, recover)


def _open_file(path: Path, head: bytes, config: ReadConfig, recover: bool) -> MessageSource:
    if not head:
        raise LogTruncated(f"{path}: empty file", hint="was the recording interrupted?")
    if MAGIC.startswith(head):
        raise LogTruncated(
            f"{path}: an MCAP that ends after its first {len(head)} bytes", hint="nothing to recover"
        )
    if head.startswith(MAGIC):
        return McapSource(path, config, recover=recover)
    if head.startswith(_BAG):
        return RosbagsFile(path, config, is_bag=True)
    if is_submap_database(head):
        raise NotALog(
            f"{path}: a submap database, not a recording", hint=f"`pc2grid info {path}` shows what is in it"
        )
    if head.startswith(SQLITE):
        return RosbagsFile(path, config, is_bag=False)
    name, advice = _looks_like(head)
    raise NotALog(f"{path}: not a recording; looks like {name}", hint=advice)


def _open_folder(path: Path, config: ReadConfig, recover: bool) -> MessageSource:
    names = sorted(entry.name for entry in path.iterdir() if entry.is_file())
    if bags.METADATA in names or any(name.endswith(bags.SUFFIXES) for name in names):
        return bags.open_folder(
            path, lambda file: open_source(file, config, recover=recover), recover=recover
        )
    if any(name.lower().endswith(cloud_folder.SUFFIXES) for name in names):
        return cloud_folder.CloudFolder(path, config)
    if any(name.endswith(".bag") for name in names):
        raise LogNotFound(
            f"{path}: a folder of ROS 1 bags", hint=f"name the files: pc2grid convert {path}/*.bag"
        )
    raise LogNotFound(
        f"{path}: a folder without a recording",
        hint="it holds neither metadata.yaml, .mcap or .db3 nor .pcd, .ply or .bin",
    )


def _looks_like(head: bytes) -> tuple[str, str]:
    """Return the likely kind of a file that begins so, and advice."""
    if is_lfs_pointer(head):
        return "a Git LFS pointer to one", LFS_HINT
    for mark, name, advice in _OTHERS:
        if head.startswith(mark):
            return name, advice
    try:
        text = head.decode("utf-8")
    except UnicodeDecodeError:
        text = "\0"
    return "text" if text.isprintable() or "\n" in text else "binary data of another kind", _READ
