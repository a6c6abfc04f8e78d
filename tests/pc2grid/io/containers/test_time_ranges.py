"""Every container gives the messages of the topics and of the time range that it is asked for, no others."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from pc2grid.io.containers.bags import RosbagsFile
from pc2grid.io.containers.mcap import McapSource
from pc2grid.io.source import MessageSource
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import (
    STEP,
    T0,
    Dialect,
    Message,
    drive,
    ros,
    write_bag,
    write_mcap,
    write_rosbag2,
)

CONFIG = ReadConfig()
PARTS: list[tuple[int | None, int | None]] = [
    (None, None), (T0 + STEP, None), (None, T0 + 5 * STEP), (T0 + 3 * STEP, T0 + 4 * STEP),
    (T0 + 3 * STEP + 1, T0 + 4 * STEP + 1), (T0 + 99 * STEP, None), (None, T0),
]  # fmt: skip


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
    source: MessageSource, topics: set[str], part: tuple[int | None, int | None]
) -> list[tuple[str, str, int, bytes]]:
    found = source.messages(topics, *part)
    return [(m.channel.topic, m.channel.type, m.log_time_ns, bytes(m.data)) for m in found]


def check(messages: list[Message], *sources: MessageSource) -> None:
    """Whether every source holds the messages, as a whole and in parts."""
    names = {m.topic for m in messages}
    exactly = [(m.log_time_ns, m.log_time_ns + 1) for m in messages]
    for source in sources:
        assert source.tally.bytes_lost == 0
        assert source.info.message_count == len(messages)
        counts = Counter(m.topic for m in messages)
        assert all(t.message_count == counts[t.topic] for t in source.info.topics)
        assert source.info.start_ns == min(m.log_time_ns for m in messages)
        assert source.info.end_ns == max(m.log_time_ns for m in messages)
        for topics in (names, {"/points"}, {"/odom", "/tf"}, {"/none"}, set[str]()):
            for low, high in (*PARTS, *exactly):
                wanted = sorted(
                    (m.topic, m.type, m.log_time_ns, m.data)
                    for m in messages
                    if m.topic in topics
                    and (low is None or m.log_time_ns >= low)
                    and (high is None or m.log_time_ns < high)
                )
                assert sorted(everything(source, topics, (low, high))) == wanted
        source.close()


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
@pytest.mark.parametrize("order", [list, late])
def test_a_bag(tmp_path: Path, compression: str, order: Callable[[list[Message]], list[Message]]) -> None:
    messages = order(at_odd_times("ros1"))
    path = write_bag(tmp_path / "a.bag", messages, compression, chunk_bytes=3000)
    check(messages, RosbagsFile(path, CONFIG, is_bag=True))
    found = everything(RosbagsFile(path, CONFIG, is_bag=True), {m.topic for m in messages}, (None, None))
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
    source = RosbagsFile(tmp_path / "a.bag", CONFIG, is_bag=True)
    assert {t.topic: t.message_count for t in source.info.topics}["/silent"] == 0
    check(messages, source)


@pytest.mark.parametrize("order", [list, late])
def test_a_db3(tmp_path: Path, order: Callable[[list[Message]], list[Message]]) -> None:
    messages = order(at_odd_times())
    (path,) = write_rosbag2(tmp_path / "log", messages).glob("*.db3")
    check(messages, RosbagsFile(path, CONFIG, is_bag=False))
    found = everything(RosbagsFile(path, CONFIG, is_bag=False), {m.topic for m in messages}, (None, None))
    assert [m[2] for m in found] == sorted(m.log_time_ns for m in messages)


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"chunk_size": 2000}])
def test_an_mcap_by_its_index_and_by_a_survey(tmp_path: Path, options: dict[str, object]) -> None:
    messages = at_odd_times()
    path = write_mcap(tmp_path / "a.mcap", messages, **options)
    indexed, surveyed = McapSource(path, CONFIG), McapSource(path, CONFIG, recover=True)
    for name in ("format", "size_bytes", "topics"):
        assert getattr(surveyed.info, name) == getattr(indexed.info, name), name
    check(messages, indexed, surveyed)
