"""The websocket against Foxglove's own server, which is what foxglove_bridge on a robot is made of."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from pc2grid.config import ReadConfig
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.io.live.feed import InboxParameters
from pc2grid.io.live.foxglove_websocket import FoxgloveWebsocket
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.nav2 import POSE, Nav2Publisher
from tests.helpers.recordings import laser_drive, write_mcap
from tests.helpers.robot import Recorded

pytest.importorskip("websockets", reason="needs the extra [live]")
foxglove = pytest.importorskip("foxglove", reason="needs the package foxglove-sdk")


def test_scans_come_in_and_the_pose_goes_out(tmp_path: Path) -> None:
    recording = write_mcap(tmp_path / "a.mcap", laser_drive())
    with open_log(recording) as log:
        expected = list(log.scans())[:-1]
    recorded = Recorded.read(recording)
    heard: list[tuple[str, bytes]] = []
    offered: dict[int, str] = {}
    subscribed = threading.Event()

    class Listener(foxglove.ServerListener):  # type: ignore[misc]
        def on_subscribe(self, client: Any, channel: Any) -> None:
            if channel.topic == "/scan":
                subscribed.set()

        def on_client_advertise(self, client: Any, channel: Any) -> None:
            offered[channel.id] = channel.topic

        def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
            heard.append((offered[client_channel_id], data))

    context = foxglove.Context()
    server = foxglove.start_server(
        port=0,
        capabilities=[foxglove.Capability.ClientPublish],
        supported_encodings=["cdr"],
        server_listener=Listener(),
        context=context,
        message_backlog_size=10_000,
    )
    channels = {
        c: foxglove.Channel(
            c.topic,
            schema=foxglove.Schema(name=c.type, encoding="ros2msg", data=c.schema.encode()),
            message_encoding="cdr",
            context=context,
        )
        for c in recorded.channels
    }

    def play() -> None:
        subscribed.wait(60.0)
        time.sleep(0.2)
        for channel, time_ns, data in recorded.messages:
            channels[channel].log(data, log_time=time_ns)
            time.sleep(0.001)

    thread = threading.Thread(target=play, daemon=True)
    thread.start()
    try:
        feed = FoxgloveWebsocket(f"ws://127.0.0.1:{server.port}", ReadConfig(), inbox=InboxParameters(1e6))
        end_s = time.monotonic() + 60.0
        with LiveLog(feed, ReadConfig()) as live:
            found: list[Any] = []
            live.on_poll = lambda: len(found) >= len(expected) or time.monotonic() > end_s
            found.extend(live.scans())
            with Nav2Publisher(feed) as publisher:
                publisher.initialpose(1, SE2(1.0, 2.0, 0.5), np.eye(3))
                while not heard and time.monotonic() < end_s:
                    time.sleep(0.01)
    finally:
        server.stop()
    assert [scan.stamp_ns for scan in found] == [scan.stamp_ns for scan in expected]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.points_m, b.points_m)
        np.testing.assert_array_equal(a.T_base_sensor, b.T_base_sensor)
    ((topic, data),) = heard
    message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, POSE)
    assert topic == "/initialpose"
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == (1.0, 2.0)
