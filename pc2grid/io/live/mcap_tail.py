"""An MCAP of which more and more is there: a file that is still being written, or a pipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, NotALog
from pc2grid.io import topics
from pc2grid.io.containers import mcap_records as rec
from pc2grid.io.containers.decompress import plain_message
from pc2grid.io.containers.mcap_records import Damage, Definitions
from pc2grid.io.message_source import RawMessage, TopicInfo
from pc2grid.io.read_plan import published_once

_BLOCK_BYTES = 1 << 20
"""After so many bytes `read` returns, so that the messages can be used."""
_END = frozenset({Opcode.DATA_END, Opcode.FOOTER})
_DEFINITIONS = frozenset({Opcode.SCHEMA, Opcode.CHANNEL})
_USED = _DEFINITIONS | {Opcode.MESSAGE, Opcode.CHUNK}
_TIMES_BYTES = 16  # first and last log time, at the beginning of a chunk


@dataclass(slots=True)
class _Block:
    """A chunk, or a message outside of chunks. channels : of its messages, as far as they are known without
    reading it."""

    offset: int
    size: int
    end_ns: int
    channels: set[int] = field(default_factory=set)


class McapTail:
    """Messages of an MCAP that grows; what is read once is not read again.

    position : bytes that were read or passed over. ended : whether the end of the data was reached.
    """

    def __init__(self, name: str, stream: BinaryIO, size: Callable[[], int], config: ReadConfig) -> None:
        """name : for the user. stream : seekable, forwards at least. size : the bytes that are there now."""
        self._name, self._stream, self._size, self._config = name, stream, size, config
        self._limits = rec.Limits(config.max_chunk_bytes, config.max_record_bytes)
        self._definitions = Definitions()
        self._topic_of: dict[int, TopicInfo] = {}
        self._first: list[RawMessage] = []
        self._since_ns = 0
        self.position = 0
        self.ended = False

    @staticmethod
    def of_file(path: Path, config: ReadConfig) -> McapTail:
        """The tail of a file. Raises OSError."""
        stream = path.open("rb", buffering=0)
        return McapTail(str(path), stream, lambda: path.stat().st_size, config)

    @property
    def size(self) -> int:
        """The bytes that are there now."""
        return self._size()

    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics of the channels seen so far."""
        return tuple(dict.fromkeys(self._topic(number) for number in self._definitions.channels))

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read(self) -> Iterator[RawMessage]:
        """The messages that are complete and were not read yet, by log time within a chunk; some at a time.

        Raises LogCorrupt, LimitExceeded, UnsupportedSchema, and NotALog if it is not an MCAP.
        """
        first, self._first = self._first, []
        yield from first
        begin = self.position
        try:
            for record in self._records():
                for message in self._messages(record):
                    if message.log_time_ns >= self._since_ns or published_once(message.channel):
                        yield message
                if self.position - begin > _BLOCK_BYTES:
                    return
        except Damage as damage:
            raise self._corrupt(damage) from damage

    def _records(self) -> Iterator[rec.Record]:
        """The records from `position` on that are complete."""
        size = self.size
        if self.position == 0:
            self._stream.seek(0)
            if size < len(rec.MAGIC):
                return
            if self._stream.read(len(rec.MAGIC)) != rec.MAGIC:
                hint = "of other recordings, name the file instead of `-`"
                raise NotALog(f"{self._name}: not an MCAP", hint=hint)
            self.position = len(rec.MAGIC)
        if self.ended:
            return
        try:
            for record in rec.read_records(self._stream, self.position, size, self._limits, wanted=_USED):
                if record.opcode in _END:
                    self.ended = True
                    return
                self.position = record.offset + record.size
                yield record
        except Damage as damage:
            if not damage.truncated:
                raise
            self._wait_for_rest(size)

    def _wait_for_rest(self, size: int) -> None:
        """Of a record that is not whole yet: pass over what is not needed, refuse what is too large."""
        self._stream.seek(self.position)
        head = self._stream.read(rec.HEAD_BYTES) if self.position + rec.HEAD_BYTES <= size else b""
        if len(head) < rec.HEAD_BYTES or head[0] in _END:
            return
        length = int.from_bytes(head[1:], "little")
        if head[0] not in _USED:
            self.position += rec.HEAD_BYTES + length
        elif length > self._limits.record_bytes:
            raise rec.too_large(self.position, length, self._limits)

    def _messages(self, record: rec.Record) -> Iterator[RawMessage]:
        """The messages of one record; remembers the definitions in it. Raises Damage."""
        match record.opcode:
            case Opcode.SCHEMA:
                self._definitions.take(rec.parsed(Schema.read, record), record.offset)
            case Opcode.CHANNEL:
                self._definitions.take(rec.parsed(Channel.read, record), record.offset)
            case Opcode.MESSAGE:
                yield self._raw(rec.parsed_message(record), record.offset)
            case Opcode.CHUNK:
                inside = rec.chunk_records(rec.parsed_chunk(record), record.offset, self._limits)
                for item in inside:
                    self._definitions.take(item, record.offset)
                messages = [item for item in inside if isinstance(item, Message)]
                for message in sorted(messages, key=lambda m: m.log_time):
                    yield self._raw(message, record.offset)

    def _raw(self, message: Message, offset: int) -> RawMessage:
        if message.channel_id not in self._definitions.channels:
            raise Damage(offset, f"a message names channel {message.channel_id}, which is missing")
        data = plain_message(message.data, self._config.max_chunk_bytes)
        return RawMessage(self._topic(message.channel_id), message.log_time, data)

    def _topic(self, number: int) -> TopicInfo:
        if number not in self._topic_of:
            self._topic_of[number] = self._definitions.topic(self._definitions.channels[number])
        return self._topic_of[number]

    def _corrupt(self, damage: Damage) -> LogCorrupt:
        return LogCorrupt(f"{self._name}: {damage.what}, at byte {damage.offset}")

    # --- finding the last seconds ---------------------------------------------------------------------

    def newest_ns(self) -> int | None:
        """The log time of the newest message; None if there is none yet."""
        return max((block.end_ns for block in self._blocks()), default=None)

    def skip_to(self, since_ns: int) -> None:
        """Leave out what was recorded before a log time, but for messages that are published once: static
        transforms, and the calibration of cameras.

        Of what is left out only the heads of its records are read, the definitions of channels, and these
        messages. Raises as `read` does.
        """
        blocks = self._blocks()
        tail = next((block.offset for block in blocks if block.end_ns >= since_ns), None)
        if tail is None:
            tail = blocks[-1].offset + blocks[-1].size if blocks else 0
        # A later block may hold older messages: they are left out one by one.
        before = [block for block in blocks if block.offset < tail]
        try:
            self._first = self._messages_published_once(before)
        except Damage as damage:
            raise self._corrupt(damage) from damage
        self._since_ns, self.position = since_ns, tail

    def _blocks(self) -> list[_Block]:
        """The blocks of the file as far as they are whole; the definitions between them are taken up."""
        size, blocks = self.size, list[_Block]()
        if size <= len(rec.MAGIC):
            return blocks
        wanted = _DEFINITIONS | {Opcode.MESSAGE_INDEX}
        try:
            for record in rec.read_records(self._stream, len(rec.MAGIC), size, self._limits, wanted=wanted):
                if record.opcode in _END:
                    break
                if record.opcode == Opcode.MESSAGE_INDEX and blocks:
                    blocks[-1].channels.add(int.from_bytes(record.data[:2], "little"))
                elif record.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                    blocks.append(self._block(record))
                else:
                    list(self._messages(record))
        except Damage as damage:
            if not damage.truncated:  # else the last record is only written in part
                raise self._corrupt(damage) from damage
        return blocks

    def _block(self, record: rec.Record) -> _Block:
        self._stream.seek(record.offset + rec.HEAD_BYTES)
        head = self._stream.read(_TIMES_BYTES)
        if record.opcode == Opcode.CHUNK:
            return _Block(record.offset, record.size, int.from_bytes(head[8:16], "little"))
        # Within a message the log time is behind its channel (uint16) and number (uint32).
        channel, time_ns = int.from_bytes(head[:2], "little"), int.from_bytes(head[6:14], "little")
        return _Block(record.offset, record.size, time_ns, {channel})

    def _messages_published_once(self, blocks: list[_Block]) -> list[RawMessage]:
        """Also reads the chunks that define channels: for each channel the first one in which it occurs."""
        known: set[int] = set()
        sought: set[int] = set()
        found: list[RawMessage] = []
        cameras: set[str] = set()
        for block in blocks:
            if block.channels and block.channels <= known and not block.channels & sought:
                continue
            self._stream.seek(block.offset)
            data = self._stream.read(block.size)
            record = rec.Record(block.offset, data[0], data[rec.HEAD_BYTES :], block.size)
            for message in self._messages(record):
                topic = message.channel
                if published_once(topic) and topic.topic not in cameras:
                    found.append(message)
                    # Of a camera's calibration, which many drivers repeat with each image, one is enough.
                    cameras |= {topic.topic} if topic.type in topics.CAMERA_INFOS else set()
            known |= block.channels
            sought = {n for n, t in self._topic_of.items() if published_once(t) and t.topic not in cameras}
        return found
