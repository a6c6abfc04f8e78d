"""The ROS 2 package of examples/, with stand-ins for rclpy and the messages, which no package index has.

They are written from the public interfaces: https://docs.ros.org/en/jazzy/p/rclpy, and the definitions of
the messages.
"""

import ast
import importlib.util
import math
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from pc2grid.io.maps import save_map
from pc2grid.io.trajectory import read_tum
from pc2grid.simulate import SimulationConfig, simulate_session
from signature.config import Config
from signature.sessions import add_sessions, build_session
from tests.helpers.robot import Recorded
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import office

PACKAGE = Path(__file__).resolve().parent.parent / "examples" / "ros2" / "pc2grid_ros"
STORE = get_typestore(Stores.ROS2_JAZZY)
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POLICY = SimpleNamespace(
    RELIABLE="reliable", BEST_EFFORT="best effort", TRANSIENT_LOCAL="kept", VOLATILE="not kept"
)


def message(name: str) -> type:
    """A class like those that rosidl makes: fields by keyword, with defaults; no other attributes."""
    constants, fields = STORE.fielddefs[name]
    defaults = {field: default(*kind) for field, kind in fields}

    def begin(self: Any, **given: Any) -> None:
        for field, value in {key: make() for key, make in defaults.items()}.items():
            setattr(self, field, given.pop(field, value))
        assert not given, f"{name} has no {given}"

    bits = {key: bytes([value]) if kind == "byte" else value for key, kind, value in constants}
    kind = name.rpartition("/")[2]
    return type(kind, (), {"__slots__": tuple(defaults), "__init__": begin, "__msgtype__": name, **bits})


def default(kind: Any, of: Any) -> Callable[[], Any]:
    if kind.name == "NAME":
        return message(of)
    if kind.name == "BASE":
        return {"string": str, "byte": lambda: b"\0"}.get(of[0], int)
    return list


def plain(value: Any) -> Any:
    """A message as one of rosbags', which has the same definitions."""
    if isinstance(value, bytes):
        return value[0]
    if isinstance(value, list):
        return [plain(member) for member in value]
    if hasattr(value, "__msgtype__") and hasattr(value, "__slots__"):
        fields = {field: plain(getattr(value, field)) for field in value.__slots__}
        return STORE.types[value.__msgtype__](**fields)
    return value


class Publisher:
    """Takes bytes or messages; one of a lifecycle node only while that is active."""

    def __init__(self, kind: type, topic: str, qos: Any, *, active: bool) -> None:
        self.kind, self.topic, self.qos, self.active = kind, topic, qos, active
        self.sent: list[Any] = []

    def publish(self, told: Any) -> None:
        assert isinstance(told, (bytes, self.kind))
        if self.active:
            self.sent.append(told)


class LifecycleNode:
    """What the package uses of rclpy's class."""

    given: dict[str, Any]

    def __init__(self, node_name: str) -> None:
        self.parameters: dict[str, Any] = {}
        self.timers: list[Callable[[], None]] = []
        self.subscriptions: dict[str, Any] = {}
        self.publishers: dict[str, Publisher] = {}
        self.said: list[str] = []
        self.now_ns = 0
        self.topics: list[tuple[str, list[str]]] = []

    def declare_parameter(self, name: str, value: Any) -> None:
        self.parameters[name] = self.given.get(name, value)

    def get_parameter(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(value=self.parameters[name])

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return self.topics

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> Callable[[], None]:
        self.timers.append(callback)
        return callback

    def destroy_timer(self, timer: Callable[[], None]) -> bool:
        self.timers.remove(timer)
        return True

    def create_subscription(
        self, msg_type: type, topic: str, callback: Callable[[Any], None], qos_profile: Any, *, raw: bool
    ) -> str:
        assert raw and msg_type.__name__ == dict(self.topics)[topic][0].rpartition("/")[2]
        self.subscriptions[topic] = SimpleNamespace(take=callback, qos=qos_profile)
        return topic

    def destroy_subscription(self, subscription: str) -> bool:
        return self.subscriptions.pop(subscription) is not None

    def create_publisher(self, msg_type: type, topic: str, qos_profile: Any) -> Publisher:
        made = self.publishers[topic] = Publisher(msg_type, topic, qos_profile, active=True)
        return made

    def create_lifecycle_publisher(self, msg_type: type, topic: str, qos_profile: Any) -> Publisher:
        made = self.publishers[topic] = Publisher(msg_type, topic, qos_profile, active=False)
        return made

    def destroy_lifecycle_publisher(self, publisher: Publisher) -> bool:
        publisher.active = False
        return True

    def get_clock(self) -> SimpleNamespace:
        stamp = {"sec": self.now_ns // 10**9, "nanosec": self.now_ns % 10**9}
        now = SimpleNamespace(
            nanoseconds=self.now_ns, to_msg=lambda: message("builtin_interfaces/msg/Time")(**stamp)
        )
        return SimpleNamespace(now=lambda: now)

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(info=self.said.append, warning=self.said.append, error=self.said.append)

    def on_activate(self, state: Any) -> str:
        for publisher in self.publishers.values():
            publisher.active = True
        return "success"

    def on_deactivate(self, state: Any) -> str:
        return "success"

    # --- of the test ----------------------------------------------------------------------------------

    def play(self, recorded: Recorded, over: Callable[[], bool]) -> None:
        """Play a recording in real time, as an executor would spin, until `over`."""
        self.topics = [(channel.topic, [channel.type]) for channel in recorded.channels]
        first_ns = self.now_ns = recorded.messages[0][1]
        for timer in list(self.timers):
            timer()
        begin_s = time.monotonic()
        for channel, time_ns, data in recorded.messages:
            time.sleep(max(begin_s + (time_ns - first_ns) * 1e-9 - time.monotonic(), 0.0))
            self.now_ns = time_ns
            if channel.topic in self.subscriptions:
                self.subscriptions[channel.topic].take(data)
            if over():
                return
        end_s = time.monotonic() + 100.0
        while not over() and time.monotonic() < end_s:
            time.sleep(0.05)


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module of the node, imported with the stand-ins."""

    def module(name: str, **contents: Any) -> None:
        found = ModuleType(name)
        vars(found).update(contents)
        monkeypatch.setitem(sys.modules, name, found)

    results = SimpleNamespace(SUCCESS="success", FAILURE="failure")
    module("rclpy")
    module("rclpy.executors", ExternalShutdownException=type("ExternalShutdownException", (Exception,), {}))
    module("rclpy.lifecycle", LifecycleNode=LifecycleNode, TransitionCallbackReturn=results)
    module("rclpy.qos", QoSProfile=SimpleNamespace, ReliabilityPolicy=POLICY, DurabilityPolicy=POLICY)
    for package, kinds in {
        "sensor_msgs": ("LaserScan",),
        "tf2_msgs": ("TFMessage",),
        "nav_msgs": ("Odometry", "OccupancyGrid"),
        "geometry_msgs": ("PoseWithCovarianceStamped",),
        "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
    }.items():
        module(f"{package}.msg", **{kind: message(f"{package}/msg/{kind}") for kind in kinds})
    spec = importlib.util.spec_from_file_location("pc2grid_ros_node", PACKAGE / "pc2grid_ros" / "node.py")
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    yield loaded
    assert not [thread for thread in threading.enumerate() if thread.name == "pc2grid"]


@shared_folder()
def folder(folder: Path) -> None:
    """plan.submaps of the office, and tuesday.mcap of a laser in it."""
    save_map(office(), folder / "plan")
    built = build_session(folder / "plan.yaml", "plan", Config())
    add_sessions(folder / "plan.submaps", [built], Config(), keep=False)
    config = SimulationConfig(length_m=3.0, seed=7, clutter=0, start_m=(10.0, 7.0))
    simulate_session(folder / "tuesday.mcap", sensor="laser", grid=office(), config=config)


def activated(module: Any, **given: Any) -> Any:
    LifecycleNode.given = given
    node = module.Pc2gridNode()
    assert node.on_configure(None) == "success", node.said
    assert node.on_activate(None) == "success"
    return node


def diagnosed(node: Any) -> Any:
    node.timers[0]()
    told = plain(node.publishers["/diagnostics"].sent[-1])
    STORE.serialize_cdr(told, told.__msgtype__)
    (status,) = told.status
    return status


def test_the_node_tells_nav2_where_the_robot_is(node_module: Any, folder: Path) -> None:
    node = activated(node_module, database=str(folder / "plan.submaps"), publish_map=True)
    assert (diagnosed(node).level, diagnosed(node).message) == (1, "searching")
    node.play(Recorded.read(folder / "tuesday.mcap"), lambda: bool(node.publishers["/initialpose"].sent))
    (data,) = node.publishers["/initialpose"].sent
    told = STORE.deserialize_cdr(data, POSE)
    stamp_ns = told.header.stamp.sec * 10**9 + told.header.stamp.nanosec
    truth = read_tum(folder / "tuesday.tum")
    pose = truth.T_session_base[int(np.argmin(np.abs(truth.stamps_ns - stamp_ns)))]
    assert told.header.frame_id == "map"
    assert math.dist((told.pose.pose.position.x, told.pose.pose.position.y), pose[:2, 3]) < 0.1
    (grid,) = (
        STORE.deserialize_cdr(data, "nav_msgs/msg/OccupancyGrid") for data in node.publishers["/map"].sent
    )
    assert grid.info.resolution == pytest.approx(0.05) and {-1, 0, 100} >= set(np.unique(grid.data).tolist())
    status = diagnosed(node)
    assert (status.level, status.message) == (0, "located")
    assert {"session", "pose", "confidence"} <= {value.key for value in status.values}
    kept = {topic: (p.qos.reliability, p.qos.durability) for topic, p in node.publishers.items()}
    assert kept["/initialpose"] == ("reliable", "not kept") and kept["/map"] == ("reliable", "kept")
    heard = {topic: (s.qos.reliability, s.qos.durability) for topic, s in node.subscriptions.items()}
    assert heard == {"/scan": ("best effort", "not kept"), "/odom": ("best effort", "not kept")}
    assert node.on_deactivate(None) == "success" and node.on_cleanup(None) == "success"
    assert not node.subscriptions and len(node.timers) == 1


def test_the_node_publishes_map_to_odom_while_it_is_active(node_module: Any, folder: Path) -> None:
    node = activated(node_module, database=str(folder / "plan.submaps"), publish="tf")
    node.play(Recorded.read(folder / "tuesday.mcap"), lambda: bool(node.publishers["/tf"].sent))
    told = STORE.deserialize_cdr(node.publishers["/tf"].sent[-1], "tf2_msgs/msg/TFMessage")
    (edge,) = told.transforms
    assert (edge.header.frame_id, edge.child_frame_id) == ("map", "odom")
    node.on_deactivate(None)
    number = len(node.publishers["/tf"].sent)
    assert node.on_activate(None) == "success"  # it begins anew
    assert diagnosed(node).message == "searching"
    node.on_shutdown(None)
    assert len(node.publishers["/tf"].sent) == 0 < number


@pytest.mark.parametrize(
    ("given", "said"),
    [({"database": "none.submaps"}, "none.submaps"), ({"publish": "pose"}, "initialpose, tf, none")],
)
def test_what_cannot_be_configured_is_said(node_module: Any, given: dict[str, str], said: str) -> None:
    LifecycleNode.given = given
    node = node_module.Pc2gridNode()
    assert node.on_configure(None) == "failure"
    assert said in node.said[-1]


def test_the_files_of_the_package_fit_together(node_module: Any) -> None:
    settings = yaml.safe_load((PACKAGE / "config" / "pc2grid.yaml").read_text())
    assert settings["pc2grid"]["ros__parameters"] == node_module.PARAMETERS
    about = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert about.findtext("export/build_type") == "ament_python"
    needed = {element.text for element in about.findall("exec_depend")}
    setup = (PACKAGE / "setup.py").read_text()
    for name in re.findall(r'"((?:launch|config)/[^"]+|package.xml)"', setup):
        assert (PACKAGE / name).is_file(), name
    assert (PACKAGE / "resource" / "pc2grid_ros").is_file()
    assert f'version="{about.findtext("version")}"' in setup
    for file in (PACKAGE / "pc2grid_ros" / "node.py", PACKAGE / "launch" / "pc2grid.launch.py"):
        imported = {
            (node.module or "").partition(".")[0]
            for node in ast.walk(ast.parse(file.read_text()))
            if isinstance(node, ast.ImportFrom)
        }
        ros = {
            name for name in imported if name.endswith("_msgs") or name in ("rclpy", "launch_ros", "launch")
        }
        assert ros <= needed, file
