"""An MCAP that comes through a pipe.

Nothing is dropped: a pipe makes the program that writes to it wait.
"""

from __future__ import annotations

import math
import os
import select
import time
from typing import BinaryIO, cast

from pc2grid.config import ReadConfig
from pc2grid.errors import LogTruncated
from pc2grid.io.live.feed import Feed
from pc2grid.io.live.inbox import Arrived, InboxParameters
from pc2grid.io.live.mcap_tail import McapTail

_BLOCK_BYTES = 1 << 20


class _Received:
    """The bytes that came through a pipe, from the place on that was sought last."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._begin = self._at = 0

    def size(self) -> int:
        """Bytes that came so far."""
        return self._begin + len(self._bytes)

    def add(self, data: bytes) -> None:
        """Add what has come."""
        self._bytes += data

    def seek(self, place: int) -> None:
        """Go forwards; what is before is forgotten."""
        passed = min(place - self._begin, len(self._bytes))
        del self._bytes[:passed]
        self._begin += passed
        self._at = place

    def read(self, count: int) -> bytes:
        """The next bytes, as many as there are."""
        begin = self._at - self._begin
        found = bytes(self._bytes[begin : begin + count])
        self._at += len(found)
        return found

    def close(self) -> None:
        """Nothing is open."""


class StandardInput(Feed):
    """The MCAP that arrives at a file descriptor, by default standard input."""

    def __init__(self, config: ReadConfig, descriptor: int = 0) -> None:
        super().__init__("standard input", config, InboxParameters(most_lag_s=math.inf))
        self._descriptor = descriptor
        self._received = _Received()
        self._tail = McapTail(self.name, cast(BinaryIO, self._received), self._received.size, config)

    def receive(self, timeout_s: float) -> Arrived | None:
        """See Feed. Raises LogTruncated for a pipe that was closed before an MCAP came."""
        end_s = time.monotonic() + timeout_s
        while True:
            found = super().receive(0.0)
            if found is not None or self._over:
                return found
            before = self._tail.position
            self._take()
            if self._tail.position > before or self._over:
                continue
            left_s = end_s - time.monotonic()
            if left_s <= 0 or not select.select([self._descriptor], [], [], left_s)[0]:
                return None
            self._fill()

    def _take(self) -> None:
        """Take in the messages that are complete."""
        for message in self._tail.read():
            topic = self._known(message.channel)
            if self._wanted is None or topic.topic in self._wanted:
                self._inbox.put(message)
        self._over = self._over or self._tail.ended

    def _fill(self) -> None:
        """Read what the pipe holds."""
        data = os.read(self._descriptor, _BLOCK_BYTES)
        self._received.add(data)
        if data:
            return
        self._over = True
        size = self._received.size()
        if size <= 8:
            raise LogTruncated(f"{self.name}: closed after {size} bytes", hint="an MCAP is expected")
        self.news.tell("standard input ends within the recording")
