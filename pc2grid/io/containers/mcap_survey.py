"""An index for MCAP files that have none: one pass over the whole file, which also names and skips damage.

Used for a file that was not closed or whose summary is damaged, and for `--recover`. The readers of `mcap`
stop at the first damage, do not say where it is, and do not go on behind it.
"""

from __future__ import annotations

import contextlib
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Message, Schema, Statistics

from pc2grid.errors import LimitExceeded, UnsupportedSchema
from pc2grid.io.containers import mcap_records as rec
from pc2grid.io.containers.mcap_index import McapIndex
from pc2grid.io.containers.mcap_records import Damage, Definitions

_READ = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.CHUNK,
        Opcode.STATISTICS,
        Opcode.DATA_END,
        Opcode.FOOTER,
    }
)
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_USER_RECORDS = 0x80  # kinds from here on are for applications
# Kind, length, times, size and checksum of a chunk; its compression behind the length of that; the length of
# its data.
_CHUNK_HEAD = re.compile(
    rb"(?=\x06(.{8}).{16}(.{8}).{4}(?:\x04\0{3}zstd|\x03\0{3}lz4|(\0{4}))(.{8}))", re.DOTALL
)
_LONGEST_HEAD = 53
_WINDOW_BYTES = 64 << 10  # chosen by hand: it is read again for each place of damage
_BLOCK_BYTES = 1 << 20


@dataclass(slots=True)
class Survey:
    """The index of what is whole, and what is wrong with the rest.

    closed : whether the recorder wrote the end of the data section.
    damage : the first thing that is wrong, or None. bytes_lost : how much was passed over, and holes :
    whether something that was read stands behind it. missing : messages that the writer counted on top of
    those that are there.
    """

    index: McapIndex
    closed: bool = False
    damage: Damage | None = None
    bytes_lost: int = 0
    holes: bool = False
    missing: int = 0
    warnings: list[str] = field(default_factory=list)

    def compare(self, listed: Sequence[ChunkIndex]) -> None:
        """Take note of chunks that the file's own index lists and that are not there.

        A chunk whose kind was changed by damage is passed over like a record of an application.
        """
        there = {chunk.chunk_start_offset for chunk in self.index.chunks}
        hidden = [chunk for chunk in listed if chunk.chunk_start_offset not in there]
        if hidden and not self.bytes_lost:
            self.bytes_lost = sum(chunk.chunk_length for chunk in hidden)
            self.warnings.append(f"{len(hidden)} chunks that the index lists are not there")


def survey(
    stream: BinaryIO, size: int, limits: rec.Limits, *, resync: bool, known: Definitions | None = None
) -> Survey:
    """Read an MCAP of `size` bytes from its start to its end and say what is in it.

    resync : go on behind damage, at the next whole chunk, and count the bytes between; else stop there.
    known : definitions that are certain already.

    Raises LimitExceeded and UnsupportedSchema as `mcap_records.chunk_records` does (unless `resync`).
    """
    surveyor = _Surveyor(stream, size, limits, resync, known or Definitions())
    surveyor.run()
    return surveyor.found


class _Surveyor:
    def __init__(
        self, stream: BinaryIO, size: int, limits: rec.Limits, resync: bool, known: Definitions
    ) -> None:
        self._stream, self._size, self._limits, self._resync = stream, size, limits, resync
        self.found = Survey(McapIndex(definitions=known))

    def run(self) -> None:
        found = self.found
        at = len(rec.MAGIC)
        while at < self._size:
            try:
                at = self._walk(at)
            except Damage as damage:
                found.damage = found.damage or damage
                if not self._resync:
                    break
                at = self._next_chunk(damage.offset + 1)
                lost = at - damage.offset
                found.warnings.append(f"{damage.what}, at byte {damage.offset}: {lost} bytes were skipped")
                found.bytes_lost += lost
                found.holes |= at < self._size
        found.index.outside_chunks = _joined(found.index.outside_chunks)

    def _walk(self, at: int) -> int:
        """Read records from `at` on until the end of the file; returns where it stopped."""
        found = self.found
        for record in rec.read_records(self._stream, at, self._size, self._limits, wanted=_READ):
            at = record.offset + record.size
            if record.opcode == Opcode.CHUNK:
                try:
                    self._take_chunk(record)
                except Damage as damage:
                    if not (self._resync and self._is_record(at)):
                        raise
                    # Only the content is damaged: the next record stands where it should.
                    found.damage = found.damage or damage
                    found.bytes_lost += record.size
                    found.holes = True
                    found.warnings.append(f"{damage.what}, at byte {damage.offset}: the chunk was skipped")
            elif record.opcode == Opcode.FOOTER:
                self._check_end(at)
                return self._size
            else:
                self._take(record)
        if not found.closed and found.damage is None:
            found.warnings.append(
                "the recording was not closed (was the recorder killed?); what is there is whole"
            )
        return at

    def _take(self, record: rec.Record) -> None:
        """Take up a record outside of chunks. Raises Damage."""
        index = self.found.index
        match record.opcode:
            case Opcode.SCHEMA:
                index.definitions.take(rec.parsed(Schema.read, record), record.offset)
            case Opcode.CHANNEL:
                index.definitions.take(rec.parsed(Channel.read, record), record.offset)
            case Opcode.MESSAGE:
                self._count([rec.parsed_message(record)], record.offset)
                index.outside_chunks.append((record.offset, record.offset + record.size))
            case Opcode.STATISTICS:
                self._compare(record)
            case Opcode.DATA_END:
                self.found.closed = True
                index.data_end = record.offset
                index.data_crc = rec.parsed(DataEnd.read, record).data_section_crc
                if (
                    index.data_crc
                    and not self.found.damage
                    and crc_of(self._stream, record.offset) != index.data_crc
                ):
                    # Chunks passed their own checksums, so only what stands between them can be wrong.
                    self.found.warnings.append(
                        "the checksum of the data section is wrong, outside of the chunks"
                    )
            case opcode if opcode not in _KNOWN and opcode < _USER_RECORDS:
                raise Damage(record.offset, f"a record of unknown kind {opcode:#x}")

    def _take_chunk(self, record: rec.Record) -> None:
        chunk = rec.parsed_chunk(record)
        try:
            records = rec.chunk_records(chunk, record.offset, self._limits)
        except (LimitExceeded, UnsupportedSchema) as error:
            if not self._resync:
                raise
            raise Damage(record.offset, error.message) from error
        for item in records:
            self.found.index.definitions.take(item, record.offset)
        messages = [item for item in records if isinstance(item, Message)]
        first_ns, last_ns = chunk.message_start_time, chunk.message_end_time
        if any(not first_ns <= m.log_time <= last_ns for m in messages):
            raise Damage(record.offset, "a chunk's times contradict its messages")
        self._count(messages, record.offset)
        self.found.index.chunks.append(
            ChunkIndex(
                chunk_length=record.size,
                chunk_start_offset=record.offset,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=last_ns,
                message_index_length=0,
                message_index_offsets=dict.fromkeys((m.channel_id for m in messages), 0),
                message_start_time=first_ns,
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def _count(self, messages: list[Message], offset: int) -> None:
        index = self.found.index
        for message in messages:
            if message.channel_id not in index.definitions.channels:
                raise Damage(offset, f"a message names channel {message.channel_id}, which is missing")
        for message in messages:
            if not index.counts:
                index.start_ns = index.end_ns = message.log_time
            index.counts[message.channel_id] = index.counts.get(message.channel_id, 0) + 1
            index.start_ns = min(index.start_ns, message.log_time)
            index.end_ns = max(index.end_ns, message.log_time)

    def _compare(self, record: rec.Record) -> None:
        """Note how many messages are missing: chunks that were removed completely leave no other trace."""
        found = self.found
        with contextlib.suppress(Damage):  # of damaged statistics nothing else depends
            statistics = rec.parsed(Statistics.read, record)
            total, counts = statistics.message_count, statistics.channel_message_counts
            there = sum(found.index.counts.values())
            found.missing = max(total - there, 0) if sum(counts.values()) == total else 0
            if found.missing:
                found.warnings.append(
                    f"{found.missing} of {total} messages that the log counts are not there"
                )

    def _is_record(self, at: int) -> bool:
        """Whether a known record that fits into the file could start at `at`, or the file ends there."""
        self._stream.seek(at)
        head = self._stream.read(rec.HEAD_BYTES)
        fits = at + rec.HEAD_BYTES + int.from_bytes(head[1:], "little") <= self._size
        return at == self._size or (len(head) == rec.HEAD_BYTES and head[0] in _KNOWN and fits)

    def _check_end(self, at: int) -> None:
        """Whether the magic, and nothing else, follows the footer. Raises Damage."""
        self._stream.seek(at)
        if self._stream.read(len(rec.MAGIC)) != rec.MAGIC:
            raise Damage(at, "the end mark is missing", truncated=True)
        at += len(rec.MAGIC)
        if at < self._size:
            raise Damage(at, f"{self._size - at} bytes follow the end of the log")

    def _next_chunk(self, start: int) -> int:
        """Offset of the next chunk record whose lengths agree, or the end of the file."""
        at = start
        while at < self._size:
            self._stream.seek(at)
            window = self._stream.read(_WINDOW_BYTES + _LONGEST_HEAD)  # a chunk may begin with its last byte
            for head in _CHUNK_HEAD.finditer(window):
                length, plain, stored = (int.from_bytes(head[i], "little") for i in (1, 2, 4))
                place = at + head.start()
                agrees = length == head.end(4) - head.start() - rec.HEAD_BYTES + stored
                fits = place + rec.HEAD_BYTES + length <= self._size
                if agrees and fits and (plain == stored or not head[3]):
                    return place
            at += _WINDOW_BYTES
        return self._size


def crc_of(stream: BinaryIO, end: int) -> int:
    """CRC-32 of the first `end` bytes of a file."""
    crc, left = 0, end
    stream.seek(0)
    while left > 0 and (block := stream.read(min(left, _BLOCK_BYTES))):
        crc = zlib.crc32(block, crc)
        left -= len(block)
    return crc


def _joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Adjacent spans as one."""
    joined: list[tuple[int, int]] = []
    for start, end in spans:
        if joined and joined[-1][1] == start:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    return joined
