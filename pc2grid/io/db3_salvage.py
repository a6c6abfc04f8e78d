"""What is whole of a damaged rosbag2 .db3, or of one whose recorder was killed before it closed the file.

The file is surveyed once, page by page. rosbag2 numbers its messages without gaps, so those that are gone
can be counted.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt
from pc2grid.io.db3_log import RECOVER, UNCHECKED, is_unfinished
from pc2grid.io.ros_definitions import short_name
from pc2grid.io.source import LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.sqlite_pages import BrokenRow, Place, Row, SqlitePages
from pc2grid.io.unpack import ZSTD_MAGIC, unpacker
from pc2grid.model import I64


class SalvagedDb3:
    """The whole messages of a .db3 and of its write-ahead log as a message source; the rest is in `tally`.

    Raises LogCorrupt if not even the size of a page is known; without `recover`, if anything is missing.
    """

    def __init__(self, path: Path, config: ReadConfig, *, recover: bool) -> None:
        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._unpack = unpacker("zstd", config.max_chunk_bytes)
        try:
            self._pages = SqlitePages(path, config.max_record_bytes)
        except ValueError as error:
            raise LogCorrupt(f"{path}: a damaged .db3: {error}", hint="nothing to recover") from error
        self._topics: dict[int, Row] = {}
        self._definitions: dict[str, Row] = {}
        self._strange = 0
        found = self._survey()
        self._count_losses(found)
        if self.tally.bytes_lost and not recover:
            self._pages.close()
            raise LogCorrupt(f"{path}: a damaged .db3: {self.tally.warnings[0]}", hint=RECOVER)
        found = found[np.isin(found[:, 2], list(self._topics))]
        # By time, and of equal times by number; of a number that comes twice the first is as good as any.
        self._messages = found[np.lexsort((found[:, 1], found[:, 0]))]
        self._topic_of = {key: self._topic(key) for key in self._topics}
        self.tally.warn(UNCHECKED)
        if self._pages.wal_pages:
            self.tally.warn("the recorder did not close the file; what it left in the -wal was read too")
        elif is_unfinished(path):
            self.tally.warn("nothing in the -wal beside it belongs to the file")
        self.info = LogInfo(
            path=path,
            format="db3/ros2",
            size_bytes=path.stat().st_size,
            start_ns=int(self._messages[0, 0]) if len(self._messages) else 0,
            end_ns=int(self._messages[-1, 0]) if len(self._messages) else 0,
            message_count=len(self._messages),
            topics=tuple(sorted(set(self._topic_of.values()), key=lambda t: (t.topic, t.type))),
            warnings=tuple(self.tally.warnings),
        )

    def close(self) -> None:
        """Close the files."""
        self._pages.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See Source.messages; exactly by log time."""
        wanted = [key for key, topic in self._topic_of.items() if topic.topic in topics]
        times = self._messages[:, 0]
        first = 0 if start_ns is None else int(np.searchsorted(times, start_ns))
        last = len(times) if end_ns is None else int(np.searchsorted(times, end_ns))
        part = self._messages[first:last]
        for time_ns, _, topic, page, cell in part[np.isin(part[:, 2], wanted)].tolist():
            data = self._pages.row(Place(page, cell)).values[3]
            assert isinstance(data, bytes)
            plain = self._unpack(data) if data[:4] == ZSTD_MAGIC else data
            yield RawMessage(self._topic_of[topic], time_ns, plain)

    def _survey(self) -> I64:
        """Time, number, topic, page and cell (N, 5) of the messages; topics are taken up on the way."""
        index = array("q")
        numbers: set[int] = set()
        for place in self._pages.places():
            try:
                row = self._pages.take(place)
            except BrokenRow as error:
                self.tally.warn(f"{error}, on page {place.page}")
                continue
            match row.values:
                case (None, int(topic), int(time_ns), bytes()) if row.rowid not in numbers:
                    numbers.add(row.rowid)
                    index.extend((time_ns, row.rowid, topic, *place))
                case (None, str(), str(kind), str(), *_) if "/" in kind:
                    self._topics.setdefault(row.rowid, row)
                case (None, str(kind), str(), str(), *_):
                    self._definitions.setdefault(kind, row)
                case (None, str()) | (None, int(), str()) | (str(), str(), str(), *_):
                    pass  # versions, what metadata.yaml says, tables: nobody here reads them
                case _:
                    self._strange += 1
        return np.frombuffer(index, np.int64).reshape(-1, 5)

    def _count_losses(self, found: I64) -> None:
        """What is missing: messages by their numbers, and the bytes of pages that were of no use."""
        pages = self._pages
        unused = pages.unused()
        if unused:
            self.tally.warn(f"{unused} pages of the .db3 are damaged")
        if pages.bytes_missing:
            self.tally.warn(f"{pages.bytes_missing} bytes at the end of the .db3 are missing")
        if pages.wal_bytes_lost:
            self.tally.warn(f"{pages.wal_bytes_lost} bytes of the -wal are damaged")
        # Every message has some bytes: a number beyond that is damaged itself.
        numbers = found[(found[:, 1] > 0) & (found[:, 1] < pages.count * pages.page_size), 1]
        gone = int(numbers.max(initial=0)) - len(numbers)
        if gone > 0:
            self.tally.warn(f"{gone} messages between others are lost")
        homeless = int(np.count_nonzero(~np.isin(found[:, 2], list(self._topics))))
        if homeless:
            self.tally.warn(f"{homeless} messages are of a topic that is lost")
            self.tally.topics_lost = True
        if self._strange:
            self.tally.warn(f"{self._strange} rows are of no kind that rosbag2 writes, or there twice")
        whole_pages = unused * pages.page_size + pages.bytes_missing + pages.wal_bytes_lost
        # Of the numbered ones a byte each, at least.
        self.tally.bytes_lost += max(whole_pages, gone + homeless + self._strange)

    def _topic(self, key: int) -> TopicInfo:
        _, name, kind, serialization, *_ = self._topics[key].values
        definition = self._definitions.get(str(kind))
        return TopicInfo(
            topic=str(name),
            type=short_name(str(kind)),
            encoding=str(serialization),
            schema_encoding="" if definition is None else str(definition.values[2]),
            schema=b"" if definition is None else str(definition.values[3]).encode(),
            message_count=int(np.count_nonzero(self._messages[:, 2] == key)),
        )
