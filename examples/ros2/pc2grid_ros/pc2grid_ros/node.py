"""A lifecycle node that finds where the robot is in a database of the building, and tells nav2.

Messages are taken as their bytes (raw=True) and decoded by pc2grid, so any of its sensors will do.
"""

from __future__ import annotations

import contextlib
import importlib
import threading
from collections.abc import Hashable, Mapping
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

import pc2grid
from pc2grid.io.live.feed import Feed
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.nav2 import Nav2Publisher
from pc2grid.io.source import RawMessage, TopicInfo
from pc2grid.settings import ReadConfig
from signature.join.building import map_of
from signature.localization.answer import Answer, answer_in_building
from signature.localization.localizer import Follower, ResetPolicy

PARAMETERS = {"database": "", "topic": "", "publish": "initialpose", "publish_map": False, "map_frame": "map"}
"""With their defaults; `config/pc2grid.yaml` explains them."""
TOLD = {"initialpose": ("/initialpose",), "tf": ("/tf",), "none": ()}
"""Topics, by the parameter `publish`."""
LEVELS = {
    "located": DiagnosticStatus.OK,
    "recovered": DiagnosticStatus.OK,
    "searching": DiagnosticStatus.WARN,
    "off_map": DiagnosticStatus.WARN,
    "doubtful": DiagnosticStatus.WARN,
    "lost": DiagnosticStatus.ERROR,
}
"""How bad each state of an answer is."""


def qos(*, reliable: bool, kept: bool, depth: int) -> QoSProfile:
    """kept : who subscribes later gets the last messages (transient local)."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
    )


def message_class(name: str) -> Any:
    """Return the Python class of a message type such as `sensor_msgs/LaserScan`."""
    package, _, kind = name.replace("/msg/", "/").partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


class RclpyFeed(Feed):
    """The topics of a node's ROS graph as a feed of messages, and where messages are published."""

    def __init__(self, node: LifecycleNode, topic: str | None) -> None:
        super().__init__("this robot", ReadConfig(topic=topic))
        self._node = node
        self._publishers: dict[str, Any] = {}
        self._timer = node.create_timer(0.5, self._discover)

    def _discover(self) -> None:
        for name, types in self._node.get_topic_names_and_types():
            self._offer(name, TopicInfo(topic=name, type=types[0].replace("/msg/", "/"), encoding="cdr"))
        self._refresh()

    def _subscribe(self, new: Mapping[Hashable, TopicInfo]) -> Mapping[Hashable, Any]:
        return {key: self._subscription(topic) for key, topic in new.items()}

    def _subscription(self, topic: TopicInfo) -> Any:
        # Best effort takes from every publisher; static transforms are published once, and kept.
        latched = topic.topic.endswith("tf_static")

        def take(data: bytes) -> None:
            now_ns = self._node.get_clock().now().nanoseconds
            self._inbox.put(RawMessage(topic, now_ns, bytes(data)))

        profile = qos(reliable=latched, kept=latched, depth=100)
        return self._node.create_subscription(message_class(topic.type), topic.topic, take, profile, raw=True)

    def _unsubscribe(self, old: Mapping[Hashable, Any]) -> None:
        for subscription in old.values():
            self._node.destroy_subscription(subscription)

    def advertise(self, topic: str, type_name: str, definition: str, *, keep_last: bool) -> None:
        """Make a publisher, which publishes while the node is active."""
        profile = qos(reliable=True, kept=keep_last, depth=1)
        self._publishers[topic] = self._node.create_lifecycle_publisher(
            message_class(type_name), topic, profile
        )

    def publish(self, topic: str, message: bytes) -> None:
        """Publish a message in CDR."""
        self._publishers[topic].publish(message)

    def close(self) -> None:
        """Remove what the node has of this feed."""
        super().close()
        self._node.destroy_timer(self._timer)
        self._unsubscribe(self._subscriptions)
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)


class Pc2gridNode(LifecycleNode):
    """Configured it has the database, active it follows the robot."""

    def __init__(self) -> None:
        super().__init__("pc2grid")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        self._building, self._robot = contextlib.ExitStack(), contextlib.ExitStack()
        profile = qos(reliable=True, kept=False, depth=1)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", profile)
        self.create_timer(1.0, self._tell_state)
        self._answer: Answer | None = None
        self._problem = ""
        self._stop = threading.Event()

    def _set(self, name: str) -> Any:
        return self.get_parameter(name).value

    # --- lifecycle ------------------------------------------------------------------------------------

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        """Open the database."""
        try:
            if self._set("publish") not in TOLD:
                raise ValueError(f"publish: one of {', '.join(TOLD)}, not {self._set('publish')}")
            self._database = self._building.enter_context(pc2grid.open_database(self._set("database")))
            self._config, self._frames = self._database.config(), self._database.frames()
            self._index = pc2grid.MapIndex.of(self._database, self._config)
        except (pc2grid.Pc2GridError, ValueError) as error:
            self.get_logger().error(str(error))
            self._building.close()
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        """Follow the robot from now on."""
        self._answer, self._problem, self._map_of = None, "", None
        self._resets = ResetPolicy()
        topic = self._set("topic") or None
        self._feed = RclpyFeed(self, topic)
        self._live = self._robot.enter_context(LiveLog(self._feed))
        self._nav2 = self._robot.enter_context(Nav2Publisher(self._feed, self._set("map_frame")))
        self._nav2.announce(*TOLD[self._set("publish")], *(["/map"] if self._set("publish_map") else []))
        self._stop.clear()
        following = threading.Thread(target=self._follow, name="pc2grid", daemon=True)
        self._robot.callback(following.join)
        self._robot.callback(self._stop.set)
        done = super().on_activate(state)  # what is announced can be published now
        following.start()
        return done

    def on_deactivate(self, state: Any) -> TransitionCallbackReturn:
        """Follow it no longer, and publish nothing."""
        self._robot.close()
        return super().on_deactivate(state)

    def on_cleanup(self, state: Any) -> TransitionCallbackReturn:
        """Close the database."""
        self._building.close()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: Any) -> TransitionCallbackReturn:
        """Stop the robot and close the database, from any state."""
        self._robot.close()
        return self.on_cleanup(state)

    # --- the robot ------------------------------------------------------------------------------------

    def _follow(self) -> None:
        """Hand every scan to the localizer, until the node is deactivated."""
        localizer = pc2grid.Localizer(self._index)
        try:
            with Follower(localizer, beside=True, step_m=self._config.relocalize.step_m) as follower:
                # Called several times a second; true ends the stream of scans.
                self._live.on_poll = lambda: self._poll(follower)
                while not self._stop.is_set():
                    for registered, planar_scan in pc2grid.follow(self._live.scans(), self._config):
                        follower.add(registered, planar_scan)
                    follower.restart()
        except pc2grid.Pc2GridError as error:
            if not self._stop.is_set():
                self._problem = str(error)
                self.get_logger().error(self._problem)

    def _poll(self, follower: Follower[Answer]) -> bool:
        for sentence in self._feed.tally.take_news():
            self.get_logger().warning(sentence)
        for answer in follower.take():
            self._tell(answer, follower.lock)
        return self._stop.is_set()

    def _tell(self, found: Answer, lock: threading.Lock) -> None:
        """Publish what follows from an answer. lock : is held to read the database."""
        self._answer = answer = answer_in_building(found, self._frames)
        self.get_logger().info(f"{answer.state} after {answer.path_m:.1f} m")
        if answer.state == "lost":
            self._nav2.stop_tf()
        may_reset = self._resets.allows(answer.state)
        if not answer.is_told or answer.session is None:
            return
        if answer.T_map_base is None or answer.covariance is None:
            return
        stamp_ns, pose = answer.stamp_ns, answer.T_map_base
        if self._set("publish_map") and answer.session != self._map_of:
            self._map_of = answer.session
            with lock:
                self._nav2.map(stamp_ns, map_of(self._database, answer.session, self._frames))
        T_map_odom, odom_frame = answer.T_map_odometry, self._live.poses.frame
        if self._set("publish") == "tf" and T_map_odom is not None and odom_frame is not None:
            self._nav2.start_tf(odom_frame, T_map_odom, self._live.now_ns)
        if self._set("publish") == "initialpose" and may_reset:
            newest = self._live.poses.newest_odometry()
            if newest is not None and T_map_odom is not None:  # the answer is some tenths of a second old
                stamp_ns, pose = newest[0], T_map_odom @ pc2grid.SE2.from_matrix(newest[1])
            self._nav2.initialpose(stamp_ns, pose, answer.covariance)

    def _tell_state(self) -> None:
        """Publish the state for `diagnostic_aggregator` and rqt."""
        answer = self._answer
        state = "searching" if answer is None else answer.state
        status = DiagnosticStatus(level=LEVELS[state], name="pc2grid: localization", message=state)
        if self._problem:
            status.level, status.message = DiagnosticStatus.ERROR, self._problem
        if answer is not None:
            facts = {
                "session": answer.session or "",
                "pose": "" if answer.T_map_base is None else str(answer.T_map_base),
                "confidence": f"{answer.confidence:.2f}",
                "travel_m": f"{answer.path_m:.1f}",
                "search_s": f"{answer.elapsed_s:.2f}",
                "scans_dropped": str(self._live.tally.dropped),
            }
            status.values = [KeyValue(key=key, value=value) for key, value in facts.items()]
        told = DiagnosticArray(status=[status])
        told.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(told)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of `ros2 run pc2grid_ros pc2grid`."""
    rclpy.init(args=arguments)
    node = Pc2gridNode()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    node.on_shutdown(None)
    rclpy.try_shutdown()
