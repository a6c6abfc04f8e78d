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
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from pc2grid import extras
from pc2grid.config import ReadConfig
from pc2grid.errors import ConfigError, LiveError
from pc2grid.io import topics
from pc2grid.io.export import ros_messages as ros
from pc2grid.io.live.feed import Feed
from pc2grid.io.live.inbox import INBOX, Arrived, Inbox, InboxParameters
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


class ZenohSession(Feed):
    """The topics of a robot in one ROS domain."""

    realtime = True

    def __init__(self, url: str, config: ReadConfig, inbox: InboxParameters = INBOX) -> None:
        """url : `zenoh://ROBOT:7447`, or `zenoh://ROBOT:7447/DOMAIN` for another ROS_DOMAIN_ID than 0.

        Raises LiveError if there is no connection, or without the package `eclipse-zenoh`, ConfigError for an
        address of another form.
        """
        super().__init__(url, config, inbox)
        host, self._domain = _address(url)
        self._tokens: dict[str, Token] = {}
        self._session = _open(url, host)
        self._publishing = _Publishing(self._session, self._domain)
        self._watching = self._session.liveliness().declare_subscriber(
            f"{_TOKENS}/{self._domain}/**", self._take_token, history=True
        )

    def receive(self, timeout_s: float) -> Arrived | None:
        """See Feed."""
        arrived = super().receive(timeout_s)
        if arrived is None:
            info = self._session.info
            self._set_connected(bool(info.routers_zid() or info.peers_zid()))
        return arrived

    def close(self) -> None:
        """End the session."""
        if not self._over:
            super().close()
            self._session.close()

    # --- Publisher ------------------------------------------------------------------------------------

    def advertise(self, topic: str, type_name: str, definition: str, *, keep_last: bool) -> None:
        """Announce a topic that `publish` will be called for.

        type_name : such as `nav_msgs/msg/OccupancyGrid`. definition : not needed here.
        keep_last : who subscribes later gets the last message.
        """
        self._publishing.offered[topic] = type_name, keep_last

    def publish(self, topic: str, message: bytes) -> None:
        """Send a message in CDR.

        The publisher is made with the first one, when the nodes of the robot, and so the hash that they use,
        are known.
        """
        type_name, _ = self._publishing.offered[topic]
        name_of_hash = self._hash_of(topic, _mangled(type_name)) or ros.type_hash(type_name)
        self._publishing.publish(topic, message, name_of_hash)

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
            self._tell_of(token)
            self._tokens[key] = token
            if token.kind == "MP":
                self._offer((token.topic, token.info.type), token.info)
        self._refresh()

    def _tell_of(self, token: Token) -> None:
        """Tell the user of a second publisher of scans, and of a subscription that may lose messages."""
        twin = next((t for t in self._tokens.values() if _rivals(t, token)), None)
        if twin is not None and twin.info.type in topics.SENSORS:
            who = f"{twin.node} and {token.node}"
            self.news.tell(f"{token.topic}: published by {who}; the messages of both are used")
        if token.kind == "MS" and token.topic in self._publishing.offered and token.best_effort:
            self.news.tell(f"{token.topic}: {token.node} subscribes as best effort: messages may get lost")

    def _subscribe(self, new: Mapping[Hashable, TopicInfo]) -> Mapping[Hashable, Any]:
        return {key: self._subscriber(topic) for key, topic in new.items()}

    def _subscriber(self, topic: TopicInfo) -> Any:
        from zenoh.ext import HistoryConfig, declare_advanced_subscriber

        package, _, kind = topic.type.partition("/")
        # Any hash: it depends on the release of ROS.
        place = f"{self._domain}/{topic.topic.lstrip('/')}/{package}::msg::dds_::{kind}_/*"
        options: dict[str, Any] = {}
        if published_once(topic):
            options["history"] = HistoryConfig(detect_late_publishers=True)
        return declare_advanced_subscriber(self._session, place, _Receiver(topic, self._inbox), **options)

    def _unsubscribe(self, old: Mapping[Hashable, Any]) -> None:
        for subscriber in old.values():
            subscriber.undeclare()


class _Publishing:
    """Publishers of a session, and the tokens by which the robot's nodes know them as those of a node
    `pc2grid`.

    offered : type, and whether the last message is kept, by topic.
    """

    def __init__(self, session: Any, domain: int) -> None:
        self.offered: dict[str, tuple[str, bool]] = {}
        self._session, self._domain = session, domain
        self._publishers: dict[str, Any] = {}
        self._tokens: list[Any] = []
        self._lock = threading.Lock()
        self._sequence = 0
        self._gid = secrets.token_bytes(16)

    def publish(self, topic: str, message: bytes, name_of_hash: str) -> None:
        """Send a message in CDR; the hash is that of its type."""
        with self._lock:
            if topic not in self._publishers:
                self._publishers[topic] = self._declare(topic, name_of_hash)
            self._sequence += 1
            number = self._sequence
        self._publishers[topic].put(message, attachment=_attachment(number, self._gid))

    def _declare(self, topic: str, name_of_hash: str) -> Any:
        from zenoh.ext import CacheConfig, MissDetectionConfig, declare_advanced_publisher

        type_name, keep_last = self.offered[topic]
        mangled = _mangled(type_name)
        node = f"{_TOKENS}/{self._domain}/{self._session.info.zid()}/0"
        qos = _TRANSIENT_LOCAL if keep_last else _RELIABLE
        entity = f"{topic.replace('/', '%')}/{mangled}/{name_of_hash}/{qos}"
        number = len(self._publishers) + 1
        for token in (f"{node}/0/NN/%/%/pc2grid", f"{node}/{number}/MP/%/%/pc2grid/{entity}"):
            self._tokens.append(self._session.liveliness().declare_token(token))
        options: dict[str, Any] = {}
        if keep_last:
            miss = MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
            options = {"cache": CacheConfig(1), "publisher_detection": True, "sample_miss_detection": miss}
        key = f"{self._domain}/{topic.lstrip('/')}/{mangled}/{name_of_hash}"
        return declare_advanced_publisher(self._session, key, **options)


def _mangled(type_name: str) -> str:
    """`nav_msgs/msg/OccupancyGrid` as DDS names it."""
    package, _, kind = type_name.partition("/msg/")
    return f"{package}::msg::dds_::{kind}_"


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
