"""A robot with rmw_zenoh, through the zenoh router that runs on it.

Keys and tokens are those of rmw_zenoh_cpp (https://github.com/ros2/rmw_zenoh, docs/design.md): a topic is
`DOMAIN/TOPIC/TYPE/HASH`, and what exists is announced by liveliness tokens below `@ros2_lv/DOMAIN`. zenoh
connects again by itself when the connection is lost.
"""

from __future__ import annotations

import re
import secrets
import struct
import threading
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from pc2grid import extras
from pc2grid.config import ReadConfig
from pc2grid.errors import ConfigError, LiveError
from pc2grid.io import topics
from pc2grid.io.export import ros_messages as ros
from pc2grid.io.live.feed import Arrived, FeedCounts, News
from pc2grid.io.live.inbox import INBOX, Inbox, InboxParameters
from pc2grid.io.message_source import RawMessage, TopicInfo
from pc2grid.io.read_plan import published_once

_PORT = 7447
_OPEN_MS = 5000
"""Time in which the first connection must succeed; chosen by hand."""
_TOKENS = "@ros2_lv"
_NO_HASH = "TypeHashNotSupported"  # ROS 2 Humble
_RELIABLE = "::,10:,:,:,,"  # rmw_qos_profile_default
_TRANSIENT_LOCAL = ":1:,1:,:,:,,"  # durability 1 (rmw/types.h), the last message kept
_BEST_EFFORT = "2"
_STAMP = b"source_timestamp"
# https://design.ros2.org/articles/topic_and_service_names.html
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE = re.compile(r"[A-Za-z0-9_]+(::[A-Za-z0-9_]+)+")


@dataclass(frozen=True, slots=True)
class Token:
    """What one liveliness token says. kind : MP of a publisher, MS of a subscription. qos : as in
    rmw_zenoh."""

    kind: str
    node: str
    topic: str
    type: str
    hash: str
    qos: str

    @staticmethod
    def of(key: str) -> Token | None:
        """The token with this key; None for those of nodes and services, of other programs, and with names
        that ROS 2 does not allow, which would be no keys of zenoh either."""
        parts = key.split("/")
        if len(parts) < 13 or parts[0] != _TOKENS or parts[5] not in ("MP", "MS"):
            return None
        namespace, name = parts[7].replace("%", "/"), parts[8]
        node, topic = f"{namespace.rstrip('/')}/{name}", parts[9].replace("%", "/")
        if not _TOPIC.fullmatch(topic) or not _TYPE.fullmatch(parts[10]):
            return None
        return Token(parts[5], node, topic, parts[10], parts[11], parts[12])

    @property
    def info(self) -> TopicInfo:
        """The topic. Its type has no definition here: decoders rely on the name."""
        package, _, name = self.type.partition("::")
        kind = name.rpartition("::")[2].removesuffix("_")
        return TopicInfo(topic=self.topic, type=f"{package}/{kind}", encoding="cdr")

    @property
    def best_effort(self) -> bool:
        """Whether messages may get lost on the way."""
        return self.qos.split(":")[0] == _BEST_EFFORT


class ZenohSession:
    """The topics of a robot in one ROS domain."""

    realtime = True

    def __init__(self, url: str, config: ReadConfig, inbox: InboxParameters = INBOX) -> None:
        """url : `zenoh://ROBOT:7447`, or `zenoh://ROBOT:7447/DOMAIN` for another ROS_DOMAIN_ID than 0.

        Raises LiveError if there is no connection, or without the package `eclipse-zenoh`, ConfigError for an
        address of another form.
        """
        self.name = url
        self.counts, self.news = FeedCounts(), News()
        self._config = config
        self._inbox = Inbox(self.counts, inbox)
        host, self._domain = _address(url)
        self._lock = threading.RLock()
        self._tokens: dict[str, Token] = {}
        self._subscribers: dict[str, Any] = {}
        self._topics: dict[tuple[str, str], TopicInfo] = {}
        self._wanted: frozenset[str] | None = None
        self._offered: dict[str, tuple[str, bool]] = {}
        self._publishers: dict[str, Any] = {}
        self._own_tokens: list[Any] = []
        self._sequence = 0
        self._gid = secrets.token_bytes(16)
        self._closed = False
        self._was_connected = True
        self._session = _open(url, host)
        liveliness = self._session.liveliness()
        self._watching = liveliness.declare_subscriber(
            f"{_TOKENS}/{self._domain}/**", self._take_token, history=True
        )

    # --- Feed -----------------------------------------------------------------------------------------

    @property
    def ended(self) -> bool:
        """Never, until it is closed: a robot may come back."""
        return self._closed

    @property
    def connected(self) -> bool:
        """Whether there is a router."""
        info = self._session.info
        return bool(info.routers_zid() or info.peers_zid())

    def topics(self) -> tuple[TopicInfo, ...]:
        """See Feed."""
        with self._lock:
            return tuple(self._topics.values())

    def want(self, topics: Collection[str]) -> None:
        """See Feed."""
        with self._lock:
            self._wanted = frozenset(topics)
            unused = [name for name in self._subscribers if name not in self._wanted]
            dropped = [self._subscribers.pop(name) for name in unused]
        for subscriber in dropped:
            subscriber.undeclare()
        self._subscribe()

    def keep_up(self) -> None:
        """See Feed."""
        self._inbox.keep_up()

    def pending(self, topics: Collection[str]) -> Sequence[RawMessage]:
        """See Feed."""
        return self._inbox.pending(topics)

    def receive(self, timeout_s: float) -> Arrived | None:
        """See Feed."""
        arrived = self._inbox.get(timeout_s)
        if arrived is None:
            self._tell_connection()
        return arrived

    def close(self) -> None:
        """End the session."""
        if not self._closed:
            self._closed = True
            self._inbox.wake()
            self._session.close()

    # --- Publisher ------------------------------------------------------------------------------------

    def advertise(self, topic: str, type_name: str, definition: str, *, keep_last: bool) -> None:
        """Announce a topic that `publish` will be called for.

        type_name : such as `nav_msgs/msg/OccupancyGrid`. definition : not needed here.
        keep_last : who subscribes later gets the last message.
        """
        self._offered[topic] = type_name, keep_last

    def publish(self, topic: str, message: bytes) -> None:
        """Send a message in CDR."""
        with self._lock:
            if topic not in self._publishers:
                self._publishers[topic] = self._declare(topic, *self._offered[topic])
            self._sequence += 1
            number = self._sequence
        self._publishers[topic].put(message, attachment=_attachment(number, self._gid))

    def _declare(self, topic: str, type_name: str, keep_last: bool) -> Any:
        """A publisher, and the tokens by which the robot's nodes know it as one of a node `pc2grid`.

        It is made with the first message, when the nodes of the robot, and so the hash that they use, are
        known.
        """
        from zenoh.ext import CacheConfig, MissDetectionConfig, declare_advanced_publisher

        package, _, kind = type_name.partition("/msg/")
        mangled = f"{package}::msg::dds_::{kind}_"
        name_of_hash = self._hash_of(topic, mangled) or ros.type_hash(type_name)
        zid = self._session.info.zid()
        node = f"{_TOKENS}/{self._domain}/{zid}/0"
        qos = _TRANSIENT_LOCAL if keep_last else _RELIABLE
        entity = f"{topic.replace('/', '%')}/{mangled}/{name_of_hash}/{qos}"
        number = len(self._publishers) + 1
        for token in (f"{node}/0/NN/%/%/pc2grid", f"{node}/{number}/MP/%/%/pc2grid/{entity}"):
            self._own_tokens.append(self._session.liveliness().declare_token(token))
        options: dict[str, Any] = {}
        if keep_last:
            miss = MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
            options = {"cache": CacheConfig(1), "publisher_detection": True, "sample_miss_detection": miss}
        key = f"{self._domain}/{topic.lstrip('/')}/{mangled}/{name_of_hash}"
        return declare_advanced_publisher(self._session, key, **options)

    def _hash_of(self, topic: str, mangled: str) -> str | None:
        """The hash by which the robot names a type; it depends on the release of ROS."""
        with self._lock:
            tokens = [t for t in self._tokens.values() if t.type == mangled]
            found = next((t.hash for t in tokens if t.topic == topic), None)
            if found is None and any(t.hash == _NO_HASH for t in self._tokens.values()):
                return _NO_HASH
        return found

    # --- what the robot says --------------------------------------------------------------------------

    def _take_token(self, sample: Any) -> None:
        """A publisher or a subscription came or went."""
        from zenoh import SampleKind

        key = str(sample.key_expr)
        with self._lock:
            if sample.kind == SampleKind.DELETE:
                self._tokens.pop(key, None)
                return
            token = Token.of(key)
            if token is None:
                return
            twin = next((t for t in self._tokens.values() if _rivals(t, token)), None)
            self._tokens[key] = token
            if token.kind == "MP":
                self._topics.setdefault((token.topic, token.info.type), token.info)
                if twin is not None and twin.info.type in topics.SENSORS:
                    who = f"{twin.node} and {token.node}"
                    self.news.tell(f"{token.topic}: published by {who}; the messages of both are used")
            elif token.topic in self._offered and token.best_effort:
                self.news.tell(
                    f"{token.topic}: {token.node} subscribes as best effort: messages may get lost"
                )
        self._subscribe()

    def _subscribe(self) -> None:
        """Subscribe to the topics that are wanted and new."""
        from zenoh.ext import HistoryConfig, declare_advanced_subscriber

        with self._lock:
            there = list(self._topics.values())
            for topic in there:
                if topic.topic in self._subscribers or not self._is_wanted(topic, there):
                    continue
                package, _, kind = topic.type.partition("/")
                # Any hash: it depends on the release of ROS.
                key = f"{self._domain}/{topic.topic.lstrip('/')}/{package}::msg::dds_::{kind}_/*"
                options: dict[str, Any] = {}
                if published_once(topic):
                    options["history"] = HistoryConfig(detect_late_publishers=True)
                self._subscribers[topic.topic] = declare_advanced_subscriber(
                    self._session, key, _Receiver(topic, self._inbox), **options
                )

    def _is_wanted(self, topic: TopicInfo, there: Sequence[TopicInfo]) -> bool:
        if self._wanted is not None:
            return topic.topic in self._wanted
        return topics.may_be_used(topic, there, self._config.topic)

    def _tell_connection(self) -> None:
        connected = self.connected
        if self._was_connected and not connected:
            self.news.tell(f"{self.name}: the connection is lost; trying again", again=True)
        elif connected and not self._was_connected:
            self.counts.reconnected += 1
        self._was_connected = connected


@dataclass(frozen=True, slots=True)
class _Receiver:
    """Puts the messages of a topic into the inbox; called in a thread of zenoh."""

    topic: TopicInfo
    inbox: Inbox

    def __call__(self, sample: Any) -> None:
        attachment = sample.attachment
        stamp_ns = _sent_ns(b"" if attachment is None else attachment.to_bytes())
        self.inbox.put(RawMessage(self.topic, stamp_ns, sample.payload.to_bytes()))


def _rivals(known: Token, new: Token) -> bool:
    return known.kind == new.kind == "MP" and known.topic == new.topic and known.node != new.node


def _address(url: str) -> tuple[str, int]:
    """The endpoint and the ROS domain. Raises ConfigError."""
    try:
        parts = urlsplit(url)
        domain = int(parts.path.strip("/") or 0)
        host, port = parts.hostname, parts.port or _PORT
    except ValueError:
        host = None
    if not host:
        raise ConfigError(
            f"{url}: not an address", hint="such as zenoh://robot:7447, or zenoh://robot:7447/DOMAIN"
        )
    return f"tcp/[{host}]:{port}" if ":" in host else f"tcp/{host}:{port}", domain


def _open(url: str, endpoint: str) -> Any:
    extras.require({"zenoh": "zenoh://"})
    import zenoh

    config = zenoh.Config()
    for key, value in (
        ("mode", '"client"'),
        ("connect/endpoints", f'["{endpoint}"]'),
        ("connect/timeout_ms", str(_OPEN_MS)),
        ("scouting/multicast/enabled", "false"),
    ):
        config.insert_json5(key, value)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise LiveError(
            f"{url}: no connection: {str(error)[:200]}",
            hint="on the robot: ros2 run rmw_zenoh_cpp rmw_zenohd, and RMW_IMPLEMENTATION=rmw_zenoh_cpp",
        ) from error


def _attachment(number: int, gid: bytes) -> bytes:
    """What rmw_zenoh demands beside each message; names and bytes have their length before them (LEB128)."""

    def sized(data: bytes) -> bytes:
        return bytes([len(data)]) + data

    return b"".join(
        (
            sized(b"sequence_number"),
            struct.pack("<q", number),
            sized(_STAMP),
            struct.pack("<q", time.time_ns()),
            sized(b"source_gid"),
            sized(gid),
        )
    )


def _sent_ns(attachment: bytes) -> int:
    """When a message was sent, by its attachment; the present time if it does not say so."""
    at = attachment.find(_STAMP)
    end = at + len(_STAMP) + 8
    if at < 0 or len(attachment) < end:
        return time.time_ns()
    return int(struct.unpack("<q", attachment[end - 8 : end])[0])
