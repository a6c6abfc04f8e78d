"""rosbag2 SQLite files (.db3) as a message source, read by `rosbags`."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, LogTruncated, NotALog
from pc2grid.io.ros_definitions import short_name
from pc2grid.io.source import LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.unpack import ZSTD_MAGIC, unpacker

MAGIC = b"SQLite format 3\0"
RECOVER = "--recover reads what is whole"
UNCHECKED = "a .db3 carries no checksum: damage to its data would not be seen"


class Db3Source:
    """One .db3, open; messages that rosbag2 compressed one by one are unpacked.

    Raises NotALog for another application's SQLite file, LogTruncated or LogCorrupt for a damaged one, when
    it is opened or read: SQLite would follow a wrong link within the file without a word, so the structure of
    all of it is checked before the first message, or when it is opened (`check`).
    """

    def __init__(self, path: Path, config: ReadConfig, *, check: bool = False) -> None:
        from rosbags.rosbag2 import ReaderError
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._path = path
        self._checked = False
        self._unpack = unpacker("zstd", config.max_chunk_bytes)
        _check_size(path)
        # It is put into a URI, where ? and # and % would mean something else.
        self._reader = Sqlite3Reader(Path(quote(str(path.absolute()))))
        try:
            self._reader.open()
            self.info = self._describe()
            if check:
                self._check_structure()
        except ReaderError as error:
            if "missing tables" in str(error):
                raise NotALog(f"{path}: an SQLite file, but not a rosbag2 .db3: no messages") from error
            raise LogCorrupt(f"{path}: a damaged .db3: {_reason(error)}", hint=RECOVER) from error
        except BaseException:
            self.close()
            raise

    def _describe(self) -> LogInfo:
        self.tally.warn(UNCHECKED)
        self._topic_of = {
            c.id: TopicInfo(
                topic=c.topic,
                type=short_name(c.msgtype),
                encoding=getattr(c.ext, "serialization_format", "cdr"),
                schema_encoding={"MSG": "ros2msg", "IDL": "ros2idl"}.get(c.msgdef.format.name, ""),
                schema=c.msgdef.data.encode(),
                message_count=c.msgcount,
            )
            for c in self._reader.connections
        }
        found = self._reader.metadata
        if sum(c.msgcount for c in self._reader.connections) != found.message_count:
            raise LogCorrupt(f"{self._path}: its messages, topics and index of times disagree", hint=RECOVER)
        return LogInfo(
            path=self._path,
            format="db3/ros2",
            size_bytes=self._path.stat().st_size,
            start_ns=found.start_time if found.message_count else 0,
            end_ns=found.end_time - 1 if found.message_count else 0,
            message_count=found.message_count,
            topics=tuple(sorted(set(self._topic_of.values()), key=lambda t: (t.topic, t.type))),
            warnings=tuple(self.tally.warnings),
        )

    def close(self) -> None:
        """Close the file."""
        if self._reader.dbconn is not None:
            self._reader.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See Source.messages; exactly by log time."""
        import apsw

        wanted = [c for c in self._reader.connections if c.topic in topics]
        try:
            self._check_structure()
            for connection, time_ns, data in self._reader.messages(wanted, start_ns, end_ns):
                plain = self._unpack(data) if data[:4] == ZSTD_MAGIC else data
                yield RawMessage(self._topic_of[connection.id], time_ns, plain)
        except apsw.Error as error:
            raise LogCorrupt(f"{self._path}: {_reason(error)}", hint=RECOVER) from error

    def _check_structure(self) -> None:
        if self._checked:
            return
        assert self._reader.dbconn is not None
        ((found,),) = self._reader.dbconn.execute("PRAGMA integrity_check(1)")
        if found != "ok":
            raise LogCorrupt(f"{self._path}: a damaged .db3: {found}", hint=RECOVER)
        self._checked = True


def is_unfinished(path: Path) -> bool:
    """Whether the recorder left messages in a write-ahead log beside the file."""
    wal = path.with_name(path.name + "-wal")
    return wal.is_file() and wal.stat().st_size > 0


def _reason(error: Exception) -> str:
    return str(error).rsplit(": ", 1)[-1]


def _check_size(path: Path) -> None:
    """Compare the file with the size in its header (https://www.sqlite.org/fileformat2.html)."""
    with path.open("rb") as stream:
        head = stream.read(100)
    size = path.stat().st_size
    if len(head) < 100:
        raise LogTruncated(f"{path}: an SQLite file that ends after {size} bytes", hint="nothing to recover")
    page = int.from_bytes(head[16:18], "big")
    needed = int.from_bytes(head[28:32], "big") * (65536 if page == 1 else page)
    if head[24:28] == head[92:96] and size < needed:
        raise LogTruncated(f"{path}: ends after {size} of {needed} bytes", hint=RECOVER)
