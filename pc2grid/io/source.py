"""The interface of all sources of messages: topics, times and bytes; and the translation of their errors.

Files of each format implement `MessageSource` (`pc2grid.io.containers`). A source does not decode its
messages: `pc2grid.io.recording` turns the bytes of any source into scans.

`guarded` is the one place where exceptions of the libraries that read recordings become errors of pc2grid.
Decoders of other projects raise a dozen unrelated types for damaged bytes (17 were counted for `mcap` alone);
a user gets one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple, Protocol, TypeVar, cast

from pydantic import Field, computed_field

from pc2grid.errors import LogCorrupt, LogError, Pc2GridError, one_line
from pc2grid.model import ReadReport, SensorKind

GAP_NS = 5_000_000_000
"""A longer time without messages, and clocks that differ by more, are reported; chosen by hand."""
LIDAR_PERIOD_NS = 100_000_000
"""Between two scans of most lidars, and of KITTI: 10 Hz."""
SQLITE = b"SQLite format 3\0"
"""How an SQLite file begins."""
SUBMAPS_ID = b"pcsm"
"""The application id in the header of a submap database."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicInfo:
    """One topic of one type; two are equal if these and the encoding are.

    type : such as `sensor_msgs/PointCloud2`, without the `msg` in the middle.
    encoding : of the messages: `cdr`, `ros1`, `protobuf`, `json`, or a format of files such as `ply`.
    schema_encoding, schema : the definition of the type in the log, such as `ros2msg` and its text; empty if
    there is none.
    message_count : None if it is unknown unless the log is read in full.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: Annotated[str, Field(exclude=True)] = field(default="", compare=False)
    schema: Annotated[bytes, Field(exclude=True)] = field(default=b"", repr=False, compare=False)
    message_count: int | None = field(default=None, compare=False)


K = TypeVar("K")


def counted(topics: Mapping[K, TopicInfo]) -> dict[K, TopicInfo]:
    """Return topics by the same keys, each with the messages of all that are equal to it.

    Several programs may publish one topic, and a recording may have several files.
    """
    groups: dict[TopicInfo, list[TopicInfo]] = {}
    for topic in topics.values():
        groups.setdefault(topic, []).append(topic)
    whole = {
        topic: replace(
            next((t for t in group if t.schema), topic), message_count=total(t.message_count for t in group)
        )
        for topic, group in groups.items()
    }
    return {key: whole[topic] for key, topic in topics.items()}


def total(counts: Iterable[int | None]) -> int | None:
    """Return the sum; None if one is unknown."""
    known = list(counts)
    return None if None in known else sum(count for count in known if count is not None)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogInfo:
    """The facts about a recording that are known without decoding it.

    format : `mcap/ros2`, `mcap/ros1`, `bag/ros1`, `db3/ros2`, `folder/ply`, ...
    start_ns, end_ns : first and last log time of all messages; 0 and 0 if there is none. Of an open `Log`
    these are the times of the scans.
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

    @computed_field  # type: ignore[prop-decorator]  # mypy has no decorated properties
    @property
    def duration_s(self) -> float:
        """Return the time from the start to the end."""
        return (self.end_ns - self.start_ns) * 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The topics that a log is read from, and why.

    topic, sensor : of the scans.
    odometry_topic : None if there is none; a tf topic if the odometry is the transform odom -> base.
    imu_topic : None if there is none, or if none is needed.
    base_frame : the robot's frame, in which points are expressed.
    sensor_frame : the frame in the header of the scans; None if it is empty. further_frames : of the sensors
    whose scans are put together with these.
    reason : one sentence for the user.
    """

    topic: str
    sensor: SensorKind
    odometry_topic: str | None
    base_frame: str
    sensor_frame: str | None
    reason: str
    imu_topic: str | None = None
    further_frames: tuple[str, ...] = ()


class RawMessage(NamedTuple):
    """A message as it stands in the log; data holds its bytes in the encoding of its channel."""

    channel: TopicInfo
    log_time_ns: int
    data: memoryview | bytes


@dataclass(slots=True)
class Tally:
    """Counts of what was read and of what could not be read.

    points_dropped : without a finite position. skipped : scans left out, by reason. bytes_lost : of the
    files, skipped for damage. topics_lost : True if these bytes may have held otherwise unknown topics.
    warnings : sentences for the user at the end. arrived, dropped, reconnected : of a robot: messages; scans
    that waited too long because the computer is too slow; lost connections that were made again.
    """

    scans_read: int = 0
    points_dropped: int = 0
    bytes_lost: int = 0
    topics_lost: bool = False
    skipped: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    arrived: int = 0
    dropped: int = 0
    reconnected: int = 0
    _told: set[str] = field(default_factory=set)
    _news: list[str] = field(default_factory=list)

    def tell(self, sentence: str, *, again: bool = False) -> None:
        """Add a sentence for the user now, at most once. again : even if it was told before."""
        if again or sentence not in self._told:
            self._told.add(sentence)
            self._news.append(sentence)

    def take_news(self) -> list[str]:
        """Return the sentences for the user since the last call."""
        taken, self._news = self._news, []
        return taken

    def warn(self, sentence: str) -> None:
        """Add a sentence for the user, unless it is there already."""
        if sentence not in self.warnings:
            self.warnings.append(sentence)

    def report(self, more_warnings: Iterable[str] = ()) -> ReadReport:
        """Return the counts so far."""
        return ReadReport(
            scans_read=self.scans_read,
            points_dropped=self.points_dropped,
            scans_skipped=dict(self.skipped),
            bytes_lost=self.bytes_lost,
            warnings=tuple(dict.fromkeys((*self.warnings, *more_warnings))),
        )

    def take_over(self, other: Tally) -> None:
        """Add the damage that another one counted, and its warnings."""
        self.bytes_lost += other.bytes_lost
        self.topics_lost |= other.topics_lost
        for sentence in other.warnings:
            self.warn(sentence)

    def skip(self, reason: str) -> None:
        """Count one more scan left out for `reason`."""
        self.skipped[reason] = self.skipped.get(reason, 0) + 1


class MessageSource(Protocol):
    """A source of timed messages.

    tally : counts while it is read. files : those that the messages come from.
    """

    tally: Tally
    files: tuple[Path, ...]

    @property
    def info(self) -> LogInfo:
        """Return the facts about them, which are known as soon as the source is open."""
        ...

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield messages of the topics with start_ns <= log time < end_ns (nanoseconds; None: no bound).

        Sorted by log time, as far as the memory suffices for it. May be called again, for another pass.

        Raises LogError (LogCorrupt, LimitExceeded, ...) when damage is reached.
        """
        ...

    def close(self) -> None:
        """Close the files."""
        ...


RECOVER_HINT = "--recover reads what is whole"
LFS_HINT = "`git lfs pull` in its repository fetches the file itself"

T = TypeVar("T")


def first_bytes(path: Path) -> bytes:
    """Return the first 100 bytes of a file, which identify its format. Raises OSError."""
    with path.open("rb") as file:
        return file.read(100)


def is_submap_database(head: bytes) -> bool:
    """Return True if a file is a submap database, by its first 100 bytes."""
    return head.startswith(SQLITE) and head[68:72] == SUBMAPS_ID


def is_submap_file(path: Path) -> bool:
    """Return True if this is the file of a submap database; False if it cannot be read."""
    try:
        return is_submap_database(first_bytes(path))
    except OSError:
        return False


def is_lfs_pointer(head: bytes) -> bool:
    """Return True if a file that begins so is the pointer that Git leaves for a large file that was not
    fetched."""
    return head.startswith(b"version https://git-lfs")


def translated(path: Path, error: Exception, hint: str | None = None) -> Pc2GridError:
    """Return the error to show for one that a decoder raised; a LogError gets the path of its recording
    added.

    hint : advice against damage in this kind of file; `--recover` if it is None.
    """
    if isinstance(error, LogError) and one_line(path.name) not in error.message:
        return type(error)(f"{path}: {error.message}", hint=error.hint or hint)
    if isinstance(error, Pc2GridError):
        return error
    if isinstance(error, OSError):
        return LogCorrupt(f"{path}: cannot be read: {error.strerror or error}")
    return LogCorrupt(
        f"{path}: damaged ({type(error).__name__}: {' '.join(str(error).split())[:120]})",
        hint=hint or RECOVER_HINT,
    )


def guarded(path: Path, action: Callable[[], T], hint: str | None = None) -> T:
    """Run an action and return its result; an exception in it is translated."""
    try:
        return action()
    except MemoryError:
        raise
    except Exception as error:
        ours = translated(path, error, hint)
        try:
            if ours is error:
                raise
            raise ours from error
        finally:
            # Its traceback holds this frame, and what was read. A name of it here would keep both alive.
            del ours


def guarded_stream(path: Path, stream: Iterator[T], hint: str | None = None) -> Iterator[T]:
    """Yield the items of an iterator, with its exceptions translated; those of its consumer do not pass
    through here."""
    end = object()
    following = partial(next, stream, end)
    while (item := guarded(path, following, hint)) is not end:
        yield cast("T", item)
