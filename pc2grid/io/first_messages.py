"""The first messages of the topics of a log, by which it is decided what to read."""

from __future__ import annotations

import contextlib
import itertools
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from pc2grid.errors import PointCloudError, UnsupportedSchema
from pc2grid.io.message_source import MessageSource, TopicInfo
from pc2grid.io.messages.decoders import decoder_for

FIRST = 5
"""So many messages of a topic are looked at: a few may have a stray time, or be unreadable. By hand."""


class First(NamedTuple):
    """One of the first messages of a topic. content : with a header."""

    log_time_ns: int
    content: Any

    @property
    def frame(self) -> str:
        """The frame in its header."""
        return str(self.content.header.frame)


class FirstMessages:
    """Reads the first messages of the topics of a log, those of each topic once.

    topics : all of the log. tally : of its source, for warnings.
    """

    def __init__(self, source: MessageSource) -> None:
        self.topics, self.tally = source.info.topics, source.tally
        self._source = source
        self._read: dict[tuple[TopicInfo, int], list[First]] = {}

    def of(self, topic: TopicInfo, count: int = FIRST) -> list[First]:
        """Return the first messages of a topic, without those that cannot be decoded.

        Raises UnsupportedSchema.
        """
        if (topic, count) not in self._read:
            decode = decoder_for(topic)
            of_topic = (m for m in self._source.messages({topic.topic}) if m.channel == topic)
            read = (First(m.log_time_ns, tolerant(decode, m.data)) for m in itertools.islice(of_topic, count))
            self._read[topic, count] = [message for message in read if message.content is not None]
        return self._read[topic, count]

    def if_known(self, topic: TopicInfo) -> list[First]:
        """Return the first messages of a topic; none if they are of a type that cannot be decoded."""
        with contextlib.suppress(UnsupportedSchema):
            return self.of(topic)
        return []

    def frames_of(self, topic: TopicInfo) -> set[str]:
        """Return the frames of the first messages of a topic; none if there is no such message."""
        return {message.frame for message in self.if_known(topic)}


def tolerant(decode: Callable[[Any], Any], data: Any, otherwise: Any = None) -> Any:
    """Decode a message that is of use but not needed (tf, odometry); `otherwise` if it cannot be decoded."""
    try:
        return decode(data)
    except PointCloudError:
        return otherwise


def delay_ns(first: Sequence[First]) -> int:
    """Return how long after their stamps messages were recorded, one with another; 0 for messages without
    stamps."""
    delays_ns = [m.log_time_ns - (m.content.header.stamp_ns or m.log_time_ns) for m in first]
    return statistics.median_low(delays_ns) if delays_ns else 0
