"""Messages between their arrival and their use."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from pc2grid.io import topics
from pc2grid.io.message_source import RawMessage


class Arrived(NamedTuple):
    """A message, and when it arrived: seconds of `time.monotonic`."""

    message: RawMessage
    arrived_s: float


@dataclass(slots=True)
class FeedCounts:
    """What happened to the messages of a feed so far.

    arrived : messages. dropped : scans that waited too long because the computer is too slow, and were left
    out. reconnected : how often a lost connection was made again.
    """

    arrived: int = 0
    dropped: int = 0
    reconnected: int = 0


@dataclass(frozen=True, slots=True)
class InboxParameters:
    """How much may wait; chosen by hand.

    most_lag_s : a scan that has waited longer than this is dropped when a newer one arrives.
    catch_up_s : time for what waited during the preparations to be used up, before scans are dropped.
    most_bytes, most_messages : of all messages that wait; beyond, the oldest are dropped.
    """

    most_lag_s: float = 0.1
    catch_up_s: float = 10.0
    most_bytes: int = 256_000_000
    most_messages: int = 100_000


INBOX = InboxParameters()


class Inbox:
    """A queue that drops scans rather than letting them wait. One thread fills it, another one empties it.

    Transforms and odometry are small and rest on each other, so they are kept.
    """

    def __init__(
        self,
        counts: FeedCounts,
        parameters: InboxParameters = INBOX,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._counts, self._parameters, self._clock = counts, parameters, clock
        self._entries: dict[int, Arrived] = {}  # by their number, oldest first
        self._scans: deque[int] = deque()  # the numbers of those that are scans
        self._bytes = 0
        self._changed = threading.Condition()
        self._patient_until_s = math.inf  # before that, scans are not dropped for their lag

    def prepared(self) -> None:
        """The preparations are over: once what waits now is used up, scans that wait too long are dropped."""
        with self._changed:
            self._patient_until_s = self._clock() + self._parameters.catch_up_s

    def put(self, message: RawMessage) -> None:
        """Add a message that has just arrived."""
        now_s = self._clock()
        with self._changed:
            self._counts.arrived += 1
            self._entries[self._counts.arrived] = Arrived(message, now_s)
            self._bytes += len(message.data)
            if message.channel.type in topics.SENSORS:
                self._scans.append(self._counts.arrived)
            oldest_s = now_s - (self._parameters.most_lag_s if now_s >= self._patient_until_s else math.inf)
            while len(self._scans) > 1 and (
                self._bytes > self._parameters.most_bytes
                or self._entries[self._scans[0]].arrived_s < oldest_s
            ):
                self._drop(self._scans[0])
            while len(self._entries) > self._parameters.most_messages:
                self._drop(next(iter(self._entries)))
            self._changed.notify()

    def _take(self, number: int) -> Arrived:
        arrived = self._entries.pop(number)
        self._bytes -= len(arrived.message.data)
        if self._scans and self._scans[0] == number:
            self._scans.popleft()
        return arrived

    def _drop(self, number: int) -> None:
        self._take(number)
        self._counts.dropped += 1

    def get(self, timeout_s: float) -> Arrived | None:
        """The oldest message; None if there is none within `timeout_s` seconds."""
        end_s = self._clock() + timeout_s
        with self._changed:
            while not self._entries:
                if math.isfinite(self._patient_until_s):
                    self._patient_until_s = 0.0
                left_s = end_s - self._clock()
                if left_s <= 0 or not self._changed.wait(left_s):
                    return None
            return self._take(next(iter(self._entries)))

    def wake(self) -> None:
        """Let `get` return: nothing more will come."""
        with self._changed:
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._entries)
