"""What is whole of a damaged ROS 1 bag, or of one whose recorder was killed before it wrote the index.

The bag is surveyed once, chunk by chunk (http://wiki.ros.org/Bags/Format/2.0): a chunk counts if it unpacks
to whole records; behind damage the survey goes on at the next chunk that is there.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pc2grid.config import ReadConfig
from pc2grid.errors import LimitExceeded, LogCorrupt
from pc2grid.io.bag_log import MAGIC, MAX_HEADER, UNCHECKED, topics_of
from pc2grid.io.bag_records import (
    CHUNK,
    CONNECTION,
    MESSAGE,
    Broken,
    Connection,
    blob,
    connection_of,
    fields_of,
)
from pc2grid.io.source import LogInfo, RawMessage, Tally
from pc2grid.io.unpack import unpacker

_KINDS = (b"\x02", b"\x03", b"\x04", b"\x05", b"\x06", b"\x07")
# Only a chunk has this field; writers differ in where in its header it stands.
_CHUNK_MARK = b"compression="
_MAX_CHUNK_HEADER = 80
_WINDOW = 64 << 10  # not larger: it is read anew for each place of damage


class _Chunk(NamedTuple):
    at: int
    size: int
    compression: str
    start_ns: int
    end_ns: int


class SalvagedBag:
    """The whole chunks of a bag as a message source; the rest is counted in `tally`."""

    def __init__(self, path: Path, config: ReadConfig) -> None:
        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._config = config
        self._chunks: list[_Chunk] = []
        self._connections: dict[int, Connection] = {}
        self._stream: BinaryIO = path.open("rb")
        size = path.stat().st_size
        self._survey(size)
        self._topic_of = topics_of(self._connections)
        topics = sorted(set(self._topic_of.values()), key=lambda t: (t.topic, t.type))
        self.info = LogInfo(
            path=path,
            format="bag/ros1",
            size_bytes=size,
            start_ns=min((c.start_ns for c in self._chunks), default=0),
            end_ns=max((c.end_ns for c in self._chunks), default=0),
            message_count=sum(t.message_count or 0 for t in topics),
            topics=tuple(topics),
            warnings=tuple(self.tally.warnings),
        )

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See Source.messages; chunk by chunk, in each by log time."""
        low = -1 if start_ns is None else start_ns
        high = 1 << 64 if end_ns is None else end_ns
        wanted = {key for key, topic in self._topic_of.items() if topic.topic in topics}
        for chunk in sorted(self._chunks, key=lambda c: c.start_ns):
            if chunk.end_ns < low or chunk.start_ns >= high:
                continue
            self._stream.seek(chunk.at)
            found = self._messages_in(self._stream.read(chunk.size), chunk.compression)
            for key, time_ns, data in sorted(found, key=lambda m: m[1]):
                if key in wanted and low <= time_ns < high:
                    yield RawMessage(self._topic_of[key], time_ns, data)

    def _survey(self, size: int) -> None:
        at = len(MAGIC)
        while at < size:
            try:
                at = self._take_record(at, size)
            except (Broken, LogCorrupt, LimitExceeded) as error:
                after = self._next_chunk(at + 1, size)
                self.tally.bytes_lost += after - at
                self.tally.topics_lost |= after < size
                self.tally.warn(f"{error}, at byte {at}: {after - at} bytes were skipped")
                at = after

    def _take_record(self, at: int, size: int) -> int:
        """Take up the record at a place in the file; returns where the next one is."""
        head_size = self._length(at, size, MAX_HEADER)
        data_at = at + 4 + head_size + 4
        data_size = self._length(data_at - 4, size, self._config.max_record_bytes)
        self._stream.seek(at + 4)
        fields = fields_of(memoryview(self._stream.read(head_size)))
        kind = fields.get(b"op")
        if kind not in _KINDS or (b"compression" in fields) != (kind == CHUNK):
            raise Broken("a record of unknown kind")
        if kind == CHUNK:
            self._stream.seek(data_at)
            compression = fields.get(b"compression", b"").decode("ascii", "replace")
            found = self._messages_in(self._stream.read(data_size), compression)
            if compression != "bz2":
                self.tally.warn(UNCHECKED)
            times = [time_ns for _, time_ns, _ in found]
            if times:
                self._chunks.append(_Chunk(data_at, data_size, compression, min(times), max(times)))
            for key, _, _ in found:
                self._connections[key] = self._connections[key].one_more()
        return data_at + data_size

    def _length(self, at: int, size: int, most: int) -> int:
        self._stream.seek(at)
        raw = self._stream.read(4)
        length = int.from_bytes(raw, "little")
        if len(raw) < 4 or at + 4 + length > size:
            raise Broken("the bag ends within a record")
        if length > most:
            raise Broken(f"a part of a record has {length} bytes; the limit is {most}")
        return length

    def _messages_in(self, stored: bytes, compression: str) -> list[tuple[int, int, memoryview]]:
        """Connection, time and data of the messages of a chunk; connections are taken up on the way."""
        if compression not in ("none", "bz2", "lz4"):
            raise Broken(f"a chunk of unknown compression {compression!r:.20}")
        content = memoryview(unpacker(compression, self._config.max_chunk_bytes)(stored))
        found, at, new = [], 0, {}
        while at < len(content):
            head, at = blob(content, at)
            data, at = blob(content, at)
            fields = fields_of(head)
            key = int.from_bytes(fields.get(b"conn", b""), "little")
            if fields.get(b"op") == CONNECTION:
                new[key] = connection_of(fields, data)
            elif fields.get(b"op") == MESSAGE:
                time = fields.get(b"time", b"")
                seconds, rest = (int.from_bytes(time[i : i + 4], "little") for i in (0, 4))
                if len(time) != 8 or b"conn" not in fields:
                    raise Broken("a message without its time or connection")
                found.append((key, seconds * 1_000_000_000 + rest, data))
            else:
                raise Broken("a record of unknown kind in a chunk")
        known = new | self._connections
        if any(key not in known for key, _, _ in found):
            raise Broken("a chunk rests on a connection that is lost")
        self._connections = known
        return found

    def _next_chunk(self, start: int, size: int) -> int:
        """Where the next chunk record begins, or the end of the file."""
        at = start
        while at < size:
            self._stream.seek(at)
            window = memoryview(self._stream.read(_WINDOW + 2 * _MAX_CHUNK_HEADER))
            for mark in re.finditer(re.escape(_CHUNK_MARK), window):
                for begin in range(max(mark.start() - _MAX_CHUNK_HEADER, 0), mark.start() - 7):
                    if _is_chunk(window, begin):
                        return at + begin
            at += _WINDOW
        return size


def _is_chunk(view: memoryview, at: int) -> bool:
    """Whether a chunk record's header could begin here."""
    length = int.from_bytes(view[at : at + 4], "little")
    try:
        return length <= _MAX_CHUNK_HEADER and fields_of(blob(view, at)[0]).get(b"op") == CHUNK
    except Broken:
        return False
