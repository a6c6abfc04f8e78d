"""A robot behind Foxglove's own server gives the scans that its recording gives, whatever happens to the
connection.
"""

import json
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import LiveError, NoScans, Pc2GridError
from pc2grid.geometry import SE2
from pc2grid.io.live.feed import LiveParameters
from pc2grid.io.live.foxglove_websocket import ConnectionParameters, FoxgloveWebsocket
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.nav2 import Nav2Publisher
from pc2grid.io.recording import open_log
from pc2grid.model import OccupancyGrid, Scan
from pc2grid.settings import ReadConfig
from tests.helpers.memory import bounded_memory
from tests.helpers.recordings import STEP, T0, laser_drive, ros, write_mcap
from tests.helpers.robot import LONG_S, SUBPROTOCOLS, Channel, Frame, Proxy, Recorded, Robot

PATIENT = LiveParameters(most_lag_s=1e6)
QUICK = ConnectionParameters(least_pause_s=0.001)


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


def connect(peer: Robot | Proxy, parameters: LiveParameters = PATIENT) -> LiveLog:
    return LiveLog(FoxgloveWebsocket(peer.url, ReadConfig(), QUICK, parameters))


def until(done: Callable[[], bool]) -> Callable[[], bool]:
    """True once `done` is, or when that takes far too long."""
    end_s = time.monotonic() + LONG_S
    return lambda: done() or time.monotonic() > end_s


def wait(done: Callable[[], bool]) -> None:
    over = until(done)
    while not over():
        time.sleep(0.001)
    assert done()


def found_by(live: LiveLog, count: int) -> list[Scan]:
    """The first `count` scans."""
    found: list[Scan] = []
    live.on_poll = until(lambda: len(found) >= count)
    found.extend(live.scans())
    return found


def assert_equal(found: list[Scan], expected: list[Scan]) -> None:
    for a, b in zip(found, expected, strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.points_m, b.points_m)
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)


def test_the_same_bytes_give_the_same_scans(recorded: Recorded, expected: list[Scan]) -> None:
    with Robot(recorded) as robot, connect(robot) as live:
        robot.wait_for_client()
        robot.play()
        # The last scan waits for odometry after it, which does not come.
        assert_equal(found_by(live, len(expected) - 1), expected[:-1])
        assert live.tally.dropped == 0


def test_a_bridge_of_before_version_3_2(recorded: Recorded, expected: list[Scan]) -> None:
    with Robot(recorded) as robot, Proxy(robot, subprotocol=SUBPROTOCOLS[1]) as proxy, connect(proxy) as live:
        robot.wait_for_client()
        robot.play()
        assert_equal(found_by(live, 10), expected[:10])


def test_a_robot_behind_tls(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a certificate that it signed itself, which has to be named."""
    fixtures = files("foxglove") / "tests" / "fixtures"
    certificate, key = ((fixtures / f"tls_{name}.pem").read_bytes() for name in ("cert", "key"))
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    with Robot(recorded, tls=(certificate, key)) as robot:
        with pytest.raises(LiveError, match="certificate verify failed") as error:
            connect(robot)
        assert "SSL_CERT_FILE" in (error.value.hint or "")
        monkeypatch.setenv("SSL_CERT_FILE", str(fixtures / "tls_cert.pem"))
        with connect(robot) as live:
            robot.wait_for_client()
            robot.play()
            assert len(found_by(live, 10)) == 10


def test_a_robot_that_restarts_is_followed_again(recorded: Recorded, expected: list[Scan]) -> None:
    """Its topics have other numbers then. It is told the map again, and nothing else."""
    half = len(recorded.messages) // 2
    grid = OccupancyGrid(cells=np.zeros((2, 3), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    with Robot(recorded) as first:
        live = connect(first)
        first.wait_for_client()
        with Nav2Publisher(live.feed) as publisher:
            publisher.map(7, grid)
            publisher.initialpose(8, SE2(1.0, 2.0, 0.5), np.eye(3))
        first.wait(lambda: len(first.told()) == 2)
        first.play(recorded.messages[:half])
        wait(lambda: live.tally.arrived == half)
    with live, Robot(recorded, port=first.port) as second:
        numbers = [{channel.id() for channel in robot.channels.values()} for robot in (first, second)]
        assert numbers[0].isdisjoint(numbers[1])
        second.wait_for_client()
        second.play(recorded.messages[half:])
        assert_equal(found_by(live, len(expected) - 1), expected[:-1])
        assert live.tally.reconnected == 1
    second.wait(lambda: not second.clients)
    assert [topic for topic, _ in second.told()] == ["/map"]


def test_a_hundred_lost_connections_are_made_again(tmp_path: Path) -> None:
    """What is lost is lost, but what arrives is right, and in order."""
    path = write_mcap(tmp_path / "a.mcap", laser_drive(300))
    with open_log(path) as log:
        expected = list(log.scans())
    recorded = Recorded.read(path)
    messages = [m for m in recorded.messages if not m[0].latched]
    with Robot(recorded) as robot, Proxy(robot) as proxy, connect(proxy) as live:

        def send(block: list[tuple[Channel, int, bytes]], cuts: int) -> None:
            """Half of the messages arrive; the others are sent while nobody is connected."""
            robot.wait(lambda: min(map(robot.subscriptions.count, ("/scan", "/odom"))) > cuts)
            arrived = live.tally.arrived
            robot.play(block[:4])
            wait(lambda: live.tally.arrived >= arrived + 4)
            proxy.cut()
            robot.play(block[4:])

        def drive() -> None:
            for cuts, begin in enumerate(range(0, len(messages), 8)):
                send(messages[begin : begin + 8], cuts)

        driven = threading.Thread(target=drive)
        driven.start()
        live.on_poll = until(lambda: not driven.is_alive())
        found = [scan for _ in range(200) if not live.ended for scan in live.scans()]
        assert live.tally.reconnected >= 100
        assert "the connection is lost" in " ".join(live.tally.take_news())
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


def test_a_network_that_falls_behind_loses_messages_but_not_the_connection(recorded: Recorded) -> None:
    """The server leaves out the oldest of what waits to be sent."""
    sent = {(channel.topic, time_ns): data for channel, time_ns, data in recorded.messages}
    last = max(sent, key=lambda which: which[1])
    arrived: dict[tuple[str, int], bytes] = {}
    with Robot(recorded, backlog=4) as robot:
        feed = FoxgloveWebsocket(robot.url, ReadConfig(), QUICK)
        robot.wait_for_client()
        robot.play()
        while last not in arrived:
            got = feed.receive(LONG_S)
            assert got is not None
            arrived[got.message.channel.topic, got.message.log_time_ns] = bytes(got.message.data)
        feed.close()
    assert len(arrived) < len(sent)
    assert arrived.items() <= sent.items()
    times_ns = [time_ns for _, time_ns in arrived]
    assert times_ns == sorted(times_ns)
    assert feed.tally.reconnected == 0


def test_a_computer_that_falls_behind_drops_scans_but_no_odometry(
    recorded: Recorded, expected: list[Scan]
) -> None:
    half = len(recorded.messages) // 2
    with Robot(recorded) as robot, connect(robot, LiveParameters(most_lag_s=0.0, catch_up_s=0.0)) as live:
        robot.wait_for_client()
        robot.play(recorded.messages[:half])
        scans = live.scans()
        found = [next(scans)]  # and now it is busy with it
        robot.play(recorded.messages[half:])
        wait(lambda: live.tally.arrived == len(recorded.messages))
        live.on_poll = until(lambda: live.poses.newest_odometry()[0] == recorded.messages[-1][1])
        found.extend(scans)
    by_stamp = {scan.stamp_ns: scan for scan in expected}
    assert_equal(found, [by_stamp[scan.stamp_ns] for scan in found])
    assert found[-1].stamp_ns == expected[-1].stamp_ns  # the newest is not dropped
    assert live.tally.dropped == len(expected) - len(found) > half // 3  # a third of them are scans


def test_what_is_published_is_what_an_independent_decoder_reads(recorded: Recorded) -> None:
    cells = np.array([[0, 100, -1], [100, 0, 0]], np.int8)
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-1.0, 2.0))
    with Robot(recorded) as robot:
        feed = FoxgloveWebsocket(robot.url, ReadConfig(), QUICK)
        with Nav2Publisher(feed) as publisher:
            publisher.initialpose(1_500_000_000, SE2(1.0, 2.0, 0.5), np.diag([0.01, 0.02, 0.03]))
            publisher.map(7, grid)
            publisher.start_tf("odom", SE2(3.0, 4.0, -1.0), lambda: 10**9)
            robot.wait(lambda: len(robot.told()) >= 5)
        feed.close()
    (topic, pose), (map_topic, drawn), *rest = robot.told()
    assert (topic, map_topic) == ("/initialpose", "/map")
    assert pose.header.frame_id == "map"
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (1, 500_000_000)
    assert (pose.pose.pose.position.x, pose.pose.pose.position.y) == (1.0, 2.0)
    assert pose.pose.pose.orientation.z == pytest.approx(np.sin(0.25))
    assert pose.pose.covariance.reshape(6, 6)[5, 5] == 0.03
    np.testing.assert_array_equal(drawn.data.reshape(2, 3), cells)
    assert {topic for topic, _ in rest} == {"/tf"}
    edge = rest[0][1].transforms[0]
    assert (edge.header.frame_id, edge.child_frame_id) == ("map", "odom")
    assert (edge.transform.translation.x, edge.transform.translation.y) == (3.0, 4.0)
    assert (edge.header.stamp.sec, edge.header.stamp.nanosec) == (1, 500_000_000)  # half a second ahead


def test_a_robot_that_takes_no_messages_is_named(recorded: Recorded) -> None:
    with Robot(recorded, capabilities=()) as robot:
        feed = FoxgloveWebsocket(robot.url, ReadConfig(), QUICK)
        with pytest.raises(LiveError, match="does not take messages") as error:
            Nav2Publisher(feed).announce("/initialpose")
        assert error.value.hint is not None
        assert "clientPublish" in error.value.hint
        feed.close()


def test_a_topic_that_never_speaks_is_named(recorded: Recorded) -> None:
    quick = LiveParameters(silent_s=0.2, poll_s=0.05)
    with Robot(recorded) as robot:
        feed = FoxgloveWebsocket(robot.url, ReadConfig(), QUICK, quick)
        with LiveLog(feed) as live:
            robot.wait_for_client()
            robot.play(m for m in recorded.messages if m[0].topic != "/scan")
            news: list[str] = []
            live.on_poll = until(lambda: bool(news.extend(feed.tally.take_news()) or news))
            with pytest.raises(NoScans, match="/scan: no message yet"):
                live.choose()
        assert news[0].startswith("/scan: no message yet")


def test_a_topic_that_is_published_twice_is_named(recorded: Recorded, expected: list[Scan]) -> None:
    """Foxglove's server makes one topic of two that have the same type."""

    def twice(frame: Frame) -> Iterator[Frame]:
        yield frame
        document = json.loads(frame) if isinstance(frame, str) else {}
        if document.get("op") == "advertise":
            scan = next(c for c in document["channels"] if c["topic"] == "/scan")
            yield json.dumps(document | {"channels": [scan | {"id": 10_000}]})

    with Robot(recorded) as robot, Proxy(robot, twice) as proxy, connect(proxy) as live:
        robot.wait_for_client()
        robot.play()
        assert_equal(found_by(live, 20), expected[:20])
        assert any("/scan: published twice" in sentence for sentence in live.tally.take_news())


def test_nobody_there_is_said_at_once() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"ws://127.0.0.1:{unused.getsockname()[1]}"
    with pytest.raises(LiveError, match="no connection") as error:
        FoxgloveWebsocket(url, ReadConfig(), ConnectionParameters(open_s=0.3))
    assert error.value.hint is not None
    assert "foxglove_bridge" in error.value.hint


# --- Robots that send garbage among their messages: what is good comes through, and nothing else happens ---


MOST_BYTES = 512 << 20


@pytest.fixture(scope="module")
def scans(recording: Path) -> list[Scan]:
    with open_log(recording) as log:
        return list(log.scans())[:-1]  # the last one waits for odometry that does not come


def channel(**changes: object) -> str:
    known = {"id": 900, "topic": "/rude", "encoding": "cdr", "schemaName": "sensor_msgs/msg/LaserScan"}
    return json.dumps({"op": "advertise", "channels": [known | {"schema": ""} | changes]})


# What is not understood, or of no use.
FRAMES: list[str | bytes] = [
    "", "null", "[]", "{", "17", '"op"', "{}", '{"op": 1}', '{"op": "advertise"}', '{"op": ["advertise"]}',
    '{"op": "advertise", "channels": 5}', '{"op": "advertise", "channels": [5, null]}',
    '{"op": "unadvertise", "channelIds": [{}, [], "x", -1, 1e999]}', '{"op": "status", "level": "high"}',
    '{"op": "status", "level": 2, "message": {"a": [1, 2]}}', '{"op": "serverInfo", "capabilities": 5}',
    "[" * 100_000, '{"op": ' + '{"a": ' * 50_000, "9" * 50_000, "\0\0\0", "\ud7ff\uffff",
    '{"op": "advertise", "channels": [{"id": 1e999, "topic": "/x", "encoding": "cdr", "schemaName": "a/b"}]}',
    channel(id=None), channel(id=[1]), channel(id="many " * 100_000), channel(id=-1, topic="/other"),
    channel(id=10**400, topic="/huge"), channel(topic="/\ud800"), channel(schemaName="\ud800"),
    channel(encoding="protobuf", schema="no base64"),
    channel(encoding="protobuf", schemaName="foxglove.PointCloud"),
    channel(schemaName="sensor_msgs/msg/PointCloud2"), channel(encoding="json", schema="{"),
    channel(topic={"a": 1}, schema=[1, 2]), channel(schemaEncoding="ros2idl", schema="module {"),
    b"", b"\x01", b"\x01\0\0", b"\x02" * 40, b"\xff" * 1000, struct.pack("<BIQ", 1, 2**32 - 1, 2**64 - 1),
]  # fmt: skip


def lying_clouds() -> Iterator[bytes]:
    """Payloads for a topic of laser scans: cut, random, and of billions of beams."""
    rng = random.Random(1)
    whole = ros().laser("/scan", T0, np.ones(20)).data
    yield b""
    yield whole[:30]
    yield bytes(rng.randrange(256) for _ in range(300))
    for size in (10**9, 2**31, 2**32 - 1):
        at = len(whole) - 4 - 20 * 4 - 4
        assert struct.unpack_from("<I", whole, at) == (20,)
        yield whole[:at] + struct.pack("<I", size) + whole[at + 4 :]


class Garbage:
    """Says all of `FRAMES` before the robot says anything, and again among its messages."""

    def __init__(self, robot: Robot, topic: str) -> None:
        self._number = next(channel.id() for channel in robot.channels.values() if channel.topic() == topic)
        self._said, self._scans = 0, 0
        self._clouds = list(lying_clouds())

    def __call__(self, frame: Frame) -> Iterator[Frame]:
        if self._said == 0:
            yield from FRAMES
        self._said += 1
        yield FRAMES[self._said % len(FRAMES)]
        yield frame
        if isinstance(frame, bytes) and struct.unpack_from("<BI", frame) == (1, self._number):
            self._scans += 1
            # The first good scans come before: bad ones alone end the search for scans.
            if self._scans > 60 and self._scans % 5 == 0:
                stamp_ns = random.Random(self._scans).choice((0, T0, 2**63, 2**64 - 1))
                cloud = self._clouds[self._scans // 5 % len(self._clouds)]
                yield struct.pack("<BIQ", 1, self._number, stamp_ns) + cloud


def test_a_websocket_that_sends_garbage(
    recording: Path, scans: list[Scan], capfd: pytest.CaptureFixture[str]
) -> None:
    found: list[Scan] = []
    end_s = time.monotonic() + LONG_S
    recorded = Recorded.read(recording)
    with bounded_memory(MOST_BYTES), Robot(recorded) as robot, Proxy(robot, Garbage(robot, "/scan")) as proxy:
        feed = FoxgloveWebsocket(proxy.url, ReadConfig(), QUICK, PATIENT)
        with LiveLog(feed) as live, robot.playing():
            live.on_poll = lambda: len(found) >= len(scans) or time.monotonic() > end_s
            while not live.ended:
                found.extend(live.scans())
            said = feed.tally.take_news()
            report = live.report()
        assert feed.tally.reconnected == 0 and feed.tally.dropped == 0
    assert [scan.stamp_ns for scan in found] == [scan.stamp_ns for scan in scans]
    for a, b in zip(found, scans, strict=True):
        np.testing.assert_array_equal(a.points_m, b.points_m)
    assert sum(report.scans_skipped.values()) > 0
    assert any("not understood" in sentence for sentence in said)
    assert max(map(len, said)) < 1000 and len(said) < 3 * len(FRAMES)
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("kind", ["laser", "cloud"])
def test_bad_scans_alone_end_with_an_error_of_ours(tmp_path: Path, kind: str) -> None:
    """Nothing but clouds and scans that announce more points than they have."""
    to = ros()
    if kind == "laser":
        bad = list(lying_clouds())
        messages = [to.laser("/scan", T0 + k * STEP, np.ones(20)) for k in range(60)]
    else:
        whole = to.cloud("/scan", T0, np.ones((5, 3))).data
        at = whole.index(struct.pack("<II", 1, 5))  # height, width
        bad = [whole[: at + 4] + struct.pack("<I", 10**9) + whole[at + 8 :], whole[:70]]
        messages = [to.cloud("/scan", T0 + k * STEP, np.ones((5, 3))) for k in range(60)]
    messages = [m._replace(data=bad[k % len(bad)]) for k, m in enumerate(messages)]
    found: list[Scan] = []
    end_s = time.monotonic() + LONG_S
    recorded = Recorded.read(write_mcap(tmp_path / "bad.mcap", messages))
    with bounded_memory(MOST_BYTES), Robot(recorded) as robot:
        feed = FoxgloveWebsocket(robot.url, ReadConfig(), QUICK, PATIENT)
        with LiveLog(feed) as live, robot.playing():
            live.on_poll = lambda: time.monotonic() > end_s
            with pytest.raises(Pc2GridError):
                found.extend(live.scans())
    assert not found and time.monotonic() < end_s
