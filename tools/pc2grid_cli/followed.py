"""What `watch` follows: a robot, or a finished recording, of which every scan is used."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pc2grid.errors import TrackingLost
from pc2grid.io import open_log
from pc2grid.io.live.feed import FeedCounts, News
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.targets import is_robot, open_live
from pc2grid.io.map_pose import BelievedPose
from pc2grid.observer import Observer
from pc2grid.pipeline import follow
from pc2grid_cli import console
from signature.localization.answer_json import TypedDict

if TYPE_CHECKING:
    from pc2grid.config import ReadConfig
    from pc2grid.io import Log
    from pc2grid.io.map_pose import MapPose
    from pc2grid.io.message_source import Choice, RawMessage
    from pc2grid.model import ReadReport, RegisteredScan, Scan
    from signature.config import Config
    from signature.localization.follower import Follower


class Live(TypedDict):
    """How a running robot is followed. scans: used so far. dropped: left out because the computer is too
    slow. reconnected: lost connections made again. lag_s, elapsed_s: seconds from a scan's arrival to its
    use, and for this estimate."""

    scans: int
    dropped: int
    reconnected: int
    lag_s: float
    elapsed_s: float


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
        """See LiveLog."""
        return self._log.choose()

    def parts(self) -> Iterator[Iterator[Scan]]:
        """See LiveLog."""
        yield self._log.scans()
        if self._pose is not None and self._pose.problem is not None:
            self.news.tell(str(self._pose.problem))

    def report(self) -> ReadReport:
        """See LiveLog."""
        return self._log.report()

    def listen_to_pose(self, topic: str) -> None:
        """See LiveLog."""
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


Followed = LiveLog | WholeRecording
"""Scans, part after part, and what is known of how they come."""


def run(
    drive: Followed,
    follower: Follower[Any],
    config: Config,
    poll: Callable[[], bool],
    *,
    see: Callable[[RegisteredScan | None], None] = lambda registered: None,
    observer: Observer = Observer(),
) -> None:
    """Feed a follower with all scans of a robot or a recording.

    poll : called after each scan, and while none comes; true if that was enough.
    see : called with each registered scan; None: what follows does not go on from what was before.
    """
    drive.on_poll = poll
    for scans in drive.parts():
        try:
            for registered, planar_scan in follow(scans, config, observer):
                see(registered)
                follower.add(registered, planar_scan)
                if poll():
                    return
        except TrackingLost as error:
            console.warn(error.in_short)
        if poll():
            return
        follower.restart()
        see(None)
    follower.finish()
    poll()


def live(drive: Followed, elapsed_s: float) -> Live:
    """How it is followed so far. elapsed_s : time that the estimate took."""
    return {
        "scans": drive.report().scans_read,
        "dropped": drive.counts.dropped,
        "reconnected": drive.counts.reconnected,
        "lag_s": drive.lag_s,
        "elapsed_s": elapsed_s,
    }
