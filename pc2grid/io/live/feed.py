"""The base class of feeds: topics, subscriptions to those that are wanted, and a queue of their messages."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pc2grid.io import topics
from pc2grid.io.source import RawMessage, TopicInfo
from pc2grid.settings import ReadConfig


class Arrived(NamedTuple):
    """A message, and when it arrived: seconds of `time.monotonic`."""

    message: RawMessage
    arrived_s: float


@dataclass(slots=True)
class FeedCounts:
    """The counts of the messages of a feed so far.

    arrived : messages. dropped : scans that waited too long because the computer is too slow. reconnected :
    number of times that a lost connection was made again.
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

    Transforms and odometry are small and depend on each other, so they are kept.
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
        """End the preparations: once the messages that wait now are used up, scans that wait too long are
        dropped."""
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
        """Return the oldest message; None if there is none within `timeout_s` seconds."""
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
        """Wake up `get`: nothing more will come."""
        with self._changed:
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._entries)


@dataclass(slots=True)
class News:
    """Sentences for the user, each at most once, until they are taken."""

    _told: set[str] = field(default_factory=set)
    _waiting: list[str] = field(default_factory=list)

    def tell(self, sentence: str, *, again: bool = False) -> None:
        """Add a sentence. again : even if it was told before."""
        if again or sentence not in self._told:
            self._told.add(sentence)
            self._waiting.append(sentence)

    def take(self) -> list[str]:
        """Return the sentences since the last call."""
        taken, self._waiting = self._waiting, []
        return taken


class Feed:
    """A source of messages that arrive while they are used.

    A kind of connection derives from it. It calls `_offer` for each topic, `_refresh` when topics came or
    went, and puts messages into `_inbox`, also from other threads.

    name : for the user. counts, news : for reports. connected : True if messages can arrive now.
    """

    def __init__(self, name: str, config: ReadConfig, inbox: InboxParameters = INBOX) -> None:
        self.name = name
        self.counts, self.news = FeedCounts(), News()
        self.connected = True
        self._over = False
        self._inbox = Inbox(self.counts, inbox)
        self._lock = threading.RLock()
        self._topics: dict[tuple[str, str], TopicInfo] = {}
        self._offered: dict[Hashable, TopicInfo] = {}
        self._subscriptions: dict[Hashable, Any] = {}
        self._wanted: frozenset[str] | None = None
        self._scans_topic = config.topic

    @property
    def ended(self) -> bool:
        """Return whether the feed is over and all of its messages are received."""
        return self._over and not len(self._inbox)

    def topics(self) -> tuple[TopicInfo, ...]:
        """Return the topics that are known so far; their message_count is None."""
        with self._lock:
            return tuple(self._topics.values())

    def want(self, topics: Collection[str]) -> None:
        """Subscribe to these topics only, and drop scans that wait too long from now on."""
        with self._lock:
            self._wanted = frozenset(topics)
        self._inbox.prepared()
        self._refresh()

    def receive(self, timeout_s: float) -> Arrived | None:
        """Return the next message; None if none arrives within `timeout_s` seconds.

        Raises LogError if the feed is damaged or cannot be read any more.
        """
        return self._inbox.get(timeout_s)

    def close(self) -> None:
        """Release connections, threads and files."""
        self._over = True
        self._inbox.wake()

    # --- for the kinds of connections -----------------------------------------------------------------

    def _offer(self, key: Hashable, topic: TopicInfo) -> None:
        """Add a topic that can be subscribed to, by a key of the connection's own; its first description
        stays."""
        with self._lock:
            self._offered[key] = self._topics.setdefault((topic.topic, topic.type), topic)

    def _withdraw(self, keys: Collection[Hashable] | None = None) -> None:
        """Remove topics that cannot be subscribed to any more; None: all, as the connection is lost."""
        with self._lock:
            for key in list(self._offered) if keys is None else keys:
                self._offered.pop(key, None)
                self._subscriptions.pop(key, None)

    def _refresh(self) -> None:
        """Subscribe to the topics that are wanted and new, and no longer to those that are not wanted."""
        with self._lock:
            there = list(self._offered.values())
            wanted = {key: topic for key, topic in self._offered.items() if self._is_wanted(topic, there)}
            old = {key: given for key, given in self._subscriptions.items() if key not in wanted}
            new = {key: topic for key, topic in wanted.items() if key not in self._subscriptions}
            for key in old:
                del self._subscriptions[key]
            if old:
                self._unsubscribe(old)
            if new:
                self._subscriptions.update(self._subscribe(new))

    def _is_wanted(self, topic: TopicInfo, there: Sequence[TopicInfo]) -> bool:
        if self._wanted is not None:
            return topic.topic in self._wanted
        return topics.may_be_used(topic, there, self._scans_topic)

    def _subscribe(self, new: Mapping[Hashable, TopicInfo]) -> Mapping[Hashable, Any]:
        """Subscribe to topics; the value that is returned for each is given to `_unsubscribe`."""
        return new

    def _unsubscribe(self, old: Mapping[Hashable, Any]) -> None:
        """Cancel subscriptions."""

    def _set_connected(self, connected: bool) -> None:
        """Set the state of the connection, and tell the user when it is lost."""
        if self.connected and not connected and not self._over:
            self.news.tell(f"{self.name}: the connection is lost; trying again", again=True)
        elif connected and not self.connected:
            self.counts.reconnected += 1
        self.connected = connected
