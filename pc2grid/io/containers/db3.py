"""rosbag2 SQLite files (.db3) as a message source, read by SQLite itself.

`rosbags` opens these files as immutable, so it ignores the write-ahead log that a killed recorder left beside
the file, and bounds no message; hence the three queries here.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import apsw

from pc2grid.config import ReadConfig
from pc2grid.errors import LimitExceeded, LogCorrupt, LogError, LogTruncated, NotALog
from pc2grid.io.containers.decompress import plain_message
from pc2grid.io.message_source import LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.messages.ros_definitions import short_name

if TYPE_CHECKING:
    import apsw

_UNCHECKED = "a .db3 carries no checksum: damage to its data would not be seen"
_UNFINISHED = "the recorder did not close the file: its write-ahead log is read as far as it is whole"
_INT64_MAX = (1 << 63) - 1
# SQLite allocates no more for one value than this, whatever limit is set (https://sqlite.org/limits.html).
_SQLITE_MAX_BYTES = 1_000_000_000


def repair_hint(path: Path) -> str:
    """The command that saves what is whole of a damaged .db3."""
    return f"`sqlite3 {path.name} .recover | sqlite3 mended.db3` mends it; --recover is for MCAP files"


class Db3Source:
    """One .db3 file, open; messages that rosbag2 compressed one by one are decompressed.

    A write-ahead log beside the file (its recorder was killed) is read with it, and no file is changed. For
    that, SQLite needs the permission to write to both files.

    Raises NotALog for the SQLite file of another application, LogTruncated or LogCorrupt for a damaged file,
    LimitExceeded for a message above `max_record_bytes`, when it is opened or read. SQLite follows a wrong
    link between pages without an error, so the structure of the whole file is checked before the first
    message.
    """

    def __init__(self, path: Path, config: ReadConfig) -> None:
        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._path = path
        self._checked = False
        self._most_bytes = min(config.max_record_bytes, _SQLITE_MAX_BYTES)
        self._max_chunk_bytes = config.max_chunk_bytes
        unfinished = _is_unfinished(path)
        if not unfinished:
            _check_size(path)
        with contextlib.ExitStack() as opened:
            opened.enter_context(self._explained())
            self._connection = _connect(path, self._most_bytes, unfinished)
            opened.callback(self._connection.close)
            self.tally.warn(_UNCHECKED)
            if unfinished:
                self.tally.warn(_UNFINISHED)
            self.info = self._describe()
            opened.pop_all()

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See MessageSource.messages; exactly by log time."""
        with self._explained():
            yield from self._messages(topics, start_ns, end_ns)

    def _messages(
        self, topics: Collection[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        self._check_structure()
        wanted = [key for key, topic in self._topic_of.items() if topic.topic in topics]
        first_ns = 0 if start_ns is None else min(start_ns, _INT64_MAX)
        last_ns = _INT64_MAX if end_ns is None else min(end_ns - 1, _INT64_MAX)
        marks = ",".join("?" * len(wanted))
        rows = self._connection.execute(
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"
            " AND timestamp BETWEEN ? AND ? ORDER BY timestamp, rowid",
            (*wanted, first_ns, last_ns),
        )
        for key, time_ns, data in rows:
            yield RawMessage(self._topic_of[key], time_ns, plain_message(data, self._max_chunk_bytes))

    def _describe(self) -> LogInfo:
        run = self._connection.execute
        tables = {name for (name,) in run("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"messages", "topics"} <= tables:
            raise NotALog(f"{self._path}: an SQLite file, but not a rosbag2 .db3: no messages")
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:  # since rosbag2 of ROS 2 Iron
            rows = run("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
            definitions = {name: (encoding, text) for name, encoding, text in rows}
        counts = dict(run("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        ((total, start_ns, end_ns),) = run("SELECT count(*), min(timestamp), max(timestamp) FROM messages")
        self._topic_of: dict[int, TopicInfo] = {}
        for key, name, kind, encoding in run("SELECT id, name, type, serialization_format FROM topics"):
            schema_encoding, schema = definitions.get(kind, ("", ""))
            self._topic_of[key] = TopicInfo(
                topic=name,
                type=short_name(kind),
                encoding=encoding,
                schema_encoding=schema_encoding,
                schema=schema.encode(),
                message_count=counts.get(key, 0),
            )
        # The total comes from the index of times, the counts of the topics from the rows themselves.
        if sum(counts.values()) != total or not counts.keys() <= self._topic_of.keys():
            raise self._corrupt("its messages, topics and index of times disagree")
        return LogInfo(
            path=self._path,
            format="db3/ros2",
            size_bytes=self._path.stat().st_size,
            start_ns=int(start_ns or 0),
            end_ns=int(end_ns or 0),
            message_count=total,
            topics=tuple(sorted(set(self._topic_of.values()), key=lambda t: (t.topic, t.type))),
            warnings=tuple(self.tally.warnings),
        )

    def _check_structure(self) -> None:
        if self._checked:
            return
        ((found,),) = self._connection.execute("PRAGMA integrity_check(1)")
        if found != "ok":
            raise self._corrupt(found)
        self._checked = True

    def _corrupt(self, what: str) -> LogCorrupt:
        return LogCorrupt(f"{self._path}: a damaged .db3: {what}", hint=repair_hint(self._path))

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn what the body raises into a LogError."""
        try:
            yield
        except (LogError, MemoryError):
            raise
        except apsw.TooBigError as error:
            raise LimitExceeded(
                f"{self._path}: a message has more than {self._most_bytes} bytes",
                hint="--set read.max_record_bytes=N raises the limit",
            ) from error
        except (apsw.CantOpenError, apsw.ReadOnlyError, apsw.IOError, apsw.BusyError) as error:
            raise LogCorrupt(
                f"{self._path}: cannot be read: {error}",
                hint="copy it and the -wal file beside it to a folder where you may write",
            ) from error
        except Exception as error:
            raise self._corrupt(" ".join(str(error).split()) or type(error).__name__) from error


def _connect(path: Path, most_bytes: int, unfinished: bool) -> apsw.Connection:
    """A connection that changes no file."""
    place = f"file:{quote(os.fsencode(path.absolute()))}"
    if unfinished:
        found = apsw.Connection(f"{place}?mode=rw", apsw.SQLITE_OPEN_READWRITE | apsw.SQLITE_OPEN_URI)
        # An exclusive connection keeps its index of the write-ahead log in memory instead of in a -shm file
        # (https://sqlite.org/wal.html#noshm); without a checkpoint the log stays as it is.
        found.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
        found.execute("PRAGMA locking_mode=EXCLUSIVE; PRAGMA query_only=1").fetchall()
    else:
        found = apsw.Connection(f"{place}?immutable=1", apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI)
    found.limit(apsw.SQLITE_LIMIT_LENGTH, most_bytes)
    return found


def _is_unfinished(path: Path) -> bool:
    """Whether the recorder left messages in a write-ahead log beside the file."""
    wal = path.with_name(path.name + "-wal")
    return wal.is_file() and wal.stat().st_size > 0


def _check_size(path: Path) -> None:
    """Compare the file with the size in its header (https://www.sqlite.org/fileformat2.html).

    Raises LogTruncated.
    """
    with path.open("rb") as stream:
        head = stream.read(100)
    size = path.stat().st_size
    if len(head) < 100:
        raise LogTruncated(f"{path}: an SQLite file that ends after {size} bytes", hint="nothing to recover")
    page_bytes = int.from_bytes(head[16:18], "big")
    needed = int.from_bytes(head[28:32], "big") * (65536 if page_bytes == 1 else page_bytes)
    if head[24:28] == head[92:96] and size < needed:
        raise LogTruncated(f"{path}: ends after {size} of {needed} bytes", hint=repair_hint(path))
