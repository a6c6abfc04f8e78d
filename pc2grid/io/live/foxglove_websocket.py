"""A robot with foxglove_bridge, through its websocket: https://github.com/foxglove/ws-protocol.

The bridge sends the definition of each type, replays topics that are published once to late subscribers, and
publishes messages of its clients, with any middleware (RMW) of the robot.
"""

from __future__ import annotations

import base64
import json
import ssl
import struct
import threading
import time
from collections.abc import Callable, Collection, Hashable, Mapping
from dataclasses import dataclass
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidURI
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from pc2grid.errors import LiveError
from pc2grid.io.live.feed import LIVE, Feed, LiveParameters
from pc2grid.io.messages.ros import short_name
from pc2grid.io.source import RawMessage, TopicInfo
from pc2grid.settings import ReadConfig

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""The protocols of the bridge since version 3.2, and before; the messages used here are the same in both."""
_MESSAGE = 0x01
_HEAD = struct.Struct("<BIQ")  # kind, subscription, time in ns
_SENT_HEAD = struct.Struct("<BI")  # kind, channel


@dataclass(frozen=True, slots=True)
class ConnectionParameters:
    """How a connection is made and kept; chosen by hand.

    open_s : time for one attempt, in which the first connection must succeed, and longest pause between two.
    least_pause_s : between two attempts; the pause doubles each time.
    ping_s : a connection on which nothing answers for so long is made again.
    most_message_bytes : a larger message ends the connection.
    """

    open_s: float = 5.0
    least_pause_s: float = 0.1
    ping_s: float = 10.0
    most_message_bytes: int = 256 << 20


CONNECTION = ConnectionParameters()


class _Link:
    """A websocket that is made again whenever it is lost, until it is closed.

    take : called with each frame. changed : called when the connection was made again (True) or lost (False).
    """

    def __init__(
        self,
        url: str,
        parameters: ConnectionParameters,
        take: Callable[[str | bytes], None],
        changed: Callable[[bool], None],
    ) -> None:
        """Connect. Raises LiveError if the first connection fails."""
        self._url, self._parameters, self._take, self._changed = url, parameters, take, changed
        self._closing = threading.Event()
        self._connection: ClientConnection | None = self._connect_first()
        self._thread = threading.Thread(target=self._run, name="foxglove websocket", daemon=True)

    def start(self) -> None:
        """Begin to take frames."""
        self._thread.start()

    def send(self, message: dict[str, Any] | bytes) -> None:
        """Send a document or a frame; it is lost if there is no connection now."""
        connection = self._connection
        if connection is None:
            return
        try:
            connection.send(message if isinstance(message, bytes) else json.dumps(message))
        except (ConnectionClosed, OSError):
            return

    def close(self) -> None:
        """End the connection and its thread."""
        self._closing.set()
        connection = self._connection
        if connection is not None:
            connection.close()
        self._thread.join(timeout=self._parameters.open_s)

    def _connect_first(self) -> ClientConnection:
        end_s = time.monotonic() + self._parameters.open_s
        while True:
            try:
                return self._connect()
            except LiveError:
                if time.monotonic() + self._parameters.least_pause_s > end_s:
                    raise
            time.sleep(self._parameters.least_pause_s)

    def _connect(self) -> ClientConnection:
        p = self._parameters
        try:
            # As with `with`, which websockets 17 demands; `close` is all that leaving it does.
            return connect(
                self._url,
                subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
                open_timeout=p.open_s,
                close_timeout=1.0,
                ping_interval=p.ping_s,
                ping_timeout=p.ping_s,
                max_size=p.most_message_bytes,
                max_queue=4,
                compression=None,
            ).__enter__()
        except InvalidURI as error:
            raise LiveError(f"{self._url}: not an address", hint="such as ws://robot:8765") from error
        except (InvalidHandshake, OSError, TimeoutError) as error:
            hint = "on the robot: ros2 launch foxglove_bridge foxglove_bridge_launch.xml"
            if isinstance(error, ssl.SSLCertVerificationError):
                hint = "SSL_CERT_FILE=ROBOT.pem in the environment names the certificate that is trusted"
            raise LiveError(f"{self._url}: no connection: {error}", hint=hint) from error

    def _run(self) -> None:
        pause_s = self._parameters.least_pause_s
        while not self._closing.is_set():
            connection = self._connection
            if connection is None:
                try:
                    connection = self._connection = self._connect()
                except LiveError:
                    self._closing.wait(pause_s)
                    pause_s = min(2 * pause_s, self._parameters.open_s)
                    continue
                self._changed(True)
            pause_s = self._parameters.least_pause_s
            try:
                for frame in connection:
                    self._take(frame)
            except (ConnectionClosed, OSError):
                pass
            self._connection = None
            connection.close()
            self._changed(False)
            self._closing.wait(pause_s)


@dataclass(slots=True)
class _Advertised:
    """A topic that is published. last : the frame of its last message; None if it is not sent again."""

    number: int
    type_name: str
    definition: str
    last: bytes | None

    def document(self, topic: str) -> dict[str, Any]:
        """Return the channel as the protocol describes it."""
        return {
            "id": self.number,
            "topic": topic,
            "encoding": "cdr",
            "schemaName": self.type_name,
            "schema": self.definition,
            "schemaEncoding": "ros2msg",
        }


class FoxgloveWebsocket(Feed):
    """The topics of a robot, over a connection that is made again whenever it is lost.

    The number of a subscription is that of its channel.
    """

    def __init__(
        self,
        url: str,
        config: ReadConfig,
        connection: ConnectionParameters = CONNECTION,
        parameters: LiveParameters = LIVE,
    ) -> None:
        """Connect. Raises LiveError if the first connection fails."""
        super().__init__(url, config, parameters)
        self._introduced_s = connection.open_s
        self._advertised: dict[str, _Advertised] = {}
        self._may_publish = False
        self._introduced = threading.Event()
        self._link = _Link(url, connection, self._take, self._connection_changed)
        self._link.start()

    def close(self) -> None:
        """End the connection."""
        super().close()
        self._link.close()

    def _connection_changed(self, connected: bool) -> None:
        self.connected = connected
        if not connected:
            self._withdraw()
            if not self._over:
                self.tally.tell(f"{self.name}: the connection is lost; trying again", again=True)
            return
        self.tally.reconnected += 1
        if self._advertised:
            self._advertise(self._advertised)
            for advertised in self._advertised.values():
                if advertised.last:
                    self._link.send(advertised.last)

    # --- Publisher ------------------------------------------------------------------------------------

    def advertise(self, topic: str, type_name: str, definition: str, *, keep_last: bool) -> None:
        """Announce a topic before `publish` is called for it.

        type_name : such as `nav_msgs/msg/OccupancyGrid`. definition : of the type, in the .msg language.
        keep_last : send the last message again after each new connection.

        Raises LiveError if the robot does not take messages from clients.
        """
        self._introduced.wait(self._introduced_s)
        if not self._may_publish:
            raise LiveError(
                f"{self.name}: does not take messages from clients",
                hint="start foxglove_bridge with `capabilities` that contain clientPublish, the default",
            )
        with self._lock:
            number = len(self._advertised) + 1
            self._advertised[topic] = _Advertised(number, type_name, definition, b"" if keep_last else None)
        self._advertise([topic])

    def publish(self, topic: str, message: bytes) -> None:
        """Send a message in CDR; it is lost if there is no connection at the moment."""
        advertised = self._advertised[topic]
        frame = _SENT_HEAD.pack(_MESSAGE, advertised.number) + message
        if advertised.last is not None:
            advertised.last = frame
        self._link.send(frame)

    def _advertise(self, names: Collection[str]) -> None:
        with self._lock:
            channels = [self._advertised[name].document(name) for name in names]
        self._link.send({"op": "advertise", "channels": channels})

    # --- messages of the server -----------------------------------------------------------------------

    def _take(self, frame: str | bytes) -> None:
        if isinstance(frame, bytes):
            if len(frame) >= _HEAD.size and frame[0] == _MESSAGE:
                _, number, time_ns = _HEAD.unpack_from(frame)
                topic = self._subscriptions.get(number)
                if topic is not None:
                    self._inbox.put(RawMessage(topic, time_ns, memoryview(frame)[_HEAD.size :]))
            return
        try:
            self._take_document(json.loads(frame))
        # RecursionError: lists in lists without end. OverflowError: infinity as a number of a channel.
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            reason = f"{type(error).__name__}: {str(error)[:100]}"
            self.tally.tell(f"{self.name}: a message that is not understood ({reason})")

    def _take_document(self, document: dict[str, Any]) -> None:
        match document["op"]:
            case "advertise":
                for channel in document["channels"]:
                    self._take_channel(channel)
                self._refresh()
            case "unadvertise":
                self._withdraw(document["channelIds"])
            case "serverInfo":
                self._may_publish = "clientPublish" in document.get("capabilities", [])
                self._introduced.set()
            case "status" if document.get("level", 0) >= 1:
                self.tally.tell(f"{self.name} says: {str(document.get('message', ''))[:500]}")

    def _take_channel(self, channel: dict[str, Any]) -> None:
        number, found = int(channel["id"]), _topic_of(channel)
        with self._lock:
            twin = next((t for k, t in self._offered.items() if t.topic == found.topic and k != number), None)
            if twin is not None:
                types = f", as {twin.type} and {found.type}" if twin.type != found.type else ""
                self.tally.tell(f"{found.topic}: published twice{types}; the first is used")
            if twin is None or twin.type != found.type:
                self._offer(number, found)

    def _subscribe(self, new: Mapping[Hashable, TopicInfo]) -> Mapping[Hashable, TopicInfo]:
        # Before it is sent: the first message may come at once.
        self._subscriptions.update(new)
        self._link.send({"op": "subscribe", "subscriptions": [{"id": n, "channelId": n} for n in new]})
        return new

    def _unsubscribe(self, old: Mapping[Hashable, Any]) -> None:
        self._link.send({"op": "unsubscribe", "subscriptionIds": list(old)})


def _topic_of(channel: dict[str, Any]) -> TopicInfo:
    """Return the topic of a channel; the definition of a type of protobuf is sent in base64."""
    encoding, text = str(channel["encoding"]), str(channel.get("schema", ""))
    plain = "ros2msg" if encoding == "cdr" else encoding
    return TopicInfo(
        topic=str(channel["topic"]),
        type=short_name(str(channel["schemaName"])),
        encoding=encoding,
        schema_encoding=str(channel.get("schemaEncoding") or plain),
        schema=base64.b64decode(text) if encoding == "protobuf" else text.encode(),
    )
