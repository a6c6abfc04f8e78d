"""What waits between its arrival and its use."""

from __future__ import annotations

import threading
import time

import pytest

from pc2grid.io.live.feed import FeedCounts, Inbox, InboxParameters
from pc2grid.io.source import RawMessage, TopicInfo

SCAN = TopicInfo(topic="/scan", type="sensor_msgs/LaserScan", encoding="cdr")
TF = TopicInfo(topic="/tf", type="tf2_msgs/TFMessage", encoding="cdr")


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def drain(inbox: Inbox) -> list[tuple[str, int]]:
    found = []
    while (arrived := inbox.get(0.0)) is not None:
        found.append((arrived.message.channel.topic, arrived.message.log_time_ns))
    return found


def fill(inbox: Inbox, clock: Clock, seconds: range) -> None:
    for now in seconds:
        clock.now_s = float(now)
        inbox.put(RawMessage(SCAN, now, b"x" * 10))
        inbox.put(RawMessage(TF, now, b"x"))


def test_scans_are_dropped_rather_than_late_and_transforms_are_kept() -> None:
    counts, clock = FeedCounts(), Clock()
    inbox = Inbox(counts, InboxParameters(most_lag_s=2.0, catch_up_s=0.0), clock=clock)
    inbox.prepared()
    fill(inbox, clock, range(10))
    found = drain(inbox)
    assert [t for topic, t in found if topic == "/scan"] == [7, 8, 9]
    assert [t for topic, t in found if topic == "/tf"] == list(range(10))
    assert (counts.arrived, counts.dropped) == (20, 7)


def test_nothing_is_dropped_before_the_preparations_are_over() -> None:
    counts, clock = FeedCounts(), Clock()
    inbox = Inbox(counts, InboxParameters(most_lag_s=2.0), clock=clock)
    fill(inbox, clock, range(10))
    assert len(drain(inbox)) == 20
    assert counts.dropped == 0


def test_memory_is_bounded_even_then() -> None:
    counts, clock = FeedCounts(), Clock()
    inbox = Inbox(counts, InboxParameters(most_bytes=45), clock=clock)
    fill(inbox, clock, range(10))
    found = drain(inbox)
    assert [t for topic, t in found if topic == "/scan"] == [7, 8, 9]
    few = Inbox(counts, InboxParameters(most_messages=6), clock=clock)
    fill(few, clock, range(10))
    assert len(drain(few)) == 6


def test_what_waited_during_the_preparations_may_be_used_up_first() -> None:
    counts, clock = FeedCounts(), Clock()
    inbox = Inbox(counts, InboxParameters(most_lag_s=2.0, catch_up_s=20.0), clock=clock)
    inbox.prepared()
    fill(inbox, clock, range(10))
    assert len(drain(inbox)) == 20
    fill(inbox, clock, range(10, 20))
    assert [t for topic, t in drain(inbox) if topic == "/scan"] == [17, 18, 19]


def test_but_not_for_ever() -> None:
    counts, clock = FeedCounts(), Clock()
    inbox = Inbox(counts, InboxParameters(most_lag_s=2.0, catch_up_s=6.0), clock=clock)
    inbox.prepared()
    fill(inbox, clock, range(10))
    assert [t for topic, t in drain(inbox) if topic == "/scan"] == [7, 8, 9]


def test_get_waits_for_another_thread() -> None:
    inbox = Inbox(FeedCounts())
    thread = threading.Timer(0.05, lambda: inbox.put(RawMessage(SCAN, 1, b"")))
    thread.start()
    arrived = inbox.get(20.0)
    assert arrived is not None
    assert arrived.arrived_s <= time.monotonic()
    assert inbox.get(0.01) is None
    thread.join()


@pytest.mark.parametrize("most", [1, 4])
def test_a_dropped_scan_gives_its_bytes_back(most: int) -> None:
    counts = FeedCounts()
    inbox = Inbox(counts, InboxParameters(most_bytes=10 * most))
    for k in range(50):
        inbox.put(RawMessage(SCAN, k, b"x" * 10))
    assert [t for _, t in drain(inbox)] == list(range(50 - most, 50))
