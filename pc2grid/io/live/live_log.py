"""Scans from messages that arrive while they are used: of a running robot, or of a recording that is
replayed.

The first seconds of messages are held back and read as a recording, by the code that reads recordings, to
plan what is read of the robot and how; then they are used like all others.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path

from pc2grid.errors import FrameError, LogError, LogNotFound, NoScans, TopicError
from pc2grid.geometry import F64
from pc2grid.io import topics
from pc2grid.io.frames import PARAMETERS as FRAMES
from pc2grid.io.frames import FrameTree
from pc2grid.io.live.feed import Arrived, Feed
from pc2grid.io.map_pose import BelievedPose, MapPose
from pc2grid.io.plan import Plan, make_plan, published_once
from pc2grid.io.recording import Log, open_log
from pc2grid.io.source import Choice, LogInfo, RawMessage, Tally, TopicInfo, guarded, guarded_stream
from pc2grid.io.stream import LogPart, Stream, StreamParameters
from pc2grid.libraries import require
from pc2grid.model import ReadReport, Scan
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
    ...     live.choose().topic, sum(1 for scan in live.scans()) > 10
    ('/scan', True)
    """
    config = config or ReadConfig()
    if is_robot(target):
        require({"live": "ws://"})
        from pc2grid.io.live.foxglove_websocket import FoxgloveWebsocket

        return LiveLog(FoxgloveWebsocket(target, config), config)
    return LiveLog(Replay(Path(target), config), config)


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


@dataclass(frozen=True, slots=True)
class LiveParameters:
    """When silence is reported, and when a segment of scans ends; chosen by hand.

    poll_s : longest wait for a message. silent_s : time after which a topic without messages
    is named. clock_scans : so many scans in a row with stamps that go back or jump mean that the clock was
    set.
    """

    poll_s: float = 0.2
    silent_s: float = 5.0
    clock_scans: int = 5


LIVE = LiveParameters()
STREAM = StreamParameters(wait_ns=200_000_000, eager=True)
"""Scans wait for odometry, but not for scans with earlier stamps; and less long than in a recording."""


class LiveLog(AbstractContextManager["LiveLog"]):
    """Scans from a feed. Use as a context manager.

    feed : source of the messages. name, counts, news : of the feed. realtime : True if scans are lost that
    are not used in time. lag_s : time from the arrival of the last scan to the end of its use. on_poll :
    called several times a second while scans are awaited and with each scan; if it returns True, no more
    scans follow.
    """

    realtime = True

    def __init__(
        self,
        feed: Feed,
        config: ReadConfig,
        parameters: LiveParameters = LIVE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.feed, self.name, self.counts, self.news = feed, feed.name, feed.counts, feed.news
        self.on_poll: Callable[[], bool] = lambda: False
        self.lag_s = 0.0
        self._config, self._parameters, self._clock = config, parameters, clock
        self._stopped = False
        self._first = LookAhead(feed, config)
        self._held: deque[Arrived] = deque()  # of the first messages, those that are not used yet
        self._planned: Planned | None = None
        self._stream: Stream | None = None
        self._newest = (0, clock())  # log time of the newest scan, and when it arrived
        self._pose: BelievedPose | None = None
        self._begun_s = self._heard_s = clock()

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the feed."""
        self.feed.close()

    @property
    def ended(self) -> bool:
        """Return whether no scan will come any more."""
        return self._stopped or (self.feed.ended and not self._held)

    def report(self) -> ReadReport:
        """Return the counts of what was read and of what was lost, so far."""
        planned = self._planned
        return Tally().report() if planned is None else planned.source.tally.report(planned.frames.warnings)

    def choose(self) -> Choice:
        """Hold back the first seconds of messages, and choose the topics to use by them.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        return self._chosen().plan.choice

    def _chosen(self) -> Planned:
        while self._planned is None:
            arrived = self.feed.receive(self._parameters.poll_s)
            if arrived is not None:
                self._first.add(arrived)
            planned = self._first.planned()
            if planned is not None:
                self._planned, self._held = planned, self._first.held
                self._begun_s = self._heard_s = self._clock()
                self._want(self._new_stream(planned))
            elif self.on_poll():
                self._stopped = True
                raise NoScans(self._first.silence(), hint="--topic chooses another one")
            elif self._clock() - self._begun_s >= self._parameters.silent_s and self.feed.connected:
                self.news.tell(self._first.silence())
        return self._planned

    def _new_stream(self, planned: Planned) -> Stream:
        made = planned.source, self._config, planned.frames, planned.plan
        self._stream = Stream(*made, parameters=STREAM)
        return self._stream

    def _want(self, stream: Stream) -> None:
        """Subscribe to the messages that are used."""
        pose = frozenset() if self._pose is None else self._pose.topics
        self.feed.want(stream.topics | pose)

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
        planned, last_scan_ns = self._chosen(), None
        stream, topic = self._stream, planned.plan.sensors[0].topic
        assert stream is not None
        while True:
            arrived = self._next(topic)
            self._stopped = self._stopped or self.on_poll()
            if self._stopped or (arrived is None and self.ended):
                yield from self._used(stream, stream.release_all())
                return
            self._hear_pose(planned, stream, arrived)
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
            if stream.stamps.out_of_time >= self._parameters.clock_scans:
                self.news.tell("the clock of the scans was set; the search starts again", again=True)
                planned.frames.forget_moving()
                break
        self._new_stream(planned)

    def _is_gap(self, message: RawMessage, last_scan_ns: int, stream: Stream) -> bool:
        """Return whether the motion since the last scan is unknown: no scans, and no odometry."""
        gap_ns = message.log_time_ns - last_scan_ns
        if gap_ns <= FRAMES.max_gap_ns or stream.poses.newest_ns() is not None:
            return False
        self.news.tell(
            f"{message.channel.topic}: no scan for {gap_ns * 1e-9:.1f} s; the search starts again", again=True
        )
        return True

    def _used(self, stream: Stream, scans: Iterator[Scan]) -> Iterator[Scan]:
        """Yield the scans, and measure the lag when the consumer asks for the next one."""
        for scan in guarded_stream(Path(self.feed.name), scans):
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
            self.news.tell(f"{topic.topic}: no message for {silent_s:.0f} s", again=True)
            self._heard_s = now_s
        return arrived

    # --- the pose by the robot's own localization ----------------------------------------------------------

    @property
    def believed(self) -> MapPose | None:
        """Return the newest pose of the base in the map by the robot's own localization; None before the
        first.

        Its topic is given to `listen_to_pose`.
        """
        return None if self._pose is None else self._pose.newest

    def listen_to_pose(self, topic: str) -> None:
        """Keep `believed` up to date from a topic of a pose, an odometry or tf, also if it begins later."""
        self._pose = BelievedPose(topic)

    def _hear_pose(self, planned: Planned, stream: Stream, arrived: Arrived | None) -> None:
        """Update the pose with the next message. Report what is missing: the topic, or tf of the map, may
        begin later."""
        pose = self._pose
        if pose is None:
            return
        try:
            if not pose.topics:
                pose.find(self.feed.topics(), planned.plan.choice.base_frame)
                self._want(stream)
            if arrived is not None:
                pose.take(arrived.message)
            if pose.problem is not None:
                raise pose.problem
        except (TopicError, FrameError) as error:
            if self._clock() - self._begun_s > self._parameters.silent_s or self.feed.ended:
                self.news.tell(error.in_short)

    # --- odometry, now --------------------------------------------------------------------------------

    @property
    def odometry_frame(self) -> str | None:
        """Return the parent frame of the robot's odometry, such as `odom`; None if there is none."""
        return None if self._stream is None else self._stream.poses.frame

    def newest_odometry(self) -> tuple[int, F64] | None:
        """Return the newest odometry that was read: its stamp and `T_odom_base` (4, 4)."""
        return None if self._stream is None else self._stream.poses.newest_odometry()

    def now_ns(self) -> int:
        """Return the present time of the robot's clock: that of the newest scan, plus the time since then."""
        newest_ns, arrived_s = self._newest
        return newest_ns + round((self._clock() - arrived_s) * 1e9)


_HOLD_S, _MOST_S = 3.0, 12.0
"""Time from the first scan to the last one that is held back for the plan: most transforms are published
several times in it; it doubles after each plan that failed, up to the last try. Chosen by hand."""


class LookAhead:
    """The messages that are held back: all of topics that may be published only once, of others the last
    seconds."""

    def __init__(self, feed: Feed, config: ReadConfig) -> None:
        self._feed, self._config = feed, config
        self._once: list[Arrived] = []
        self._recent: deque[Arrived] = deque()
        self._needed_s = _HOLD_S

    @property
    def held(self) -> deque[Arrived]:
        """Return all of them, those that are published once first."""
        return deque((*self._once, *self._recent))

    def add(self, arrived: Arrived) -> None:
        """Hold a message back."""
        if published_once(arrived.message.channel):
            self._once.append(arrived)
            return
        self._recent.append(arrived)
        while self._recent[0].arrived_s < arrived.arrived_s - 2 * _MOST_S:
            self._recent.popleft()

    def planned(self) -> Planned | None:
        """Return the plan once it can be made; None before.

        Raises the error of the last try: FrameError, NoScans; TopicError and UnsupportedSchema at once.
        """
        ended = self._feed.ended
        scans_ns = [a.message.log_time_ns for a in self._recent if a.message.channel.type in topics.SENSORS]
        if not ended and (not scans_ns or scans_ns[-1] - scans_ns[0] < self._needed_s * 1e9):
            return None
        self._needed_s *= 2
        try:
            return self._plan()
        except (FrameError, NoScans):
            if ended or self._needed_s > _MOST_S:
                raise
            return None

    def _plan(self) -> Planned:
        found = [a.message for a in self.held]
        counts = Counter(m.channel for m in found)
        known = [replace(t, message_count=counts[t]) for t in self._feed.topics()]
        times_ns = [m.log_time_ns for m in found]
        info = LogInfo(
            path=Path(self._feed.name),
            format="live",
            size_bytes=0,
            start_ns=min(times_ns, default=0),
            end_ns=max(times_ns, default=0),
            message_count=len(found),
            topics=tuple(sorted(known, key=lambda t: (t.topic, t.type))),
        )
        source, frames = HeldMessages(info, found), FrameTree()
        plan = guarded(info.path, lambda: make_plan(source, self._config, frames))
        source.found = ()
        return Planned(source, frames, plan)

    def silence(self) -> str:
        """Return why there is no plan yet."""
        name, there = self._feed.name, self._feed.topics()
        heard = {a.message.channel.topic for a in self._recent}
        scans = topics.usable(there, self._config.topic)
        silent = ", ".join(t.topic for t in scans if t.topic not in heard)
        if silent:
            return f"{silent}: no message yet (is the sensor's driver running? does its QoS fit?)"
        if scans:
            return f"{', '.join(t.topic for t in scans)}: too few messages so far"
        return f"{name}: no topic with scans yet; there is: {topics.listed(there) or 'no topic'}"


@dataclass(frozen=True, slots=True)
class Planned:
    """The plan, made once enough messages had arrived. source : without its messages."""

    source: HeldMessages
    frames: FrameTree
    plan: Plan


@dataclass(slots=True)
class HeldMessages:
    """Messages that have arrived, as a `MessageSource`."""

    info: LogInfo
    found: Collection[RawMessage]
    tally: Tally = field(default_factory=Tally)
    files: tuple[Path, ...] = ()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages, see MessageSource."""
        for message in self.found:
            if message.channel.topic in topics and (end_ns is None or message.log_time_ns < end_ns):
                yield message

    def close(self) -> None:
        """Do nothing: no file is open."""


class Replay(Feed):
    """The messages of a recording, with their original delays after its first scan."""

    def __init__(self, path: Path, config: ReadConfig) -> None:
        """Open the recording. Raises what `open_log` does."""
        super().__init__(str(path), config)
        self._log = open_log(path, config)
        self._error: LogError | None = None
        self._stop = threading.Event()
        for topic in self._log.info.topics:
            self._offer((topic.topic, topic.type), topic)
        self._refresh()
        self._thread = threading.Thread(target=self._play, args=(self._log,), name="replay", daemon=True)
        self._thread.start()

    def receive(self, timeout_s: float) -> Arrived | None:
        """Return the next message, see Feed. Raises LogError where the recording is damaged."""
        arrived = super().receive(timeout_s)
        if arrived is None and self._error is not None:
            raise self._error
        return arrived

    def close(self) -> None:
        """Stop, and close the recording."""
        super().close()
        self._stop.set()
        self._thread.join()
        self._log.close()

    def _play(self, log: Log) -> None:
        try:
            self._send(log)
        except LogError as error:
            self._error = error
        self._over = True
        self._inbox.wake()

    def _send(self, log: Log) -> None:
        """Send the messages at their times; those before the first scan at once."""
        begin_s, begin_ns = time.monotonic(), log.info.start_ns
        _, end_ns = LogPart(end_ns=log.info.end_ns).with_margin()
        for message in log.messages({topic.topic for topic in log.info.topics}):
            wait_s = (message.log_time_ns - begin_ns) * 1e-9 - (time.monotonic() - begin_s)
            if (end_ns is not None and message.log_time_ns > end_ns) or self._stop.wait(max(wait_s, 0.0)):
                return
            if (message.channel.topic, message.channel.type) in self._subscriptions:
                self._inbox.put(message)
