"""The MCAP container, record by record (https://mcap.dev/spec).

A reader of our own, because damage must be seen, placed and bounded: every length is checked before
anything is allocated, every chunk's checksum is verified, and an unknown compression is never taken for
none. Nothing here knows what the messages mean.
"""

from __future__ import annotations

import functools
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

from pc2grid.errors import LimitExceeded, UnsupportedSchema
from pc2grid.io.unpack import expand

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)

RECORD_HEAD = 9
FOOTER_SIZE = RECORD_HEAD + 20
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_HEAD = struct.Struct("<BQ")


class Damage(Exception):
    """The bytes at `offset` are not what the format demands; `truncated` if the file just ends."""

    def __init__(self, offset: int, what: str, *, truncated: bool = False) -> None:
        super().__init__(what)
        self.offset = offset
        self.what = what
        self.truncated = truncated


@dataclass(frozen=True, slots=True)
class Limits:
    """What a file may ask of memory."""

    chunk_bytes: int
    record_bytes: int


class Record(NamedTuple):
    """A top-level record; `data` is empty for kinds that nobody here reads (attachments and the like)."""

    offset: int
    opcode: int
    data: bytes
    size: int  # with its 9-byte head


class RawSchema(NamedTuple):
    """A schema record."""

    name: str
    encoding: str
    data: bytes


class RawChannel(NamedTuple):
    """A channel record."""

    schema_id: int
    topic: str
    message_encoding: str


class ChunkHead(NamedTuple):
    """A chunk record in front of its data."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    data_at: int


class ChunkIndex(NamedTuple):
    """Where a chunk is and what is in it; `channels` is None if the writer did not say."""

    offset: int
    size: int
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    after: int  # offset behind the chunk and its message indexes


class Statistics(NamedTuple):
    """What a writer counted; `counts` of each channel may be left out."""

    message_count: int
    channel_count: int
    chunk_count: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]

    @property
    def counted(self) -> bool:
        """Whether the counts of the channels agree with that of all messages."""
        return sum(self.counts.values()) == self.message_count


class ChunkMessage(NamedTuple):
    """A message in a chunk or in the data section."""

    channel_id: int
    log_time_ns: int
    data: memoryview


@dataclass(slots=True)
class Definitions:
    """Schemas and channels seen so far."""

    schemas: dict[int, RawSchema] = field(default_factory=dict)
    channels: dict[int, RawChannel] = field(default_factory=dict)

    def take(self, opcode: int, data: bytes | memoryview, offset: int) -> None:
        """Add a schema or channel record. Raises Damage if it contradicts an earlier one."""
        fields = Fields(data, offset)
        key = fields.number("<H")
        if opcode == SCHEMA:
            schema = RawSchema(fields.text(), fields.text(), bytes(fields.blob()))
            if key == 0 or self.schemas.setdefault(key, schema) != schema:
                raise Damage(offset, f"schema {key} is defined twice")
        else:
            channel = RawChannel(fields.number("<H"), fields.text(), fields.text())
            if self.channels.setdefault(key, channel) != channel:
                raise Damage(offset, f"channel {key} is defined twice")
            if channel.schema_id and channel.schema_id not in self.schemas:
                raise Damage(offset, f"channel {key} names schema {channel.schema_id}, which is missing")


class Fields:
    """Reads the fields of a record, never past its end."""

    def __init__(self, data: bytes | memoryview, offset: int) -> None:
        self._data = memoryview(data)
        self._offset = offset
        self.at = 0

    def number(self, code: str) -> int:
        """One integer of a struct format."""
        (value,) = self.numbers(code)
        return value

    def numbers(self, codes: str) -> tuple[int, ...]:
        """Integers of a struct format."""
        layout = _struct(codes)
        start = self.at
        self.at = start + layout.size
        if self.at > len(self._data):
            raise Damage(self._offset, "a record is shorter than its fields")
        return layout.unpack_from(self._data, start)

    def blob(self, length: str = "<I") -> memoryview:
        """Bytes behind their length."""
        size = self.number(length)
        if size > len(self._data) - self.at:
            raise Damage(self._offset, "a record is shorter than its fields")
        self.at += size
        return self._data[self.at - size : self.at]

    def text(self) -> str:
        """A string behind its length."""
        try:
            return bytes(self.blob()).decode("utf-8")
        except UnicodeDecodeError:
            raise Damage(self._offset, "a name is not text") from None

    @property
    def done(self) -> bool:
        """Whether everything is read."""
        return self.at >= len(self._data)


@functools.cache
def _struct(codes: str) -> struct.Struct:
    return struct.Struct(codes)


def read_records(
    stream: BinaryIO, start: int, end: int, limits: Limits, *, wanted: frozenset[int]
) -> Iterator[Record]:
    """Records from byte `start` to `end`; only those of the `wanted` kinds have their data loaded.

    Raises Damage if a record does not fit before `end`, LimitExceeded if one is absurdly large.
    """
    offset = start
    while offset < end:
        stream.seek(offset)
        head = stream.read(RECORD_HEAD)
        if offset + RECORD_HEAD > end or len(head) < RECORD_HEAD:
            raise Damage(offset, "the file ends within a record", truncated=True)
        opcode, length = _HEAD.unpack(head)
        if opcode == 0:
            raise Damage(offset, "not a record")
        if length > end - offset - RECORD_HEAD:
            raise Damage(offset, f"a record of {length} bytes does not fit into the file", truncated=True)
        data = b""
        if opcode in wanted:
            if length > limits.record_bytes:
                raise too_large(offset, length, limits)
            data = stream.read(length)
            if len(data) < length:
                raise Damage(offset, "the file ends within a record", truncated=True)
        yield Record(offset, opcode, data, RECORD_HEAD + length)
        offset += RECORD_HEAD + length


def too_large(offset: int, length: int, limits: Limits) -> LimitExceeded:
    """The error for a record that is not read for its size."""
    return LimitExceeded(
        f"a record at byte {offset} has {length} bytes; the limit is {limits.record_bytes}",
        hint="--set read.max_record_bytes=N raises it",
    )


def statistics(record: Record) -> Statistics:
    """The fields of a statistics record. Raises Damage if they do not fit into it."""
    fields = Fields(record.data, record.offset)
    messages, _, channels, _, _, chunks, start_ns, end_ns = fields.numbers("<QHIIIIQQ")
    pairs = Fields(fields.blob(), record.offset)
    counts: dict[int, int] = {}
    while not pairs.done:
        key, count = pairs.numbers("<HQ")
        counts[key] = count
    return Statistics(messages, channels, chunks, start_ns, end_ns, counts)


def chunk_head(data: bytes | memoryview, offset: int) -> ChunkHead:
    """The fields in front of a chunk's data. Raises Damage if they contradict the record's length."""
    fields = Fields(data, offset)
    start_ns, end_ns, size, crc = fields.numbers("<QQQI")
    compression = fields.text()
    stored = fields.number("<Q")
    if stored != len(data) - fields.at:
        raise Damage(offset, "a chunk's lengths contradict each other")
    return ChunkHead(start_ns, end_ns, size, crc, compression, fields.at)


def decompress(data: bytes, head: ChunkHead, offset: int, limits: Limits) -> bytes | memoryview:
    """The records of a chunk, decompressed and checked.

    Raises Damage if they are not what was written, LimitExceeded for a decompression bomb,
    UnsupportedSchema for a compression we do not know.
    """
    if head.uncompressed_size > limits.chunk_bytes:
        raise LimitExceeded(
            f"the chunk at byte {offset} would expand to {head.uncompressed_size} bytes; "
            f"the limit is {limits.chunk_bytes}",
            hint="--set read.max_chunk_bytes=N raises it",
        )
    stored = memoryview(data)[head.data_at :]
    expanded: bytes | memoryview = stored
    if head.compression:
        if head.compression not in ("zstd", "lz4"):
            raise UnsupportedSchema(
                f"the chunk at byte {offset} is compressed with {head.compression!r:.40}",
                hint="pc2grid reads zstd, lz4 and uncompressed chunks; `mcap convert` can change it",
            )
        try:
            # One byte more than wanted: so it shows if there is more than the chunk says.
            expanded = expand(head.compression, stored, head.uncompressed_size + 1)
        except ValueError as error:
            raise Damage(offset, f"a chunk cannot be decompressed ({error})") from error
    if len(expanded) != head.uncompressed_size:
        raise Damage(offset, f"a chunk has {len(expanded)} bytes instead of {head.uncompressed_size}")
    if head.crc and zlib.crc32(expanded) != head.crc:
        raise Damage(offset, "a chunk's checksum (CRC) is wrong")
    return expanded


def chunk_messages(
    content: bytes | memoryview, offset: int, definitions: Definitions, wanted: frozenset[int] | None
) -> list[ChunkMessage]:
    """Messages of the wanted channels (None: all) in a chunk's content; definitions are taken up on the way.

    Raises Damage if the content is not a sequence of records, or a message has no channel.
    """
    view = memoryview(content)
    messages: list[ChunkMessage] = []
    at, size = 0, len(view)
    channels = definitions.channels
    while at < size:
        if at + RECORD_HEAD > size:
            raise Damage(offset, "a chunk ends within a record")
        opcode, length = _HEAD.unpack_from(view, at)
        stop = at + RECORD_HEAD + length
        if stop > size:
            raise Damage(offset, "a chunk ends within a record")
        if opcode == MESSAGE:
            if length < 22:
                raise Damage(offset, "a message is shorter than its fields")
            _, _, channel_id, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(view, at)
            if wanted is None or channel_id in wanted:
                if channel_id not in channels:
                    raise Damage(offset, f"a message names channel {channel_id}, which is missing")
                messages.append(ChunkMessage(channel_id, log_time_ns, view[at + 31 : stop]))
        elif opcode in (SCHEMA, CHANNEL):
            definitions.take(opcode, view[at + RECORD_HEAD : stop], offset)
        at = stop
    return messages
