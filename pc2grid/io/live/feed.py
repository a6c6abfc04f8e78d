"""Feeds: topics, subscriptions to those that are wanted, and a queue of their messages.

A kind of connection derives from `Feed`: a websocket, a node of ROS 2, a recording that is replayed.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from pc2grid.io import topics
from pc2grid.io.source import GAP_NS, LIDAR_PERIOD_NS, LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.stream import PARAMETERS
from pc2grid.settings import ReadConfig

HOLD_S, MOST_S = 3.0, 12.0
"""Time from the first scan to the last one that is held back for the plan: most transforms are published
several times in it; it doubles after each plan that failed, up to the last try. Chosen by hand."""


class Arrived(NamedTuple):
    """A message, and when it arrived: seconds of `time.monotonic`."""

    message: RawMessage
    arrived_s: float


@dataclass(frozen=True, slots=True)
class LiveParameters:
    """How much may wait, when silence is reported, and when a segment of scans ends; chosen by hand.

    most_lag_s : a scan that has waited longer than this is dropped when a newer one arrives.
    catch_up_s : time for what waited during the preparations to be used up, before scans are dropped.
    most_bytes, most_messages : of all messages that wait; beyond, the oldest are dropped.
    poll_s : longest wait for a message. silent_s : time after which a topic without messages is named.
    """

    most_lag_s: float = LIDAR_PERIOD_NS * 1e-9
    catch_up_s: float = MOST_S
    most_bytes: int = PARAMETERS.max_waiting_bytes
    most_messages: int = 100_000
    poll_s: float = 0.2
    silent_s: float = GAP_NS * 1e-9


LIVE = LiveParameters()


class Inbox:
    """A queue that drops scans rather than letting them wait. One thread fills it, another one empties it.

    Transforms and odometry are small and depend on each other, so they are kept.
    """

    def __init__(
        self,
        tally: Tally,
        parameters: LiveParameters = LIVE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._tally, self._parameters, self._clock = tally, parameters, clock
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

    def put(self, message: RawMessage, arrived_s: float | None = None) -> None:
        """Add a message. arrived_s : None: now."""
        now_s = self._clock() if arrived_s is None else arrived_s
        with self._changed:
            self._tally.arrived += 1
            self._entries[self._tally.arrived] = Arrived(message, now_s)
            self._bytes += len(message.data)
            if message.channel.type in topics.SENSORS:
                self._scans.append(self._tally.arrived)
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
        self._tally.dropped += 1

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


class Feed:
    """A source of messages that arrive while they are used: a `MessageSource` of those that are held back.

    A kind of connection derives from it. It calls `_offer` for each topic, `_refresh` when topics came or
    went, and puts messages into `_inbox`, also from other threads.

    name : for the user. config : of what is read. parameters : of the waiting. connected : True if messages
    can arrive now.
    """

    files: tuple[Path, ...] = ()

    def __init__(self, name: str, config: ReadConfig, parameters: LiveParameters = LIVE) -> None:
        self.name, self.config, self.parameters = name, config, parameters
        self.tally = Tally()
        self.connected = True
        self._over = False
        self._inbox = Inbox(self.tally, parameters)
        self._once: list[Arrived] = []
        self._recent: deque[Arrived] = deque()
        self._lock = threading.RLock()
        self._topics: dict[tuple[str, str], TopicInfo] = {}
        self._offered: dict[Hashable, TopicInfo] = {}
        self._subscriptions: dict[Hashable, Any] = {}
        self._wanted: frozenset[str] | None = None

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

    # --- the messages that are held back --------------------------------------------------------------

    @property
    def held(self) -> deque[Arrived]:
        """Return the messages that are held back, in the order of their arrival.

        All of topics that may be published only once, of others the last seconds.
        """
        return deque((*self._once, *self._recent))

    def hold(self, arrived: Arrived) -> None:
        """Hold a message back."""
        self._recent.append(arrived)
        while self._recent[0].arrived_s < arrived.arrived_s - 2 * MOST_S:
            old = self._recent.popleft()
            topic = old.message.channel
            if topic.type in topics.CAMERA_INFOS or (topic.type in topics.TF and topics.is_static(topic)):
                self._once.append(old)  # it may be published only once, when the robot starts

    @property
    def info(self) -> LogInfo:
        """Return the facts about those that are held back, and the topics that are known so far."""
        found = [a.message for a in self.held]
        counts, times_ns = Counter(m.channel for m in found), [m.log_time_ns for m in found]
        known = [replace(t, message_count=counts[t]) for t in self.topics()]
        return LogInfo(
            path=Path(self.name),
            format="live",
            size_bytes=0,
            start_ns=min(times_ns, default=0),
            end_ns=max(times_ns, default=0),
            message_count=len(found),
            topics=tuple(sorted(known, key=lambda t: (t.topic, t.type))),
        )

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield those that are held back, see MessageSource."""
        for message, _ in self.held:
            if message.channel.topic in topics and (end_ns is None or message.log_time_ns < end_ns):
                yield message

    @property
    def held_s(self) -> float:
        """Return the log time from the first scan that is held back to the last one; 0 without scans."""
        times_ns = [a.message.log_time_ns for a in self._recent if a.message.channel.type in topics.SENSORS]
        return 1e-9 * (times_ns[-1] - times_ns[0]) if times_ns else 0.0

    def silence(self) -> str:
        """Return why there is no plan yet."""
        there = self.topics()
        heard = {a.message.channel.topic for a in self._recent}
        scans = topics.usable(there, self.config.topic)
        silent = ", ".join(t.topic for t in scans if t.topic not in heard)
        if silent:
            return f"{silent}: no message yet (is the sensor's driver running? does its QoS fit?)"
        if scans:
            return f"{', '.join(t.topic for t in scans)}: too few messages so far"
        return f"{self.name}: no topic with scans yet; there is: {topics.listed(there) or 'no topic'}"

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
        return topics.may_be_used(topic, there, self.config.topic)

    def _subscribe(self, new: Mapping[Hashable, TopicInfo]) -> Mapping[Hashable, Any]:
        """Subscribe to topics; the value that is returned for each is given to `_unsubscribe`."""
        return new

    def _unsubscribe(self, old: Mapping[Hashable, Any]) -> None:
        """Cancel subscriptions."""
