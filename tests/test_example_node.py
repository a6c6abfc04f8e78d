"""The node of examples/ with a stand-in for rclpy, which no package index has: it locates a robot."""

from __future__ import annotations

import importlib.util
import math
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from pc2grid.io.nav2_map import save_map
from pc2grid.io.trajectory import read_tum
from pc2grid.simulate import SimulationConfig, simulate_session
from signature.config import Config
from signature.sessions import add_sessions, build_session
from tests.helpers.robot import Recorded
from tests.helpers.simulated_drives import office

ROOT = Path(__file__).resolve().parent.parent
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


class Node:
    """What the example uses of rclpy's Node: it plays a recording in real time."""

    def __init__(self, recorded: Recorded) -> None:
        self.recorded = recorded
        self.timers: list[Callable[[], None]] = []
        self.subscriptions: dict[str, Callable[[bytes], None]] = {}
        self.qos: dict[str, Any] = {}
        self.published: list[tuple[str, bytes]] = []
        self.said: list[str] = []
        self.now_ns = recorded.messages[0][1]

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(channel.topic, [channel.type]) for channel in self.recorded.channels]

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        self.timers.append(callback)

    def create_subscription(
        self,
        kind: type,
        topic: str,
        callback: Callable[[bytes], None],
        qos: Any,
        *,
        raw: bool,
        event_callbacks: Any,
    ) -> str:
        assert raw
        assert (
            kind.__name__
            == next(c.type for c in self.recorded.channels if c.topic == topic).rpartition("/")[2]
        )
        event_callbacks.incompatible_qos("RELIABILITY")
        self.subscriptions[topic], self.qos[topic] = callback, qos
        return topic

    def destroy_subscription(self, topic: str) -> None:
        del self.subscriptions[topic]

    def create_publisher(self, kind: type, topic: str, qos: Any) -> SimpleNamespace:
        self.qos[topic] = qos
        return SimpleNamespace(publish=lambda data: self.published.append((topic, data)))

    def get_clock(self) -> SimpleNamespace:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now_ns))

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(info=self.said.append, warning=self.said.append)

    def spin(self) -> None:
        for timer in self.timers:
            timer()
        begin_s, first_ns = time.monotonic(), self.now_ns
        for channel, time_ns, data in self.recorded.messages:
            time.sleep(max(begin_s + (time_ns - first_ns) * 1e-9 - time.monotonic(), 0.0))
            self.now_ns = time_ns
            take = self.subscriptions.get(channel.topic)
            if take is not None:
                take(data)


def stand_in(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    def module(name: str, **contents: Any) -> None:
        found = ModuleType(name)
        vars(found).update(contents)
        monkeypatch.setitem(sys.modules, name, found)

    policy = SimpleNamespace(
        RELIABLE="reliable", BEST_EFFORT="best effort", TRANSIENT_LOCAL="kept", VOLATILE="no"
    )
    module("rclpy", init=lambda: None, create_node=lambda name: node, spin=lambda node: node.spin())
    module("rclpy.event_handler", SubscriptionEventCallbacks=SimpleNamespace)
    module("rclpy.qos", QoSProfile=SimpleNamespace, ReliabilityPolicy=policy, DurabilityPolicy=policy)
    for package, kinds in (
        ("sensor_msgs", ("LaserScan",)),
        ("tf2_msgs", ("TFMessage",)),
        ("nav_msgs", ("Odometry",)),
        ("geometry_msgs", ("PoseWithCovarianceStamped",)),
    ):
        module(f"{package}.msg", **{kind: type(kind, (), {}) for kind in kinds})


def test_the_node_publishes_where_the_robot_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_map(office(), tmp_path / "plan")
    database = tmp_path / "plan.submaps"
    add_sessions(database, [build_session(tmp_path / "plan.yaml", "plan", Config())], Config(), keep=False)
    config = SimulationConfig(length_m=3.0, seed=7, clutter=0, start_m=(10.0, 7.0))
    simulate_session(tmp_path / "tuesday.mcap", sensor="laser", grid=office(), config=config)
    node = Node(Recorded.read(tmp_path / "tuesday.mcap"))
    stand_in(node, monkeypatch)
    spec = importlib.util.spec_from_file_location("nav2_node", ROOT / "examples" / "nav2_node.py")
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    thread = threading.Thread(target=example.main, args=([str(database)],), daemon=True)
    thread.start()
    thread.join(100.0)
    assert not thread.is_alive()
    ((topic, data),) = node.published
    assert topic == "/initialpose"
    message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, POSE)
    stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    truth = read_tum(tmp_path / "tuesday.tum")
    pose = truth.T_session_base[int(np.argmin(np.abs(truth.stamps_ns - stamp_ns)))]
    position = message.pose.pose.position
    assert math.dist((position.x, position.y), pose[:2, 3]) < 0.1
    assert node.qos["/initialpose"].reliability == "reliable"
    assert (node.qos["/tf_static"].durability, node.qos["/scan"].reliability) == ("kept", "best effort")
    assert "/scan: QoS does not fit: RELIABILITY" in node.said
    assert set(node.subscriptions) == {"/scan", "/odom"}
