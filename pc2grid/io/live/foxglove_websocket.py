"""A robot with foxglove_bridge, through its websocket: https://github.com/foxglove/ws-protocol.

The bridge hands out the definition of each type, replays topics that are published once to whoever subscribes
late, and publishes what it is sent, with any middleware (RMW) of the robot.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pc2grid import extras
from pc2grid.config import ReadConfig
from pc2grid.errors import LiveError
from pc2grid.io import topics
from pc2grid.io.live.feed import Arrived, FeedCounts, News
from pc2grid.io.live.inbox import INBOX, Inbox, InboxParameters
from pc2grid.io.message_source import RawMessage, TopicInfo
from pc2grid.io.messages.ros_definitions import short_name

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""What the bridge speaks since version 3.2, and before; the messages used here are the same in both."""
_MESSAGE = 0x01
_HEAD = struct.Struct("<BIQ")  # kind, subscription, time in ns
_SENT_HEAD = struct.Struct("<BI")  # kind, channel


@dataclass(frozen=True, slots=True)
class ConnectionParameters:
    """How a connection is made and kept; chosen by hand.

    open_s : time for one attempt. first_s : time in which the first connection must succeed.
    least_pause_s, most_pause_s : between two attempts; the pause doubles each time.
    ping_s : a connection on which nothing answers for so long is made again.
    most_message_bytes : a larger message ends the connection.
    """

    open_s: float = 5.0
    first_s: float = 5.0
    least_pause_s: float = 0.1
    most_pause_s: float = 5.0
    ping_s: float = 10.0
    most_message_bytes: int = 256 << 20


CONNECTION = ConnectionParameters()


class FoxgloveWebsocket:
    """The topics of a robot, over a connection that is made again whenever it is lost."""

    realtime = True

    def __init__(
        self,
        url: str,
        config: ReadConfig,
        parameters: ConnectionParameters = CONNECTION,
        inbox: InboxParameters = INBOX,
    ) -> None:
        """Raises LiveError if the first connection fails, or without the package `websockets`."""
        extras.require({"live": "ws://"})
        self.name = url
        self.counts, self.news = FeedCounts(), News()
        self._url, self._config, self._parameters = url, config, parameters
        self._inbox = Inbox(self.counts, inbox)
        self._lock = threading.Lock()
        self._connection: ClientConnection | None = None
        self._channels: dict[int, TopicInfo] = {}
        self._subscribed: dict[int, TopicInfo] = {}
        self._of_channel: dict[int, int] = {}
        self._topics: dict[tuple[str, str], TopicInfo] = {}
        self._wanted: frozenset[str] | None = None
        self._next_id = 1
        self._offered: dict[str, tuple[int, str, str]] = {}
        self._last: dict[str, bytes] = {}
        self._may_publish = False
        self._introduced = threading.Event()
        self._closing = threading.Event()
        self._connect_first()
        self._thread = threading.Thread(target=self._run, name="foxglove websocket", daemon=True)
        self._thread.start()

    # --- Feed -----------------------------------------------------------------------------------------

    @property
    def ended(self) -> bool:
        """Never, until it is closed: a robot may come back."""
        return self._closing.is_set()

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self._connection is not None

    def topics(self) -> tuple[TopicInfo, ...]:
        """See Feed."""
        with self._lock:
            return tuple(self._topics.values())

    def want(self, topics: Collection[str]) -> None:
        """See Feed."""
        with self._lock:
            self._wanted = frozenset(topics)
            unused = [number for number, t in self._subscribed.items() if t.topic not in self._wanted]
            for number in unused:
                del self._subscribed[number]
            self._of_channel = {c: s for c, s in self._of_channel.items() if s not in unused}
        if unused:
            self._send({"op": "unsubscribe", "subscriptionIds": unused})
        self._subscribe()

    def keep_up(self) -> None:
        """See Feed."""
        self._inbox.keep_up()

    def pending(self, topics: Collection[str]) -> Sequence[RawMessage]:
        """See Feed."""
        return self._inbox.pending(topics)

    def receive(self, timeout_s: float) -> Arrived | None:
        """See Feed."""
        return self._inbox.get(timeout_s)

    def close(self) -> None:
        """End the connection and its thread."""
        self._closing.set()
        connection = self._connection
        if connection is not None:
            connection.close()
        self._thread.join(timeout=self._parameters.open_s)

    # --- Publisher ------------------------------------------------------------------------------------

    def advertise(self, topic: str, type_name: str, definition: str, *, keep_last: bool) -> None:
        """Announce a topic that `publish` will be called for.

        type_name : such as `nav_msgs/msg/OccupancyGrid`. definition : of the type, in the .msg language.
        keep_last : send the last message again after each new connection.

        Raises LiveError if the robot does not take messages from clients.
        """
        self._introduced.wait(self._parameters.open_s)
        if not self._may_publish:
            raise LiveError(
                f"{self.name}: does not take messages from clients",
                hint="start foxglove_bridge with `capabilities` that contain clientPublish, the default",
            )
        with self._lock:
            number = len(self._offered) + 1
            self._offered[topic] = (number, type_name, definition)
            if keep_last:
                self._last.setdefault(topic, b"")
        self._advertise([topic])

    def publish(self, topic: str, message: bytes) -> None:
        """Send a message in CDR; it is lost if there is no connection at the moment."""
        with self._lock:
            frame = _SENT_HEAD.pack(_MESSAGE, self._offered[topic][0]) + message
            if topic in self._last:
                self._last[topic] = frame
        self._send(frame)

    def _advertise(self, names: Collection[str]) -> None:
        channels = [
            {
                "id": number,
                "topic": topic,
                "encoding": "cdr",
                "schemaName": type_name,
                "schema": definition,
                "schemaEncoding": "ros2msg",
            }
            for topic, (number, type_name, definition) in self._offered.items()
            if topic in names
        ]
        if channels:
            self._send({"op": "advertise", "channels": channels})

    # --- connection -----------------------------------------------------------------------------------

    def _connect_first(self) -> None:
        """Connect, and wait for what the server says about itself."""
        end_s = time.monotonic() + self._parameters.first_s
        while True:
            try:
                self._connection = self._connect()
                return
            except LiveError:
                if time.monotonic() + self._parameters.least_pause_s > end_s:
                    raise
            time.sleep(self._parameters.least_pause_s)

    def _connect(self) -> ClientConnection:
        from websockets.exceptions import InvalidHandshake, InvalidURI
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        p = self._parameters
        problem: Exception | None = None
        for subprotocol in SUBPROTOCOLS:
            try:
                # As with `with`, which websockets 17 demands; `close` is all that leaving it does.
                return connect(
                    self._url,
                    subprotocols=[Subprotocol(subprotocol)],
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
            except InvalidHandshake as error:  # an older or newer bridge refuses the other subprotocol
                problem = error
            except (OSError, TimeoutError) as error:
                problem = error
                break
        raise LiveError(
            f"{self._url}: no connection: {problem}",
            hint="on the robot: ros2 launch foxglove_bridge foxglove_bridge_launch.xml",
        )

    def _run(self) -> None:
        """Read from the connection, and make it again when it is lost, until it is closed."""
        from websockets.exceptions import ConnectionClosed

        pause_s = self._parameters.least_pause_s
        while not self._closing.is_set():
            connection = self._connection
            if connection is None:
                try:
                    connection = self._connect()
                except LiveError:
                    self._closing.wait(pause_s)
                    pause_s = min(2 * pause_s, self._parameters.most_pause_s)
                    continue
                self.counts.reconnected += 1
                self._connection = connection
                self._advertise(list(self._offered))
                for last in self._last.values():
                    if last:
                        self._send(last)
            pause_s = self._parameters.least_pause_s
            try:
                for frame in connection:
                    self._take(frame)
            except (ConnectionClosed, OSError):
                pass
            self._lose()
        self._inbox.wake()

    def _lose(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()
        with self._lock:
            self._channels.clear()
            self._subscribed.clear()
            self._of_channel.clear()
        if not self._closing.is_set():
            self.news.tell(f"{self.name}: the connection is lost; trying again", again=True)
            self._closing.wait(self._parameters.least_pause_s)

    def _send(self, message: dict[str, Any] | bytes) -> None:
        """Send a document or a frame; what cannot be sent now is sent after the next connection, if at
        all."""
        connection = self._connection
        if connection is None:
            return
        from websockets.exceptions import ConnectionClosed

        try:
            connection.send(message if isinstance(message, bytes) else json.dumps(message))
        except (ConnectionClosed, OSError):
            return

    # --- what the server says -------------------------------------------------------------------------

    def _take(self, frame: str | bytes) -> None:
        if isinstance(frame, bytes):
            if len(frame) < _HEAD.size or frame[0] != _MESSAGE:
                return
            _, subscription, time_ns = _HEAD.unpack_from(frame)
            topic = self._subscribed.get(subscription)
            if topic is not None:
                self._inbox.put(RawMessage(topic, time_ns, memoryview(frame)[_HEAD.size :]))
            return
        try:
            document = json.loads(frame)
            operation = document["op"]
            if operation == "advertise":
                self._take_channels(document["channels"])
            elif operation == "unadvertise":
                self._forget_channels(document["channelIds"])
            elif operation == "serverInfo":
                self._may_publish = "clientPublish" in document.get("capabilities", [])
                self._introduced.set()
            elif operation == "status" and document.get("level", 0) >= 1:
                self.news.tell(f"{self.name} says: {str(document.get('message', ''))[:500]}")
        # RecursionError: lists in lists without end. OverflowError: infinity as a number of a channel.
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            reason = f"{type(error).__name__}: {str(error)[:100]}"
            self.news.tell(f"{self.name}: a message that is not understood ({reason})")

    def _take_channels(self, channels: Sequence[dict[str, Any]]) -> None:
        with self._lock:
            for channel in channels:
                encoding = str(channel["encoding"])
                kind = str(channel["schemaName"])
                found = TopicInfo(
                    topic=str(channel["topic"]),
                    type=short_name(kind),
                    encoding=encoding,
                    schema_encoding=_schema_encoding(channel),
                    schema=_schema(channel),
                )
                twin = next((t for t in self._channels.values() if t.topic == found.topic), None)
                if twin is not None and channel["id"] not in self._channels:
                    self.news.tell(
                        f"{found.topic}: published twice"
                        + (f", as {twin.type} and {found.type}" if twin.type != found.type else "")
                        + "; the first is used"
                    )
                    if twin.type == found.type:
                        continue
                self._topics.setdefault((found.topic, found.type), found)
                self._channels[int(channel["id"])] = self._topics[found.topic, found.type]
        self._subscribe()

    def _forget_channels(self, numbers: Sequence[int]) -> None:
        with self._lock:
            for number in numbers:
                self._channels.pop(number, None)
                self._subscribed.pop(self._of_channel.pop(number, -1), None)

    def _subscribe(self) -> None:
        """Subscribe to the channels that are wanted and new."""
        with self._lock:
            there = list(self._channels.values())
            new: list[dict[str, int]] = []
            for number, topic in self._channels.items():
                if number in self._of_channel or not self._is_wanted(topic, there):
                    continue
                self._of_channel[number] = self._next_id
                self._subscribed[self._next_id] = topic
                new.append({"id": self._next_id, "channelId": number})
                self._next_id += 1
        if new:
            self._send({"op": "subscribe", "subscriptions": new})

    def _is_wanted(self, topic: TopicInfo, there: Sequence[TopicInfo]) -> bool:
        if self._wanted is not None:
            return topic.topic in self._wanted
        return topics.may_be_used(topic, there, self._config.topic)


def _schema_encoding(channel: dict[str, Any]) -> str:
    given = channel.get("schemaEncoding")
    if isinstance(given, str) and given:
        return given
    return "ros2msg" if channel["encoding"] == "cdr" else str(channel["encoding"])


def _schema(channel: dict[str, Any]) -> bytes:
    """The definition of a type as bytes; that of protobuf is sent in base64."""
    text = str(channel.get("schema", ""))
    if channel["encoding"] != "protobuf":
        return text.encode()
    import base64

    return base64.b64decode(text)
