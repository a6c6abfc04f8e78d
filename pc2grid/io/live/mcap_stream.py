"""MCAP as it comes, byte by byte: from a pipe, or from a file that is still being written."""

from __future__ import annotations

from collections.abc import Iterator

from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, NotALog
from pc2grid.io.containers import mcap_records as rec
from pc2grid.io.containers.decompress import ZSTD_MAGIC, unpacker
from pc2grid.io.containers.mcap_records import Damage, Definitions
from pc2grid.io.message_source import RawMessage, TopicInfo
from pc2grid.io.messages.ros_definitions import short_name

_USED = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK})


class McapStream:
    """Parses an MCAP of which more and more is known.

    ended : whether the end of its data was reached. definitions : schemas and channels seen so far.
    """

    def __init__(self, name: str, config: ReadConfig, *, at: int = 0) -> None:
        """at : the byte that the first one fed has in the file; the file's magic is expected at 0 only."""
        self._name = name
        self._limits = rec.Limits(config.max_chunk_bytes, config.max_record_bytes)
        self._unpack = unpacker("zstd", config.max_chunk_bytes)
        self._buffer = bytearray()
        self._at = at
        self._skip = 0
        self._topic_of: dict[int, TopicInfo] = {}
        self.definitions = Definitions()
        self.ended = False

    def feed(self, data: bytes) -> Iterator[RawMessage]:
        """Take in the next bytes, and yield the messages that are complete with them, by log time within a
        chunk.

        Raises LogCorrupt, LimitExceeded, UnsupportedSchema, and NotALog if it is not an MCAP.
        """
        if self._skip:
            passed = min(self._skip, len(data))
            self._skip -= passed
            self._at += passed
            data = data[passed:]
        self._buffer += data
        try:
            yield from self._records()
        except Damage as damage:
            raise LogCorrupt(f"{self._name}: {damage.what}, at byte {damage.offset}") from damage

    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics of the channels seen so far."""
        for number in self.definitions.channels:
            self._topic(number)
        return tuple(dict.fromkeys(self._topic_of.values()))

    def _records(self) -> Iterator[RawMessage]:
        if self._at == 0:
            if len(self._buffer) < len(rec.MAGIC):
                return
            if not self._buffer.startswith(rec.MAGIC):
                raise NotALog(
                    f"{self._name}: not an MCAP", hint="of other recordings, name the file instead of `-`"
                )
            self._consume(len(rec.MAGIC))
        while not self.ended and len(self._buffer) >= rec.HEAD_BYTES:
            opcode = self._buffer[0]
            length = int.from_bytes(self._buffer[1 : rec.HEAD_BYTES], "little")
            if opcode == 0:
                raise Damage(self._at, "not a record")
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                self.ended = True
                return
            if opcode not in _USED:
                self._pass_over(rec.HEAD_BYTES + length)
                continue
            if length > self._limits.record_bytes:
                raise rec.too_large(self._at, length, self._limits)
            size = rec.HEAD_BYTES + length
            if len(self._buffer) < size:
                return
            record = rec.Record(self._at, opcode, bytes(self._buffer[rec.HEAD_BYTES : size]), size)
            self._consume(size)
            yield from self.read(record)

    def read(self, record: rec.Record) -> Iterator[RawMessage]:
        """The messages of one record; remembers the definitions in it."""
        match record.opcode:
            case Opcode.SCHEMA:
                self.definitions.take(rec.parsed(Schema.read, record), record.offset)
            case Opcode.CHANNEL:
                self.definitions.take(rec.parsed(Channel.read, record), record.offset)
            case Opcode.MESSAGE:
                if len(record.data) < rec.MESSAGE_FIELDS_BYTES:
                    raise Damage(record.offset, "a message is shorter than its fields")
                length = len(record.data)
                message = rec.parsed(lambda stream: Message.read(stream, length), record)
                yield self._raw(message, record.offset)
            case Opcode.CHUNK:
                chunk = rec.parsed_chunk(record)
                messages: list[Message] = []
                for inner in rec.chunk_records(chunk, record.offset, self._limits):
                    if isinstance(inner, Message):
                        messages.append(inner)
                    else:
                        self.definitions.take(inner, record.offset)
                for found in sorted(messages, key=lambda m: m.log_time):
                    yield self._raw(found, record.offset)

    def _raw(self, message: Message, offset: int) -> RawMessage:
        topic = self._topic(message.channel_id)
        if topic is None:
            raise Damage(offset, f"a message names channel {message.channel_id}, which is missing")
        data = message.data
        # rosbag2 may compress each message on its own; no encoding of messages begins like that.
        plain = self._unpack(data) if data[:4] == ZSTD_MAGIC else data
        return RawMessage(topic, message.log_time, plain)

    def _topic(self, number: int) -> TopicInfo | None:
        if number not in self._topic_of:
            channel = self.definitions.channels.get(number)
            if channel is None:
                return None
            schema = self.definitions.schemas.get(channel.schema_id)
            self._topic_of[number] = TopicInfo(
                topic=channel.topic,
                type=short_name(schema.name) if schema else "",
                encoding=channel.message_encoding,
                schema_encoding=schema.encoding if schema else "",
                schema=schema.data if schema else b"",
            )
        return self._topic_of[number]

    def _consume(self, size: int) -> None:
        del self._buffer[:size]
        self._at += size

    def _pass_over(self, size: int) -> None:
        """Leave out bytes, of which some may still have to come."""
        there = min(size, len(self._buffer))
        self._consume(there)
        self._skip = size - there
