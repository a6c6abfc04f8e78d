"""A robot behind a websocket gives the scans that its recording gives, whatever happens to the connection."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from pc2grid.config import ReadConfig
from pc2grid.errors import LiveError, NoScans
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.io.live.feed import InboxParameters
from pc2grid.io.live.foxglove_websocket import ConnectionParameters, FoxgloveWebsocket
from pc2grid.io.live.live_log import LiveLog, LiveParameters
from pc2grid.io.live.nav2 import Nav2Publisher
from pc2grid.model import OccupancyGrid, Scan
from tests.helpers.recordings import laser_drive, write_mcap
from tests.helpers.robot import SUBPROTOCOLS, Recorded, Robot

websockets = pytest.importorskip("websockets", reason="needs the extra [live]")
PATIENT = InboxParameters(most_lag_s=1e6)
QUICK = ConnectionParameters(first_s=0.3, least_pause_s=0.001, most_pause_s=0.01)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("robot") / "a.mcap", laser_drive())


@pytest.fixture(scope="module")
def recorded(recording: Path) -> Recorded:
    return Recorded.read(recording)


@pytest.fixture(scope="module")
def expected(recording: Path) -> list[Scan]:
    with open_log(recording) as log:
        return list(log.scans())


def connect(robot: Robot, config: ReadConfig | None = None) -> LiveLog:
    config = config or ReadConfig()
    return LiveLog(FoxgloveWebsocket(robot.url, config, QUICK, PATIENT), config)


def until(done: Callable[[], bool], timeout_s: float = 60.0) -> Callable[[], bool]:
    """True once `done` is, or when that takes far too long."""
    end_s = time.monotonic() + timeout_s
    return lambda: done() or time.monotonic() > end_s


@pytest.mark.parametrize("subprotocol", SUBPROTOCOLS)
def test_the_same_bytes_give_the_same_scans(
    recorded: Recorded, expected: list[Scan], subprotocol: str
) -> None:
    found: list[Scan] = []
    with Robot(recorded, speed=30.0, subprotocol=subprotocol).running() as robot, connect(robot) as live:
        live.on_poll = until(lambda: len(found) >= len(expected) - 1)
        found.extend(live.scans())
        assert live.feed.counts.dropped == 0
    # The last scan waits for odometry after it, which does not come.
    for a, b in zip(found, expected[: len(expected) - 1], strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.points_m, b.points_m)
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)


def test_a_hundred_lost_connections_are_made_again(tmp_path: Path) -> None:
    """What is lost is lost, but what arrives is right, and in order."""
    path = write_mcap(tmp_path / "a.mcap", laser_drive(300))
    with open_log(path) as log:
        expected = list(log.scans())
    # Slow enough that a busy machine is connected again before the next messages are sent.
    with Robot(Recorded.read(path), speed=5.0, cut_after=4).running() as robot, connect(robot) as live:
        live.on_poll = until(robot.finished.is_set)
        found = [scan for _ in range(200) if not live.ended for scan in live.scans()]
        assert live.feed.counts.reconnected >= 100
        assert "the connection is lost" in " ".join(live.feed.news.take())
    by_stamp = {scan.stamp_ns: scan for scan in expected}
    assert len(found) > 20
    stamps = [scan.stamp_ns for scan in found]
    assert stamps == sorted(set(stamps))
    for scan in found:
        np.testing.assert_array_equal(scan.points_m, by_stamp[scan.stamp_ns].points_m)
        if scan.T_odom_base is not None:
            truth = by_stamp[scan.stamp_ns].T_odom_base
            assert truth is not None
            assert abs(scan.T_odom_base[0, 3] - truth[0, 3]) < 0.06  # interpolated over what was lost


def test_what_is_published_is_what_an_independent_decoder_reads(recorded: Recorded) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    cells = np.array([[0, 100, -1], [100, 0, 0]], np.int8)
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-1.0, 2.0))
    with Robot(recorded, speed=30.0).running() as robot:
        feed = FoxgloveWebsocket(robot.url, ReadConfig(), QUICK)
        with Nav2Publisher(feed) as publisher:
            publisher.initialpose(1_500_000_000, SE2(1.0, 2.0, 0.5), np.diag([0.01, 0.02, 0.03]))
            publisher.map(7, grid)
            publisher.start_tf("odom", SE2(3.0, 4.0, -1.0), lambda: 10**9)
            wait = until(lambda: len(robot.published) >= 5)
            while not wait():
                time.sleep(0.01)
            publisher.stop_tf()
            count = len(robot.published)
            robot.cut()
            wait = until(lambda: len(robot.published) > count)
            while not wait():
                time.sleep(0.01)
        feed.close()
    decoded = [(t, store.deserialize_cdr(data, kind)) for t, kind, data in robot.published]
    (topic, pose), (map_topic, drawn), *rest = decoded
    assert (topic, map_topic) == ("/initialpose", "/map")
    assert pose.header.frame_id == "map"
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (1, 500_000_000)
    assert (pose.pose.pose.position.x, pose.pose.pose.position.y) == (1.0, 2.0)
    assert pose.pose.pose.orientation.z == pytest.approx(np.sin(0.25))
    assert pose.pose.covariance.reshape(6, 6)[5, 5] == 0.03
    np.testing.assert_array_equal(drawn.data.reshape(2, 3), cells)
    edge = rest[0][1].transforms[0]
    assert (edge.header.frame_id, edge.child_frame_id) == ("map", "odom")
    assert (edge.transform.translation.x, edge.transform.translation.y) == (3.0, 4.0)
    assert (edge.header.stamp.sec, edge.header.stamp.nanosec) == (1, 500_000_000)  # half a second ahead
    # After the connection was lost, the map is sent again, and nothing else.
    assert [topic for topic, _ in decoded[count:]] == ["/map"]


def test_a_robot_that_takes_no_messages_is_named(recorded: Recorded) -> None:
    with Robot(recorded, capabilities=()).running() as robot:
        feed = FoxgloveWebsocket(robot.url, ReadConfig(), QUICK)
        with pytest.raises(LiveError, match="does not take messages") as error:
            Nav2Publisher(feed).announce("/initialpose")
        assert error.value.hint is not None
        assert "clientPublish" in error.value.hint
        feed.close()


def test_a_topic_that_never_speaks_is_named(recorded: Recorded) -> None:
    quick = LiveParameters(silent_s=0.2, poll_s=0.05)
    robot = Robot(recorded, speed=30.0, begin_topic="/odom", silent=frozenset({"/scan"}))
    with robot.running():
        feed = FoxgloveWebsocket(robot.url, ReadConfig(), QUICK)
        with LiveLog(feed, ReadConfig(), quick) as live:
            news: list[str] = []
            live.on_poll = until(lambda: bool(news.extend(feed.news.take()) or news))
            with pytest.raises(NoScans, match="/scan: no message yet"):
                live.choose()
        assert news[0].startswith("/scan: no message yet")


def test_a_topic_that_is_published_twice_is_named(recorded: Recorded, expected: list[Scan]) -> None:
    scan = next(c for c in recorded.channels if c.topic == "/scan")
    twice = replace(recorded, channels=(*recorded.channels, replace(scan, id=99)))
    found: list[Scan] = []
    with Robot(twice, speed=30.0).running() as robot, connect(robot) as live:
        live.on_poll = until(lambda: len(found) >= 20)
        found.extend(live.scans())
        assert any("/scan: published twice" in sentence for sentence in live.feed.news.take())
    assert [s.stamp_ns for s in found] == [s.stamp_ns for s in expected[: len(found)]]


def test_nobody_there_is_said_at_once() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"ws://127.0.0.1:{unused.getsockname()[1]}"
    with pytest.raises(LiveError, match="no connection") as error:
        FoxgloveWebsocket(url, ReadConfig(), QUICK)
    assert error.value.hint is not None
    assert "foxglove_bridge" in error.value.hint
