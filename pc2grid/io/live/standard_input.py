"""An MCAP that comes through a pipe.

Nothing is dropped: a pipe makes the program that writes to it wait.
"""

from __future__ import annotations

import math
import os
import select
import time
from collections.abc import Collection, Sequence

from pc2grid.config import ReadConfig
from pc2grid.errors import LogTruncated
from pc2grid.io.live.feed import Arrived, FeedCounts, News
from pc2grid.io.live.inbox import Inbox, InboxParameters
from pc2grid.io.live.mcap_stream import McapStream
from pc2grid.io.message_source import RawMessage, TopicInfo

_BLOCK_BYTES = 1 << 20


class StandardInput:
    """The MCAP that arrives at a file descriptor, by default standard input."""

    name = "standard input"
    realtime = False

    def __init__(self, config: ReadConfig, descriptor: int = 0) -> None:
        self.counts, self.news = FeedCounts(), News()
        self._descriptor = descriptor
        self._stream = McapStream(self.name, config)
        self._inbox = Inbox(self.counts, InboxParameters(most_lag_s=math.inf))
        self._wanted: frozenset[str] | None = None
        self._closed = False
        self._bytes = 0

    @property
    def ended(self) -> bool:
        """Whether the pipe is closed, or the MCAP is complete, and its messages are received."""
        return self._closed and not len(self._inbox)

    @property
    def connected(self) -> bool:
        """Whether the pipe is open."""
        return not self._closed

    def topics(self) -> tuple[TopicInfo, ...]:
        """See Feed."""
        return self._stream.topics()

    def want(self, topics: Collection[str]) -> None:
        """See Feed."""
        self._wanted = frozenset(topics)

    def keep_up(self) -> None:
        """Nothing is dropped."""

    def pending(self, topics: Collection[str]) -> Sequence[RawMessage]:
        """See Feed."""
        return self._inbox.pending(topics)

    def receive(self, timeout_s: float) -> Arrived | None:
        """See Feed. Raises LogTruncated for a pipe that was closed before an MCAP came."""
        end_s = time.monotonic() + timeout_s
        while True:
            found = self._inbox.get(0.0)
            if found is not None or self._closed:
                return found
            left_s = end_s - time.monotonic()
            if left_s <= 0 or not select.select([self._descriptor], [], [], left_s)[0]:
                return None
            self._read()

    def close(self) -> None:
        """Standard input stays open."""

    def _read(self) -> None:
        data = os.read(self._descriptor, _BLOCK_BYTES)
        self._bytes += len(data)
        if not data:
            self._closed = True
            if self._bytes <= 8:
                raise LogTruncated(
                    f"{self.name}: closed after {self._bytes} bytes", hint="an MCAP is expected"
                )
            self.news.tell("standard input ends within the recording")
            return
        for message in self._stream.feed(data):
            if self._wanted is None or message.channel.topic in self._wanted:
                self._inbox.put(message)
        self._closed = self._stream.ended
