"""A recording in several files, one after another, as one message source."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pc2grid.io.containers.decompress import plain_message
from pc2grid.io.message_source import LogInfo, MessageSource, RawMessage, Tally, TopicInfo


class SplitSource:
    """The parts of a recording in the order in which they were recorded; they share one tally."""

    def __init__(
        self, path: Path, parts: Sequence[MessageSource], tally: Tally, max_chunk_bytes: int
    ) -> None:
        self._parts = parts
        self.files: tuple[Path, ...] = tuple(file for part in parts for file in part.files)
        self.tally = tally
        for part in parts:
            tally.take_over(part.tally)
            part.tally = tally
        self._max_chunk_bytes = max_chunk_bytes
        self._topics = _merged([t for part in parts for t in part.info.topics])
        self.info = _info(path, [part.info for part in parts], self._topics, tally)

    def close(self) -> None:
        """Close all files."""
        for part in self._parts:
            part.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See MessageSource.messages; parts outside of the time range are not read."""
        for part in self._parts:
            if start_ns is not None and part.info.end_ns < start_ns:
                continue
            if end_ns is not None and part.info.start_ns >= end_ns:
                continue
            for channel, log_time_ns, data in part.messages(topics, start_ns, end_ns):
                plain = plain_message(data, self._max_chunk_bytes)
                yield RawMessage(self._topics[channel], log_time_ns, plain)


def _info(
    path: Path, infos: Sequence[LogInfo], topics: Mapping[TopicInfo, TopicInfo], tally: Tally
) -> LogInfo:
    """The facts about the whole recording, by those about its parts."""
    spans = [info for info in infos if info.message_count != 0]
    return LogInfo(
        path=path,
        format=next((info.format for info in infos if info.topics), infos[0].format),
        size_bytes=sum(info.size_bytes for info in infos),
        start_ns=min((s.start_ns for s in spans), default=0),
        end_ns=max((s.end_ns for s in spans), default=0),
        message_count=_total(info.message_count for info in infos),
        topics=tuple(sorted(set(topics.values()), key=lambda t: (t.topic, t.type))),
        warnings=tuple(tally.warnings),
    )


def _total(counts: Iterable[int | None]) -> int | None:
    """The sum; None if one is unknown."""
    known = list(counts)
    return None if None in known else sum(count for count in known if count is not None)


def _merged(topics: list[TopicInfo]) -> dict[TopicInfo, TopicInfo]:
    """For each topic of a part, the topic of the whole recording, with all messages counted."""
    groups: dict[tuple[str, str, str], list[TopicInfo]] = {}
    for topic in topics:
        groups.setdefault((topic.topic, topic.type, topic.encoding), []).append(topic)
    whole: dict[TopicInfo, TopicInfo] = {}
    for group in groups.values():
        total = _total(t.message_count for t in group)
        described = next((t for t in group if t.schema), group[0])
        whole.update(dict.fromkeys(group, replace(described, message_count=total)))
    return whole
