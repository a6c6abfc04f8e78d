"""Robots that send garbage among their messages: what is good comes through, and nothing else happens."""

from __future__ import annotations

import json
import random
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import Pc2GridError
from pc2grid.io import open_log
from pc2grid.io.live.feed import InboxParameters
from pc2grid.io.live.foxglove_websocket import ConnectionParameters, FoxgloveWebsocket
from pc2grid.io.live.live_log import LiveLog
from pc2grid.model import Scan
from pc2grid.settings import ReadConfig
from tests.helpers.memory import bounded_memory
from tests.helpers.recordings import STEP, T0, laser_drive, ros, write_mcap
from tests.helpers.robot import LONG_S, Frame, Proxy, Recorded, Robot

PATIENT = InboxParameters(most_lag_s=1e6)
QUICK = ConnectionParameters(first_s=0.3, least_pause_s=0.001, most_pause_s=0.01)
MOST_BYTES = 512 << 20


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("robot") / "a.mcap", laser_drive())


@pytest.fixture(scope="module")
def expected(recording: Path) -> list[Scan]:
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
    recording: Path, expected: list[Scan], capfd: pytest.CaptureFixture[str]
) -> None:
    found: list[Scan] = []
    end_s = time.monotonic() + LONG_S
    recorded = Recorded.read(recording)
    with (
        bounded_memory(MOST_BYTES),
        Robot(recorded) as robot,
        Proxy(robot, Garbage(robot, "/scan")) as proxy,
    ):
        feed = FoxgloveWebsocket(proxy.url, ReadConfig(), QUICK, PATIENT)
        with LiveLog(feed, ReadConfig()) as live, robot.playing():
            live.on_poll = lambda: len(found) >= len(expected) or time.monotonic() > end_s
            while not live.ended:
                found.extend(live.scans())
            said = feed.news.take()
            report = live.report()
        assert feed.counts.reconnected == 0 and feed.counts.dropped == 0
    assert [scan.stamp_ns for scan in found] == [scan.stamp_ns for scan in expected]
    for a, b in zip(found, expected, strict=True):
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
        with LiveLog(feed, ReadConfig()) as live, robot.playing():
            live.on_poll = lambda: time.monotonic() > end_s
            with pytest.raises(Pc2GridError):
                found.extend(live.scans())
    assert not found and time.monotonic() < end_s
