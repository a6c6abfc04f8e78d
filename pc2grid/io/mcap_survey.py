"""An index for MCAP files that have none: one pass over everything, counting what is whole."""

from __future__ import annotations

import contextlib
import re
import zlib
from dataclasses import dataclass, field
from typing import BinaryIO

from pc2grid.errors import LimitExceeded, UnsupportedSchema
from pc2grid.io import mcap_records as rec
from pc2grid.io.mcap_records import ChunkIndex, Damage, Definitions, Fields

_READ = frozenset({rec.SCHEMA, rec.CHANNEL, rec.MESSAGE, rec.CHUNK, rec.STATISTICS, rec.DATA_END, rec.FOOTER})
_KNOWN = frozenset(range(rec.HEADER, rec.DATA_END + 1))
# Its kind, length, times, size, checksum; its compression behind its length; the length of the content.
_CHUNK_HEAD = re.compile(
    rb"(?=\x06(.{8}).{16}(.{8}).{4}(?:\x04\0{3}zstd|\x03\0{3}lz4|(\0{4}))(.{8}))", re.DOTALL
)
_LONGEST_HEAD = 53
_WINDOW = 64 << 10  # not larger: it is read anew for each place of damage


@dataclass(slots=True)
class Survey:
    """What is where in an MCAP file.

    chunks : whole chunks, by place. loose : byte spans that hold messages outside chunks.
    counts : messages per channel, complete if `counted`. data_end, data_crc : end and checksum of the data
    section (0: none). damage : the first thing that is wrong, or None. bytes_lost : how much was given up,
    and holes : whether in front of something that was read. missing : messages that the writer counted on
    top of those.
    """

    definitions: Definitions = field(default_factory=Definitions)
    chunks: list[ChunkIndex] = field(default_factory=list)
    loose: list[tuple[int, int]] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    counted: bool = True
    missing: int = 0
    start_ns: int = 0
    end_ns: int = 0
    data_end: int = 0
    data_crc: int = 0
    damage: Damage | None = None
    bytes_lost: int = 0
    holes: bool = False
    warnings: list[str] = field(default_factory=list)

    def count(self, channel_id: int, log_time_ns: int) -> None:
        """Note one more message."""
        if not any(self.counts.values()):
            self.start_ns = self.end_ns = log_time_ns
        self.counts[channel_id] = self.counts.get(channel_id, 0) + 1
        self.start_ns = min(self.start_ns, log_time_ns)
        self.end_ns = max(self.end_ns, log_time_ns)


def survey(stream: BinaryIO, size: int, limits: rec.Limits, *, resync: bool, known: Definitions) -> Survey:
    """Read an MCAP from its start to its end and say what is in it.

    known : definitions that are certain already.
    resync : go on behind damage, at the next whole chunk, and count the bytes between; else stop there.
    Raises LimitExceeded and UnsupportedSchema as `mcap_records.decompress` does (unless `resync`).
    """
    found = Survey(definitions=known)
    at = len(rec.MAGIC)
    while at < size:
        try:
            at = _walk(stream, at, size, limits, found, resync)
        except Damage as damage:
            found.damage = found.damage or damage
            if not resync:
                break
            next_at = _next_chunk(stream, damage.offset + 1, size)
            found.warnings.append(
                f"{damage.what}, at byte {damage.offset}: {next_at - damage.offset} bytes were skipped"
            )
            found.bytes_lost += next_at - damage.offset
            found.holes |= next_at < size
            at = next_at
    found.loose = _joined(found.loose)
    return found


def _walk(stream: BinaryIO, at: int, size: int, limits: rec.Limits, found: Survey, resync: bool) -> int:
    """Read records from `at` on until the end of the file; returns where it stopped."""
    closed = False
    for record in rec.read_records(stream, at, size, limits, wanted=_READ):
        at = record.offset + record.size
        if record.opcode == rec.CHUNK:
            try:
                _take_chunk(record, limits, found, resync)
            except Damage as damage:
                if not (resync and _is_record(stream, at, size)):
                    raise
                # Only what is inside is damaged: the next record stands where it should.
                found.damage = found.damage or damage
                found.bytes_lost += record.size
                found.holes = True
                found.warnings.append(f"{damage.what}, at byte {damage.offset}: the chunk was skipped")
        elif record.opcode in (rec.SCHEMA, rec.CHANNEL):
            found.definitions.take(record.opcode, record.data, record.offset)
        elif record.opcode == rec.MESSAGE:
            fields = Fields(record.data, record.offset)
            channel_id, _, log_time_ns, _ = fields.numbers("<HIQQ")
            if channel_id not in found.definitions.channels:
                raise Damage(record.offset, f"a message names channel {channel_id}, which is missing")
            found.count(channel_id, log_time_ns)
            found.loose.append((record.offset, at))
        elif record.opcode == rec.STATISTICS:
            _compare(record, found)
        elif record.opcode == rec.DATA_END:
            closed = True
            found.data_end = record.offset
            found.data_crc = Fields(record.data, record.offset).number("<I")
            _check_data_crc(stream, found)
        elif record.opcode == rec.FOOTER:
            _after_footer(stream, at, size)
            return size
        elif record.opcode not in _KNOWN and record.opcode < 0x80:
            raise Damage(record.offset, f"a record of unknown kind {record.opcode:#x}")
    if not closed and found.damage is None:
        found.warnings.append(
            "the recording was not closed (was the recorder killed?); what is there is whole"
        )
    return at


def _take_chunk(record: rec.Record, limits: rec.Limits, found: Survey, resync: bool) -> None:
    head = rec.chunk_head(record.data, record.offset)
    try:
        content = rec.decompress(record.data, head, record.offset, limits)
    except (LimitExceeded, UnsupportedSchema) as error:
        if not resync:
            raise
        raise Damage(record.offset, error.message) from error
    messages = rec.chunk_messages(content, record.offset, found.definitions, None)
    if any(not head.start_ns <= m.log_time_ns <= head.end_ns for m in messages):
        raise Damage(record.offset, "a chunk's times contradict its messages")
    for message in messages:
        found.count(message.channel_id, message.log_time_ns)
    channels = frozenset(m.channel_id for m in messages)
    after = record.offset + record.size
    found.chunks.append(ChunkIndex(record.offset, record.size, head.start_ns, head.end_ns, channels, after))


def _compare(record: rec.Record, found: Survey) -> None:
    """Note how many messages are missing: of chunks that are cut out as a whole nothing else may tell."""
    with contextlib.suppress(Damage):  # damaged statistics tell nothing, and cost nothing
        statistics = rec.statistics(record)
        total = statistics.message_count
        found.missing = max(total - sum(found.counts.values()), 0) if statistics.counted else 0
        if found.missing:
            found.warnings.append(f"{found.missing} of {total} messages that the log counts are not there")


def _is_record(stream: BinaryIO, at: int, size: int) -> bool:
    """Whether a known record that fits into the file could start at `at`, or the file ends there."""
    stream.seek(at)
    head = stream.read(rec.RECORD_HEAD)
    fits = at + rec.RECORD_HEAD + int.from_bytes(head[1:], "little") <= size
    return at == size or (len(head) == rec.RECORD_HEAD and head[0] in _KNOWN and fits)


def _after_footer(stream: BinaryIO, at: int, size: int) -> None:
    stream.seek(at)
    if stream.read(len(rec.MAGIC)) != rec.MAGIC:
        raise Damage(at, "the end mark is missing", truncated=True)
    if at + len(rec.MAGIC) < size:
        raise Damage(at + len(rec.MAGIC), f"{size - at - len(rec.MAGIC)} bytes follow the end of the log")


def _check_data_crc(stream: BinaryIO, found: Survey) -> None:
    """Compare the data section with its checksum; chunks have their own, the rest only this."""
    if not found.data_crc:
        return
    crc, left = 0, found.data_end
    stream.seek(0)
    while left > 0 and (block := stream.read(min(left, 1 << 20))):
        crc = zlib.crc32(block, crc)
        left -= len(block)
    if crc != found.data_crc and found.damage is None:
        # Chunks passed their own checksums, so only what stands between them can be wrong.
        found.warnings.append("the checksum of the data section is wrong, outside of the chunks")


def _next_chunk(stream: BinaryIO, start: int, size: int) -> int:
    """Offset of the next chunk record that is plausible as a whole, or the end of the file."""
    at = start
    while at < size:
        stream.seek(at)
        window = stream.read(_WINDOW + _LONGEST_HEAD)  # a chunk may begin with its last byte
        for head in _CHUNK_HEAD.finditer(window):
            length, plain, stored = (int.from_bytes(head[i], "little") for i in (1, 2, 4))
            place = at + head.start()
            agrees = length == head.end(4) - head.start() - rec.RECORD_HEAD + stored
            if agrees and (plain == stored or not head[3]) and place + rec.RECORD_HEAD + length <= size:
                return place
        at += _WINDOW
    return size


def _joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Adjacent spans as one."""
    joined: list[tuple[int, int]] = []
    for start, end in spans:
        if joined and joined[-1][1] == start:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    return joined
