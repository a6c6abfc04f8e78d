"""What is where in an MCAP file, as its summary says; used only as far as it agrees with the file.

`mcap` parses the summary. It does not compare the summary's checksum, nor its parts with each other, and it
reads no message that stands outside of the chunks if there are any; that is done here.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex, DataEnd
from mcap.summary import Summary

from pc2grid.io.containers import mcap_records as rec
from pc2grid.io.containers.mcap_records import Damage, Definitions


@dataclass(slots=True)
class McapIndex:
    """What is where in an MCAP file.

    chunks : whole chunks, by offset. outside_chunks : byte spans that hold messages outside of chunks.
    counts : messages per channel id, complete if `counted`. start_ns, end_ns : first and last log time.
    data_end, data_crc : end and checksum of the data section (0: none).
    """

    definitions: Definitions = field(default_factory=Definitions)
    chunks: list[ChunkIndex] = field(default_factory=list)
    outside_chunks: list[tuple[int, int]] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    counted: bool = True
    start_ns: int = 0
    end_ns: int = 0
    data_end: int = 0
    data_crc: int = 0


def read_index(stream: BinaryIO, size: int, limits: rec.Limits) -> McapIndex | str:
    """The index in the summary section of a file of `size` bytes; a string says why there is none.

    stream : a file that bounds what is read at once (BoundedFile).

    Raises Damage if there is one that contradicts the file or itself, LimitExceeded.
    """
    found = _read_summary(stream, size, limits)
    if isinstance(found, str):
        return found
    summary, summary_at = found
    statistics, chunks = summary.statistics, summary.chunk_indexes
    if statistics is None:
        return "it has no statistics"
    if statistics.chunk_count != len(chunks):
        return "it does not list the chunks"
    needed = max(statistics.channel_count, int(statistics.message_count > 0 and not chunks))
    if needed > len(summary.channels):
        return "it does not list the channels"
    definitions = Definitions()
    for definition in (*summary.schemas.values(), *summary.channels.values()):
        definitions.take(definition, summary_at)
    for chunk in chunks:
        _check(chunk, summary, summary_at)
    chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    outside_chunks, data_end, data_crc = _between_chunks(stream, chunks, summary_at, limits)
    counts = statistics.channel_message_counts
    return McapIndex(
        definitions=definitions,
        chunks=chunks,
        outside_chunks=outside_chunks,
        counts=counts,
        counted=sum(counts.values()) == statistics.message_count,
        start_ns=statistics.message_start_time,
        end_ns=statistics.message_end_time,
        data_end=data_end,
        data_crc=data_crc,
    )


def _check(chunk: ChunkIndex, summary: Summary, summary_at: int) -> None:
    """Raises Damage if a chunk cannot be where the summary says."""
    if not chunk.message_index_offsets.keys() <= summary.channels.keys():
        raise Damage(summary_at, "it names channels that are missing")
    first, behind = chunk.chunk_start_offset, _behind(chunk)
    if first < len(rec.MAGIC) or chunk.chunk_length < rec.HEAD_BYTES or behind > summary_at:
        raise Damage(summary_at, "it places a chunk outside of the data")


def _behind(chunk: ChunkIndex) -> int:
    """The offset behind a chunk and its message indexes."""
    return chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length


def _read_summary(stream: BinaryIO, size: int, limits: rec.Limits) -> tuple[Summary, int] | str:
    """The summary and its offset; a string says why there is none."""
    foot = size - len(rec.MAGIC) - rec.FOOTER_BYTES
    if foot < len(rec.MAGIC):
        return "the recording was not finished"
    stream.seek(foot)
    tail = stream.read(rec.FOOTER_BYTES + len(rec.MAGIC))
    if tail[-8:] != rec.MAGIC or tail[0] != Opcode.FOOTER or int.from_bytes(tail[1:9], "little") != 20:
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
    stream.seek(0)
    with rec.mcap_errors_as_damage(summary_at):
        summary = SeekingReader(stream, record_size_limit=limits.record_bytes).get_summary()
    assert summary is not None  # its offset is not 0
    return summary, summary_at


def _between_chunks(
    stream: BinaryIO, chunks: list[ChunkIndex], data_end: int, limits: rec.Limits
) -> tuple[list[tuple[int, int]], int, int]:
    """Spans of the data section that hold messages outside of chunks, its end, and its checksum.

    A chunk that the summary does not list, or whose kind was changed by damage, is noticed here: it leaves a
    gap that is no sequence of records, or its statistics do not add up.
    """
    if not chunks:  # everything is one span; following its records would mean to read all of them
        end_of_data, crc = _data_end(stream, data_end)
        return [(len(rec.MAGIC), end_of_data)], end_of_data, crc
    outside_chunks: list[tuple[int, int]] = []
    at, end_of_data, crc = len(rec.MAGIC), data_end, 0
    for stop, behind in [*((c.chunk_start_offset, _behind(c)) for c in chunks), (data_end, data_end)]:
        if stop < at:
            raise Damage(stop, "it lists chunks that overlap")
        for record in rec.read_records(stream, at, stop, limits, wanted=frozenset({Opcode.DATA_END})):
            if record.opcode == Opcode.DATA_END:
                end_of_data, crc = record.offset, rec.parsed(DataEnd.read, record).data_section_crc
            elif record.opcode == Opcode.MESSAGE and (not outside_chunks or outside_chunks[-1] != (at, stop)):
                outside_chunks.append((at, stop))
        at = behind
    return outside_chunks, end_of_data, crc


def _data_end(stream: BinaryIO, summary_at: int) -> tuple[int, int]:
    """Offset and checksum of the DataEnd record, which stands right before the summary."""
    offset = summary_at - rec.HEAD_BYTES - 4
    stream.seek(max(offset, 0))
    head = stream.read(rec.HEAD_BYTES + 4)
    if (
        offset < len(rec.MAGIC)
        or head[0] != Opcode.DATA_END
        or int.from_bytes(head[1 : rec.HEAD_BYTES], "little") != 4
    ):
        raise Damage(offset, "the data section has no end")
    return offset, int.from_bytes(head[rec.HEAD_BYTES :], "little")
