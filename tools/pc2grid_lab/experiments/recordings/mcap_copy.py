"""An MCAP made of messages of other ones, as they are stored; and one with fewer scans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import Writer

from pc2grid.io.atomic import replace_file

_SCANS = ("PointCloud2", "PointCloud", "LaserScan", "Image", "CompressedImage")


class Stored(NamedTuple):
    """A message as it is stored."""

    schema: Schema
    channel: Channel
    log_time_ns: int
    data: bytes


def stored_messages(path: Path) -> Iterator[Stored]:
    """All messages of an MCAP. Raises OSError, and the errors of the `mcap` library."""
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            yield Stored(schema, channel, message.log_time, message.data)


class McapCopy:
    """Writes messages to an MCAP, each topic as one channel."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}

    def add(self, message: Stored) -> None:
        """Write a message."""
        schema, channel = message.schema, message.channel
        if channel.topic not in self._channels:
            number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._channels[channel.topic] = self._writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata
            )
        time_ns = message.log_time_ns
        self._writer.add_message(self._channels[channel.topic], time_ns, message.data, time_ns)


@contextmanager
def mcap_copy(target: Path) -> Iterator[McapCopy]:
    """The MCAP file `target`, which is there when the body ends."""
    with replace_file(target) as draft, draft.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        yield McapCopy(writer)
        writer.finish()  # type: ignore[no-untyped-call]


def write_thinned(source: Path, target: Path, every: int) -> None:
    """Write the MCAP file `target` with every nth message of each topic of scans in `source`.

    Raises OSError, and the errors of the `mcap` library.
    """
    counts: Counter[str] = Counter()
    with mcap_copy(target) as copy:
        for message in stored_messages(source):
            topic, is_scan = message.channel.topic, message.schema.name.split("/")[-1] in _SCANS
            if not is_scan or counts[topic] % every == 0:
                copy.add(message)
            counts[topic] += 1
