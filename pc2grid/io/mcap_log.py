"""MCAP files as a message source.

With a sound summary, chunks are found by the index, so a part of a huge log costs what that part costs.
Without one (a recorder that was killed, a damaged summary, `recover`), the file is surveyed once from the
start and the index is made from what is there.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, LogTruncated
from pc2grid.io import mcap_records as rec
from pc2grid.io.mcap_records import ChunkIndex, Damage, Definitions, Fields
from pc2grid.io.mcap_summary import read_summary
from pc2grid.io.mcap_survey import Survey, survey
from pc2grid.io.ros_definitions import short_name
from pc2grid.io.source import LogInfo, RawMessage, Tally, TopicInfo

_ENCODINGS = {"cdr": "cdr", "ros1": "ros1", "protobuf": "protobuf", "json": "json"}
_PENDING_BYTES = 128 << 20


class McapSource:
    """One MCAP file, open.

    Raises LogTruncated, LogCorrupt or LimitExceeded when it is opened or read; with `recover`, whatever is
    whole is read and the rest is counted in `tally`.
    """

    def __init__(self, path: Path, config: ReadConfig, *, recover: bool = False) -> None:
        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._path = path
        self._limits = rec.Limits(config.max_chunk_bytes, config.max_record_bytes)
        self._recover = recover
        self._stream: BinaryIO = path.open("rb")
        try:
            self._survey = self._look()
            self.info = self._describe()
        except BaseException:
            self._stream.close()
            raise
        self._loose_checked = False

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    # --- opening --------------------------------------------------------------------------------------

    def _look(self) -> Survey:
        """The index of the file: its own if it is sound, else one made by reading everything."""
        size = self._path.stat().st_size
        known, listed = Definitions(), list[ChunkIndex]()
        try:
            found = read_summary(self._stream, size, self._limits)
        except Damage as damage:
            self.tally.warn(f"the index is not usable ({damage.what}); the log was read in full instead")
        else:
            if not isinstance(found, Survey):
                self.tally.warn(f"the log has no index ({found}); it was read in full instead")
            elif self._recover:
                # A chunk may rest on definitions in an earlier one that is lost; the summary repeats them.
                known, listed = found.definitions, found.chunks
            else:
                self.tally.warnings += found.warnings
                return found
        told = bool(known.channels)
        made = survey(self._stream, size, self._limits, resync=self._recover, known=known)
        there = {chunk.offset for chunk in made.chunks}
        hidden = [chunk for chunk in listed if chunk.offset not in there]
        if hidden and not made.bytes_lost:
            # With another first byte a chunk looks like a record that is none of our business.
            made.bytes_lost = sum(chunk.size for chunk in hidden)
            made.warnings.append(f"{len(hidden)} chunks that the index lists are not there")
        self.tally.warnings += made.warnings
        self.tally.bytes_lost += made.bytes_lost
        unexplained = made.missing > 0 and not made.bytes_lost
        self.tally.topics_lost = (made.holes and not told) or unexplained
        if made.damage is not None and not self._recover:
            seconds = (made.end_ns - made.start_ns) * 1e-9
            count = sum(made.counts.values())
            kind = LogTruncated if made.damage.truncated else LogCorrupt
            raise kind(
                f"{self._path}: {made.damage.what}, at byte {made.damage.offset} of {size}; "
                f"{count} messages ({seconds:.1f} s) before it are readable",
                hint="--recover reads what is whole",
            )
        return made

    def _describe(self) -> LogInfo:
        found = self._survey
        self._topic_of: dict[int, TopicInfo] = {}
        merged: dict[tuple[str, str, str], list[int]] = {}
        for key, channel in found.definitions.channels.items():
            schema = found.definitions.schemas.get(channel.schema_id, rec.RawSchema("", "", b""))
            merged.setdefault((channel.topic, schema.name, channel.message_encoding), []).append(key)
        for (topic, schema_name, encoding), keys in merged.items():
            schema = found.definitions.schemas.get(
                found.definitions.channels[keys[0]].schema_id, rec.RawSchema("", "", b"")
            )
            topic_info = TopicInfo(
                topic=topic,
                type=short_name(schema_name),
                encoding=_ENCODINGS.get(encoding, encoding),
                schema_encoding=schema.encoding,
                schema=schema.data,
                message_count=sum(found.counts.get(k, 0) for k in keys) if found.counted else None,
            )
            self._topic_of.update(dict.fromkeys(keys, topic_info))
        topics = sorted(dict.fromkeys(self._topic_of.values()), key=lambda t: (t.topic, t.type))
        dialects = Counter(t.encoding for t in topics)
        dialect = {"cdr": "ros2"}.get(name := dialects.most_common(1)[0][0], name) if dialects else "empty"
        return LogInfo(
            path=self._path,
            format=f"mcap/{dialect}",
            size_bytes=self._path.stat().st_size,
            start_ns=found.start_ns,
            end_ns=found.end_ns,
            message_count=sum(found.counts.values()) if found.counted else None,
            topics=tuple(topics),
            warnings=tuple(self.tally.warnings),
        )

    # --- reading --------------------------------------------------------------------------------------

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See Source.messages. Chunks that overlap in time are merged, up to a bound in memory."""
        wanted = frozenset(
            key for key, channel in self._survey.definitions.channels.items() if channel.topic in topics
        )
        low = -1 if start_ns is None else start_ns
        high = 1 << 64 if end_ns is None else end_ns
        try:
            yield from self._loose_messages(wanted, low, high)
            yield from self._chunk_messages(wanted, low, high)
        except Damage as damage:
            raise LogCorrupt(
                f"{self._path}: {damage.what}, at byte {damage.offset}", hint="--recover reads what is whole"
            ) from damage

    def _chunk_messages(self, wanted: frozenset[int], low: int, high: int) -> Iterator[RawMessage]:
        chunks = [
            chunk
            for chunk in sorted(self._survey.chunks, key=lambda c: (c.start_ns, c.offset))
            if chunk.end_ns >= low
            and chunk.start_ns < high
            and (chunk.channels is None or chunk.channels & wanted)
        ]
        pending: list[RawMessage] = []
        pending_bytes = 0
        for chunk in chunks:
            if pending and (pending[0].log_time_ns < chunk.start_ns or pending_bytes > _PENDING_BYTES):
                ready = len(pending)
                if pending_bytes <= _PENDING_BYTES and pending[-1].log_time_ns >= chunk.start_ns:
                    ready = next(i for i, m in enumerate(pending) if m.log_time_ns >= chunk.start_ns)
                yield from pending[:ready]
                del pending[:ready]
                pending_bytes = sum(len(m.data) for m in pending)
            for channel_id, log_time_ns, data in self._load(chunk, wanted):
                if low <= log_time_ns < high:
                    pending.append(RawMessage(self._topic_of[channel_id], log_time_ns, data))
                    pending_bytes += len(data)
            pending.sort(key=lambda m: m.log_time_ns)  # stable: equal times stay in file order
        yield from pending

    def _load(self, chunk: ChunkIndex, wanted: frozenset[int]) -> list[rec.ChunkMessage]:
        try:
            self._stream.seek(chunk.offset)
            head = self._stream.read(rec.RECORD_HEAD)
            if len(head) < rec.RECORD_HEAD or head[0] != rec.CHUNK:
                raise Damage(chunk.offset, "the index points to something else")
            length = int.from_bytes(head[1:], "little")
            if length + rec.RECORD_HEAD != chunk.size:
                raise Damage(chunk.offset, "the index gives another length")
            if length > self._limits.record_bytes:
                raise rec.too_large(chunk.offset, length, self._limits)
            data = self._stream.read(length)
            if len(data) < length:
                raise Damage(chunk.offset, "the file ends within it", truncated=True)
            fields = rec.chunk_head(data, chunk.offset)
            if (fields.start_ns, fields.end_ns) != (chunk.start_ns, chunk.end_ns):
                raise Damage(chunk.offset, "the index gives other times")
            if fields.crc == 0 and fields.uncompressed_size:
                self.tally.warn("chunks of the log carry no checksum: damage would not be seen")
            content = rec.decompress(data, fields, chunk.offset, self._limits)
            found = rec.chunk_messages(content, chunk.offset, self._survey.definitions, wanted)
            if 2 * sum(len(m.data) for m in found) < len(content):
                # A view keeps the whole chunk: small messages of many large chunks would fill the memory.
                return [m._replace(data=memoryview(bytes(m.data))) for m in found]
            return found
        except Damage as damage:
            number = self._survey.chunks.index(chunk) + 1
            where = f"chunk {number} ({self._when(chunk.start_ns)} to {self._when(chunk.end_ns)})"
            raise Damage(damage.offset, f"{where}: {damage.what}", truncated=damage.truncated) from damage

    def _when(self, stamp_ns: int) -> str:
        return f"{(stamp_ns - self.info.start_ns) * 1e-9:.1f} s"

    def _loose_messages(self, wanted: frozenset[int], low: int, high: int) -> Iterator[RawMessage]:
        """Messages outside chunks, in file order; only the data section's checksum protects them."""
        spans = self._survey.loose
        if not spans:
            return
        if not self._loose_checked:
            self._check_data_section()
        kinds = frozenset({rec.MESSAGE})
        for start, end in spans:
            for record in rec.read_records(self._stream, start, end, self._limits, wanted=kinds):
                if record.opcode != rec.MESSAGE:
                    continue
                view = memoryview(record.data)
                fields = Fields(view, record.offset)
                channel_id, _, log_time_ns, _ = fields.numbers("<HIQQ")
                if channel_id in wanted and low <= log_time_ns < high:
                    yield RawMessage(self._topic_of[channel_id], log_time_ns, view[fields.at :])

    def _check_data_section(self) -> None:
        found = self._survey
        self._loose_checked = True
        if not found.data_crc:
            self.tally.warn("messages of the log carry no checksum: damage would not be seen")
            return
        crc, left = 0, found.data_end
        self._stream.seek(0)
        while left > 0 and (block := self._stream.read(min(left, 1 << 20))):
            crc = zlib.crc32(block, crc)
            left -= len(block)
        if crc != found.data_crc:
            if not self._recover:
                raise Damage(found.data_end, "the checksum (CRC) of the data section is wrong")
            doubtful = sum(end - start for start, end in found.loose)
            self.tally.bytes_lost += doubtful
            self.tally.warn(f"{doubtful} bytes of messages fail their checksum and may be wrong")
