"""ROS 1 bags (http://wiki.ros.org/Bags/Format/2.0) as a message source, read by `rosbags`.

The format has no checksums, so damage shows in the structure only, and `rosbags` checks neither lengths nor
the entries of the index. Therefore record lengths are compared with the file before `rosbags` opens it, its
reads and decompressions are bounded, and the index is compared with the chunks.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pc2grid.config import ReadConfig
from pc2grid.errors import LimitExceeded, LogCorrupt, LogTruncated
from pc2grid.io.containers.bounded_file import BoundedFile
from pc2grid.io.containers.decompress import unpacker
from pc2grid.io.error_translation import guarded, guarded_stream
from pc2grid.io.message_source import LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.messages.ros_definitions import short_name

MAGIC = b"#ROSBAG V2.0\n"
_MAX_HEADER_BYTES = 1 << 20  # chosen by hand: real headers have less than a kilobyte
_OP_CONNECTION = 7
_UNCHECKED = "the bag carries no checksum: damage to its data would not be seen"


def repair_hint(path: Path) -> str:
    """The command that makes a readable bag of what is whole."""
    return f"`rosbag reindex {path.name}` mends it; --recover is for MCAP files"


class BagSource:
    """One ROS 1 bag (format 2.0), open.

    Raises LogTruncated or LogCorrupt for a damaged bag or one without an index (its recorder was killed), and
    LimitExceeded, when it is opened or read.
    """

    def __init__(self, path: Path, config: ReadConfig) -> None:
        from rosbags.rosbag1 import Reader

        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._path = path
        self._hint = repair_hint(path)
        self._check_record_lengths(config.max_record_bytes)
        self._reader = Reader(path)
        self._reader.path = _BoundedPath(path)
        self._reader.path.most_bytes = config.max_record_bytes
        try:
            guarded(path, lambda: self._open(config), hint=self._hint)
        except BaseException:
            self.close()
            raise

    def _open(self, config: ReadConfig) -> None:
        from rosbags.rosbag1 import ReaderError

        try:
            self._reader.open()
        except ReaderError as error:
            # A recorder writes the index last; without one it was interrupted.
            kind = LogTruncated if "not indexed" in str(error) else LogCorrupt
            raise kind(f"{self._path}: {error}", hint=self._hint) from error
        self._check_index()
        for place, chunk in self._reader.chunks.items():
            compression = _compression(chunk)
            bounded = unpacker(compression, config.max_chunk_bytes)
            if compression != "bz2":  # the only one with a checksum
                self.tally.warn(_UNCHECKED)
            self._reader.chunks[place] = chunk._replace(decompressor=bounded)
        self._check_connections()
        self._topic_of = self._topics()
        topics = sorted(set(self._topic_of.values()), key=lambda t: (t.topic, t.type))
        count = sum(t.message_count or 0 for t in topics)
        self.info = LogInfo(
            path=self._path,
            format="bag/ros1",
            size_bytes=self._path.stat().st_size,
            start_ns=self._reader.start_time if count else 0,
            end_ns=self._reader.end_time - 1 if count else 0,
            message_count=count,
            topics=tuple(topics),
            warnings=tuple(self.tally.warnings),
        )

    def close(self) -> None:
        """Close the file."""
        if self._reader.bio is not None:
            self._reader.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See MessageSource.messages; exactly by log time."""
        wanted = [c for c in self._reader.connections if self._topic_of[c.id].topic in topics]
        if not wanted:
            return  # rosbags reads every topic if it is given none
        found = self._reader.messages(wanted, start_ns, end_ns)
        for connection, time_ns, data in guarded_stream(self._path, found, hint=self._hint):
            yield RawMessage(self._topic_of[connection.id], time_ns, data)

    def _topics(self) -> dict[int, TopicInfo]:
        """The topic of each connection; a topic has one connection per publisher."""
        connections = self._reader.connections
        counts: dict[tuple[str, str], int] = {}
        for c in connections:
            counts[c.topic, c.msgtype] = counts.get((c.topic, c.msgtype), 0) + c.msgcount
        first: dict[tuple[str, str], TopicInfo] = {}
        for c in connections:
            info = TopicInfo(
                topic=c.topic,
                type=short_name(c.msgtype),
                encoding="ros1",
                schema_encoding="ros1msg",
                schema=c.msgdef.data.encode(),
                message_count=counts[c.topic, c.msgtype],
            )
            first.setdefault((c.topic, c.msgtype), info)
        return {c.id: first[c.topic, c.msgtype] for c in connections}

    # --- what rosbags does not check ------------------------------------------------------------------

    def _check_record_lengths(self, most_bytes: int) -> None:
        """Follow all records by their lengths: header and data, a uint32 length in front of each.

        Raises LogTruncated, or LimitExceeded for a record that is too large to be read.
        """
        size = self._path.stat().st_size
        at = len(MAGIC)
        with self._path.open("rb") as stream:
            while at < size:
                for limit in (_MAX_HEADER_BYTES, most_bytes):
                    stream.seek(at)
                    raw = stream.read(4)
                    length = int.from_bytes(raw, "little")
                    at += 4 + length
                    if len(raw) < 4 or at > size:
                        raise LogTruncated(
                            f"{self._path}: the bag ends within a record ({size} bytes, {at} needed)",
                            hint=self._hint,
                        )
                    if length > limit:
                        raise LimitExceeded(
                            f"{self._path}: a record's part of {length} bytes, before byte {at}; "
                            f"the limit is {limit}",
                            hint="--set read.max_record_bytes=N raises it",
                        )

    def _check_index(self) -> None:
        """Compare the message counts of the chunk records with the index: rosbags leaves the rest out."""
        counted: dict[int, int] = {}
        for chunk in self._reader.chunk_infos:
            for connection, count in chunk.connection_counts.items():
                counted[connection] = counted.get(connection, 0) + count
        listed = {connection: len(entries) for connection, entries in self._reader.indexes.items() if entries}
        if listed != {connection: count for connection, count in counted.items() if count}:
            raise LogCorrupt(f"{self._path}: the index does not list what the chunks hold", hint=self._hint)

    def _check_connections(self) -> None:
        """Compare each connection of the index with its copy in the first chunk that uses it.

        A flipped bit in the name of a topic would hide the topic.
        """
        first: dict[int, int] = {}
        for info in sorted(self._reader.chunk_infos, key=lambda info: info.pos):
            for key in info.connection_counts:
                first.setdefault(key, info.pos)
        in_chunks: dict[int, _Connection] = {}
        for place in sorted(set(first.values())):
            chunk = self._reader.chunks[place]
            assert self._reader.bio is not None
            self._reader.bio.seek(chunk.datapos)
            content = chunk.decompressor(self._reader.bio.read(chunk.datasize))
            in_chunks = _connections_in(content) | in_chunks
        for c in self._reader.connections:
            there = in_chunks.get(c.id)
            if there and there != _comparable(c.topic, c.msgtype, c.msgdef.data):
                raise LogCorrupt(
                    f"{self._path}: the index describes {c.topic:.80} otherwise than its chunk does",
                    hint=self._hint,
                )


class _BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose file refuses to read more than `most_bytes` at once."""

    most_bytes: int

    def open(self, *arguments: Any, **options: Any) -> BoundedFile:
        return BoundedFile(io.FileIO(self), self.most_bytes)


class _Connection(NamedTuple):
    """A publisher of a topic."""

    topic: list[str]
    type: str
    definition: str


def _comparable(topic: str, kind: str, definition: str) -> _Connection:
    """A connection without the differences in spelling that rosbags removes: slashes, and `msg` in types."""
    return _Connection([name for name in topic.split("/") if name], short_name(kind), definition)


def _connections_in(content: bytes) -> dict[int, _Connection]:
    """The connections that a chunk's content describes, by their numbers."""
    from rosbags.rosbag1.reader import Header, read_bytes, read_uint32

    found: dict[int, _Connection] = {}
    stream = io.BytesIO(content)
    while stream.tell() < len(content):
        header = Header.read(stream)
        data = read_bytes(stream, read_uint32(stream))
        if header.get_uint8("op") == _OP_CONNECTION:
            fields = Header.read(io.BytesIO(struct.pack("<I", len(data)) + data))
            found[header.get_uint32("conn")] = _comparable(
                header.get_string("topic"), fields.get_string("type"), fields.get_string("message_definition")
            )
    return found


def _compression(chunk: Any) -> str:
    from rosbags.rosbag1.reader import decompressors

    return next(name for name, function in decompressors.items() if function is chunk.decompressor)
