"""Scans from messages that arrive while they are used: of a running robot, or of a recording that is
replayed.

The first seconds of messages are held back and read as a recording, by the code that reads recordings, to
plan what is read of the robot and how; then they are used like all others.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

from pc2grid.errors import FrameError, LogNotFound, NoScans, TopicError
from pc2grid.io.frames import PARAMETERS as FRAMES, FrameTree
from pc2grid.io.live.feed import HOLD_S, MOST_S, Arrived, Feed
from pc2grid.io.map_pose import BelievedPose
from pc2grid.io.plan import Plan
from pc2grid.io.recording import ScanSource, open_log
from pc2grid.io.source import RawMessage, TopicInfo, guarded_stream
from pc2grid.io.stream import Poses, Stream, StreamParameters
from pc2grid.libraries import require
from pc2grid.model import Scan
from pc2grid.settings import ReadConfig

_HINT = (
    "ws://ROBOT:8765 follows a robot that runs foxglove_bridge, whatever its middleware; "
    "a recording is followed when it is finished, by its path"
)


def open_live(target: str, config: ReadConfig | None = None) -> LiveLog:
    """Follow a running robot, or a recording at its own pace as if it were one.

    target : `ws://ROBOT:8765` (foxglove_bridge), or the path of a recording.

    Raises LiveError if the robot cannot be reached, LogNotFound and what `open_log` raises.

    >>> with open_live("monday.mcap") as live:
    ...     scan = next(live.scans())
    ...     live.choose().topic, scan.sensor
    ('/scan', 'laser')
    """
    config = config or ReadConfig()
    if is_robot(target):
        require({"live": "ws://"})
        from pc2grid.io.live.foxglove_websocket import FoxgloveWebsocket

        return LiveLog(FoxgloveWebsocket(target, config))
    return LiveLog(Replay(Path(target), config))


def is_robot(target: str) -> bool:
    """Return True if a target is the address of a robot. Raises LogNotFound for one that cannot be followed.

    >>> is_robot("ws://robot:8765"), is_robot("monday.mcap")
    (True, False)
    """
    scheme, separator, _ = target.partition("://")
    if separator and scheme not in ("ws", "wss"):
        raise LogNotFound(f"{target}: {scheme}:// cannot be followed", hint=_HINT)
    if target == "-":
        raise LogNotFound("-: standard input cannot be followed", hint=_HINT)
    return bool(separator)


STREAM = StreamParameters(wait_ns=200_000_000, eager=True)
"""Scans wait for odometry, but not for scans with earlier stamps; and less long than in a recording."""


class LiveLog(ScanSource):
    """Scans of a robot, planned by the first seconds of its messages. Use as a context manager.

    feed : source of the messages.
    """

    def __init__(self, feed: Feed, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(feed, feed.config, STREAM)
        self.feed, self.name = feed, feed.name
        self._parameters, self._clock = feed.parameters, clock
        self._stopped, self._needed_s = False, HOLD_S
        self._held: deque[Arrived] = deque()  # of the first messages, those that are not used yet
        self._newest = (0, clock())  # log time of the newest scan, and when it arrived
        self._begun_s = self._heard_s = clock()

    @property
    def ended(self) -> bool:
        """Return whether no scan will come any more."""
        return self._stopped or (self.feed.ended and not self._held)

    def _planned(self) -> Plan:
        """Hold back the first seconds of messages, and plan by them."""
        feed = self.feed
        while self._plan is None:
            if self.on_poll():
                self._stopped = True
                raise NoScans(feed.silence(), hint="--topic chooses another one")
            arrived = feed.receive(self._parameters.poll_s)
            if arrived is not None:
                feed.hold(arrived)
            if feed.ended or feed.held_s >= self._needed_s:
                self._try_to_plan()
            elif self._clock() - self._begun_s >= self._parameters.silent_s and feed.connected:
                self.tally.tell(feed.silence())
        return self._plan

    def _try_to_plan(self) -> None:
        """Plan, unless it needs more messages. Raises the error of the last try."""
        last = self.feed.ended or self._needed_s >= MOST_S
        self._needed_s *= 2
        try:
            plan = super()._planned()
        except (FrameError, NoScans):
            if last:
                raise
            self._frames = FrameTree()
            self.tally.warnings.clear()
            return
        self._held = self.feed.held
        self._begun_s = self._heard_s = self._clock()
        self.feed.want(self._begin(plan).topics)

    # --- scans ----------------------------------------------------------------------------------------

    def parts(self) -> Iterator[Iterator[Scan]]:
        """Yield one iterator of scans per uninterrupted segment, see `scans`."""
        while not self.ended:
            yield self.scans()

    def scans(self) -> Iterator[Scan]:
        """Yield the scans of one uninterrupted segment, as they arrive.

        A segment ends when the clock was set, or after a gap if there is no odometry: later scans are yielded
        by the next call, unless `ended`.

        Raises LogError as `Log.scans` does.
        """
        plan, last_scan_ns = self._planned(), None
        stream, topic = self._stream, plan.sensors[0].topic
        assert stream is not None
        while True:
            arrived = self._next(topic)
            self._stopped = self._stopped or self.on_poll()
            if self._stopped or (arrived is None and self.ended):
                yield from self._used(stream, stream.release_all())
                return
            self._find_pose(stream)
            if arrived is None:
                continue
            message = arrived.message
            if message.channel == topic:
                if last_scan_ns is not None and self._is_gap(message, last_scan_ns, stream):
                    yield from self._used(stream, stream.release_all())
                    self._held.appendleft(arrived)
                    break
                last_scan_ns = message.log_time_ns
                self._newest = max(self._newest, (message.log_time_ns, arrived.arrived_s))
            yield from self._used(stream, stream.take(message))
            if stream.stamps.out_of_time >= STREAM.patience:  # of scans in a row
                self.tally.tell("the clock of the scans was set; the search starts again", again=True)
                self._frames.forget_moving()
                break
        self._begin(plan)

    def _is_gap(self, message: RawMessage, last_scan_ns: int, stream: Stream) -> bool:
        """Return whether the motion since the last scan is unknown: no scans, and no odometry."""
        gap_ns = message.log_time_ns - last_scan_ns
        if gap_ns <= FRAMES.max_gap_ns or stream.poses.newest_ns() is not None:
            return False
        self.tally.tell(
            f"{message.channel.topic}: no scan for {gap_ns * 1e-9:.1f} s; the search starts again", again=True
        )
        return True

    def _used(self, stream: Stream, scans: Iterator[Scan]) -> Iterator[Scan]:
        """Yield the scans, and measure the lag when the consumer asks for the next one."""
        for scan in guarded_stream(self._path, scans):
            log_time_ns = stream.stamps.last_log_ns
            yield scan
            self.lag_s = (self.now_ns() - log_time_ns) * 1e-9

    def _next(self, topic: TopicInfo) -> Arrived | None:
        """Return the next message: of those held back, then of those that arrive. Report a long time without
        scans.

        topic : of the scans.
        """
        if self._held:
            return self._held.popleft()
        arrived, now_s = self.feed.receive(self._parameters.poll_s), self._clock()
        if arrived is not None and arrived.message.channel == topic:
            self._heard_s = now_s
        silent_s = now_s - self._heard_s
        if arrived is None and silent_s >= self._parameters.silent_s and self.feed.connected:
            self.tally.tell(f"{topic.topic}: no message for {silent_s:.0f} s", again=True)
            self._heard_s = now_s
        return arrived

    def listen_to_pose(self, topic: str) -> BelievedPose:
        """See `ScanSource`; the topic may begin later."""
        self._believed = BelievedPose(topic)
        return self._believed

    def _find_pose(self, stream: Stream) -> None:
        """Ask for the topic of the pose. Report what is missing: topic or tf may begin later."""
        believed = stream.believed
        if believed is None:
            return
        try:
            if not believed.topics:
                believed.find(self.feed.topics(), self.choose().base_frame)
                self.feed.want(stream.topics)
            if believed.problem is not None:
                raise believed.problem
        except (TopicError, FrameError) as error:
            if self._clock() - self._begun_s > self._parameters.silent_s or self.feed.ended:
                self.tally.tell(error.in_short)

    # --- odometry, now --------------------------------------------------------------------------------

    @property
    def poses(self) -> Poses:
        """Return the odometry by what has been read so far, after `choose`."""
        assert self._stream is not None
        return self._stream.poses

    def now_ns(self) -> int:
        """Return the present time of the robot's clock: that of the newest scan, plus the time since then."""
        newest_ns, arrived_s = self._newest
        return newest_ns + round((self._clock() - arrived_s) * 1e9)


class Replay(Feed):
    """The messages of a recording, with their original delays after its first scan; those before it at once.

    They arrive at their times, whenever they are taken.
    """

    def __init__(self, path: Path, config: ReadConfig) -> None:
        """Open the recording. Raises what `open_log` does."""
        super().__init__(str(path), config)
        self._log = open_log(path, config)
        info = self._log.info
        for topic in info.topics:
            self._offer((topic.topic, topic.type), topic)
        self._refresh()
        end_ns = info.end_ns + FRAMES.max_gap_ns
        messages = self._log.messages({topic.topic for topic in info.topics})
        self._messages = itertools.takewhile(lambda message: message.log_time_ns <= end_ns, messages)
        self._next = next(self._messages, None)
        self._begin_s, self._begin_ns = time.monotonic(), info.start_ns

    def receive(self, timeout_s: float) -> Arrived | None:
        """Return the next message, see Feed. Raises LogError where the recording is damaged."""
        while self._next is not None:
            due_s = self._begin_s + max((self._next.log_time_ns - self._begin_ns) * 1e-9, 0.0)
            wait_s = due_s - time.monotonic()
            if wait_s > 0.0:
                timeout_s = min(timeout_s, wait_s)
                break
            if (self._next.channel.topic, self._next.channel.type) in self._subscriptions:
                self._inbox.put(self._next, due_s)
            self._next = next(self._messages, None)
        self._over = self._next is None
        return super().receive(timeout_s)

    def close(self) -> None:
        """Close the recording."""
        super().close()
        self._log.close()
