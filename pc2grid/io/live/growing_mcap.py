"""An MCAP that is still being written: its last seconds, then what is added."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt
from pc2grid.io import topics
from pc2grid.io.containers import mcap_records as rec
from pc2grid.io.containers.mcap_records import Damage
from pc2grid.io.live.mcap_stream import McapStream
from pc2grid.io.message_source import RawMessage, TopicInfo
from pc2grid.io.read_plan import published_once

_BLOCK_BYTES = 1 << 20
_TIMES_BYTES = 16  # first and last log time, at the beginning of a chunk
_LOG_TIME = slice(6, 14)  # within a message: behind its channel (uint16) and number (uint32)
_WALKED = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE_INDEX})


@dataclass(slots=True)
class _Block:
    """A chunk, or a message outside of chunks: a part of the file with messages.

    channels : of its messages; empty if they are not known without reading it.
    """

    offset: int
    size: int
    start_ns: int
    end_ns: int
    is_chunk: bool
    channels: set[int] = field(default_factory=set)


class GrowingMcap:
    """One MCAP file. What is read once is not read again.

    Of the part before the last seconds only the heads of its records are read, the definitions of channels,
    and the messages that are published once: static transforms and the calibration of cameras.
    """

    def __init__(self, path: Path, config: ReadConfig, last_s: float | None) -> None:
        """last_s : seconds before the newest message with which to begin; None: at the beginning.

        Raises LogCorrupt, LimitExceeded, UnsupportedSchema, NotALog.
        """
        self._path, self._config = path, config
        self._file: BinaryIO = path.open("rb", buffering=0)
        self._at = 0
        self._stream = McapStream(str(path), config)
        self._since_ns: int | None = None
        self._first: list[RawMessage] = []
        if last_s is not None and self.size > len(rec.MAGIC):
            self._seek_tail(last_s)

    @property
    def size(self) -> int:
        """Bytes that the file has now."""
        return os.fstat(self._file.fileno()).st_size

    @property
    def ended(self) -> bool:
        """Whether the recorder has written the end of the data, and it was read."""
        return self._stream.ended

    @property
    def position(self) -> int:
        """Bytes that were read."""
        return self._at

    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics that are known so far."""
        return self._stream.topics()

    def read(self) -> Iterator[RawMessage]:
        """The messages of the next block of bytes; none if nothing was added."""
        yield from self._first
        self._first.clear()
        if self.ended:
            return
        self._file.seek(self._at)
        data = self._file.read(_BLOCK_BYTES)
        self._at += len(data)
        since_ns = self._since_ns or 0
        for message in self._stream.feed(data):
            if message.log_time_ns >= since_ns or published_once(message.channel):
                yield message

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    # --- finding the last seconds ---------------------------------------------------------------------

    def _seek_tail(self, last_s: float) -> None:
        with self._path.open("rb") as file:
            try:
                blocks = self._walk(file)
                if not blocks:
                    return
                newest_ns = max(block.end_ns for block in blocks)
                since_ns = newest_ns - round(last_s * 1e9)
                tail = next(block.offset for block in blocks if block.end_ns >= since_ns)
                # A later block may hold older messages: they are left out one by one.
                before = [block for block in blocks if block.offset < tail]
                self._take_definitions(file, before)
                self._first = self._messages_published_once(file, before)
            except Damage as damage:
                raise LogCorrupt(f"{self._path}: {damage.what}, at byte {damage.offset}") from damage
        self._since_ns, self._at = since_ns, tail
        stream = McapStream(str(self._path), self._config, at=tail)
        stream.definitions = self._stream.definitions
        self._stream = stream

    def _walk(self, file: BinaryIO) -> list[_Block]:
        """The blocks of the file as far as they are whole; the definitions between them are taken up."""
        size = self.size
        limits = rec.Limits(self._config.max_chunk_bytes, self._config.max_record_bytes)
        blocks: list[_Block] = []
        try:
            for record in rec.read_records(file, len(rec.MAGIC), size, limits, wanted=_WALKED):
                if record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    break
                if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    list(self._stream.read(record))
                elif record.opcode == Opcode.MESSAGE_INDEX and blocks and blocks[-1].is_chunk:
                    blocks[-1].channels.add(int.from_bytes(record.data[:2], "little"))
                elif record.opcode == Opcode.CHUNK:
                    file.seek(record.offset + rec.HEAD_BYTES)
                    times = file.read(_TIMES_BYTES)
                    start_ns, end_ns = (int.from_bytes(times[i : i + 8], "little") for i in (0, 8))
                    blocks.append(_Block(record.offset, record.size, start_ns, end_ns, True))
                elif record.opcode == Opcode.MESSAGE:
                    file.seek(record.offset + rec.HEAD_BYTES)
                    head = file.read(rec.MESSAGE_FIELDS_BYTES)
                    time_ns = int.from_bytes(head[_LOG_TIME], "little")
                    channel = int.from_bytes(head[:2], "little")
                    blocks.append(_Block(record.offset, record.size, time_ns, time_ns, False, {channel}))
        except Damage as damage:
            if not damage.truncated:  # the last record is only written in part
                raise
        return blocks

    def _take_definitions(self, file: BinaryIO, blocks: list[_Block]) -> None:
        """Read the chunks that define channels: for each channel the first one in which it occurs."""
        known: set[int] = set()
        for block in blocks:
            if block.is_chunk and (not block.channels or block.channels - known):
                self._messages_of(file, block)
            known |= block.channels

    def _messages_published_once(self, file: BinaryIO, blocks: list[_Block]) -> list[RawMessage]:
        channels = self._stream.definitions.channels
        names = {t.topic: t for t in self._stream.topics()}
        once = {key for key, channel in channels.items() if published_once(names[channel.topic])}
        found: list[RawMessage] = []
        cameras: set[str] = set()
        for block in blocks:
            # Of a camera's calibration, which many drivers repeat with each image, the first is enough.
            sought = {key for key in once if channels[key].topic not in cameras}
            if block.channels and not block.channels & sought:
                continue
            for message in self._messages_of(file, block):
                topic = message.channel
                if not published_once(topic) or topic.topic in cameras:
                    continue
                found.append(message)
                if topic.type in topics.CAMERA_INFOS:
                    cameras.add(topic.topic)
        return found

    def _messages_of(self, file: BinaryIO, block: _Block) -> list[RawMessage]:
        file.seek(block.offset)
        data = file.read(block.size)
        record = rec.Record(block.offset, data[0], data[rec.HEAD_BYTES :], block.size)
        return list(self._stream.read(record))
