"""MCAP files as a message source, read by `mcap`.

With a sound summary, chunks are found by the index, so a part of a long log costs what that part costs.
Without one (a recorder that was killed, a damaged summary, `recover`), the file is surveyed once from its
start and the index is made from what is there. Either way the messages come from `mcap`'s StreamReader, chunk
by chunk.

Its SeekingReader would choose and sort the chunks, too. It is not used for that: it does not compare a chunk
with the index, does not bound a decompression, and holds all chunks that overlap in time in memory.
"""

from __future__ import annotations

import bisect
import io
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message
from mcap.stream_reader import StreamReader

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, LogTruncated
from pc2grid.io.containers import mcap_records as rec
from pc2grid.io.containers.bounded_file import BoundedFile
from pc2grid.io.containers.mcap_index import McapIndex, read_index
from pc2grid.io.containers.mcap_records import Damage
from pc2grid.io.containers.mcap_survey import crc_of, survey
from pc2grid.io.error_translation import RECOVER_HINT
from pc2grid.io.message_source import LogInfo, RawMessage, Tally, TopicInfo

# Messages of chunks that overlap in time wait to be merged in this much memory (chosen by hand); in a file
# whose chunks overlap more, they come less well sorted.
_MAX_PENDING_BYTES = 128 << 20


class _TimeRange(NamedTuple):
    """Log times from start_ns up to, not including, end_ns."""

    start_ns: int
    end_ns: int

    def __contains__(self, time_ns: object) -> bool:
        return isinstance(time_ns, int) and self.start_ns <= time_ns < self.end_ns


class McapSource:
    """One MCAP file, open.

    Raises LogTruncated, LogCorrupt or LimitExceeded when it is opened or read; with `recover`, what is whole
    is read and the rest is counted in `tally`.
    """

    def __init__(self, path: Path, config: ReadConfig, *, recover: bool = False) -> None:
        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._path = path
        self._limits = rec.Limits(config.max_chunk_bytes, config.max_record_bytes)
        self._recover = recover
        self._stream = BoundedFile(io.FileIO(path), config.max_record_bytes)
        try:
            self._index = self._find_index()
            self.info = self._describe()
        except BaseException:
            self._stream.close()
            raise
        self._loose_checked = False

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    # --- opening --------------------------------------------------------------------------------------

    def _find_index(self) -> McapIndex:
        """The index of the file: its own if it is sound, else one made by reading the whole file."""
        own: McapIndex | None = None
        try:
            found = read_index(self._stream, self._path.stat().st_size, self._limits)
        except Damage as damage:
            self.tally.warn(f"the index is not usable ({damage.what}); the log was read in full instead")
        else:
            if isinstance(found, str):
                self.tally.warn(f"the log has no index ({found}); it was read in full instead")
            elif not self._recover:
                return found
            else:
                own = found
        return self._surveyed(own)

    def _surveyed(self, own: McapIndex | None) -> McapIndex:
        """An index made by reading the whole file; `own` is the one in its summary."""
        size = self._path.stat().st_size
        # A chunk may rest on definitions in an earlier one that is lost; the summary repeats them.
        known = own.definitions if own else None
        with self._path.open("rb") as stream:
            found = survey(stream, size, self._limits, resync=self._recover, known=known)
        index, tally = found.index, self.tally
        if own is not None:
            found.compare(own.chunks)
        for sentence in found.warnings:
            tally.warn(sentence)
        tally.bytes_lost += found.bytes_lost
        unexplained = found.missing > 0 and not found.bytes_lost
        tally.topics_lost = (found.holes and own is None) or unexplained
        if found.damage is not None and not self._recover:
            raise self._damaged(found.damage, index, size)
        return index

    def _damaged(self, damage: Damage, index: McapIndex, size: int) -> LogCorrupt | LogTruncated:
        seconds = (index.end_ns - index.start_ns) * 1e-9
        count = sum(index.counts.values())
        kind = LogTruncated if damage.truncated else LogCorrupt
        return kind(
            f"{self._path}: {damage.what}, at byte {damage.offset} of {size}; "
            f"{count} messages ({seconds:.1f} s) before it are readable",
            hint=RECOVER_HINT,
        )

    def _describe(self) -> LogInfo:
        index = self._index
        groups: dict[tuple[str, str, str], list[Channel]] = {}
        for channel in index.definitions.channels.values():
            topic = index.definitions.topic(channel)
            groups.setdefault((topic.topic, topic.type, topic.encoding), []).append(channel)
        self._topic_of: dict[int, TopicInfo] = {}
        for group in groups.values():
            count = sum(index.counts.get(c.id, 0) for c in group) if index.counted else None
            info = replace(index.definitions.topic(group[0]), message_count=count)
            self._topic_of.update((channel.id, info) for channel in group)
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
        """See MessageSource.messages. Chunks that overlap in time are merged, up to a bound in memory."""
        wanted = frozenset(key for key, topic in self._topic_of.items() if topic.topic in topics)
        times = _TimeRange(-1 if start_ns is None else start_ns, 1 << 64 if end_ns is None else end_ns)
        try:
            yield from self._loose_messages(wanted, times)
            yield from self._chunk_messages(wanted, times)
        except Damage as damage:
            raise LogCorrupt(
                f"{self._path}: {damage.what}, at byte {damage.offset}", hint=RECOVER_HINT
            ) from damage

    def _chunk_messages(self, wanted: frozenset[int], times: _TimeRange) -> Iterator[RawMessage]:
        chunks = sorted(self._index.chunks, key=lambda c: (c.message_start_time, c.chunk_start_offset))
        pending: list[RawMessage] = []
        for chunk in chunks:
            if not _is_wanted(chunk, wanted, times):
                continue
            ready = _ready(pending, chunk.message_start_time)
            yield from pending[:ready]
            del pending[:ready]
            pending += (
                RawMessage(self._topic_of[message.channel_id], message.log_time, message.data)
                for message in self._load(chunk)
                if message.channel_id in wanted and message.log_time in times
            )
            pending.sort(key=lambda m: m.log_time_ns)  # stable: equal times stay in file order
        yield from pending

    def _load(self, listed: ChunkIndex) -> list[Message]:
        """The messages of a chunk that the index lists. Raises Damage if it is not what the index says."""
        offset = listed.chunk_start_offset
        try:
            chunk = self._read_chunk(listed)
            if chunk.uncompressed_crc == 0 and chunk.uncompressed_size:
                self.tally.warn("chunks of the log carry no checksum: damage would not be seen")
            records = rec.chunk_records(chunk, offset, self._limits)
            messages = []
            for record in records:
                if isinstance(record, Message):
                    if record.channel_id not in self._topic_of:
                        raise Damage(offset, f"a message names channel {record.channel_id}, which is missing")
                    messages.append(record)
                else:
                    self._index.definitions.take(record, offset)
        except Damage as damage:
            number = self._index.chunks.index(listed) + 1
            first_s, last_s = (
                (time_ns - self.info.start_ns) * 1e-9
                for time_ns in (listed.message_start_time, listed.message_end_time)
            )
            where = f"chunk {number} ({first_s:.1f} s to {last_s:.1f} s)"
            raise Damage(damage.offset, f"{where}: {damage.what}", truncated=damage.truncated) from damage
        return messages

    def _read_chunk(self, listed: ChunkIndex) -> Chunk:
        offset, size = listed.chunk_start_offset, listed.chunk_length
        self._stream.seek(offset)
        head = self._stream.read(rec.HEAD_BYTES)
        if head[:1] != rec.CHUNK_KIND:
            raise Damage(offset, "the index points to something else")
        length = int.from_bytes(head[1:], "little")
        if length + rec.HEAD_BYTES != size:
            raise Damage(offset, "the index gives another length")
        if length > self._limits.record_bytes:
            raise rec.too_large(offset, length, self._limits)
        self._stream.seek(offset)
        with rec.mcap_errors_as_damage(offset):
            chunk = next(self._records())
        assert isinstance(chunk, Chunk)
        fields_bytes = rec.HEAD_BYTES + rec.CHUNK_FIELDS_BYTES + len(chunk.compression.encode())
        if fields_bytes + len(chunk.data) != size or self._stream.tell() != offset + size:
            raise Damage(offset, "a chunk's lengths contradict each other")
        if (chunk.message_start_time, chunk.message_end_time) != (
            listed.message_start_time,
            listed.message_end_time,
        ):
            raise Damage(offset, "the index gives other times")
        return chunk

    def _loose_messages(self, wanted: frozenset[int], times: _TimeRange) -> Iterator[RawMessage]:
        """Messages outside of chunks, in file order; only the data section's checksum protects them."""
        spans = self._index.outside_chunks
        if spans and not self._loose_checked:
            self._check_data_section()
        for start, end in spans:
            self._stream.seek(start)
            records = self._records()
            at = start
            while at < end:
                self._stream.seek(at)  # another pass over the file may have moved it
                with rec.mcap_errors_as_damage(at):
                    record = next(records)
                at = self._stream.tell()
                if isinstance(record, Message) and record.channel_id in wanted and record.log_time in times:
                    yield RawMessage(self._topic_of[record.channel_id], record.log_time, record.data)

    def _records(self) -> Iterator[McapRecord]:
        """The records from where the file stands on, chunks as they are stored."""
        limit = self._limits.record_bytes
        return StreamReader(self._stream, skip_magic=True, emit_chunks=True, record_size_limit=limit).records

    def _check_data_section(self) -> None:
        """Compare the checksum of everything up to the end of the data; `mcap` would do so too late."""
        index = self._index
        self._loose_checked = True
        if not index.data_crc:
            self.tally.warn("messages of the log carry no checksum: damage would not be seen")
            return
        with self._path.open("rb") as stream:
            if crc_of(stream, index.data_end) == index.data_crc:
                return
        if not self._recover:
            raise Damage(index.data_end, "the checksum (CRC) of the data section is wrong")
        doubtful = sum(end - start for start, end in index.outside_chunks)
        self.tally.bytes_lost += doubtful
        self.tally.warn(f"{doubtful} bytes of messages fail their checksum and may be wrong")


def _is_wanted(chunk: ChunkIndex, channels: frozenset[int], times: _TimeRange) -> bool:
    """Whether a chunk may hold messages of these channels and times."""
    if chunk.message_end_time < times.start_ns or chunk.message_start_time >= times.end_ns:
        return False
    # Without message indexes, only its records say which topics are in a chunk.
    return not chunk.message_index_offsets or bool(chunk.message_index_offsets.keys() & channels)


def _ready(pending: list[RawMessage], start_ns: int) -> int:
    """How many of the sorted messages need not wait for those of a chunk that begins at `start_ns`."""
    if sum(len(m.data) for m in pending) > _MAX_PENDING_BYTES:
        return len(pending)
    return bisect.bisect_left(pending, start_ns, key=lambda m: m.log_time_ns)
