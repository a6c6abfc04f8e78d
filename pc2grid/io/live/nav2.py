"""Publishing to nav2 in the place of its localization: /initialpose, the transform map -> odom, /map."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from pc2grid.geometry import F64, SE2
from pc2grid.io import export
from pc2grid.model import OccupancyGrid

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"
MAP = "nav_msgs/msg/OccupancyGrid"


@dataclass(frozen=True, slots=True)
class BroadcastParameters:
    """How map -> odom is published: at the rate and with the lead of AMCL.

    period_s : between two messages. ahead_s : by which the stamp lies in the future, so that a transform
    exists for poses before the next message (`transform_tolerance` of AMCL).
    """

    period_s: float = 0.05
    ahead_s: float = 0.5


BROADCAST = BroadcastParameters()


class Outlet(Protocol):
    """A connection to a robot that takes messages.

    Raises LiveError where the robot does not take them.
    """

    def advertise(self, topic: str, type_name: str, definition: str, *, keep_last: bool) -> None:
        """Announce a topic; keep_last: who subscribes later gets the last message (transient local)."""
        ...

    def publish(self, topic: str, message: bytes) -> None:
        """Send a message in CDR."""
        ...


class Nav2Publisher(AbstractContextManager["Nav2Publisher"]):
    """Publishes the place of the robot to nav2. Use as a context manager: leaving it ends the broadcast.

    outlet : target of the messages. map_frame : the frame of nav2's map.
    """

    def __init__(
        self, outlet: Outlet, map_frame: str = "map", parameters: BroadcastParameters = BROADCAST
    ) -> None:
        self._outlet, self._frame, self._parameters = outlet, map_frame, parameters
        self._advertised: set[str] = set()
        self._stop: threading.Event | None = None
        self._thread: threading.Thread | None = None

    def __exit__(self, *error: object) -> None:
        self.stop_tf()

    def announce(self, *topics: str) -> None:
        """Advertise topics before the first message, so that subscribers have time to connect."""
        kinds = {"/initialpose": POSE, "/tf": TF, "/map": MAP}
        for topic in topics:
            if topic not in self._advertised:
                self._advertised.add(topic)
                kind = kinds[topic]
                self._outlet.advertise(topic, kind, export.definition(kind), keep_last=topic == "/map")

    def initialpose(self, stamp_ns: int, T_map_base: SE2, covariance: F64) -> None:
        """Publish the pose of the base once, as AMCL and slam_toolbox take it; covariance (3, 3)."""
        self.announce("/initialpose")
        message = export.initialpose(stamp_ns, T_map_base, covariance, self._frame)
        self._outlet.publish("/initialpose", export.serialized(message))

    def map(self, stamp_ns: int, grid: OccupancyGrid) -> None:
        """Publish the map, also for those who subscribe later."""
        self.announce("/map")
        self._outlet.publish("/map", export.serialized(export.occupancy_grid(stamp_ns, grid, self._frame)))

    def start_tf(self, odom_frame: str, T_map_odom: SE2, now_ns: Callable[[], int]) -> None:
        """Publish map -> odom from now on, in place of what was published before.

        now_ns : the present time of the robot's clock, nanoseconds.
        """
        self.stop_tf()
        self.announce("/tf")
        stop = self._stop = threading.Event()
        T = T_map_odom.lift()

        def broadcast() -> None:
            ahead_ns = round(self._parameters.ahead_s * 1e9)
            while True:
                edges = export.transforms(now_ns() + ahead_ns, [(self._frame, odom_frame, T)])
                self._outlet.publish("/tf", export.serialized(edges))
                if stop.wait(self._parameters.period_s):
                    return

        self._thread = threading.Thread(target=broadcast, name="map -> odom", daemon=True)
        self._thread.start()

    def stop_tf(self) -> None:
        """Stop publishing map -> odom: the robot's place is not known."""
        if self._stop is not None and self._thread is not None:
            self._stop.set()
            self._thread.join()
        self._stop = self._thread = None
