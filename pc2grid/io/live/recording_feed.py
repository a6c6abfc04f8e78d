"""Recordings that are still being written, and finished ones from their last seconds on, as a feed."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from pc2grid.config import ReadConfig
from pc2grid.errors import LogError, LogNotFound, NotALog
from pc2grid.io.containers import rosbag2_folder
from pc2grid.io.containers.cloud_folder import natural
from pc2grid.io.containers.detect import first_bytes, is_submap_database, open_source
from pc2grid.io.live.feed import Arrived, FeedCounts, News
from pc2grid.io.live.growing_db3 import GrowingDb3
from pc2grid.io.live.growing_mcap import GrowingMcap
from pc2grid.io.live.inbox import Inbox, InboxParameters
from pc2grid.io.message_source import RawMessage, TopicInfo
from pc2grid.io.read_plan import published_once

_POLL_S = 0.05
"""How often a file is looked at; chosen by hand: half the time between two scans of a lidar."""
_LOOK_S = 0.5
"""How often a file is read although messages of it still wait; chosen by hand: a tenth of the lag allowed."""
_SETTLED_S = 1.0
"""A recording with a metadata.yaml that has not grown for so long is finished; chosen by hand."""
_QUIET_S = 5.0
"""After so long without growth the user is told; chosen by hand."""
_MOST_LAG_S = 10.0
"""Log time by which the scans used may be behind the newest one in the file. Recorders write blocks of
several seconds, so less would drop scans of a block that has just arrived. Chosen by hand."""
_MCAP, _SQLITE = b"\x89MCAP0\r\n", b"SQLite format 3\0"


class Growing(Protocol):
    """One file that may still grow."""

    @property
    def size(self) -> int:
        """Bytes that it has now."""
        ...

    @property
    def position(self) -> int:
        """How much of it was read; grows with each part."""
        ...

    @property
    def ended(self) -> bool:
        """Whether it is read to its end, and its recorder has closed it."""
        ...

    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics that are known so far."""
        ...

    def read(self) -> Iterator[RawMessage]:
        """The next messages, none if nothing was added."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class RecordingFeed:
    """A file, or the files of a rosbag2 folder one after another; a next file may appear at any time."""

    realtime = False

    def __init__(self, path: Path, config: ReadConfig, last_s: float) -> None:
        """last_s : seconds before the newest message with which to begin.

        Raises LogNotFound, NotALog, LogCorrupt, LimitExceeded.
        """
        self.name = str(path)
        self.counts, self.news = FeedCounts(), News()
        self._path, self._config = path, config
        self._inbox = Inbox(self.counts, InboxParameters(most_lag_s=_MOST_LAG_S), by_log_time=True)
        self._wanted: frozenset[str] | None = None
        self._topics: dict[tuple[str, str], TopicInfo] = {}
        self._ended = self._keeps_up = False
        self._looked_s = 0.0
        self._before, self._grew_s = (-1, -1), time.monotonic()
        self._folder = path if path.is_dir() else None
        files = self._files() if self._folder else [path]
        if not files:
            raise LogNotFound(f"{path}: a folder without a recording", hint="it holds neither .mcap nor .db3")
        for message in self._from_finished(files[:-1], last_s):
            self._inbox.put(message)
        self._done = set(files[:-1])
        self._file_path = files[-1]
        self._file = _grow(files[-1], config, last_s)

    @property
    def ended(self) -> bool:
        """Whether the recording is finished and read."""
        return self._ended and not len(self._inbox)

    @property
    def connected(self) -> bool:
        """Always: a file does not go away."""
        return True

    def topics(self) -> tuple[TopicInfo, ...]:
        """See Feed."""
        for topic in self._file.topics():
            self._topics.setdefault((topic.topic, topic.type), topic)
        return tuple(self._topics.values())

    def want(self, topics: Collection[str]) -> None:
        """See Feed."""
        self._wanted = frozenset(topics)

    def keep_up(self) -> None:
        """See Feed."""
        self._keeps_up = True
        self._inbox.keep_up()

    def pending(self, topics: Collection[str]) -> Sequence[RawMessage]:
        """See Feed."""
        return self._inbox.pending(topics)

    def receive(self, timeout_s: float) -> Arrived | None:
        """See Feed."""
        end_s = time.monotonic() + timeout_s
        if self._keeps_up and time.monotonic() - self._looked_s > _LOOK_S:
            self._looked_s = time.monotonic()
            while self._read():
                pass
        while True:
            found = self._inbox.get(0.0)
            if found is not None or self._ended:
                return found
            if not self._read() and not self._ended:
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    return None
                time.sleep(min(_POLL_S, left_s))

    def close(self) -> None:
        """See Feed."""
        self._file.close()

    # --- reading --------------------------------------------------------------------------------------

    def _read(self) -> bool:
        """Read on. Returns whether there was anything, be it messages or only bytes."""
        before = self._file.size, self._file.position
        for message in self._file.read():
            topic = message.channel
            known = self._topics.setdefault((topic.topic, topic.type), topic)
            if self._wanted is None or topic.topic in self._wanted:
                self._inbox.put(message._replace(channel=known))
        if before != self._before or self._file.position != before[1]:
            self._before = before
            self._grew_s = time.monotonic()
            return True
        still_s = time.monotonic() - self._grew_s
        following = self._next_file()
        if following is not None and (self._file.ended or still_s > _SETTLED_S):
            self._done.add(self._file_path)
            self._file.close()
            self._file_path, self._file = following, _grow(following, self._config, None)
            return True
        if following is None and self._is_finished(still_s):
            self._ended = True
        elif still_s > _QUIET_S:
            self.news.tell(f"{self._file_path}: does not grow; is it still being recorded?")
        return False

    def _is_finished(self, still_s: float) -> bool:
        if self._folder is None:
            return self._file.ended
        closed = (self._folder / rosbag2_folder.METADATA).is_file()
        return closed and (self._file.ended or still_s > _SETTLED_S)

    def _files(self) -> list[Path]:
        """The files of the folder in the order of their numbers."""
        assert self._folder is not None
        names = sorted(p.name for p in self._folder.iterdir() if p.suffix in rosbag2_folder.SUFFIXES)
        return [self._folder / name for name in sorted(names, key=natural)]

    def _next_file(self) -> Path | None:
        if self._folder is None:
            return None
        return next((p for p in self._files() if p not in self._done and p != self._file_path), None)

    def _from_finished(self, paths: list[Path], last_s: float) -> list[RawMessage]:
        """Of files before the last one: messages that are published once, and what is in the last seconds."""
        found: list[RawMessage] = []
        newest_ns = 0
        for path in paths:
            try:
                source = open_source(path, self._config, recover=False)
            except LogError as error:
                self.news.tell(f"{error.message}: left out")
                continue
            try:
                newest_ns = max(newest_ns, source.info.end_ns)
                once = {t.topic for t in source.info.topics if published_once(t)}
                since_ns = source.info.end_ns - round(last_s * 1e9)
                tail = source.messages({t.topic for t in source.info.topics}, start_ns=since_ns)
                found += (m for m in source.messages(once, end_ns=since_ns))
                found += (m._replace(data=bytes(m.data)) for m in tail)
            finally:
                source.close()
        since_ns = newest_ns - round(last_s * 1e9)
        return [
            m._replace(channel=self._of_feed(m.channel))
            for m in found
            if m.log_time_ns >= since_ns or published_once(m.channel)
        ]

    def _of_feed(self, topic: TopicInfo) -> TopicInfo:
        """The topic without what one file says about it."""
        plain = TopicInfo(
            topic=topic.topic,
            type=topic.type,
            encoding=topic.encoding,
            schema_encoding=topic.schema_encoding,
            schema=topic.schema,
        )
        return self._topics.setdefault((topic.topic, topic.type), plain)


def _grow(path: Path, config: ReadConfig, last_s: float | None) -> Growing:
    """Open one file by its first bytes; an empty one by its name. Raises NotALog."""
    head = first_bytes(path)
    if head.startswith(_SQLITE) and not is_submap_database(head):
        return GrowingDb3(path, config, last_s)
    if not head and path.suffix == ".db3":
        return GrowingDb3(path, config, last_s)
    if head.startswith(_MCAP[: len(head)]) and (head or path.suffix == ".mcap"):
        return GrowingMcap(path, config, last_s)
    raise NotALog(
        f"{path}: not a recording that can be followed",
        hint="MCAP files, .db3 files and rosbag2 folders can; `pc2grid relocalize` reads the others",
    )
