"""A robot process of our own: it replays a recording as a server that speaks the Foxglove websocket protocol.

It shares no code with the client. What clients publish is kept, to be decoded by `rosbags`.
"""

from __future__ import annotations

import contextlib
import json
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
