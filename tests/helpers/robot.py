"""A robot: Foxglove's own websocket server, which foxglove_bridge is made of, with the topics of a recording.

What clients publish is kept, to be decoded by `rosbags`. `Proxy` stands between the robot and a client for
what Foxglove's server never does: connections that break without a goodbye, garbage, the subprotocol of
bridges before version 3.2.
"""

from __future__ import annotations

import contextlib
import functools
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import foxglove
from foxglove.websocket import (
    Capability,
    ChannelView,
    Client,
    ClientChannel,
    ServerListener,
    WebSocketServer,
)
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import serve

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
LONG_S = 100.0
"""What takes longer than this on the busiest machine will not happen any more."""
Frame = str | bytes


@dataclass(frozen=True)
class Channel:
    """A topic that the robot publishes. latched: its messages are sent to whoever subscribes later, too."""

    topic: str
    encoding: str
    type: str
    schema_encoding: str
    schema: bytes
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
                    kind = (channel.message_encoding, schema.name, schema.encoding, schema.data)
                    channels[topic] = Channel(topic, *kind, latched=topic.endswith("tf_static"))
                messages.append((channels[topic], message.log_time, message.data))
        return Recorded(tuple(channels.values()), tuple(messages))


def _when_free(start: Callable[[], WebSocketServer]) -> WebSocketServer:
    """Start a server as soon as its port is free: one that was stopped gives it back in its own time."""
    until_s = time.monotonic() + LONG_S
    while True:
        try:
            return start()
        except RuntimeError as error:
            if "in use" not in str(error) or time.monotonic() > until_s:
                raise
            time.sleep(0.05)


class Robot(ServerListener):
    """The server, until the block ends; it is made by `with`.

    subscriptions : the topics, one entry for each subscription so far. clients : which topics a client is
    subscribed to now.
    """

    def __init__(
        self,
        recorded: Recorded,
        *,
        port: int = 0,
        capabilities: Iterable[Capability] = (Capability.ClientPublish,),
        backlog: int | None = None,
        tls: tuple[bytes, bytes] | None = None,
    ) -> None:
        """port : 0: any that is free. backlog : the messages that may wait for a client; None: all of the
        recording. tls : certificate and key, PEM."""
        self.recorded = recorded
        self.subscriptions: list[str] = []
        self.clients: dict[int, set[str]] = {}
        self._published: list[tuple[ClientChannel, bytes]] = []
        self._advertised: dict[tuple[int, int], ClientChannel] = {}
        self._changed = threading.Condition()
        self._context = foxglove.Context()  # its channels close when it is forgotten
        self.channels = {
            channel: foxglove.Channel(
                channel.topic,
                message_encoding=channel.encoding,
                schema=foxglove.Schema(
                    name=channel.type, encoding=channel.schema_encoding, data=channel.schema
                ),
                context=self._context,
            )
            for channel in recorded.channels
        }
        certificate, key = tls or (None, None)
        start = functools.partial(
            foxglove.start_server,
            name="robot",
            port=port,
            capabilities=[*capabilities],
            server_listener=self,
            supported_encodings=["cdr"],
            context=self._context,
            message_backlog_size=2 * len(recorded.messages) if backlog is None else backlog,
            tls_cert=certificate,
            tls_key=key,
        )
        self._server = _when_free(start)
        self.port = self._server.port
        self.url = f"{'wss' if tls else 'ws'}://127.0.0.1:{self.port}"

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *error: object) -> None:
        self._server.stop()

    def wait(self, done: Callable[[], bool]) -> None:
        """Wait until clients have done what makes `done` true."""
        with self._changed:
            assert self._changed.wait_for(done, LONG_S)

    def wait_for_client(self) -> None:
        """Wait until a client is subscribed to all topics."""
        topics = {channel.topic for channel in self.recorded.channels}
        self.wait(lambda: topics in self.clients.values())

    def play(self, messages: Iterable[tuple[Channel, int, bytes]] | None = None) -> None:
        """Send messages at once; None: all of the recording. Those of latched topics are left out."""
        for channel, time_ns, data in self.recorded.messages if messages is None else messages:
            if not channel.latched:
                self.channels[channel].log(data, log_time=time_ns)

    @contextlib.contextmanager
    def playing(self, end_ns: int | None = None) -> Iterator[None]:
        """Beside the block: play the recording, to before `end_ns`, once a client is there."""

        def play() -> None:
            self.wait_for_client()
            self.play(m for m in self.recorded.messages if end_ns is None or m[1] < end_ns)

        thread = threading.Thread(target=play, daemon=True)
        thread.start()
        yield
        thread.join(LONG_S)

    def told(self) -> list[tuple[str, Any]]:
        """What clients have published so far: topic and message."""
        store = get_typestore(Stores.ROS2_HUMBLE)
        with self._changed:
            published = list(self._published)
        assert {(c.encoding, c.schema_encoding) for c, _ in published} <= {("cdr", "ros2msg")}
        return [(c.topic, store.deserialize_cdr(data, c.schema_name)) for c, data in published]

    # --- called by the server, in its threads -----------------------------------------------------------

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        for known, time_ns, data in self.recorded.messages:
            if known.latched and known.topic == channel.topic:
                self.channels[known].log(data, log_time=time_ns)
        with self._changed:
            self.subscriptions.append(channel.topic)
            self.clients.setdefault(client.id, set()).add(channel.topic)
            self._changed.notify_all()

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Is called when a client leaves, too, after its last message."""
        with self._changed:
            self.clients[client.id].discard(channel.topic)
            if not self.clients[client.id]:
                del self.clients[client.id]
            self._changed.notify_all()

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        with self._changed:
            self._advertised[client.id, channel.id] = channel

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        with self._changed:
            self._published.append((self._advertised[client.id, client_channel_id], data))
            self._changed.notify_all()


class Proxy:
    """Passes frames on between clients and the robot, until the block ends; it is made by `with`.

    tamper : what is sent in place of a frame of the robot. subprotocol : the only one that clients may speak.
    """

    def __init__(
        self,
        robot: Robot,
        tamper: Callable[[Frame], Iterable[Frame]] = lambda frame: [frame],
        subprotocol: str = SUBPROTOCOLS[0],
    ) -> None:
        self._robot, self._tamper = robot, tamper
        self._clients: list[Any] = []
        options: dict[str, Any] = {"subprotocols": [subprotocol], "compression": None}
        self._server = serve(self._serve, "127.0.0.1", 0, **options)
        self.url = f"ws://127.0.0.1:{self._server.socket.getsockname()[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def __enter__(self) -> Proxy:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self.cut()
        self._thread.join(LONG_S)

    def cut(self) -> None:
        """Break all connections with clients, without a goodbye."""
        for client in self._clients:
            with contextlib.suppress(OSError):
                client.socket.shutdown(socket.SHUT_RDWR)

    def _serve(self, client: Any) -> None:
        self._clients.append(client)
        options: dict[str, Any] = {"subprotocols": [SUBPROTOCOLS[0]], "compression": None}
        with connect(self._robot.url, **options) as robot:
            back = threading.Thread(target=_pass_on, args=(client, robot, lambda frame: [frame]), daemon=True)
            back.start()
            _pass_on(robot, client, self._tamper)
            back.join(LONG_S)


def _pass_on(source: Any, sink: Any, tamper: Callable[[Frame], Iterable[Frame]]) -> None:
    """Pass frames on until one of the two is gone, then end the other."""
    with contextlib.suppress(ConnectionClosed, OSError):
        for frame in source:
            for sent in tamper(frame):
                sink.send(sent)
    sink.close()
