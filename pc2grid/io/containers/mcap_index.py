"""What is where in an MCAP: as its summary says, or by reading it up to its end or its first damage.

`mcap` parses the records. It takes whatever memory a chunk claims, does not compare the checksum of the
summary, and raises many unrelated errors for damage; that is done here.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from pc2grid.errors import LimitExceeded, LogCorrupt, LogError, LogTruncated, UnsupportedSchema
from pc2grid.io.containers.bounds import BoundedFile, expand
from pc2grid.io.error_translation import RECOVER_HINT
from pc2grid.io.message_source import TopicInfo
from pc2grid.io.messages.ros_definitions import short_name

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<9xQQI8s")  # offsets of the summary and of its parts, checksum, magic
_RECORD = struct.Struct("<BQ")  # kind, length
_CHUNK_BYTES = 49  # of a chunk's record, without the name of the compression and the data
_MESSAGE_BYTES = 31  # of a message's record, without the data
_RUN_BYTES = 1 << 20
"""Length of the runs in which messages outside of chunks are listed; by hand, as long as usual chunks."""


class Run(ChunkIndex):
    """The place of messages that stand one after another outside of chunks."""


@dataclass(slots=True)
class McapIndex:
    """What is where in an MCAP file.

    chunks : and runs of messages outside of them. counts : of messages, by channel; complete if `counted`.
    start_ns, end_ns : first and last log time. checked : whether there is a checksum on it.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    counted: bool = True
    start_ns: int = 0
    end_ns: int = 0
    checked: bool = True

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


def records_of(stream: BoundedFile, *, whole_file: bool = False) -> Iterator[McapRecord]:
    """The records of a stream, chunks as they are stored; `stream` bounds what is read at once.

    whole_file : from the start of the file, the checksum of its data compared; else from where it stands.
    """
    reader = StreamReader(
        stream,
        skip_magic=not whole_file,
        emit_chunks=True,
        validate_crcs=whole_file,
        record_size_limit=None,
    )
    return reader.records


def open_chunk(chunk: Chunk, most_bytes: int) -> list[McapRecord]:
    """The schemas, channels and messages in a chunk.

    Raises LimitExceeded for one that would expand to more than `most_bytes`, UnsupportedSchema for a
    compression that pc2grid does not read, and other errors for damage.
    """
    if chunk.uncompressed_size > most_bytes:
        raise LimitExceeded(
            f"a chunk would expand to {chunk.uncompressed_size} bytes; the limit is {most_bytes}",
            hint="--set read.max_chunk_bytes=N raises it",
        )
    if chunk.compression not in ("", "zstd", "lz4"):
        raise UnsupportedSchema(
            f"a chunk is compressed with {chunk.compression!r:.40}",
            hint="pc2grid reads zstd, lz4 and uncompressed chunks; `mcap convert` can change it",
        )
    # One byte more than declared, so that a longer content is noticed.
    content = expand(chunk.compression or "none", chunk.data, chunk.uncompressed_size + 1)
    if len(content) != chunk.uncompressed_size:
        raise LogCorrupt(f"a chunk does not hold {chunk.uncompressed_size} bytes, as it says")
    return breakup_chunk(replace(chunk, compression="", data=content), validate_crc=True)


def named(error: Exception, where: str, behind: str = "") -> LogError:
    """The error to show for one that was raised while a place was read."""
    if isinstance(error, CRCValidationError):
        what = "the checksum (CRC) is wrong"
    elif isinstance(error, LogError):
        what = error.message
    else:
        what = f"damaged ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
    kind = type(error) if isinstance(error, LogError) else LogCorrupt
    return kind(f"{where}: {what}{behind}", hint=getattr(error, "hint", None) or RECOVER_HINT)


def _has_checksum(stream: BoundedFile) -> bool:
    """Whether the summary has a checksum. Raises LogError if it is wrong, or there is no summary."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(max(size - _FOOTER.size, 0))
    start, _, crc, magic = _FOOTER.unpack(stream.read(_FOOTER.size))
    if magic != _MAGIC:
        raise LogTruncated("the recording was not finished")
    stream.seek(start)
    if start and crc and zlib.crc32(stream.read(size - start - len(_MAGIC) - 4)) != crc:
        raise LogCorrupt("its checksum (CRC) is wrong")
    return bool(crc)


def read_summary(stream: BoundedFile) -> McapIndex:
    """The index in the summary at the end of a file. Raises LogError if there is none, or it is damaged."""
    checked = _has_checksum(stream)
    stream.seek(0)
    summary = SeekingReader(stream, record_size_limit=None).get_summary()
    if summary is None or summary.statistics is None:
        raise LogCorrupt("its writer made none")
    statistics, chunks, channels = summary.statistics, summary.chunk_indexes, summary.channels
    counts = statistics.channel_message_counts
    used = {key for chunk in chunks for key in chunk.message_index_offsets}
    complete = len(chunks) == statistics.chunk_count and len(channels) >= statistics.channel_count
    if not complete or used - channels.keys():
        raise LogCorrupt("it does not list all chunks and channels")
    if _has_messages_outside(stream, chunks):
        raise LogCorrupt("it does not list the messages outside of the chunks")
    return McapIndex(
        summary.schemas,
        channels,
        chunks,
        counts,
        sum(counts.values()) == statistics.message_count,
        statistics.message_start_time,
        statistics.message_end_time,
        checked=checked,
    )


def _has_messages_outside(stream: BoundedFile, chunks: list[ChunkIndex]) -> bool:
    """Whether messages stand between the chunks, as far as the records there can be told apart."""
    listed = {c.chunk_start_offset: c.chunk_length + c.message_index_length for c in chunks}
    at, kind = len(_MAGIC), 0
    while kind not in (Opcode.MESSAGE, Opcode.DATA_END):
        length = listed.pop(at, 0)
        if not length:
            stream.seek(at)
            try:
                kind, behind = _RECORD.unpack(stream.read(_RECORD.size))
            except LogError:
                return False
            length = _RECORD.size + behind
        at += length
    return kind == Opcode.MESSAGE


class Survey:
    """The index of a file, made by reading it up to its end or its first damage.

    damage : what ended the reading, or None. at : the offset up to which the file is whole. closed : whether
    the recorder wrote the end of the data. missing : how many of the messages that it counted are not there:
    chunks that were cut out completely leave no other trace.
    """

    def __init__(self, stream: BoundedFile, most_chunk_bytes: int) -> None:
        self.index = McapIndex(checked=False)
        self.damage: Exception | None = None
        self.closed = False
        self.missing = 0
        self.at = 0
        self._most_bytes = most_chunk_bytes
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        try:
            self._read(stream)
        except MemoryError:
            raise
        except Exception as error:  # behind the end of the data, only the summary can be wrong
            self.damage = error if self.at < size and not self.closed else None
        self.index.checked |= {type(chunk) for chunk in self.index.chunks} == {
            ChunkIndex
        }  # they have their own

    def _read(self, stream: BoundedFile) -> None:
        for record in records_of(stream, whole_file=True):
            if not self.closed:  # what the summary repeats may be damaged
                self._take(record, stream.tell())
            self.at = stream.tell()
            if isinstance(record, DataEnd):
                self.closed = True
                self.index.checked = bool(record.data_section_crc)
            elif isinstance(record, Statistics):
                self.missing = record.message_count - sum(self.index.counts.values())

    def _take(self, record: McapRecord, end: int) -> None:
        """Take up a record that ends at an offset; raises whatever is wrong with it."""
        if not isinstance(record, Chunk):
            self._take_content(record)
            if isinstance(record, Message):
                self._list(_as_run(record, end))
            return
        items = open_chunk(record, self._most_bytes)
        for item in items:
            self._take_content(item)
        there = {item.channel_id for item in items if isinstance(item, Message)}
        self.index.chunks.append(_indexed(record, end, there))

    def _list(self, run: Run) -> None:
        """Add a run of messages to the index, to the one before if it goes on there."""
        last = self.index.chunks[-1] if self.index.chunks else run
        goes_on = last.chunk_start_offset + last.chunk_length == run.chunk_start_offset
        if not isinstance(last, Run) or not goes_on or last.chunk_length > _RUN_BYTES:
            self.index.chunks.append(run)
            return
        last.chunk_length += run.chunk_length
        last.message_start_time = min(last.message_start_time, run.message_start_time)
        last.message_end_time = max(last.message_end_time, run.message_end_time)
        last.message_index_offsets.update(run.message_index_offsets)

    def _take_content(self, item: McapRecord) -> None:
        index = self.index
        if isinstance(item, Schema):
            index.schemas[item.id] = item
        elif isinstance(item, Channel):
            index.channels[item.id] = item
        elif isinstance(item, Message):
            if item.channel_id not in index.channels:
                raise LogCorrupt(f"a message of channel {item.channel_id}, which is missing")
            index.start_ns = min(index.start_ns, item.log_time) if index.counts else item.log_time
            index.end_ns = max(index.end_ns, item.log_time)
            index.counts[item.channel_id] = index.counts.get(item.channel_id, 0) + 1


def _indexed(chunk: Chunk, end: int, channels: set[int]) -> ChunkIndex:
    """The place of a chunk that ends at an offset, and what is in it."""
    size = _CHUNK_BYTES + len(chunk.compression.encode()) + len(chunk.data)
    return ChunkIndex(
        chunk_length=size,
        chunk_start_offset=end - size,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=0,
        message_index_offsets=dict.fromkeys(channels, 0),
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )


def _as_run(message: Message, end: int) -> Run:
    """The place of a message outside of chunks that ends at an offset."""
    size = _MESSAGE_BYTES + len(message.data)
    return Run(
        chunk_length=size,
        chunk_start_offset=end - size,
        compression="",
        compressed_size=size,
        message_end_time=message.log_time,
        message_index_length=0,
        message_index_offsets={message.channel_id: 0},
        message_start_time=message.log_time,
        uncompressed_size=size,
    )
