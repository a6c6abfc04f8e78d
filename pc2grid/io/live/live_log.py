"""Scans from messages that arrive while they are used: of a running robot, or of a recording that is
replayed.

The first seconds of messages are held back and read as a recording, by the code that reads recordings, to
plan what is read of the robot and how; then they are used like all others.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from pc2grid.errors import FrameError, LogNotFound, NoScans, TopicError
from pc2grid.geometry import F64
from pc2grid.io import topics
from pc2grid.io.frames import PARAMETERS as FRAMES, FrameTree
from pc2grid.io.map_pose import BelievedPose, MapPose
from pc2grid.io.plan import Plan, make_plan, published_once
from pc2grid.io.recording import open_log
from pc2grid.io.source import Choice, LogInfo, RawMessage, Tally, TopicInfo, guarded, guarded_stream
from pc2grid.io.stream import LogPart, Stream, StreamParameters
from pc2grid.libraries import require
from pc2grid.model import ReadReport, Scan
from pc2grid.settings import ReadConfig

# --- feeds: topics, subscriptions to those that are wanted, and a queue of their messages -------------


class Arrived(NamedTuple):
    """A message, and when it arrived: seconds of `time.monotonic`."""

    message: RawMessage
    arrived_s: float


@dataclass(slots=True)
class FeedCounts:
    """The counts of the messages of a feed so far.

    arrived : messages. dropped : scans that waited too long because the computer is too slow. reconnected :
    number of times that a lost connection was made again.
    """

    arrived: int = 0
    dropped: int = 0
    reconnected: int = 0


@dataclass(frozen=True, slots=True)
class InboxParameters:
    """How much may wait; chosen by hand.

    most_lag_s : a scan that has waited longer than this is dropped when a newer one arrives.
    catch_up_s : time for what waited during the preparations to be used up, before scans are dropped.
    most_bytes, most_messages : of all messages that wait; beyond, the oldest are dropped.
    """

    most_lag_s: float = 0.1
    catch_up_s: float = 10.0
    most_bytes: int = 256_000_000
    most_messages: int = 100_000


INBOX = InboxParameters()


class Inbox:
    """A queue that drops scans rather than letting them wait. One thread fills it, another one empties it.

    Transforms and odometry are small and depend on each other, so they are kept.
    """

    def __init__(
        self,
        counts: FeedCounts,
        parameters: InboxParameters = INBOX,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._counts, self._parameters, self._clock = counts, parameters, clock
        self._entries: dict[int, Arrived] = {}  # by their number, oldest first
        self._scans: deque[int] = deque()  # the numbers of those that are scans
        self._bytes = 0
        self._changed = threading.Condition()
        self._patient_until_s = math.inf  # before that, scans are not dropped for their lag

    def prepared(self) -> None:
        """End the preparations: once the messages that wait now are used up, scans that wait too long are
        dropped."""
        with self._changed:
            self._patient_until_s = self._clock() + self._parameters.catch_up_s

    def put(self, message: RawMessage, arrived_s: float | None = None) -> None:
        """Add a message. arrived_s : None: now."""
        now_s = self._clock() if arrived_s is None else arrived_s
        with self._changed:
            self._counts.arrived += 1
            self._entries[self._counts.arrived] = Arrived(message, now_s)
            self._bytes += len(message.data)
            if message.channel.type in topics.SENSORS:
                self._scans.append(self._counts.arrived)
            oldest_s = now_s - (self._parameters.most_lag_s if now_s >= self._patient_until_s else math.inf)
            while len(self._scans) > 1 and (
                self._bytes > self._parameters.most_bytes
                or self._entries[self._scans[0]].arrived_s < oldest_s
            ):
                self._drop(self._scans[0])
            while len(self._entries) > self._parameters.most_messages:
                self._drop(next(iter(self._entries)))
            self._changed.notify()

    def _take(self, number: int) -> Arrived:
        arrived = self._entries.pop(number)
        self._bytes -= len(arrived.message.data)
        if self._scans and self._scans[0] == number:
            self._scans.popleft()
        return arrived

    def _drop(self, number: int) -> None:
        self._take(number)
        self._counts.dropped += 1

    def get(self, timeout_s: float) -> Arrived | None:
        """Return the oldest message; None if there is none within `timeout_s` seconds."""
        end_s = self._clock() + timeout_s
        with self._changed:
            while not self._entries:
                if math.isfinite(self._patient_until_s):
                    self._patient_until_s = 0.0
                left_s = end_s - self._clock()
                if left_s <= 0 or not self._changed.wait(left_s):
                    return None
            return self._take(next(iter(self._entries)))

    def wake(self) -> None:
        """Wake up `get`: nothing more will come."""
        with self._changed:
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._entries)


@dataclass(slots=True)
class News:
    """Sentences for the user, each at most once, until they are taken."""

    _told: set[str] = field(default_factory=set)
    _waiting: list[str] = field(default_factory=list)

    def tell(self, sentence: str, *, again: bool = False) -> None:
        """Add a sentence. again : even if it was told before."""
        if again or sentence not in self._told:
            self._told.add(sentence)
            self._waiting.append(sentence)

    def take(self) -> list[str]:
        """Return the sentences since the last call."""
        taken, self._waiting = self._waiting, []
        return taken


class Feed:
    """A source of messages that arrive while they are used.

    A kind of connection derives from it. It calls `_offer` for each topic, `_refresh` when topics came or
    went, and puts messages into `_inbox`, also from other threads.

    name : for the user. counts, news : for reports. connected : True if messages can arrive now.
    """

    def __init__(self, name: str, config: ReadConfig, inbox: InboxParameters = INBOX) -> None:
        self.name = name
        self.counts, self.news = FeedCounts(), News()
        self.connected = True
        self._over = False
        self._inbox = Inbox(self.counts, inbox)
        self._lock = threading.RLock()
        self._topics: dict[tuple[str, str], TopicInfo] = {}
        self._offered: dict[Hashable, TopicInfo] = {}
        self._subscriptions: dict[Hashable, Any] = {}
        self._wanted: frozenset[str] | None = None
        self._scans_topic = config.topic

    @property
    def ended(self) -> bool:
        """Return whether the feed is over and all of its messages are received."""
        return self._over and not len(self._inbox)

    def topics(self) -> tuple[TopicInfo, ...]:
        """Return the topics that are known so far; their message_count is None."""
        with self._lock:
            return tuple(self._topics.values())

    def want(self, topics: Collection[str]) -> None:
        """Subscribe to these topics only, and drop scans that wait too long from now on."""
        with self._lock:
            self._wanted = frozenset(topics)
        self._inbox.prepared()
        self._refresh()

    def receive(self, timeout_s: float) -> Arrived | None:
        """Return the next message; None if none arrives within `timeout_s` seconds.

        Raises LogError if the feed is damaged or cannot be read any more.
        """
        return self._inbox.get(timeout_s)

    def close(self) -> None:
        """Release connections, threads and files."""
        self._over = True
        self._inbox.wake()

    # --- for the kinds of connections -----------------------------------------------------------------

    def _offer(self, key: Hashable, topic: TopicInfo) -> None:
        """Add a topic that can be subscribed to, by a key of the connection's own; its first description
        stays."""
        with self._lock:
            self._offered[key] = self._topics.setdefault((topic.topic, topic.type), topic)

    def _withdraw(self, keys: Collection[Hashable] | None = None) -> None:
        """Remove topics that cannot be subscribed to any more; None: all, as the connection is lost."""
        with self._lock:
            for key in list(self._offered) if keys is None else keys:
                self._offered.pop(key, None)
                self._subscriptions.pop(key, None)

    def _refresh(self) -> None:
        """Subscribe to the topics that are wanted and new, and no longer to those that are not wanted."""
        with self._lock:
            there = list(self._offered.values())
            wanted = {key: topic for key, topic in self._offered.items() if self._is_wanted(topic, there)}
            old = {key: given for key, given in self._subscriptions.items() if key not in wanted}
            new = {key: topic for key, topic in wanted.items() if key not in self._subscriptions}
            for key in old:
                del self._subscriptions[key]
            if old:
                self._unsubscribe(old)
            if new:
                self._subscriptions.update(self._subscribe(new))

    def _is_wanted(self, topic: TopicInfo, there: Sequence[TopicInfo]) -> bool:
        if self._wanted is not None:
            return topic.topic in self._wanted
        return topics.may_be_used(topic, there, self._scans_topic)

    def _subscribe(self, new: Mapping[Hashable, TopicInfo]) -> Mapping[Hashable, Any]:
        """Subscribe to topics; the value that is returned for each is given to `_unsubscribe`."""
        return new

    def _unsubscribe(self, old: Mapping[Hashable, Any]) -> None:
        """Cancel subscriptions."""

    def _set_connected(self, connected: bool) -> None:
        """Set the state of the connection, and tell the user when it is lost."""
        if self.connected and not connected and not self._over:
            self.news.tell(f"{self.name}: the connection is lost; trying again", again=True)
        elif connected and not self.connected:
            self.counts.reconnected += 1
        self.connected = connected


# --- scans of a feed ----------------------------------------------------------------------------------

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
        self._first = FirstSeconds(feed, config)
        self._held: deque[Arrived] = deque()  # of the first messages, those that are not used yet
        self._plan: Plan | None = None
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
        return self._first.tally.report(self._first.frames.warnings)

    def choose(self) -> Choice:
        """Hold back the first seconds of messages, and choose the topics to use by them.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        return self._chosen().choice

    def _chosen(self) -> Plan:
        while self._plan is None:
            arrived = self.feed.receive(self._parameters.poll_s)
            if arrived is not None:
                self._first.add(arrived)
            self._plan = self._first.planned()
            if self._plan is not None:
                self._held = self._first.held
                self._begun_s = self._heard_s = self._clock()
                self._want(self._new_stream(self._plan))
            elif self.on_poll():
                self._stopped = True
                raise NoScans(self._first.silence(), hint="--topic chooses another one")
            elif self._clock() - self._begun_s >= self._parameters.silent_s and self.feed.connected:
                self.news.tell(self._first.silence())
        return self._plan

    def _new_stream(self, plan: Plan) -> Stream:
        first = self._first
        self._stream = Stream(first, self._config, first.frames, plan, parameters=STREAM)
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
        plan, last_scan_ns = self._chosen(), None
        stream, topic = self._stream, plan.sensors[0].topic
        assert stream is not None
        while True:
            arrived = self._next(topic)
            self._stopped = self._stopped or self.on_poll()
            if self._stopped or (arrived is None and self.ended):
                yield from self._used(stream, stream.release_all())
                return
            self._hear_pose(plan, stream, arrived)
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
                self._first.frames.forget_moving()
                break
        self._new_stream(plan)

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

    def _hear_pose(self, plan: Plan, stream: Stream, arrived: Arrived | None) -> None:
        """Update the pose with the next message. Report what is missing: the topic, or tf of the map, may
        begin later."""
        pose = self._pose
        if pose is None:
            return
        try:
            if not pose.topics:
                pose.find(self.feed.topics(), plan.choice.base_frame)
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


class FirstSeconds:
    """The messages that are held back, as a `MessageSource`.

    All of topics that may be published only once, of others the last seconds.

    tally, frames : those of the plan.
    """

    files: tuple[Path, ...] = ()

    def __init__(self, feed: Feed, config: ReadConfig) -> None:
        self.tally, self.frames = Tally(), FrameTree()
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

    @property
    def info(self) -> LogInfo:
        """Return the facts about them, and the topics that are known so far."""
        found = [a.message for a in self.held]
        counts, times_ns = Counter(m.channel for m in found), [m.log_time_ns for m in found]
        known = [replace(t, message_count=counts[t]) for t in self._feed.topics()]
        return LogInfo(
            path=Path(self._feed.name),
            format="live",
            size_bytes=0,
            start_ns=min(times_ns, default=0),
            end_ns=max(times_ns, default=0),
            message_count=len(found),
            topics=tuple(sorted(known, key=lambda t: (t.topic, t.type))),
        )

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages, see MessageSource."""
        for message, _ in self.held:
            if message.channel.topic in topics and (end_ns is None or message.log_time_ns < end_ns):
                yield message

    def close(self) -> None:
        """Do nothing: no file is open."""

    def planned(self) -> Plan | None:
        """Return the plan once it can be made; None before.

        Raises the error of the last try: FrameError, NoScans; TopicError and UnsupportedSchema at once.
        """
        ended = self._feed.ended
        scans_ns = [a.message.log_time_ns for a in self._recent if a.message.channel.type in topics.SENSORS]
        if not ended and (not scans_ns or scans_ns[-1] - scans_ns[0] < self._needed_s * 1e9):
            return None
        self._needed_s *= 2
        self.tally, self.frames = Tally(), FrameTree()
        try:
            return guarded(Path(self._feed.name), lambda: make_plan(self, self._config, self.frames))
        except (FrameError, NoScans):
            if ended or self._needed_s > _MOST_S:
                raise
            return None

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
        self._messages = self._log.messages({topic.topic for topic in info.topics})
        self._next = next(self._messages, None)
        self._begin_s, self._begin_ns = time.monotonic(), info.start_ns
        _, self._end_ns = LogPart(end_ns=info.end_ns).with_margin()

    def receive(self, timeout_s: float) -> Arrived | None:
        """Return the next message, see Feed. Raises LogError where the recording is damaged."""
        while self._next is not None:
            due_s = self._begin_s + max((self._next.log_time_ns - self._begin_ns) * 1e-9, 0.0)
            wait_s = due_s - time.monotonic()
            if wait_s > 0.0:
                timeout_s = min(timeout_s, wait_s)
                break
            self._arrive(self._next, due_s)
        self._over = self._next is None
        return super().receive(timeout_s)

    def _arrive(self, message: RawMessage, due_s: float) -> None:
        if (message.channel.topic, message.channel.type) in self._subscriptions:
            self._inbox.put(message, due_s)
        self._next = next(self._messages, None)
        if self._next is not None and self._end_ns is not None and self._next.log_time_ns > self._end_ns:
            self._next = None

    def close(self) -> None:
        """Close the recording."""
        super().close()
        self._log.close()
