"""MCAP files as a message source, read by `mcap` with checksums compared.

By the index in its summary, a part of a long log costs what that part costs. A file whose recorder was
killed, or whose summary is damaged, is read once up to its end or its first damage, and indexed meanwhile.
Messages that rosbag2 compressed one by one are decompressed.
"""

from __future__ import annotations

import bisect
import io
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from mcap.records import Chunk, ChunkIndex, McapRecord, Message

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, LogError
from pc2grid.io.containers.bounds import BoundedFile, plain_message
from pc2grid.io.containers.mcap_index import (
    McapIndex,
    Run,
    Survey,
    named,
    open_chunk,
    read_summary,
    records_of,
)
from pc2grid.io.message_source import LogInfo, RawMessage, Tally, TopicInfo

_LAST_NS = 1 << 64
_UNCHECKED = "parts of the log carry no checksum: damage would not be seen"


class McapSource:
    """One MCAP file, open.

    Raises LogTruncated, LogCorrupt, LimitExceeded or UnsupportedSchema when it is opened or read. With
    `recover`, damaged chunks are left out and counted in `tally`; without an index, all behind the damage is.
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
        """The index in the summary; None if there is none, it is damaged, or it lists no chunks."""
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
        """An index made by reading the file. Raises LogError for damage, unless `recover`."""
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
        """The topic of each channel; one that several programs publish may have several channels."""
        index = self._index
        of_channel = {key: index.topic(channel) for key, channel in index.channels.items()}
        groups: dict[tuple[str, str, str], list[int]] = {}
        for key, topic in of_channel.items():
            groups.setdefault((topic.topic, topic.type, topic.encoding), []).append(key)
        for group in groups.values():
            total = sum(index.counts.get(key, 0) for key in group) if index.counted else None
            of_channel.update(dict.fromkeys(group, replace(of_channel[group[0]], message_count=total)))
        return of_channel

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
        """See MessageSource.messages."""
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
        """The messages of a chunk that the index lists. Raises LogError if it is damaged."""
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
        """The records of a chunk, or of a run of messages."""
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
    """The chunks that may hold messages of these channels and times, by their first times."""
    found = [
        chunk
        for chunk in chunks
        if chunk.message_end_time >= low_ns
        and chunk.message_start_time < high_ns
        # Without message indexes, only its records say which channels are in a chunk.
        and (not chunk.message_index_offsets or chunk.message_index_offsets.keys() & channels)
    ]
    return sorted(found, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
