"""The transforms of the robot: all static ones, and as many of the moving ones as are needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pc2grid.io import topics
from pc2grid.io.first_messages import FIRST, First, tolerant
from pc2grid.io.frames import FrameTree
from pc2grid.io.message_source import MessageSource, TopicInfo
from pc2grid.io.messages.decoders import decoder_for


class Transforms:
    """Fills a tree of frames.

    frames : the tree. moving : the topics of moving transforms. edges : those of them that were read.
    """

    def __init__(
        self, source: MessageSource, tf: Sequence[TopicInfo], frames: FrameTree, end_ns: int
    ) -> None:
        """Take in the static transforms of some topics. end_ns : up to which moving ones are read."""
        self._source, self.frames = source, frames
        self.moving = [t for t in tf if not topics.is_static(t)]
        self.edges: list[First] = []
        for _ in self._read([t for t in tf if topics.is_static(t)], None):
            pass
        self._later = self._read(self.moving, end_ns)

    def read_on(self) -> bool:
        """Take in the next message of moving transforms; returns whether there is one."""
        found = next(self._later, None)
        self.edges += found or ()
        return found is not None

    def read_odometry(self, base: str) -> str | None:
        """Return the frame above the base in which tf holds its odometry, after enough of it was read to know
        its clock."""
        while (len(self.edges) < FIRST or self.odometry_frame(base) is None) and self.read_on():
            pass
        return self.odometry_frame(base)

    def odometry_frame(self, base: str) -> str | None:
        """Return the frame above the base in which tf holds its odometry, as far as it was read."""
        above = self.frames.chain(base)[1:]
        return next((f for f in above if f == "odom" or f.endswith(("/odom", "_odom"))), None)

    def _read(self, tf: Sequence[TopicInfo], end_ns: int | None) -> Iterator[list[First]]:
        """Take in the transforms of some topics; yields those of each message."""
        decoders = {t: decoder_for(t) for t in tf}
        for message in self._source.messages({t.topic for t in tf}, end_ns=end_ns):
            if message.channel in decoders:
                at_ns, edges = message.log_time_ns, tolerant(decoders[message.channel], message.data)
                self.frames.add_all(edges, static=topics.is_static(message.channel), log_time_ns=at_ns)
                yield [First(at_ns, edge) for edge in edges or ()]
