"""Recordings that are written bit by bit, as a recorder writes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from tests.helpers.recordings import Message, ros


class Recorder:
    """Writes an MCAP that can be read while it is written."""

    def __init__(self, path: Path, **options: Any) -> None:
        """options : of mcap's Writer, such as chunk_size or use_chunking."""
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, **{"compression": CompressionType.ZSTD, **options})
        self._writer.start(profile="ros2")
        self._channels: dict[str, int] = {}

    def add(self, messages: Sequence[Message]) -> None:
        for topic, kind, log_time_ns, data in messages:
            if topic not in self._channels:
                name = kind.replace("/", "/msg/")
                schema = self._writer.register_schema(name, "ros2msg", ros().schema(kind))
                self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
            self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns)
        self._stream.flush()

    def finish(self) -> None:
        self._writer.finish()
        self._stream.close()


def laser_drive(count: int = 120, step_ns: int = 100_000_000) -> list[Message]:
    """A laser that moves 0.05 m a scan, with odometry between the scans, and static tf at the beginning
    only."""
    from tests.helpers.recordings import T0

    to = ros()
    messages = [to.tf(T0, "base_link", "laser", 0.2, topic="/tf_static")]
    for i in range(count):
        stamp = T0 + i * step_ns
        messages.append(to.laser("/scan", stamp, [1.0 + 0.01 * ((i + k) % 7) for k in range(30)]))
        messages.append(to.odometry("/odom", stamp, 0.05 * i))
        messages.append(to.odometry("/odom", stamp + step_ns // 2, 0.05 * i + 0.025))
    return messages
