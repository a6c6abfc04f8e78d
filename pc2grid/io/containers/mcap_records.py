"""Records of MCAP files (https://mcap.dev/spec): `mcap` parses them, this module bounds and checks them.

What the readers of `mcap` do not do, and what a file that may be damaged or hostile needs:

- They accept a record that ends within its fields, and hand out fewer bytes than a field has.
- They take an unknown compression for none, and allocate whatever a compressed frame claims.
- They do not compare the sizes of a chunk with each other, nor its records with its size.
- They raise 17 unrelated types of exceptions for damage, and none of them says where.

Of 2,100 random mutations of a recording, reading by `mcap` without checksums gave wrong data and no error for
23 %. Nothing here knows what the messages mean.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import struct
from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, breakup_chunk, get_chunk_data_stream

from pc2grid.errors import LimitExceeded, LogCorrupt, Pc2GridError, UnsupportedSchema
from pc2grid.io.containers.decompress import expand
from pc2grid.io.message_source import TopicInfo
from pc2grid.io.messages.ros_definitions import short_name

MAGIC = b"\x89MCAP0\r\n"
HEAD_BYTES = 9  # kind (uint8) and length (uint64)
CHUNK_KIND = bytes([Opcode.CHUNK])
FOOTER_BYTES = HEAD_BYTES + 20
# A chunk's times, size, checksum, and the lengths of its compression's name and of its data.
CHUNK_FIELDS_BYTES = 8 + 8 + 8 + 4 + 4 + 8
MESSAGE_FIELDS_BYTES = 22
_HEAD = struct.Struct("<BQ")

T = TypeVar("T")


class Damage(Exception):
    """The bytes at `offset` are not what the format demands; `truncated` if the file just ends."""

    def __init__(self, offset: int, what: str, *, truncated: bool = False) -> None:
        super().__init__(what)
        self.offset = offset
        self.what = what
        self.truncated = truncated


@dataclasses.dataclass(frozen=True, slots=True)
class Limits:
    """How much memory a file may ask for: bytes of a decompressed chunk, and of a record."""

    chunk_bytes: int
    record_bytes: int


class Record(NamedTuple):
    """A record of the file; `data` is empty for kinds that were not asked for."""

    offset: int
    opcode: int
    data: bytes
    size: int  # with its head


@dataclasses.dataclass(slots=True)
class Definitions:
    """Schemas and channels seen so far, by their ids."""

    schemas: dict[int, Schema] = dataclasses.field(default_factory=dict)
    channels: dict[int, Channel] = dataclasses.field(default_factory=dict)

    def take(self, found: McapRecord, offset: int) -> None:
        """Add a schema or a channel; other records are ignored.

        Raises Damage if it contradicts an earlier one, or names a schema that is missing.
        """
        if isinstance(found, Schema):
            if found.id == 0 or self.schemas.setdefault(found.id, found) != found:
                raise Damage(offset, f"schema {found.id} is defined twice")
        elif isinstance(found, Channel):
            known = self.channels.setdefault(found.id, found)
            if known is not found and _essence(known) != _essence(found):
                raise Damage(offset, f"channel {found.id} is defined twice")
            if found.schema_id and found.schema_id not in self.schemas:
                raise Damage(offset, f"channel {found.id} names schema {found.schema_id}, which is missing")

    def topic(self, channel: Channel) -> TopicInfo:
        """The topic of a channel."""
        schema = self.schemas.get(channel.schema_id)
        return TopicInfo(
            topic=channel.topic,
            type=short_name(schema.name) if schema else "",
            encoding=channel.message_encoding,
            schema_encoding=schema.encoding if schema else "",
            schema=schema.data if schema else b"",
        )


def _essence(channel: Channel) -> tuple[int, str, str]:
    return channel.schema_id, channel.topic, channel.message_encoding


def read_records(
    stream: BinaryIO, start: int, end: int, limits: Limits, *, wanted: frozenset[int]
) -> Iterator[Record]:
    """Records from byte `start` to `end`; only those of the `wanted` kinds have their data loaded.

    Raises Damage if a record does not fit before `end`, LimitExceeded if one is above the limit.
    """
    offset = start
    while offset < end:
        stream.seek(offset)
        head = stream.read(HEAD_BYTES)
        if offset + HEAD_BYTES > end or len(head) < HEAD_BYTES:
            raise Damage(offset, "the file ends within a record", truncated=True)
        opcode, length = _HEAD.unpack(head)
        if opcode == 0:
            raise Damage(offset, "not a record")
        if length > end - offset - HEAD_BYTES:
            raise Damage(offset, f"a record of {length} bytes does not fit into the file", truncated=True)
        data = b""
        if opcode in wanted:
            if length > limits.record_bytes:
                raise too_large(offset, length, limits)
            data = stream.read(length)
            if len(data) < length:
                raise Damage(offset, "the file ends within a record", truncated=True)
        yield Record(offset, opcode, data, HEAD_BYTES + length)
        offset += HEAD_BYTES + length


def too_large(offset: int, length: int, limits: Limits) -> LimitExceeded:
    """The error for a record above the limit."""
    return LimitExceeded(
        f"a record at byte {offset} has {length} bytes; the limit is {limits.record_bytes}",
        hint="--set read.max_record_bytes=N raises it",
    )


class _Fields(ReadDataStream):
    """The bytes of one record, for the parsers of `mcap`; reading past their end raises Damage."""

    def __init__(self, record: Record) -> None:
        super().__init__(io.BytesIO(record.data))
        self._offset, self._size = record.offset, len(record.data)

    def read(self, length: int) -> bytes:
        if self.count + length > self._size:
            raise Damage(self._offset, "a record is shorter than its fields")
        return super().read(length)


def parsed(read: Callable[[ReadDataStream], T], record: Record) -> T:
    """The record as an object of `mcap`; `read` is the class's parser. Raises Damage."""
    try:
        return read(_Fields(record))
    except UnicodeDecodeError:
        raise Damage(record.offset, "a name is not text") from None


def parsed_message(record: Record) -> Message:
    """The record of a message. Raises Damage."""
    # A length that is too small would make mcap read a negative number of bytes.
    length = max(len(record.data), MESSAGE_FIELDS_BYTES)
    message: Message = parsed(lambda data: Message.read(data, length), record)
    return message


def parsed_chunk(record: Record) -> Chunk:
    """The record of a chunk. Raises Damage if its lengths contradict that of the record."""
    size = len(record.data)
    if size >= CHUNK_FIELDS_BYTES:
        name_bytes = int.from_bytes(record.data[28:32], "little")
        stored = int.from_bytes(record.data[32 + name_bytes : 40 + name_bytes], "little")
        if CHUNK_FIELDS_BYTES + name_bytes + stored != size:
            raise Damage(record.offset, "a chunk's lengths contradict each other")
    chunk: Chunk = parsed(Chunk.read, record)
    return chunk


def chunk_records(chunk: Chunk, offset: int, limits: Limits) -> list[McapRecord]:
    """Schemas, channels and messages in a chunk, whose checksum `mcap` compares.

    Raises Damage if they are not what was written, LimitExceeded for a chunk that would expand to more than
    the limit, UnsupportedSchema for a compression that pc2grid does not read.
    """
    if chunk.uncompressed_size > limits.chunk_bytes:
        raise LimitExceeded(
            f"the chunk at byte {offset} would expand to {chunk.uncompressed_size} bytes; "
            f"the limit is {limits.chunk_bytes}",
            hint="--set read.max_chunk_bytes=N raises it",
        )
    content = chunk.data
    if chunk.compression:
        if chunk.compression not in ("zstd", "lz4"):
            raise UnsupportedSchema(
                f"the chunk at byte {offset} is compressed with {chunk.compression!r:.40}",
                hint="pc2grid reads zstd, lz4 and uncompressed chunks; `mcap convert` can change it",
            )
        try:
            # One byte more than declared, so that a longer content is noticed.
            content = expand(chunk.compression, content, chunk.uncompressed_size + 1)
        except ValueError as error:
            raise Damage(offset, f"a chunk cannot be decompressed ({error})") from error
    if len(content) != chunk.uncompressed_size:
        raise Damage(offset, f"a chunk has {len(content)} bytes instead of {chunk.uncompressed_size}")
    plain = dataclasses.replace(chunk, compression="", data=content)
    with mcap_errors_as_damage(offset):
        get_chunk_data_stream(plain, validate_crc=True)
        _check_heads(content, offset)
        return breakup_chunk(plain)


def _check_heads(content: bytes, offset: int) -> None:
    """Whether the records of a chunk fill it, and its messages have all their fields. Raises Damage."""
    at, size = 0, len(content)
    while at < size:
        if at + HEAD_BYTES > size:
            raise Damage(offset, "a chunk ends within a record")
        opcode, length = _HEAD.unpack_from(content, at)
        at += HEAD_BYTES + length
        if at > size:
            raise Damage(offset, "a chunk ends within a record")
        if opcode == Opcode.MESSAGE and length < MESSAGE_FIELDS_BYTES:
            raise Damage(offset, "a message is shorter than its fields")


@contextlib.contextmanager
def mcap_errors_as_damage(offset: int) -> Iterator[None]:
    """Whatever `mcap` raises in the body becomes Damage at `offset`, or LimitExceeded."""
    try:
        yield
    except CRCValidationError as error:
        raise Damage(offset, "a chunk's checksum (CRC) is wrong") from error
    except RecordLengthLimitExceeded as error:
        raise LimitExceeded(
            f"at byte {offset}: {error}", hint="--set read.max_record_bytes=N raises the limit"
        ) from error
    except LogCorrupt as error:  # of BoundedFile
        raise Damage(offset, error.message) from error
    except (Damage, Pc2GridError, MemoryError, OSError):
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        raise Damage(offset, f"its records cannot be read ({what})") from error
