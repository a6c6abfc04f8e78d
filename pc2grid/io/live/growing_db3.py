"""A rosbag2 .db3 that is still being written: its last seconds, then what is added.

Watching must not disturb the recorder: rosbag2 stops with an error when it finds its database locked by a
reader (ros2/rosbag2#602). With a write-ahead log readers lock nobody out. Without one, which is rosbag2's
default, the file is read without any lock, at moments at which nobody writes to it, and what was read while
it changed is thrown away.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import apsw

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt
from pc2grid.io import topics
from pc2grid.io.containers.decompress import ZSTD_MAGIC, unpacker
from pc2grid.io.message_source import RawMessage, TopicInfo
from pc2grid.io.messages.ros_definitions import short_name
from pc2grid.io.read_plan import published_once

_ROWS = 500
"""Most messages that are read at once."""
_QUIET_S = 0.005
"""Time for which nobody must have written to a file without write-ahead log before it is read; chosen by
hand: the pages of one transaction are written within less."""
_PATIENCE = 200
"""Attempts in a row that fail, while the file does not change, before it counts as damaged; chosen by
hand."""


class GrowingDb3:
    """One .db3 file. What is read once is not read again.

    ended : never, because a .db3 has no mark for its end.
    """

    ended = False

    def __init__(self, path: Path, config: ReadConfig, last_s: float | None) -> None:
        """last_s : seconds before the newest message with which to begin; None: at the beginning."""
        self._path, self._last_s = path, last_s
        self._unpack = unpacker("zstd", config.max_chunk_bytes)
        self._most_bytes = min(config.max_record_bytes, 1_000_000_000)
        self._topic_of: dict[int, TopicInfo] = {}
        self._since_ns: int | None = None
        self._last_id = -1
        self._failures = 0

    @property
    def size(self) -> int:
        """Bytes that the file and its write-ahead log have now."""
        return sum(p.stat().st_size for p in (self._path, self._wal) if p.exists())

    @property
    def _wal(self) -> Path:
        return self._path.with_name(self._path.name + "-wal")

    @property
    def position(self) -> int:
        """The number of the last message that was read."""
        return self._last_id

    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics that are known so far."""
        return tuple(self._topic_of.values())

    def read(self) -> Iterator[RawMessage]:
        """The next messages, at most some hundred; none if nothing was added.

        Raises LogCorrupt if the file cannot be read although nobody writes to it.
        """
        with_wal = self._wal.exists()
        before = self._state()
        if not with_wal and time.time_ns() - before[0] < _QUIET_S * 1e9:
            return
        try:
            rows = self._query(with_wal)
        except apsw.Error as error:
            if isinstance(error, apsw.BusyError) or self._state() != before:
                return
            self._failures += 1
            if self._failures > _PATIENCE:
                raise LogCorrupt(f"{self._path}: cannot be read: {error}") from error
            return
        if not with_wal and self._state() != before:
            return
        self._failures = 0
        for number, key, time_ns, data in rows:
            self._last_id = max(self._last_id, number)
            if key in self._topic_of:
                plain = self._unpack(data) if data[:4] == ZSTD_MAGIC else data
                yield RawMessage(self._topic_of[key], time_ns, plain)

    def close(self) -> None:
        """Nothing stays open between two calls of `read`."""

    def _state(self) -> tuple[int, int]:
        found = self._path.stat()
        return found.st_mtime_ns, found.st_size

    def _query(self, with_wal: bool) -> list[tuple[int, int, int, bytes]]:
        place = f"file:{quote(os.fsencode(self._path.absolute()))}"
        # A connection that ignores locks must not keep pages from one call to the next.
        how = "mode=ro" if with_wal else "mode=ro&immutable=1"
        connection = apsw.Connection(f"{place}?{how}", apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI)
        try:
            connection.limit(apsw.SQLITE_LIMIT_LENGTH, self._most_bytes)
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
            if not {"topics", "messages"} <= tables:
                return []
            if len(self._topic_of) != next(connection.execute("SELECT count(*) FROM topics"))[0]:
                self._read_topics(connection, tables)
            return self._rows(connection)
        finally:
            connection.close()

    def _rows(self, connection: apsw.Connection) -> list[tuple[int, int, int, bytes]]:
        columns = "SELECT id, topic_id, timestamp, data FROM messages"
        first: list[tuple[int, int, int, bytes]] = []
        if self._since_ns is None:
            ((newest_ns,),) = connection.execute("SELECT max(timestamp) FROM messages")
            if newest_ns is None:
                return []
            self._since_ns = 0 if self._last_s is None else newest_ns - round(self._last_s * 1e9)
            once = [key for key, topic in self._topic_of.items() if published_once(topic)]
            for key in once:
                most = 1 if self._topic_of[key].type in topics.CAMERA_INFOS else -1
                first += connection.execute(
                    f"{columns} WHERE topic_id = ? AND timestamp < ? ORDER BY id LIMIT ?",
                    (key, self._since_ns, most),
                )
            ((start,),) = connection.execute(
                "SELECT min(id) FROM messages WHERE timestamp >= ?", (self._since_ns,)
            )
            self._last_id = start - 1
            first.sort()
        rows = connection.execute(f"{columns} WHERE id > ? ORDER BY id LIMIT ?", (self._last_id, _ROWS))
        return [*first, *rows]

    def _read_topics(self, connection: apsw.Connection, tables: set[str]) -> None:
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:  # since rosbag2 of ROS 2 Iron
            found = connection.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
            definitions = {name: (encoding, text) for name, encoding, text in found}
        for key, name, kind, encoding in connection.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            schema_encoding, schema = definitions.get(kind, ("", ""))
            self._topic_of[key] = TopicInfo(
                topic=name,
                type=short_name(kind),
                encoding=encoding,
                schema_encoding=schema_encoding,
                schema=schema.encode(),
            )
