"""MCAP files as a message source, read by `mcap` with checksums compared.

With the index in the summary, a part of a long log costs what that part costs (`read_summary`). A file whose
recorder was killed, or whose summary is damaged, is read once up to its end or its first damage, and indexed
meanwhile (`Survey`). Messages that rosbag2 compressed one by one are decompressed.

`mcap` parses the records. It takes whatever memory a chunk claims, does not compare the checksum of the
summary, and raises many unrelated errors for damage; that is done here. The readers of `mcap` and `rosbags`
read as many bytes as a record claims, and Python reserves the memory before it reads: a damaged length of 4
GB costs 4 GB, and `mcap` accepts fewer bytes than it asked for. So `BoundedFile` and `expand` stop at a
limit.
"""

from __future__ import annotations

import bisect
import bz2
import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from pc2grid.errors import LimitExceeded, LogCorrupt, LogError, LogTruncated, UnsupportedSchema
from pc2grid.io.messages.ros import short_name
from pc2grid.io.source import RECOVER_HINT, LogInfo, RawMessage, Tally, TopicInfo, counted
from pc2grid.settings import ReadConfig

_LAST_NS = 1 << 64
_UNCHECKED = "parts of the log carry no checksum: damage would not be seen"


class McapSource:
    """One MCAP file, open.

    Raises LogTruncated, LogCorrupt, LimitExceeded or UnsupportedSchema when it is opened or read. With
    `recover`, damaged chunks are left out and counted in `tally`; without an index, everything behind the
    damage is left out.
    """

    def __init__(self, path: Path, config: ReadConfig, *, recover: bool = False) -> None:
        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._path, self._config = path, config
        self._stream = BoundedFile(io.FileIO(path), config.max_record_bytes)
        try:
            self._index = self._indexed(recover) or self._surveyed(recover)
            if not self._index.checked:
                self.tally.warn(_UNCHECKED)
            self._topic_of = self._topics()
            self.info = self._describe()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    # --- opening --------------------------------------------------------------------------------------

    def _indexed(self, recover: bool) -> McapIndex | None:
        """Return the index in the summary; None if there is none, it is damaged, or it lists no chunks."""
        try:
            index = read_summary(self._stream)
        except MemoryError:
            raise
        except Exception as error:
            why = named(error, "the index is not usable")
            self.tally.warn(f"{why.message}; the log was read in full instead")
            return None
        for chunk in list(index.chunks) if recover else ():
            try:
                self._load(chunk, index)
            except LogError as error:
                index.chunks.remove(chunk)
                index.counted = False
                self.tally.warn(f"{error.message}: the chunk was left out")
                self.tally.bytes_lost += chunk.chunk_length
        is_empty = index.counted and not any(index.counts.values())
        return index if index.chunks or is_empty else None

    def _surveyed(self, recover: bool) -> McapIndex:
        """Make an index by reading the file. Raises LogError for damage, unless `recover`."""
        found = Survey(self._stream, self._config.max_chunk_bytes)
        size = self._path.stat().st_size
        if found.damage is not None:
            where = f"{self._path}: at byte {found.at} of {size}"
            count = sum(found.index.counts.values())
            error = named(found.damage, where, f"; {count} messages before it are readable")
            if not recover:
                raise error from found.damage
            self.tally.warn(f"{error.message}; the rest was left out")
            self.tally.bytes_lost += size - found.at
            self.tally.topics_lost = True
        elif not found.closed:
            self.tally.warn("the recording was not closed (was the recorder killed?); what is there is whole")
        elif found.missing > 0:
            self.tally.warn(f"{found.missing} messages that the log counts are not there")
            self.tally.topics_lost = True
        return found.index

    def _topics(self) -> dict[int, TopicInfo]:
        """Return the topic of each channel; one that several programs publish may have several channels."""
        index = self._index
        return counted(
            {
                key: replace(
                    index.topic(channel), message_count=index.counts.get(key, 0) if index.counted else None
                )
                for key, channel in index.channels.items()
            }
        )

    def _describe(self) -> LogInfo:
        index = self._index
        topics = sorted(set(self._topic_of.values()), key=lambda t: (t.topic, t.type))
        encodings = Counter(t.encoding for t in topics)
        dialect = encodings.most_common(1)[0][0] if encodings else "empty"
        return LogInfo(
            path=self._path,
            format=f"mcap/{'ros2' if dialect == 'cdr' else dialect}",
            size_bytes=self._path.stat().st_size,
            start_ns=index.start_ns,
            end_ns=index.end_ns,
            message_count=sum(index.counts.values()) if index.counted else None,
            topics=tuple(topics),
            warnings=tuple(self.tally.warnings),
        )

    # --- reading --------------------------------------------------------------------------------------

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages, see MessageSource.messages."""
        wanted = {key for key, topic in self._topic_of.items() if topic.topic in topics}
        low_ns, high_ns = start_ns or 0, _LAST_NS if end_ns is None else end_ns

        def fitting(messages: Iterable[Message]) -> Iterator[RawMessage]:
            for m in messages:
                if m.channel_id in wanted and low_ns <= m.log_time < high_ns:
                    data = plain_message(m.data, self._config.max_chunk_bytes)
                    yield RawMessage(self._topic_of[m.channel_id], m.log_time, data)

        pending: list[RawMessage] = []  # of chunks that overlap in time
        for chunk in _wanted(self._index.chunks, wanted, low_ns, high_ns):
            ready = bisect.bisect_left(pending, chunk.message_start_time, key=lambda m: m.log_time_ns)
            yield from pending[:ready]
            del pending[:ready]
            pending += fitting(self._load(chunk, self._index))
            pending.sort(key=lambda m: m.log_time_ns)  # stable: equal times stay in the order of the file
        yield from pending

    def _load(self, listed: ChunkIndex, index: McapIndex) -> list[Message]:
        """Return the messages of a chunk that the index lists. Raises LogError if it is damaged."""
        try:
            records = self._records(listed)
            messages = [record for record in records if isinstance(record, Message)]
            if any(message.channel_id not in index.channels for message in messages):
                raise LogCorrupt("a message of a channel that is missing")
        except MemoryError:
            raise
        except Exception as error:
            raise named(error, f"{self._path}: chunk at byte {listed.chunk_start_offset}") from error
        return messages

    def _records(self, listed: ChunkIndex) -> list[McapRecord]:
        """Return the records of a chunk, or of a run of messages."""
        self._stream.seek(listed.chunk_start_offset)
        end, reader = listed.chunk_start_offset + listed.chunk_length, records_of(self._stream)
        records = [next(reader)]
        while isinstance(listed, Run) and self._stream.tell() < end:
            records.append(next(reader))
        chunk = records[0]
        if self._stream.tell() != end or isinstance(chunk, Chunk) is isinstance(listed, Run):
            raise LogCorrupt("the index points to something else")
        if not isinstance(chunk, Chunk):
            return records
        # A header of zeros is that of an empty chunk without a checksum.
        if chunk.uncompressed_size != listed.uncompressed_size:
            raise LogCorrupt(f"{chunk.uncompressed_size} bytes where {listed.uncompressed_size} are listed")
        if not chunk.uncompressed_crc and chunk.data:
            self.tally.warn(_UNCHECKED)
        return open_chunk(chunk, self._config.max_chunk_bytes)


def _wanted(chunks: list[ChunkIndex], channels: set[int], low_ns: int, high_ns: int) -> list[ChunkIndex]:
    """Return the chunks that may hold messages of these channels and times, by their first times."""
    found = [
        chunk
        for chunk in chunks
        if chunk.message_end_time >= low_ns
        and chunk.message_start_time < high_ns
        # Without message indexes, only its records say which channels are in a chunk.
        and (not chunk.message_index_offsets or chunk.message_index_offsets.keys() & channels)
    ]
    return sorted(found, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))


# --- the index of a file ------------------------------------------------------------------------------

MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<9xQQI8s")  # offsets of the summary and of its parts, checksum, magic
_RECORD = struct.Struct("<BQ")  # kind, length
_CHUNK_BYTES = struct.calcsize("<BQQQQIIQ")  # of a chunk's record, without its compression and its data
_MESSAGE_BYTES = struct.calcsize("<BQHIQQ")  # of a message's record, without the data
_RUN_BYTES = 1 << 20
"""Length of the runs in which messages outside of chunks are listed; by hand, as long as usual chunks."""


class Run(ChunkIndex):
    """The place of messages that stand one after another outside of chunks."""


@dataclass(slots=True)
class McapIndex:
    """The position of everything in an MCAP file.

    chunks : and runs of messages outside of them. counts : of messages, by channel; complete if `counted`.
    start_ns, end_ns : first and last log time. checked : True if it has a checksum.
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
        """Return the topic of a channel."""
        schema = self.schemas.get(channel.schema_id)
        return TopicInfo(
            topic=channel.topic,
            type=short_name(schema.name) if schema else "",
            encoding=channel.message_encoding,
            schema_encoding=schema.encoding if schema else "",
            schema=schema.data if schema else b"",
        )


def read_summary(stream: BoundedFile) -> McapIndex:
    """Read the index in the summary at the end of a file. Raises LogError if there is none, or it is
    damaged."""
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


def _has_checksum(stream: BoundedFile) -> bool:
    """Return True if the summary has a checksum. Raises LogError if it is wrong, or there is no summary."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(max(size - _FOOTER.size, 0))
    start, _, crc, magic = _FOOTER.unpack(stream.read(_FOOTER.size))
    if magic != MAGIC:
        raise LogTruncated("the recording was not finished")
    stream.seek(start)
    if start and crc and zlib.crc32(stream.read(size - start - len(MAGIC) - 4)) != crc:
        raise LogCorrupt("its checksum (CRC) is wrong")
    return bool(crc)


def _has_messages_outside(stream: BoundedFile, chunks: list[ChunkIndex]) -> bool:
    """Return True if messages stand between the chunks, as far as the records there can be parsed."""
    listed = {c.chunk_start_offset: c.chunk_length + c.message_index_length for c in chunks}
    at, kind = len(MAGIC), 0
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

    damage : the error that ended the reading, or None. at : the offset up to which the file is whole. closed
    : True if the recorder wrote the end of the data. missing : number of counted messages that are not there:
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
        """Add a record that ends at an offset; raises any damage of it."""
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
        """Add a run of messages to the index, or to the run before if it continues that."""
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
    """Return the place of a chunk that ends at an offset, and its content."""
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
    """Return the place of a message outside of chunks that ends at an offset."""
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


# --- records and chunks -------------------------------------------------------------------------------


def records_of(stream: BoundedFile, *, whole_file: bool = False) -> Iterator[McapRecord]:
    """Return the records of a stream, chunks as they are stored; `stream` bounds a single read.

    whole_file : from the start of the file, with the checksum of its data compared; else from the present
    position.
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
    """Return the schemas, channels and messages in a chunk.

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
    """Return the error to show for one that was raised while a place was read."""
    if isinstance(error, CRCValidationError):
        what = "the checksum (CRC) is wrong"
    elif isinstance(error, LogError):
        what = error.message
    else:
        what = f"damaged ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
    kind = type(error) if isinstance(error, LogError) else LogCorrupt
    return kind(f"{where}: {what}{behind}", hint=getattr(error, "hint", None) or RECOVER_HINT)


# --- bounded reading and decompression ----------------------------------------------------------------

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class BoundedFile(io.BufferedReader):
    """A file, open for reading.

    most_bytes : how many bytes one call may ask for.
    """

    def __init__(self, raw: io.FileIO, most_bytes: int) -> None:
        super().__init__(raw)
        self._most_bytes = most_bytes
        self._size = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes, see io.BufferedReader.

        Raises LogTruncated if fewer bytes are left, LogCorrupt if `size` is negative (a length was smaller
        than the fields it counts), LimitExceeded if it is above the limit.
        """
        if size is None or size < 0:
            raise LogCorrupt(f"a length of {size} bytes where a record should begin")
        if size > self._size - self.tell():
            raise LogTruncated(f"the file ends within {size} bytes of a record")
        if size > self._most_bytes:
            raise LimitExceeded(
                f"a record has {size} bytes; the limit is {self._most_bytes}",
                hint="--set read.max_record_bytes=N raises it",
            )
        return super().read(size)


def plain_message(data: bytes | memoryview, limit: int) -> bytes | memoryview:
    """Return a message, decompressed if rosbag2 compressed it by itself. No encoding of messages begins like
    zstd.

    Raises as `unpacked` does.
    """
    return unpacked("zstd", limit, bytes(data)) if data[:4] == ZSTD_MAGIC else data


def unpacked(compression: str, limit: int, data: bytes) -> bytes:
    """Decompress data. Raises LimitExceeded above `limit` bytes, LogCorrupt for damage."""
    try:
        found = expand(compression, data, limit + 1)
    except ValueError as error:
        raise LogCorrupt(f"{compression} data cannot be decompressed ({error})") from error
    if len(found) > limit:
        raise LimitExceeded(
            f"{compression} data would expand to more than {limit} bytes",
            hint="--set read.max_chunk_bytes=N raises the limit",
        )
    return found


def expand(compression: str, data: bytes | memoryview, most: int) -> bytes:
    """Return the first `most` bytes (> 0) of the decompressed data; `compression` is bz2, lz4, zstd or none.

    Raises ValueError for damage.
    """
    try:
        return _EXPAND[compression](bytes(data), most)
    except (OSError, EOFError, RuntimeError, zstandard.ZstdError) as error:
        raise ValueError(error) from error


def _zstd(data: bytes, most: int) -> bytes:
    # zstandard allocates the size that the frame declares, whatever max_output_size is.
    if zstandard.frame_content_size(data) > most:
        return bytes(most)
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=most)


def _whole(decompressor: Any, data: bytes, most: int) -> bytes:
    found = bytes(decompressor.decompress(data, max_length=most))
    if not decompressor.eof and len(found) < most:
        raise EOFError("it ends too early")
    return found


_EXPAND: dict[str, Callable[[bytes, int], bytes]] = {
    "none": lambda data, most: data[:most],
    "bz2": lambda data, most: _whole(bz2.BZ2Decompressor(), data, most),
    "lz4": lambda data, most: _whole(lz4.frame.LZ4FrameDecompressor(), data, most),
    "zstd": _zstd,
}
