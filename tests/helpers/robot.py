"""A robot process of our own: it replays a recording as a server that speaks the Foxglove websocket protocol.

It shares no code with the client. What clients publish is kept, to be decoded by `rosbags`.
"""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")


@dataclass(frozen=True)
class Channel:
    """A topic that the robot publishes. latched: its messages are sent to whoever subscribes later, too."""

    id: int
    topic: str
    type: str
    schema: str
    latched: bool


@dataclass(frozen=True)
class Recorded:
    """The messages of an MCAP, by log time: (channel, log time in ns, CDR)."""

    channels: tuple[Channel, ...]
    messages: tuple[tuple[Channel, int, bytes], ...]

    @staticmethod
    def read(path: Path) -> Recorded:
        channels: dict[str, Channel] = {}
        messages = []
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                assert schema is not None
                topic = channel.topic
                if topic not in channels:
                    latched = topic.endswith("tf_static")
                    text = schema.data.decode()
                    channels[topic] = Channel(len(channels) + 1, topic, schema.name, text, latched)
                messages.append((channels[topic], message.log_time, message.data))
        return Recorded(tuple(channels.values()), tuple(messages))


@dataclass
class Robot:
    """The server. `published` is what clients sent: (topic, type, CDR).

    speed : how fast the recording is replayed; it begins when a client subscribes to `begin_topic`, and goes
    on while nobody is connected. cut_after : a connection is cut after so many messages of the replay.
    subprotocol : the only one that it speaks.
    """

    recorded: Recorded
    begin_topic: str = "/scan"
    speed: float = 1.0
    cut_after: int | None = None
    subprotocol: str = SUBPROTOCOLS[0]
    capabilities: tuple[str, ...] = ("clientPublish",)
    silent: frozenset[str] = frozenset()
    published: list[tuple[str, str, bytes]] = field(default_factory=list)
    connections: int = 0
    url: str = ""
    finished: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._clients: dict[Any, dict[int, int]] = {}
        self._begun = threading.Event()
        self._stop = threading.Event()

    @contextlib.contextmanager
    def running(self) -> Iterator[Robot]:
        """Serve on a free port of this machine until the block ends."""
        from websockets.sync.server import serve

        options: dict[str, Any] = {"select_subprotocol": self._select, "compression": None}
        with serve(self._serve, "127.0.0.1", 0, subprotocols=[self.subprotocol], **options) as server:
            self.url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
            threads = [
                threading.Thread(target=server.serve_forever, daemon=True),
                threading.Thread(target=self._replay, daemon=True),
            ]
            for thread in threads:
                thread.start()
            try:
                yield self
            finally:
                self._stop.set()
                self._begun.set()
                server.shutdown()
                for client in list(self._clients):
                    client.close()
                for thread in threads:
                    thread.join(5.0)

    def cut(self) -> None:
        """Cut all connections, without a goodbye."""
        for client in list(self._clients):
            client.socket.close()

    def _select(self, connection: Any, offered: Any) -> Any:
        from websockets.exceptions import NegotiationError

        if self.subprotocol not in offered:
            raise NegotiationError(f"only {self.subprotocol} is spoken")
        return self.subprotocol

    def _serve(self, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        with self._lock:
            self.connections += 1
            self._clients[connection] = {}
        offered: dict[int, tuple[str, str]] = {}
        able = {"capabilities": [*self.capabilities], "supportedEncodings": ["cdr"]}
        info = {"op": "serverInfo", "name": "robot", **able}
        channels = [
            {"id": c.id, "topic": c.topic, "encoding": "cdr", "schemaName": c.type, "schema": c.schema}
            for c in self.recorded.channels
        ]
        try:
            connection.send(json.dumps(info))
            connection.send(json.dumps({"op": "advertise", "channels": channels}))
            for frame in connection:
                if isinstance(frame, bytes):
                    kind, channel = struct.unpack_from("<BI", frame)
                    assert kind == 1
                    self.published.append((*offered[channel], frame[5:]))
                    continue
                document = json.loads(frame)
                if document["op"] == "advertise":
                    for channel in document["channels"]:
                        assert channel["encoding"] == "cdr"
                        offered[channel["id"]] = (channel["topic"], channel["schemaName"])
                elif document["op"] == "subscribe":
                    for wanted in document["subscriptions"]:
                        self._subscribe(connection, wanted["id"], wanted["channelId"])
                elif document["op"] == "unsubscribe":
                    with self._lock:
                        for number in document["subscriptionIds"]:
                            for channel, known in list(self._clients[connection].items()):
                                if known == number:
                                    del self._clients[connection][channel]
        except (ConnectionClosed, OSError):
            pass
        finally:
            with self._lock:
                self._clients.pop(connection, None)

    def _subscribe(self, connection: Any, number: int, channel_id: int) -> None:
        channel = next(c for c in self.recorded.channels if c.id == channel_id)
        with self._lock:
            if channel.latched:
                for which, time_ns, data in self.recorded.messages:
                    if which == channel:
                        connection.send(struct.pack("<BIQ", 1, number, time_ns) + data)
            self._clients[connection][channel_id] = number
        if channel.topic == self.begin_topic:
            self._begun.set()

    def _replay(self) -> None:
        from websockets.exceptions import ConnectionClosed

        self._begun.wait()
        begin_s, first_ns = time.monotonic(), self.recorded.messages[0][1]
        sent = 0
        for channel, time_ns, data in self.recorded.messages:
            played_s = (time_ns - first_ns) * 1e-9
            wait_s = begin_s + played_s / self.speed - time.monotonic()
            if wait_s > 0 and self._stop.wait(wait_s):
                return
            if self.cut_after is not None and sent >= self.cut_after:
                sent = 0
                self.cut()
            if channel.latched or channel.topic in self.silent:
                continue
            with self._lock:
                clients = list(self._clients.items())
            for client, subscribed in clients:
                number = subscribed.get(channel.id)
                if number is not None:
                    sent += 1
                    with contextlib.suppress(ConnectionClosed, OSError):
                        client.send(struct.pack("<BIQ", 1, number, time_ns) + data)
        self.finished.set()


class ZenohRobot:
    """The same recording through a zenoh router, with the keys, tokens and attachments of rmw_zenoh.

    `published` is what clients sent to the topics of `listens`: (topic, type, CDR).
    """

    def __init__(
        self, recorded: Recorded, *, speed: float = 1.0, hash_name: str = "RIHS01_" + "0" * 64
    ) -> None:
        self.recorded, self.speed, self._hash = recorded, speed, hash_name
        self.published: list[tuple[str, str, bytes]] = []
        self.attachments: list[bytes] = []
        self.finished = threading.Event()
        self.port = 0
        self._stop = threading.Event()

    @property
    def url(self) -> str:
        return f"zenoh://127.0.0.1:{self.port}"

    @contextlib.contextmanager
    def running(self, listens: tuple[tuple[str, str], ...] = (), nodes: int = 1) -> Iterator[ZenohRobot]:
        """A router on a free port. listens : topic and type, such as `nav_msgs/msg/OccupancyGrid`, of nodes
        that subscribe. nodes : how many announce that they publish."""
        import zenoh
        from zenoh.ext import CacheConfig, declare_advanced_publisher

        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{self.port}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        # A router hands out what late subscribers need only with timestamps.
        config.insert_json5("timestamping/enabled", "true")
        with zenoh.open(config) as session:
            zid, kept = session.info.zid(), []
            publishers: dict[Channel, Any] = {}
            for number, channel in enumerate(self.recorded.channels):
                kind = mangled(channel.type)
                key = f"0{channel.topic}/{kind}/{self._hash}"
                publishers[channel] = (
                    declare_advanced_publisher(session, key, cache=CacheConfig(10), publisher_detection=True)
                    if channel.latched
                    else session.declare_publisher(key)
                )
                topic = channel.topic.replace("/", "%")
                for node in range(nodes):
                    token = (
                        f"@ros2_lv/0/{zid}/{node}/{number}/MP/%/%/driver{node}/{topic}/{kind}/{self._hash}"
                    )
                    kept.append(session.liveliness().declare_token(f"{token}/::,10:,:,:,,"))
            for number, (topic, type_name) in enumerate(listens, start=50):
                kind = mangled(type_name)
                token = (
                    f"@ros2_lv/0/{zid}/9/{number}/MS/%/%/nav2/{topic.replace('/', '%')}/{kind}/{self._hash}"
                )
                kept.append(session.liveliness().declare_token(f"{token}/::,10:,:,:,,"))

                def heard(sample: Any, topic: str = topic, type_name: str = type_name) -> None:
                    self.published.append((topic, type_name, sample.payload.to_bytes()))
                    self.attachments.append(sample.attachment.to_bytes())

                kept.append(session.declare_subscriber(f"0{topic}/{kind}/{self._hash}", heard))
            thread = threading.Thread(target=self._replay, args=(publishers,), daemon=True)
            thread.start()
            try:
                yield self
            finally:
                self._stop.set()
                thread.join(10.0)

    def _replay(self, publishers: dict[Channel, Any]) -> None:
        for channel, time_ns, data in self.recorded.messages:
            if channel.latched:
                publishers[channel].put(data, attachment=attachment(time_ns))
        scans = next(
            p for c, p in publishers.items() if c.type.endswith(("LaserScan", "PointCloud2", "Image"))
        )
        while not scans.matching_status.matching:
            if self._stop.wait(0.01):
                return
        self._stop.wait(0.3)  # for the subscriptions to the other topics
        begin_s, first_ns = time.monotonic(), self.recorded.messages[0][1]
        for channel, time_ns, data in self.recorded.messages:
            wait_s = begin_s + (time_ns - first_ns) * 1e-9 / self.speed - time.monotonic()
            if wait_s > 0 and self._stop.wait(wait_s):
                return
            if not channel.latched:
                publishers[channel].put(data, attachment=attachment(time_ns))
        self.finished.set()


def mangled(type_name: str) -> str:
    package, _, kind = type_name.partition("/msg/")
    return f"{package}::msg::dds_::{kind}_"


def attachment(stamp_ns: int) -> bytes:
    """As rmw_zenoh serialises it."""
    from zenoh.ext import Int64, z_serialize

    parts: tuple[Any, ...] = (
        "sequence_number",
        Int64(1),
        "source_timestamp",
        Int64(stamp_ns),
        "source_gid",
        bytes(16),
    )
    return b"".join(z_serialize(part).to_bytes() for part in parts)
