"""Clocks that jump, gaps, and lag, without any network."""

import threading
import time
from collections import deque
from collections.abc import Collection, Sequence

import pytest

from pc2grid.errors import NoScans
from pc2grid.io.live.feed import Arrived, Feed, Inbox, LiveParameters
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.source import RawMessage, Tally, TopicInfo
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import T0, Message, laser_drive, ros


class Given(Feed):
    """A feed of messages that are all there; by its clock scans arrive as they were sent."""

    def __init__(self, messages: Sequence[Message]) -> None:
        super().__init__("given", ReadConfig())
        self.now_s = 0.0
        self.wanted: frozenset[str] | None = None
        self._waiting: deque[RawMessage] = deque()
        for topic, kind, time_ns, data in messages:
            self._offer(topic, TopicInfo(topic=topic, type=kind, encoding="cdr"))
            self._waiting.append(RawMessage(self._topics[topic, kind], time_ns, data))

    @property
    def ended(self) -> bool:
        return not self._waiting

    def want(self, topics: Collection[str]) -> None:
        self.wanted = frozenset(topics)

    def receive(self, timeout_s: float) -> Arrived | None:
        if not self._waiting:
            self.now_s += timeout_s
            return None
        message = self._waiting.popleft()
        if message.channel.topic == "/scan":
            self.now_s = max(self.now_s, (message.log_time_ns - T0) * 1e-9)
        return Arrived(message, self.now_s)


def live_log(messages: Sequence[Message]) -> tuple[LiveLog, Given]:
    feed = Given(messages)
    return LiveLog(feed, clock=lambda: feed.now_s), feed


def parts_of(live: LiveLog) -> list[list[int]]:
    """Stamps of the scans that belong together."""
    parts = []
    while not live.ended:
        parts.append([scan.stamp_ns for scan in live.scans()])
    return [part for part in parts if part]


def test_odometry_that_comes_after_its_scan_is_waited_for() -> None:
    """But no longer: a scan is used as soon as what it needs is there."""
    messages = laser_drive(60)
    live, _ = live_log(messages)
    scans = live.scans()
    late = 0
    for scan in scans:
        assert scan.T_odom_base is not None
        number = round((scan.stamp_ns - messages[0].log_time_ns) / 1e8)
        assert scan.T_odom_base[0, 3] == pytest.approx(0.05 * number)
        newest = live.poses.newest_odometry()
        assert newest is not None
        late += newest[0] < scan.stamp_ns
    assert late == 0


def test_only_what_is_used_is_asked_for() -> None:
    live, feed = live_log(laser_drive(60))
    live.choose()
    assert feed.wanted == {"/scan", "/odom"}


@pytest.mark.parametrize("jump_s", [-3600, 3600])
def test_a_clock_that_is_set_begins_a_new_part(jump_s: int) -> None:
    messages = laser_drive(120)
    later = laser_drive(240)[361:]
    offset_ns = jump_s * 10**9
    set_back = [
        ros().laser("/scan", m.log_time_ns + offset_ns, [1.0] * 30)._replace(log_time_ns=m.log_time_ns)
        if m.topic == "/scan"
        else ros().odometry("/odom", m.log_time_ns + offset_ns, 6.0)._replace(log_time_ns=m.log_time_ns)
        for m in later
    ]
    live, feed = live_log([*messages, *set_back])
    first, second = parts_of(live)
    assert first[0] == T0
    assert len(first) >= 119
    assert len(second) >= 110  # a few tell that it was not one wrong stamp
    assert second[-1] == later[-2].log_time_ns - 50_000_000 + offset_ns or second == sorted(second)
    assert any("clock of the scans was set" in sentence for sentence in feed.tally.take_news())


def test_a_gap_without_odometry_begins_a_new_part() -> None:
    messages = [m for m in laser_drive(100) if m.topic != "/odom"]
    gap = [m for i, m in enumerate(messages) if not 50 <= i < 90]
    live, feed = live_log(gap)
    first, second = parts_of(live)
    assert (len(first), len(second)) == (49, 11)
    assert any("no scan for 4.1 s" in sentence for sentence in feed.tally.take_news())


def test_a_gap_with_odometry_is_bridged() -> None:
    messages = laser_drive(100)
    gap = [m for i, m in enumerate(messages) if m.topic != "/scan" or not 150 <= i < 270]
    live, _ = live_log(gap)
    (only,) = parts_of(live)
    assert len(only) == 60


def test_no_scan_at_all_is_said() -> None:
    live, _ = live_log([m for m in laser_drive(50) if m.topic != "/scan"])
    with pytest.raises(NoScans, match="no topic with scans"):
        live.choose()


def test_lag_is_the_time_from_arrival_to_the_end_of_the_use() -> None:
    live, feed = live_log(laser_drive(60))
    for count, _scan in enumerate(live.scans()):
        feed.now_s += 0.01
        if count > 40:  # those held back for the plan have waited longer
            assert live.lag_s < 0.05
    assert live.lag_s > 0.009


def test_a_message_from_another_week_hides_no_scan() -> None:
    """A late transform moved all others out of what is held back: "no message in the log"."""
    messages = laser_drive(60)
    week_ns = 7 * 24 * 3600 * 10**9
    stray = ros().tf(T0 + week_ns, "base_link", "camera", 0.1, topic="/tf_static")
    live, feed = live_log([*messages[:30], stray, *messages[30:]])
    assert len(list(live.scans())) == 60
    feed.now_s = 6.0
    assert live.now_ns() < T0 + week_ns


# --- What waits between its arrival and its use ---


SCAN = TopicInfo(topic="/scan", type="sensor_msgs/LaserScan", encoding="cdr")
TF = TopicInfo(topic="/tf", type="tf2_msgs/TFMessage", encoding="cdr")


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def waiting(inbox: Inbox, clock: Clock, seconds: range) -> dict[str, list[int]]:
    """When the messages were recorded that still wait after one of each topic came in each second."""
    for now in seconds:
        clock.now_s = float(now)
        inbox.put(RawMessage(SCAN, now, b"x" * 10))
        inbox.put(RawMessage(TF, now, b"x"))
    found: dict[str, list[int]] = {"/scan": [], "/tf": []}
    while (arrived := inbox.get(0.0)) is not None:
        found[arrived.message.channel.topic].append(arrived.message.log_time_ns)
    return found


@pytest.mark.parametrize(
    ("limits", "prepared", "scans"),
    [
        ({"most_lag_s": 2.0, "catch_up_s": 0.0}, True, [7, 8, 9]),  # dropped rather than late
        ({"most_lag_s": 2.0}, False, [*range(10)]),  # before the preparations are over, none is late
        ({"most_bytes": 45}, False, [7, 8, 9]),  # but memory is bounded even then
        ({"most_lag_s": 2.0, "catch_up_s": 20.0}, True, [*range(10)]),  # they may be used up first
        ({"most_lag_s": 2.0, "catch_up_s": 6.0}, True, [7, 8, 9]),  # but not for ever
    ],
)
def test_scans_are_dropped_and_transforms_are_kept(
    limits: dict[str, float], prepared: bool, scans: list[int]
) -> None:
    tally, clock = Tally(), Clock()
    inbox = Inbox(tally, LiveParameters(**limits), clock=clock)  # type: ignore[arg-type]
    if prepared:
        inbox.prepared()
    found = waiting(inbox, clock, range(10))
    assert found["/scan"] == scans
    assert found["/tf"] == [*range(10)] or "most_bytes" in limits
    assert tally.arrived == 20 and tally.dropped == 20 - len(found["/scan"]) - len(found["/tf"])
    if limits.get("catch_up_s") == 20.0:
        assert waiting(inbox, clock, range(10, 20))["/scan"] == [17, 18, 19]


def test_the_number_of_messages_is_bounded() -> None:
    clock = Clock()
    inbox = Inbox(Tally(), LiveParameters(most_messages=6), clock=clock)
    assert sum(map(len, waiting(inbox, clock, range(10)).values())) == 6


def test_get_waits_for_another_thread() -> None:
    inbox = Inbox(Tally())
    thread = threading.Timer(0.05, lambda: inbox.put(RawMessage(SCAN, 1, b"")))
    thread.start()
    arrived = inbox.get(20.0)
    assert arrived is not None
    assert arrived.arrived_s <= time.monotonic()
    assert inbox.get(0.01) is None
    thread.join()


@pytest.mark.parametrize("most", [1, 4])
def test_a_dropped_scan_gives_its_bytes_back(most: int) -> None:
    inbox = Inbox(Tally(), LiveParameters(most_bytes=10 * most))
    for k in range(50):
        inbox.put(RawMessage(SCAN, k, b"x" * 10))
    assert waiting(inbox, Clock(), range(0))["/scan"] == [*range(50 - most, 50)]
