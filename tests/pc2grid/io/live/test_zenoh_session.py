"""A robot behind a zenoh router gives the scans that its recording gives."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from pc2grid.config import ReadConfig
from pc2grid.errors import ConfigError, LiveError
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.io.live import zenoh_session
from pc2grid.io.live.inbox import InboxParameters
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.nav2 import MAP, POSE, Nav2Publisher
from pc2grid.io.live.zenoh_session import Token, ZenohSession
from pc2grid.model import OccupancyGrid, Scan
from tests.helpers.growing import laser_drive
from tests.helpers.recordings import write_mcap
from tests.helpers.robot import Recorded, ZenohRobot, attachment, mangled

zenoh = pytest.importorskip("zenoh", reason="needs the extra [zenoh]")
PATIENT = InboxParameters(most_lag_s=1e6)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("robot") / "a.mcap", laser_drive())


def until(done: Callable[[], bool], timeout_s: float = 60.0) -> Callable[[], bool]:
    end_s = time.monotonic() + timeout_s
    return lambda: done() or time.monotonic() > end_s


def wait_for(done: Callable[[], bool]) -> None:
    over = until(done)
    while not over():
        time.sleep(0.01)
    assert done()


def test_the_same_bytes_give_the_same_scans(recording: Path) -> None:
    with open_log(recording) as log:
        expected = list(log.scans())[:-1]  # the last one waits for odometry that does not come
    found: list[Scan] = []
    with ZenohRobot(Recorded.read(recording), speed=4.0).running(nodes=2) as robot:
        feed = ZenohSession(robot.url, ReadConfig(), PATIENT)
        with LiveLog(feed, ReadConfig()) as live:
            live.on_poll = until(lambda: len(found) >= len(expected))
            found.extend(live.scans())
            assert feed.counts.dropped == 0
            assert any(said.startswith("/scan: published by /driver") for said in feed.news.take())
    assert [s.stamp_ns for s in found] == [s.stamp_ns for s in expected]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.points_m, b.points_m)
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)


@pytest.mark.parametrize("hash_name", ["RIHS01_" + "7" * 64, "TypeHashNotSupported"])
def test_what_is_published_is_what_an_independent_decoder_reads(recording: Path, hash_name: str) -> None:
    """By the hash that the robot's own nodes use; and the map also for those who subscribe late."""
    from zenoh.ext import HistoryConfig, declare_advanced_subscriber

    store = get_typestore(Stores.ROS2_HUMBLE)
    grid = OccupancyGrid(cells=np.array([[0, 100, -1]], np.int8), resolution_m=0.05, origin_m=(-1.0, 2.0))
    robot = ZenohRobot(Recorded.read(recording), hash_name=hash_name)
    with robot.running(listens=(("/initialpose", POSE), ("/map", MAP))):
        feed = ZenohSession(robot.url, ReadConfig())
        wait_for(lambda: feed._hash_of("/map", mangled(MAP)) is not None)
        with Nav2Publisher(feed) as publisher:
            publisher.announce("/initialpose", "/map")
            time.sleep(0.2)
            publisher.initialpose(1_500_000_000, SE2(1.0, 2.0, 0.5), np.diag([0.01, 0.02, 0.03]))
            publisher.map(7, grid)
            wait_for(lambda: len(robot.published) >= 2)
            late: list[bytes] = []
            config = zenoh.Config()
            config.insert_json5("mode", '"client"')
            config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{robot.port}"]')
            with zenoh.open(config) as session:
                key = f"0/map/{mangled(MAP)}/{hash_name}"
                kept = declare_advanced_subscriber(
                    session,
                    key,
                    lambda sample: late.append(sample.payload.to_bytes()),
                    history=HistoryConfig(detect_late_publishers=True),
                )
                wait_for(lambda: bool(late))
                assert kept is not None
        feed.close()
    decoded = {topic: store.deserialize_cdr(data, kind) for topic, kind, data in robot.published}
    pose, drawn = decoded["/initialpose"], store.deserialize_cdr(late[0], MAP)
    assert (pose.pose.pose.position.x, pose.pose.pose.position.y) == (1.0, 2.0)
    assert pose.header.frame_id == "map"
    np.testing.assert_array_equal(drawn.data, [0, 100, -1])
    np.testing.assert_array_equal(decoded["/map"].data, [0, 100, -1])


def test_attachments_are_those_of_rmw_zenoh() -> None:
    """Compared with zenoh's own serialisation."""
    ours = zenoh_session._attachment(1, bytes(16))
    stamp_ns = zenoh_session._sent_ns(ours)
    assert abs(stamp_ns - time.time_ns()) < 60 * 10**9
    assert ours == attachment(stamp_ns)
    assert abs(zenoh_session._sent_ns(b"something else") - time.time_ns()) < 60 * 10**9


def test_tokens_are_read_as_rmw_zenoh_writes_them() -> None:
    key = (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%robot/driver/%robot%scan/"
        "sensor_msgs::msg::dds_::LaserScan_/RIHS01_ab/2:1:,10:,:,:,,"
    )
    token = Token.of(key)
    assert token is not None
    assert (token.kind, token.node, token.topic) == ("MP", "/robot/driver", "/robot/scan")
    assert token.info.type == "sensor_msgs/LaserScan"
    assert token.best_effort
    for other in ("@ros2_lv/2/aa/0/0/NN/%/%/driver", key.replace("/MP/", "/SS/"), "something/else"):
        assert Token.of(other) is None


def test_nobody_there_and_a_wrong_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_session, "_OPEN_MS", 100)
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"zenoh://127.0.0.1:{unused.getsockname()[1]}"
    with pytest.raises(LiveError, match="no connection") as error:
        ZenohSession(url, ReadConfig())
    assert error.value.hint is not None
    assert "rmw_zenohd" in error.value.hint
    for wrong in ("zenoh://", "zenoh://robot:port", "zenoh://robot:7447/domain"):
        with pytest.raises(ConfigError, match="not an address"):
            ZenohSession(wrong, ReadConfig())
