"""The index that an MCAP carries at its end, believed only as far as it agrees with the file."""

from __future__ import annotations

import zlib
from typing import BinaryIO

from pc2grid.io import mcap_records as rec
from pc2grid.io.mcap_records import ChunkIndex, Damage, Definitions, Fields
from pc2grid.io.mcap_survey import Survey


def read_summary(stream: BinaryIO, size: int, limits: rec.Limits) -> Survey | str:
    """The summary section as an index; a string says why there is none.

    Raises Damage if there is one that cannot be trusted.
    """
    least = len(rec.MAGIC) + rec.FOOTER_SIZE + len(rec.MAGIC)
    if size < least:
        return "the recording was not finished"
    foot = size - len(rec.MAGIC) - rec.FOOTER_SIZE
    stream.seek(foot)
    tail = stream.read(rec.FOOTER_SIZE + len(rec.MAGIC))
    if tail[-8:] != rec.MAGIC or tail[0] != rec.FOOTER or int.from_bytes(tail[1:9], "little") != 20:
        return "the recording was not finished"
    summary_at = int.from_bytes(tail[9:17], "little")
    crc = int.from_bytes(tail[25:29], "little")
    if summary_at == 0:
        return "its writer made none"
    if not len(rec.MAGIC) <= summary_at <= foot:
        raise Damage(foot, "the footer points outside of the file")
    if foot - summary_at > limits.record_bytes:
        raise Damage(foot, "the summary is larger than the limit")
    stream.seek(summary_at)
    section = stream.read(foot - summary_at)
    if crc and zlib.crc32(tail[:25], zlib.crc32(section)) != crc:
        raise Damage(summary_at, "its checksum (CRC) is wrong")

    definitions = Definitions()
    chunks: list[ChunkIndex] = []
    statistics: rec.Statistics | None = None
    kinds = frozenset({rec.SCHEMA, rec.CHANNEL, rec.CHUNK_INDEX, rec.STATISTICS})
    for record in rec.read_records(stream, summary_at, foot, limits, wanted=kinds):
        if record.opcode in (rec.SCHEMA, rec.CHANNEL):
            definitions.take(record.opcode, record.data, record.offset)
        elif record.opcode == rec.CHUNK_INDEX:
            chunks.append(_chunk_index(record, summary_at))
        elif record.opcode == rec.STATISTICS:
            statistics = rec.statistics(record)
    if statistics is None:
        return "it has no statistics"
    if statistics.chunk_count != len(chunks):
        return "it does not list the chunks"
    if statistics.channel_count > len(definitions.channels):
        return "it does not list the channels"
    if any(c.channels is not None and not c.channels <= definitions.channels.keys() for c in chunks):
        raise Damage(summary_at, "it names channels that are missing")
    if statistics.message_count and not (chunks or definitions.channels):
        return "it does not list the channels"
    chunks.sort(key=lambda c: c.offset)
    loose, data_end, data_crc = _between_chunks(stream, chunks, summary_at, limits)
    return Survey(
        definitions=definitions,
        chunks=chunks,
        loose=loose,
        counts=statistics.counts,
        counted=statistics.counted,
        start_ns=statistics.start_ns,
        end_ns=statistics.end_ns,
        data_end=data_end,
        data_crc=data_crc,
    )


def _chunk_index(record: rec.Record, summary_at: int) -> ChunkIndex:
    fields = Fields(record.data, record.offset)
    start_ns, end_ns, offset, size = fields.numbers("<QQQQ")
    offsets = Fields(fields.blob(), record.offset)
    channels: set[int] = set()
    while not offsets.done:
        channel, _ = offsets.numbers("<HQ")
        channels.add(channel)
    index_size = fields.number("<Q")
    after = offset + size + index_size
    if offset < len(rec.MAGIC) or size < rec.RECORD_HEAD or after > summary_at:
        raise Damage(record.offset, "it places a chunk outside of the data")
    return ChunkIndex(offset, size, start_ns, end_ns, frozenset(channels) if channels else None, after)


def _between_chunks(
    stream: BinaryIO, chunks: list[ChunkIndex], data_end: int, limits: rec.Limits
) -> tuple[list[tuple[int, int]], int, int]:
    """Spans of the data section that hold messages outside chunks, its end, and its checksum."""
    loose: list[tuple[int, int]] = []
    at, crc = len(rec.MAGIC), 0
    end_of_data = data_end
    for stop, after in [*((c.offset, c.after) for c in chunks), (data_end, data_end)]:
        if stop < at:
            raise Damage(stop, "it lists chunks that overlap")
        kinds = frozenset({rec.DATA_END})
        if not chunks:
            # A file without chunks: everything is one span, and walking it now would cost too much.
            end_of_data, crc = _data_end(stream, data_end)
            return [(at, end_of_data)], end_of_data, crc
        for record in rec.read_records(stream, at, stop, limits, wanted=kinds):
            if record.opcode == rec.DATA_END:
                end_of_data, crc = record.offset, Fields(record.data, record.offset).number("<I")
            elif record.opcode == rec.MESSAGE and (not loose or loose[-1] != (at, stop)):
                loose.append((at, stop))
        at = after
    return loose, end_of_data, crc


def _data_end(stream: BinaryIO, summary_at: int) -> tuple[int, int]:
    """Offset and checksum of the DataEnd record, which stands right before the summary."""
    offset = summary_at - rec.RECORD_HEAD - 4
    stream.seek(max(offset, 0))
    head = stream.read(rec.RECORD_HEAD + 4)
    if offset < len(rec.MAGIC) or head[0] != rec.DATA_END or int.from_bytes(head[1:9], "little") != 4:
        raise Damage(offset, "the data section has no end")
    return offset, int.from_bytes(head[9:13], "little")
