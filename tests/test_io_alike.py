"""Two ways to read one format give the same: by its index, and by going through what is there."""

from __future__ import annotations

import contextlib
import itertools
import sqlite3
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt
from pc2grid.io.bag_log import MAGIC, BagSource
from pc2grid.io.bag_records import blob
from pc2grid.io.bag_salvage import SalvagedBag
from pc2grid.io.db3_log import Db3Source
from pc2grid.io.db3_salvage import SalvagedDb3
from pc2grid.io.mcap_log import McapSource
from pc2grid.io.source import Source
from tests.builders import STEP, T0, Dialect, Message, drive, ros, write_bag, write_mcap, write_rosbag2

CONFIG = ReadConfig()
PARTS: list[tuple[int | None, int | None]] = [
    (None, None),
    (T0 + STEP, None),
    (None, T0 + 5 * STEP),
    (T0 + 3 * STEP, T0 + 4 * STEP),
    (T0 + 3 * STEP + 1, T0 + 4 * STEP + 1),
    (T0 + 99 * STEP, None),
    (None, T0),
]


def at_odd_times(dialect: Dialect = "ros2") -> list[Message]:
    """A drive whose times have no zeros in their last bytes."""
    return [m._replace(log_time_ns=m.log_time_ns + 7 + 3 * i) for i, m in enumerate(drive(dialect))]


def late(messages: list[Message]) -> list[Message]:
    """Some recorded out of order, within a chunk and beyond."""
    moved = list(messages)
    for i in (3, 9, 15):
        moved[i], moved[i + 2] = moved[i + 2], moved[i]
    return moved


def everything(
    source: Source, topics: set[str], part: tuple[int | None, int | None]
) -> list[tuple[str, str, int, bytes]]:
    found = source.messages(topics, *part)
    return [(m.channel.topic, m.channel.type, m.log_time_ns, bytes(m.data)) for m in found]


def alike(indexed: Source, gone_through: Source, messages: list[Message]) -> None:
    assert gone_through.tally.bytes_lost == 0
    for name in ("format", "size_bytes", "start_ns", "end_ns", "message_count", "topics"):
        assert getattr(gone_through.info, name) == getattr(indexed.info, name), name
    assert indexed.info.message_count == len(messages)
    assert indexed.info.start_ns == min(m.log_time_ns for m in messages)
    assert indexed.info.end_ns == max(m.log_time_ns for m in messages)
    names = {m.topic for m in messages}
    exactly = [(m.log_time_ns, m.log_time_ns + 1) for m in messages]
    for topics in (names, {"/points"}, {"/odom", "/tf"}, {"/none"}, set[str]()):
        for low, high in (*PARTS, *exactly):
            wanted = sorted(
                (m.topic, m.type, m.log_time_ns, m.data)
                for m in messages
                if m.topic in topics
                and (low is None or m.log_time_ns >= low)
                and (high is None or m.log_time_ns < high)
            )
            for source in (indexed, gone_through):
                found = everything(source, topics, (low, high))
                assert sorted(found) == wanted
    indexed.close()
    gone_through.close()


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
@pytest.mark.parametrize("order", [list, late])
def test_a_bag(tmp_path: Path, compression: str, order: Callable[[list[Message]], list[Message]]) -> None:
    messages = order(at_odd_times("ros1"))
    path = write_bag(tmp_path / "a.bag", messages, compression, chunk_bytes=3000)
    alike(BagSource(path, CONFIG), SalvagedBag(path, CONFIG), messages)
    found = everything(SalvagedBag(path, CONFIG), {m.topic for m in messages}, (None, None))
    if order is list:
        assert [m[2] for m in found] == sorted(m.log_time_ns for m in messages)


def test_a_topic_of_a_bag_that_has_no_messages(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer

    messages = at_odd_times("ros1")
    with Writer(tmp_path / "a.bag") as out:
        for topic, kind in dict.fromkeys((m.topic, m.type) for m in messages):
            out.add_connection(topic, kind.replace("/", "/msg/"), typestore=ros("ros1").store)
        of = {connection.topic: connection for connection in out.connections}
        out.add_connection("/silent", "sensor_msgs/msg/LaserScan", typestore=ros("ros1").store)
        for topic, _, log_time_ns, data in messages:
            out.write(of[topic], log_time_ns, data)
    sources = BagSource(tmp_path / "a.bag", CONFIG), SalvagedBag(tmp_path / "a.bag", CONFIG)
    for source in sources:
        assert {t.topic: t.message_count for t in source.info.topics}["/silent"] == 0
    alike(*sources, messages)


def test_messages_of_a_salvaged_chunk_come_by_their_times(tmp_path: Path) -> None:
    messages = late(at_odd_times("ros1"))
    source = SalvagedBag(write_bag(tmp_path / "a.bag", messages), CONFIG)
    found = everything(source, {m.topic for m in messages}, (None, None))
    assert [m[2] for m in found] == sorted(m.log_time_ns for m in messages)


@pytest.mark.parametrize("order", list(itertools.permutations((b"op=", b"compression=", b"size="))))
def test_a_chunk_is_found_whatever_its_header_begins_with(tmp_path: Path, order: tuple[bytes, ...]) -> None:
    """Writers differ in the order of its fields; behind damage it is looked for by one of them."""
    path = write_bag(tmp_path / "a.bag", at_odd_times("ros1"), chunk_bytes=3000)
    content = bytearray(path.read_bytes())
    chunks = []
    at = len(MAGIC)
    while at < len(content):
        header, begin = blob(memoryview(bytes(content)), at)
        fields = [bytes(field) for field in split(header)]
        if any(field == b"op=\x05" for field in fields):
            fields.sort(key=lambda field: [field.startswith(name) for name in order].index(True))
            content[at + 4 : begin] = b"".join(struct.pack("<I", len(f)) + f for f in fields)
            chunks.append(at)
        _, at = blob(memoryview(bytes(content)), begin)
    assert len(chunks) > 3
    whole = SalvagedBag(rewritten(path, content), CONFIG)
    hit = chunks[-2]  # the first ones say what the topics are
    content[hit : hit + 4] = b"\xff" * 4
    damaged = SalvagedBag(rewritten(path, content), CONFIG)
    assert damaged.tally.bytes_lost == chunks[-1] - hit
    assert whole.tally.bytes_lost == 0
    lost = (whole.info.message_count or 0) - (damaged.info.message_count or 0)
    assert 0 < lost < (whole.info.message_count or 0) / 2


def split(header: memoryview) -> Iterator[memoryview]:
    at = 0
    while at < len(header):
        field, at = blob(header, at)
        yield field


def rewritten(path: Path, content: bytes | bytearray) -> Path:
    path.write_bytes(content)
    return path


def test_a_db3(tmp_path: Path) -> None:
    messages = at_odd_times()
    (path,) = write_rosbag2(tmp_path / "log", messages).glob("*.db3")
    alike(Db3Source(path, CONFIG), SalvagedDb3(path, CONFIG, recover=True), messages)


def test_a_db3_whose_messages_are_gone(tmp_path: Path) -> None:
    """Deleted as by a program, so that every page is whole: only their numbers tell."""
    (path,) = write_rosbag2(tmp_path / "log", at_odd_times()).glob("*.db3")
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("DELETE FROM messages WHERE id IN (3, 4, 9)")
        connection.commit()
    before = psutil.Process().num_fds()
    with pytest.raises(LogCorrupt, match=r"a damaged \.db3: .*lost") as caught:
        SalvagedDb3(path, CONFIG, recover=False)
    assert psutil.Process().num_fds() == before, caught
    source = SalvagedDb3(path, CONFIG, recover=True)
    assert "3 messages between others are lost" in source.tally.warnings
    assert source.tally.bytes_lost >= 3
    assert any("no checksum" in sentence for sentence in source.tally.warnings)
    source.close()


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"chunk_size": 2000}])
def test_an_mcap(tmp_path: Path, options: dict[str, object]) -> None:
    messages = at_odd_times()
    path = write_mcap(tmp_path / "a.mcap", messages, **options)
    alike(McapSource(path, CONFIG), McapSource(path, CONFIG, recover=True), messages)
