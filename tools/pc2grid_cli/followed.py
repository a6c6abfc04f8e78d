"""What `watch` follows: a robot, or a finished recording, of which every scan is used."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from pc2grid.io import open_log
from pc2grid.io.live.feed import News
from pc2grid.io.live.inbox import FeedCounts
from pc2grid.io.live.targets import is_robot, open_live
from pc2grid.io.map_pose import BelievedPose

if TYPE_CHECKING:
    from pc2grid.config import ReadConfig
    from pc2grid.io import Log
    from pc2grid.io.map_pose import MapPose
    from pc2grid.io.message_source import Choice, RawMessage
    from pc2grid.model import ReadReport, Scan


class Followed(Protocol):
    """Scans, part after part, and what is known of how they come.

    on_poll : called several times a second while scans are awaited.
    """

    on_poll: Callable[[], bool]

    @property
    def name(self) -> str:
        """For the user."""
        ...

    @property
    def realtime(self) -> bool:
        """Whether scans are lost that are not used in time."""
        ...

    @property
    def counts(self) -> FeedCounts:
        """Of messages that came and that were lost."""
        ...

    @property
    def news(self) -> News:
        """What the user should know."""
        ...

    @property
    def lag_s(self) -> float:
        """Time from the arrival of the last scan to the end of its use."""
        ...

    @property
    def believed(self) -> MapPose | None:
        """The newest pose by the robot's own localization, on the topic given to `listen_to_pose`."""
        ...

    def choose(self) -> Choice:
        """See `Log.choose`."""
        ...

    def parts(self) -> Iterator[Iterator[Scan]]:
        """The scans; those of one part belong together."""
        ...

    def report(self) -> ReadReport:
        """See `Log.report`."""
        ...

    def listen_to_pose(self, topic: str) -> None:
        """Keep `believed` up to date. Raises TopicError if it is known that there is no such topic."""
        ...


@contextlib.contextmanager
def followed(source: str, config: ReadConfig, *, real_time: bool = False) -> Iterator[Followed]:
    """A robot by its address, or a recording by its path.

    real_time : a recording is replayed at its own pace. Raises what `open_live` and `open_log` do.
    """
    if real_time or is_robot(source):
        with open_live(source, config) as live:
            yield live
    else:
        with open_log(Path(source), config) as log:
            yield WholeRecording(log)


class WholeRecording:
    """A finished recording, read as by all other commands: each scan once, as fast as it can be used."""

    realtime = False
    lag_s = 0.0

    def __init__(self, log: Log) -> None:
        self.on_poll: Callable[[], bool] = lambda: False
        self.name = str(log.info.path)
        self.counts, self.news = FeedCounts(), News()
        self._log = log
        self._pose: BelievedPose | None = None
        self._messages: Iterator[RawMessage] = iter(())
        self._next: RawMessage | None = None

    def choose(self) -> Choice:
        """See Followed."""
        return self._log.choose()

    def parts(self) -> Iterator[Iterator[Scan]]:
        """See Followed."""
        yield self._log.scans()
        if self._pose is not None and self._pose.problem is not None:
            self.news.tell(str(self._pose.problem))

    def report(self) -> ReadReport:
        """See Followed."""
        return self._log.report()

    def listen_to_pose(self, topic: str) -> None:
        """See Followed."""
        self._pose = BelievedPose(topic)
        self._pose.find(self._log.info.topics, self.choose().base_frame)
        self._messages = self._log.messages(self._pose.topics)
        self._next = next(self._messages, None)

    @property
    def believed(self) -> MapPose | None:
        """The newest pose that was recorded before the last scan."""
        if self._pose is None:
            return None
        while self._next is not None and self._next.log_time_ns <= self._log.last_scan_ns:
            self._pose.take(self._next)
            self._next = next(self._messages, None)
        return self._pose.newest
