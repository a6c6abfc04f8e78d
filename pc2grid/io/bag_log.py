"""ROS 1 bags as a message source, read by `rosbags`.

The format has no checksums, so all that can be seen of damage is structure: record lengths are checked
against the file before `rosbags` is let at it, and what it unpacks is bounded.
"""

from __future__ import annotations

import io
import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from pc2grid.config import ReadConfig
from pc2grid.errors import LimitExceeded, LogCorrupt, LogTruncated
from pc2grid.io.bag_records import Broken, Connection, connections_in
from pc2grid.io.ros_definitions import short_name
from pc2grid.io.source import LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.unpack import unpacker

MAGIC = b"#ROSBAG V2.0\n"
MAX_HEADER = 1 << 20
_RECOVER = "--recover reads what is whole"


UNCHECKED = "the bag carries no checksum: damage to its data would not be seen"


class BagSource:
    """One ROS 1 bag (format 2.0), open.

    Raises LogTruncated or LogCorrupt when it is opened or read. What is whole of a
    damaged one is read by `bag_salvage`.
    """

    def __init__(self, path: Path, config: ReadConfig) -> None:
        from rosbags.rosbag1 import Reader, ReaderError

        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._path = path
        _check_records(path, config.max_record_bytes)
        self._reader = Reader(path)
        self._reader.path = _BoundedPath(path)
        self._reader.path.most_bytes = config.max_record_bytes
        try:
            self._reader.open()
        except ReaderError as error:
            # A recorder writes the index last; without one it was interrupted.
            kind = LogTruncated if "not indexed" in str(error) else LogCorrupt
            raise kind(f"{path}: {error}", hint=_RECOVER) from error
        self._check_index()
        for place, chunk in self._reader.chunks.items():
            kind_of = _compression(chunk)
            bounded = unpacker(kind_of, config.max_chunk_bytes)
            if kind_of != "bz2":
                self.tally.warn(UNCHECKED)
            self._reader.chunks[place] = chunk._replace(decompressor=bounded)
        self._check_connections()
        self._topic_of = topics_of(
            {
                c.id: Connection(c.topic, c.msgtype, c.msgdef.data, c.msgcount)
                for c in self._reader.connections
            }
        )
        topics = sorted(set(self._topic_of.values()), key=lambda t: (t.topic, t.type))
        count = sum(t.message_count or 0 for t in topics)
        self.info = LogInfo(
            path=path,
            format="bag/ros1",
            size_bytes=path.stat().st_size,
            start_ns=self._reader.start_time if count else 0,
            end_ns=self._reader.end_time - 1 if count else 0,
            message_count=count,
            topics=tuple(topics),
            warnings=tuple(self.tally.warnings),
        )

    def _check_index(self) -> None:
        """What each chunk says to hold must be what the index lists, or messages would be left out unseen."""
        told: dict[int, int] = {}
        for chunk in self._reader.chunk_infos:
            for connection, count in chunk.connection_counts.items():
                told[connection] = told.get(connection, 0) + count
        listed = {connection: len(entries) for connection, entries in self._reader.indexes.items() if entries}
        if listed != {connection: count for connection, count in told.items() if count}:
            self._reader.close()
            raise LogCorrupt(f"{self._path}: the index does not list what the chunks hold", hint=_RECOVER)

    def _check_connections(self) -> None:
        """What the index says of a topic, its first chunk said before; a flipped bit in it would hide it."""
        first: dict[int, int] = {}
        for info in sorted(self._reader.chunk_infos, key=lambda info: info.pos):
            for key in info.connection_counts:
                first.setdefault(key, info.pos)
        said: dict[int, Connection] = {}
        try:
            for place in sorted(set(first.values())):
                chunk = self._reader.chunks[place]
                assert self._reader.bio is not None
                self._reader.bio.seek(chunk.datapos)
                said = connections_in(chunk.decompressor(self._reader.bio.read(chunk.datasize))) | said
            for c in self._reader.connections:
                there = said.get(c.id)
                if there and _plain(there) != _plain(Connection(c.topic, c.msgtype, c.msgdef.data, 0)):
                    raise Broken(f"the index describes {c.topic:.80} otherwise than its chunk does")
        except (Broken, LogCorrupt, LimitExceeded) as error:
            self.close()
            kind = LimitExceeded if isinstance(error, LimitExceeded) else LogCorrupt
            raise kind(f"{self._path}: {error}", hint=_RECOVER) from error

    def close(self) -> None:
        """Close the file."""
        if self._reader.bio is not None:
            self._reader.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See Source.messages; exactly by log time."""
        from rosbags.rosbag1 import ReaderError

        wanted = [c for c in self._reader.connections if self._topic_of[c.id].topic in topics]
        if not wanted:
            return  # an empty choice would mean everything
        try:
            for connection, time_ns, data in self._reader.messages(wanted, start_ns, end_ns):
                yield RawMessage(self._topic_of[connection.id], time_ns, data)
        except (ReaderError, AssertionError) as error:
            raise LogCorrupt(f"{self._path}: a chunk is damaged: {error}", hint=_RECOVER) from error


class _BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose file hands out no more than `most_bytes` at once."""

    most_bytes: int

    def open(self, *arguments: Any, **options: Any) -> _BoundedFile:
        return _BoundedFile(io.FileIO(self), self.most_bytes)


class _BoundedFile(io.BufferedReader):
    """Lengths that a wrong place in the index leads to are refused, and not set aside in memory."""

    def __init__(self, raw: io.FileIO, most_bytes: int) -> None:
        super().__init__(raw)
        self._most_bytes = most_bytes
        self._size = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """See io.BufferedReader. Raises LogCorrupt for more than is allowed or there."""
        if size is not None and size > min(self._most_bytes, self._size):
            raise LogCorrupt(f"a length of {size} bytes where a record should begin", hint=_RECOVER)
        return super().read(size)


def _plain(connection: Connection) -> tuple[list[str], str, str]:
    """What of it does not depend on how names are spelled: with which slashes, with `msg` or without."""
    names = [name for name in connection.topic.split("/") if name]
    return names, short_name(connection.type), connection.definition


def _compression(chunk: Any) -> str:
    from rosbags.rosbag1.reader import decompressors

    return next(name for name, function in decompressors.items() if function is chunk.decompressor)


def topics_of(connections: dict[int, Connection]) -> dict[int, TopicInfo]:
    """The topic of each connection; a topic has one per publisher."""
    counts: dict[tuple[str, str], int] = {}
    for c in connections.values():
        counts[c.topic, c.type] = counts.get((c.topic, c.type), 0) + c.messages
    first: dict[tuple[str, str], TopicInfo] = {}
    for c in connections.values():
        info = TopicInfo(
            topic=c.topic,
            type=short_name(c.type),
            encoding="ros1",
            schema_encoding="ros1msg",
            schema=c.definition.encode(),
            message_count=counts[c.topic, c.type],
        )
        first.setdefault((c.topic, c.type), info)
    return {key: first[c.topic, c.type] for key, c in connections.items()}


def _check_records(path: Path, most_bytes: int) -> None:
    """Walk over all records by their lengths: header and data, a u32 length in front of each.

    Raises LogTruncated, or LimitExceeded for a record that nobody should try to read.
    """
    size = path.stat().st_size
    at = len(MAGIC)
    with path.open("rb") as stream:
        while at < size:
            for limit in (MAX_HEADER, most_bytes):
                stream.seek(at)
                raw = stream.read(4)
                length = int.from_bytes(raw, "little")
                at += 4 + length
                if len(raw) < 4 or at > size:
                    raise LogTruncated(
                        f"{path}: the bag ends within a record ({size} bytes, {at} needed)", hint=_RECOVER
                    )
                if length > limit:
                    raise LimitExceeded(
                        f"{path}: a record's part of {length} bytes, before byte {at}; the limit is {limit}",
                        hint="--set read.max_record_bytes=N raises it",
                    )
