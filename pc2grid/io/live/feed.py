"""The interface of everything that messages arrive from."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from pc2grid.io.message_source import RawMessage, TopicInfo


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
        """The sentences since the last call."""
        taken, self._waiting = self._waiting, []
        return taken


class Feed(Protocol):
    """Where messages arrive from.

    name : for the user. realtime : whether messages are lost that are not received in time. counts, news : of
    what happened. connected : whether messages can arrive now. ended : whether no message will arrive any
    more; those that have arrived can still be received.
    """

    name: str
    realtime: bool
    counts: FeedCounts
    news: News

    @property
    def ended(self) -> bool:
        """See above."""
        ...

    @property
    def connected(self) -> bool:
        """See above."""
        ...

    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics that are known so far; their message_count is None."""
        ...

    def want(self, topics: Collection[str]) -> None:
        """From now on, only messages of these topics are asked for."""
        ...

    def receive(self, timeout_s: float) -> Arrived | None:
        """The next message; None if none arrives within `timeout_s` seconds.

        Raises LogError if the feed is damaged or cannot be read any more.
        """
        ...

    def pending(self, topics: Collection[str]) -> Sequence[RawMessage]:
        """Messages of these topics that have arrived and not been received yet."""
        ...

    def keep_up(self) -> None:
        """From now on scans may be dropped: the messages that arrived during the preparations are used up."""
        ...

    def close(self) -> None:
        """Release connections, threads and files."""
        ...
