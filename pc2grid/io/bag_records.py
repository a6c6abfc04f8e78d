"""Records of a ROS 1 bag (http://wiki.ros.org/Bags/Format/2.0) that `rosbags` does not look at."""

from __future__ import annotations

from typing import NamedTuple

MESSAGE, CHUNK, CONNECTION = b"\x02", b"\x05", b"\x07"


class Broken(ValueError):
    """A record does not fit."""


class Connection(NamedTuple):
    """A publisher of a topic: type and definition of its messages, and how many there are."""

    topic: str
    type: str
    definition: str
    messages: int

    def one_more(self) -> Connection:
        """The same with another message."""
        return self._replace(messages=self.messages + 1)


def connection_of(fields: dict[bytes, bytes], data: memoryview) -> Connection:
    """What a connection record says, from the fields of its header and its data. Raises Broken."""
    inner = fields_of(data)
    return Connection(
        topic=fields.get(b"topic", b"").decode("utf-8", "replace"),
        type=inner.get(b"type", b"").decode("utf-8", "replace"),
        definition=inner.get(b"message_definition", b"").decode("utf-8", "replace"),
        messages=0,
    )


def connections_in(content: bytes) -> dict[int, Connection]:
    """The connections that a chunk's content describes, by their numbers. Raises Broken."""
    view, found, at = memoryview(content), {}, 0
    while at < len(view):
        head, at = blob(view, at)
        data, at = blob(view, at)
        fields = fields_of(head)
        if fields.get(b"op") == CONNECTION:
            found[int.from_bytes(fields.get(b"conn", b""), "little")] = connection_of(fields, data)
    return found


def blob(view: memoryview, at: int) -> tuple[memoryview, int]:
    """The bytes behind a length, and where they end. Raises Broken."""
    stop = at + 4 + int.from_bytes(view[at : at + 4], "little")
    if at + 4 > len(view) or stop > len(view):
        raise Broken("a chunk ends within a record")
    return view[at + 4 : stop], stop


def fields_of(head: memoryview) -> dict[bytes, bytes]:
    """`name=value` fields, each behind its length. Raises Broken."""
    found, at = {}, 0
    while at < len(head):
        field, at = blob(head, at)
        name, _, value = bytes(field).partition(b"=")
        found[name] = value
    return found
