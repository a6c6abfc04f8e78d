"""The first seconds of messages of a robot, by which it is decided what to read of it and how.

They are looked at as a short recording by the code that reads recordings, and then used like all others.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, NoScans
from pc2grid.io import topics
from pc2grid.io.error_translation import guarded
from pc2grid.io.frames import FrameTree
from pc2grid.io.live.feed import Feed
from pc2grid.io.live.inbox import Arrived
from pc2grid.io.message_source import LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.read_plan import Plan, make_plan, published_once


@dataclass(frozen=True, slots=True)
class HoldParameters:
    """When the plan is made; chosen by hand.

    hold_s : time from the first scan to the last one that is held back for the plan; most transforms are
    published several times in it. retry_s, most_tries : after a plan that failed, how long until the next
    one, and how many are made.
    """

    hold_s: float = 3.0
    retry_s: float = 1.0
    most_tries: int = 8


HOLD = HoldParameters()


@dataclass(slots=True)
class HeldMessages:
    """Messages that have arrived, as a `MessageSource`."""

    info: LogInfo
    found: Collection[RawMessage]
    tally: Tally = field(default_factory=Tally)
    files: tuple[Path, ...] = ()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See MessageSource."""
        for message in self.found:
            if message.channel.topic in topics and (end_ns is None or message.log_time_ns < end_ns):
                yield message

    def close(self) -> None:
        """Nothing is open."""


@dataclass(frozen=True, slots=True)
class Planned:
    """What was decided once enough had arrived.

    source : of it, only what may be published only once is left. topic_of : the topics as the plan knows
    them, by name and type.
    """

    source: HeldMessages
    frames: FrameTree
    plan: Plan
    topic_of: dict[tuple[str, str], TopicInfo]

    def named(self, message: RawMessage) -> RawMessage:
        """The message with the topic as the plan knows it."""
        return _named(message, self.topic_of)

    def arrived(self, arrived: Arrived) -> Arrived:
        """The same of a message that has arrived."""
        return arrived._replace(message=self.named(arrived.message))


class FirstMessages:
    """The messages that are held back: of what may be published only once all, of the others the last
    seconds."""

    def __init__(self, feed: Feed, config: ReadConfig, parameters: HoldParameters = HOLD) -> None:
        self._feed, self._config, self._parameters = feed, config, parameters
        self._once: list[Arrived] = []
        self._recent: deque[Arrived] = deque()
        self._next_try_s = -math.inf
        self._tries = 0

    @property
    def held(self) -> deque[Arrived]:
        """All of them, what is published once first."""
        return deque((*self._once, *self._recent))

    def add(self, arrived: Arrived) -> None:
        """Hold a message back."""
        if published_once(arrived.message.channel):
            self._once.append(arrived)
            return
        self._recent.append(arrived)
        while self._recent[0].arrived_s < arrived.arrived_s - 2 * self._parameters.hold_s:
            self._recent.popleft()

    def planned(self, now_s: float) -> Planned | None:
        """The plan once it can be made; None before.

        Raises what is missing for it after the last try: FrameError, NoScans; TopicError and
        UnsupportedSchema at once.
        """
        ended = self._feed.ended
        if not ended and (now_s < self._next_try_s or not self._enough()):
            return None
        self._next_try_s = now_s + self._parameters.retry_s
        self._tries += 1
        try:
            return self._plan()
        except (FrameError, NoScans):
            if ended or self._tries >= self._parameters.most_tries:
                raise
            return None

    def _enough(self) -> bool:
        scans_ns = [a.message.log_time_ns for a in self._recent if a.message.channel.type in topics.SENSORS]
        return bool(scans_ns) and scans_ns[-1] - scans_ns[0] >= self._parameters.hold_s * 1e9

    def _plan(self) -> Planned:
        held = [a.message for a in self.held]
        counts = Counter((m.channel.topic, m.channel.type) for m in held)
        topic_of = {
            (t.topic, t.type): replace(t, message_count=counts[t.topic, t.type]) for t in self._feed.topics()
        }
        found = [_named(message, topic_of) for message in held]
        times_ns = [m.log_time_ns for m in found]
        info = LogInfo(
            path=Path(self._feed.name),
            format="live",
            size_bytes=0,
            start_ns=min(times_ns, default=0),
            end_ns=max(times_ns, default=0),
            message_count=len(found),
            topics=tuple(sorted(topic_of.values(), key=lambda t: (t.topic, t.type))),
        )
        source, frames = HeldMessages(info, found), FrameTree()
        plan = guarded(info.path, lambda: make_plan(source, self._config, frames))
        source.found = [m for m in found if published_once(m.channel)]
        return Planned(source, frames, plan, topic_of)

    def silence(self) -> str:
        """Why there is no plan yet."""
        name, there = self._feed.name, self._feed.topics()
        if not there:
            return f"{name}: no topics yet"
        heard = {a.message.channel.topic for a in self._recent}
        scans = topics.usable(there, self._config.topic)
        if not scans:
            listed = ", ".join(f"{t.topic} ({t.type})" for t in there[:12])
            return f"{name}: no topic with scans yet; there is: {listed}"
        silent = ", ".join(t.topic for t in scans if t.topic not in heard)
        if not silent:
            return f"{', '.join(t.topic for t in scans)}: too few messages so far"
        return f"{silent}: no message yet (is the sensor's driver running? does its QoS fit?)"


def _named(message: RawMessage, topic_of: Mapping[tuple[str, str], TopicInfo]) -> RawMessage:
    key = message.channel.topic, message.channel.type
    return message._replace(channel=topic_of.get(key, message.channel))
