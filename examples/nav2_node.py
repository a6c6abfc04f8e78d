"""A ROS 2 node that tells nav2 where the robot is, for those who have rclpy and want no bridge.

    pip install .                                             # a clone of the sources, into ROS 2's Python
    python3 nav2_node.py building.submaps                     # publishes /initialpose once
    python3 nav2_node.py building.submaps --topic /scan_front

Messages are taken as their bytes (raw=True) and decoded by pc2grid, so no message package is needed for
sensors. Without rclpy, `pc2grid watch ws://robot:8765` does the same from another computer.
"""

from __future__ import annotations

import argparse
import importlib
import threading
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import pc2grid
from pc2grid.config import ReadConfig
from pc2grid.io.live.feed import Feed
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.nav2 import Nav2Publisher
from pc2grid.io.message_source import RawMessage, TopicInfo
from signature.database import open_database
from signature.localization.follower import Follower
from signature.localization.localizer import Estimate, Localizer
from signature.localization.map_index import MapIndex

try:
    import rclpy
    from rclpy.event_handler import SubscriptionEventCallbacks
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
except ModuleNotFoundError:
    rclpy = None


class RclpyFeed(Feed):
    """The topics of the node's ROS graph as a feed, and where messages are published."""

    def __init__(self, node: Any, topic: str | None) -> None:
        super().__init__("this robot", ReadConfig(topic=topic))
        self._node = node
        self._publishers: dict[str, Any] = {}
        node.create_timer(0.5, self._discover)

    def _discover(self) -> None:
        for name, types in self._node.get_topic_names_and_types():
            kind = types[0].replace("/msg/", "/")
            self._offer(name, TopicInfo(topic=name, type=kind, encoding="cdr"))
        self._refresh()

    def _subscribe(self, new: Mapping[Hashable, TopicInfo]) -> Mapping[Hashable, Any]:
        return {key: self._subscription(topic) for key, topic in new.items()}

    def _subscription(self, topic: TopicInfo) -> Any:
        # Best effort takes from every publisher; static transforms are published once and kept for those who
        # ask.
        latched = topic.topic.endswith("tf_static")
        qos = QoSProfile(
            depth=100,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self.news.tell(f"{topic.topic}: QoS does not fit: {event}")
        )

        def take(data: bytes) -> None:
            now_ns = self._node.get_clock().now().nanoseconds
            self._inbox.put(RawMessage(topic, now_ns, bytes(data)))

        return self._node.create_subscription(
            _type(topic.type), topic.topic, take, qos, raw=True, event_callbacks=events
        )

    def _unsubscribe(self, old: Mapping[Hashable, Any]) -> None:
        for subscription in old.values():
            self._node.destroy_subscription(subscription)

    def advertise(self, topic: str, type_name: str, definition: str, *, keep_last: bool) -> None:
        """Make a publisher."""
        durability = DurabilityPolicy.TRANSIENT_LOCAL if keep_last else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        self._publishers[topic] = self._node.create_publisher(_type(type_name), topic, qos)

    def publish(self, topic: str, message: bytes) -> None:
        """Publish a message in CDR."""
        self._publishers[topic].publish(message)


def _type(name: str) -> Any:
    """The Python class of a message type such as `sensor_msgs/LaserScan`."""
    package, _, kind = name.replace("/msg/", "/").partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def main(arguments: Sequence[str] | None = None) -> None:
    """Follow the robot until it is located, and publish /initialpose."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("database")
    parser.add_argument("--topic", help="of the scans, if several fit")
    options = parser.parse_args(arguments)
    if rclpy is None:
        parser.error("there is no rclpy here: source ROS 2, or use `pc2grid watch ws://...`")
    rclpy.init()
    node = rclpy.create_node("pc2grid")
    spin = threading.Thread(target=rclpy.spin, args=(node,), daemon=True)
    feed = RclpyFeed(node, options.topic)
    spin.start()
    with open_database(options.database) as database, LiveLog(feed, ReadConfig(topic=options.topic)) as live:
        config = database.config()
        localizer = Localizer(MapIndex.of(database, config))
        with Nav2Publisher(feed) as publisher, Follower(localizer, beside=True) as follower:
            publisher.announce("/initialpose")
            # Called several times a second; true ends the stream of scans.
            live.on_poll = lambda: tell(node, live, publisher, follower.take())
            while not live.ended:
                for registered, planar_scan in pc2grid.follow(live.scans(), config):
                    follower.add(registered, planar_scan)
                follower.restart()


def tell(node: Any, live: LiveLog, publisher: Nav2Publisher, estimates: Sequence[Estimate]) -> bool:
    """Log what there is to say; publish the pose and return true once the robot is located."""
    for sentence in live.feed.news.take():
        node.get_logger().warning(sentence)
    for estimate in estimates:
        answer = estimate.answer
        node.get_logger().info(f"{estimate.state} after {answer.path_m:.1f} m")
        if answer.T_map_base is None or answer.covariance is None:
            continue
        # The answer is about a scan some tenths of a second ago: apply it to the newest odometry.
        stamp_ns, pose = answer.stamp_ns, answer.T_map_base
        newest = live.newest_odometry()
        if newest is not None and estimate.T_map_odom is not None:
            stamp_ns, pose = newest[0], estimate.T_map_odom @ pc2grid.SE2.from_matrix(newest[1])
        publisher.initialpose(stamp_ns, pose, answer.covariance)
        node.get_logger().info(f"in {answer.session} at {pose}")
        return True
    return False


if __name__ == "__main__":
    main()
