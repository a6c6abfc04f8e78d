"""Scans of messages that arrive while they are used.

Topics, odometry and transforms are chosen by the code that reads recordings. For that, the first seconds of
messages are held back, looked at as a short recording, and then used like all others.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from pc2grid.arrays import F64
from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, NoScans, Pc2GridError, TopicError
from pc2grid.io import topics
from pc2grid.io.error_translation import guarded, guarded_stream
from pc2grid.io.frames import FrameTree
from pc2grid.io.live.feed import Feed
from pc2grid.io.live.inbox import Arrived
from pc2grid.io.map_pose import MapPose, MapPoses, map_poses
from pc2grid.io.message_source import Choice, LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.read_plan import Plan, make_plan, published_once
from pc2grid.io.scan_stream import Stream, StreamParameters
from pc2grid.model import ReadReport, Scan


@dataclass(frozen=True, slots=True)
class LiveParameters:
    """When the plan is made, and what is reported; chosen by hand.

    hold_s : log time behind the first scan that is held back for the plan; most transforms are published
    several times in it. retry_s, most_tries : after a plan that failed, how long until the next one, and
    how many are made. poll_s : longest time without a look at the clock. silent_s : time after which a
    topic without messages is named. catch_up_s : time for the scans that were held back to be used up,
    before scans are dropped. clock_scans : so many scans in a row with stamps that go back or jump mean
    that the clock was set. gap_s : after a longer time without scans, the pose of a robot without
    odometry is not known any more.
    """

    hold_s: float = 3.0
    retry_s: float = 1.0
    most_tries: int = 8
    poll_s: float = 0.2
    silent_s: float = 5.0
    catch_up_s: float = 10.0
    caught_up_s: float = 0.1
    clock_scans: int = 5
    gap_s: float = 2.0


LIVE = LiveParameters()
STREAM = StreamParameters(wait_ns=200_000_000, eager=True)
"""Scans wait for odometry, but not for scans with earlier stamps; and less long than in a recording."""
_MOST_UNDER_WAY = 1000
"""Scans whose time of arrival is remembered; chosen by hand: far more than ever wait."""


@dataclass(slots=True)
class _Held:
    """The first messages, as a MessageSource for the plan."""

    info: LogInfo
    found: Collection[RawMessage]
    tally: Tally = field(default_factory=Tally)
    files: tuple[Path, ...] = ()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See MessageSource."""
        for message in self.found:
            if message.channel.topic in topics and (end_ns is None or message.log_time_ns < end_ns):
                yield message

    def close(self) -> None:
        """Nothing is open."""


@dataclass(slots=True)
class _Reading:
    """What was decided once enough had arrived, and what reads by it.

    topic_of : the topics as the plan knows them, by name and type. planned_s : when that was.
    """

    source: _Held
    frames: FrameTree
    plan: Plan
    topic_of: dict[tuple[str, str], TopicInfo]
    planned_s: float
    stream: Stream

    def named(self, message: RawMessage) -> RawMessage:
        """The message with the topic as the plan knows it."""
        return _named(message, self.topic_of)


class _Times:
    """When messages arrived. lag_s : time from the arrival of the last scan to the end of its use."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.lag_s = 0.0
        self._clock = clock
        self._newest = (0, clock())
        self._arrived_s: dict[int, float] = {}

    def arrived(self, arrived: Arrived) -> None:
        """Take note of a message."""
        if arrived.message.log_time_ns > self._newest[0]:
            self._newest = arrived.message.log_time_ns, arrived.arrived_s

    def begun(self, arrived: Arrived) -> None:
        """A scan begins to be used."""
        if len(self._arrived_s) > _MOST_UNDER_WAY:  # of scans that were skipped
            self._arrived_s.clear()
        self._arrived_s[arrived.message.log_time_ns] = arrived.arrived_s

    def used(self, log_time_ns: int) -> bool:
        """A scan was used. Returns whether it is known when it arrived."""
        arrived_s = self._arrived_s.pop(log_time_ns, None)
        if arrived_s is None:
            return False
        self.lag_s = self._clock() - arrived_s
        return True

    def now_ns(self) -> int:
        """The present time of the robot's clock: that of the newest message, and what has passed since."""
        newest_ns, arrived_s = self._newest
        return newest_ns + round((self._clock() - arrived_s) * 1e9)


class _BelievedPose:
    """The newest pose on a topic; None before the first. poses : None until the topic is there."""

    def __init__(self, topic: str) -> None:
        self.newest: MapPose | None = None
        self._topic = topic
        self._poses: MapPoses | None = None

    @property
    def topics(self) -> frozenset[str]:
        """The topics whose messages are used."""
        return frozenset() if self._poses is None else self._poses.topics

    def find(self, known: tuple[TopicInfo, ...], base_frame: str) -> bool:
        """Look for the topic. Returns whether it was just found. Raises TopicError, UnsupportedSchema."""
        if self._poses is not None:
            return False
        self._poses = map_poses(known, self._topic, base_frame)
        return True

    def take(self, message: RawMessage) -> None:
        """Take in a message. Raises FrameError as long as tf lacks the map."""
        if self._poses is not None and message.channel.topic in self._poses.topics:
            self._poses.take(message)
            with contextlib.suppress(NoScans):
                self.newest = self._poses.newest(message.log_time_ns)


class LiveLog:
    """Scans from a feed. Use as a context manager.

    feed : where the messages arrive.
    keeps_up : whether the scans that were held back for the plan are used up, so that late ones are dropped.
    on_poll : called several times a second while scans are awaited and with each scan; if it returns true, no
    more scans are given.
    """

    def __init__(
        self,
        feed: Feed,
        config: ReadConfig,
        parameters: LiveParameters = LIVE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.feed = feed
        self.keeps_up = False
        self.on_poll: Callable[[], bool] = lambda: False
        self._config, self._parameters, self._clock = config, parameters, clock
        self._stopped = False
        self._held: deque[Arrived] = deque()
        self._reading: _Reading | None = None
        self._times = _Times(clock)
        self._pose: _BelievedPose | None = None
        self._heard_s = clock()

    def __enter__(self) -> LiveLog:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the feed."""
        self.feed.close()

    @property
    def ended(self) -> bool:
        """Whether no scan will come any more."""
        return self._stopped or (self.feed.ended and not self._held)

    @property
    def lag_s(self) -> float:
        """Time from the arrival of the last scan to the end of its use."""
        return self._times.lag_s

    def report(self) -> ReadReport:
        """Counts of what was read and of what was lost, so far."""
        reading = self._reading
        return Tally().report() if reading is None else reading.source.tally.report(reading.frames.warnings)

    # --- the plan -------------------------------------------------------------------------------------

    def choose(self) -> Choice:
        """Hold back the first seconds of messages, and decide by them which topics are used.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        return self._chosen().plan.choice

    def _chosen(self) -> _Reading:
        p = self._parameters
        tries = 0
        ready_s: float | None = None
        while self._reading is None:
            arrived = self.feed.receive(p.poll_s)
            if arrived is not None:
                self._hold(arrived)
            now_s = self._clock()
            if ready_s is None and (self._held_enough() or self.feed.ended):
                ready_s = now_s
            if ready_s is None:
                self._name_silent(now_s)
            elif now_s >= ready_s:
                tries += 1
                self._try_plan(last=tries >= p.most_tries or self.feed.ended)
                ready_s = now_s + p.retry_s
            if self._reading is None and self.on_poll():
                self._stopped = True
                raise NoScans(self._silence(), hint="--topic chooses another one")
        return self._reading

    def _hold(self, arrived: Arrived) -> None:
        self._held.append(arrived)
        limit_ns = round(2 * self._parameters.hold_s * 1e9)
        while arrived.message.log_time_ns - self._held[
            0
        ].message.log_time_ns > limit_ns and not published_once(self._held[0].message.channel):
            self._held.popleft()

    def _held_enough(self) -> bool:
        scans = [a.message.log_time_ns for a in self._held if a.message.channel.type in topics.SENSORS]
        if not scans:
            return False
        return self._held[-1].message.log_time_ns - scans[0] >= self._parameters.hold_s * 1e9

    def _try_plan(self, *, last: bool) -> None:
        """Make the plan, if it can be made; else raise what is missing, if it is the `last` try."""
        try:
            self._reading = self._planned()
        except (FrameError, NoScans):
            if last:
                raise
            return
        named = self._reading.named
        self._held = deque(Arrived(named(a.message), a.arrived_s) for a in self._held)
        self._want()
        self._heard_s = self._reading.planned_s

    def _planned(self) -> _Reading:
        counts = Counter((a.message.channel.topic, a.message.channel.type) for a in self._held)
        topic_of = {
            (t.topic, t.type): replace(t, message_count=counts[t.topic, t.type]) for t in self.feed.topics()
        }
        found = [_named(a.message, topic_of) for a in self._held]
        times = [message.log_time_ns for message in found]
        info = LogInfo(
            path=Path(self.feed.name),
            format="live",
            size_bytes=0,
            start_ns=min(times, default=0),
            end_ns=max(times, default=0),
            message_count=len(found),
            topics=tuple(sorted(topic_of.values(), key=lambda t: (t.topic, t.type))),
        )
        source, frames = _Held(info, found), FrameTree()
        plan = guarded(info.path, lambda: make_plan(source, self._config, frames))
        stream = Stream(source, self._config, frames, plan, parameters=STREAM)
        source.found = [m for m in found if published_once(m.channel)]
        return _Reading(source, frames, plan, topic_of, self._clock(), stream)

    def _want(self) -> None:
        """Ask for the messages that are used."""
        assert self._reading is not None
        pose = frozenset() if self._pose is None else self._pose.topics
        self.feed.want(self._reading.stream.topics | pose)

    def _begin_anew(self, reading: _Reading) -> None:
        reading.stream = Stream(reading.source, self._config, reading.frames, reading.plan, parameters=STREAM)

    # --- scans ----------------------------------------------------------------------------------------

    def scans(self) -> Iterator[Scan]:
        """The scans that belong together, as they arrive, until there are no more or they do not go on.

        They do not go on when the clock was set, or after a gap if there is no odometry: what comes then is
        given by the next call, unless `ended`.

        Raises LogError as `Log.scans` does.
        """
        reading = self._chosen()
        stream = reading.stream
        last_scan_ns: int | None = None
        while True:
            arrived = self._next(reading)
            self._stopped = self._stopped or self.on_poll()
            if arrived is None or self._stopped:
                if self.ended:
                    yield from self._used(stream, stream.release_all())
                    return
                continue
            message = arrived.message
            self._hear_pose(message, reading)
            if message.channel == reading.plan.scans:
                if last_scan_ns is not None and self._is_gap(message, last_scan_ns, stream):
                    yield from self._used(stream, stream.release_all())
                    self._held.appendleft(arrived)
                    break
                last_scan_ns = message.log_time_ns
                self._times.begun(arrived)
            yield from self._used(stream, stream.take(message))
            if stream.out_of_time >= self._parameters.clock_scans:
                self.feed.news.tell("the clock of the scans was set; the search starts again", again=True)
                reading.frames.forget_moving()
                break
        self._begin_anew(reading)

    def _is_gap(self, message: RawMessage, last_scan_ns: int, stream: Stream) -> bool:
        """Whether the motion since the last scan is unknown: no scans, and no odometry."""
        gap_s = (message.log_time_ns - last_scan_ns) * 1e-9
        if gap_s <= self._parameters.gap_s or stream.newest_odometry_ns() is not None:
            return False
        self.feed.news.tell(
            f"{message.channel.topic}: no scan for {gap_s:.1f} s; the search starts again", again=True
        )
        return True

    def _used(self, stream: Stream, scans: Iterator[Scan]) -> Iterator[Scan]:
        """The scans; when the next one is asked for, the last one was used."""
        for scan in guarded_stream(Path(self.feed.name), scans):
            log_time_ns = stream.last_log_ns
            yield scan
            if self._times.used(log_time_ns) and self.lag_s < self._parameters.caught_up_s:
                self._keep_up()

    def _next(self, reading: _Reading) -> Arrived | None:
        """The next message: of those held back, then of those that arrive."""
        if self._held:
            return self._held.popleft()
        arrived = self.feed.receive(self._parameters.poll_s)
        now_s = self._clock()
        if arrived is None:
            self._keep_up()
            self._name_silent(now_s)
            self._find_pose_topic(reading)
            return None
        if now_s - reading.planned_s > self._parameters.catch_up_s:
            self._keep_up()
        self._times.arrived(arrived)
        if arrived.message.channel.topic == reading.plan.scans.topic:
            self._heard_s = now_s
        return Arrived(reading.named(arrived.message), arrived.arrived_s)

    def _keep_up(self) -> None:
        if not self.keeps_up:
            self.keeps_up = True
            self.feed.keep_up()

    # --- the pose by the robot's own localization ----------------------------------------------------------

    @property
    def believed(self) -> MapPose | None:
        """The newest pose of the base in the map, by the robot's own localization, on the topic given to
        `listen_to_pose`; None before the first."""
        return None if self._pose is None else self._pose.newest

    def listen_to_pose(self, topic: str) -> None:
        """Keep `believed` up to date from a topic of a pose, an odometry or tf, also if it begins later."""
        self._pose = _BelievedPose(topic)

    def _find_pose_topic(self, reading: _Reading) -> None:
        """Ask for the messages of the pose's topic as soon as it is there."""
        if self._pose is None:
            return
        try:
            if self._pose.find(self.feed.topics(), reading.plan.choice.base_frame):
                self._want()
        except TopicError as error:
            self._tell_late(error, reading)

    def _hear_pose(self, message: RawMessage, reading: _Reading) -> None:
        self._find_pose_topic(reading)
        if self._pose is not None:
            try:
                self._pose.take(message)
            except FrameError as error:  # tf of the map may begin later
                self._tell_late(error, reading)

    def _tell_late(self, error: Pc2GridError, reading: _Reading) -> None:
        """Report what is still missing, after `silent_s` or at the end of the feed."""
        if self._clock() - reading.planned_s > self._parameters.silent_s or self.feed.ended:
            self.feed.news.tell(str(error))

    # --- odometry, now --------------------------------------------------------------------------------

    @property
    def odometry_frame(self) -> str | None:
        """The parent frame of the robot's odometry, such as `odom`; None if there is none."""
        return None if self._reading is None else self._reading.stream.odometry_frame

    def newest_odometry(self) -> tuple[int, F64] | None:
        """The newest odometry that has arrived, used or not: its stamp and `T_odom_base` (4, 4)."""
        reading = self._reading
        if reading is None:
            return None
        for message in (*(a.message for a in self._held), *self.feed.pending(reading.stream.topics)):
            reading.stream.absorb(reading.named(message))
        return reading.stream.newest_odometry()

    def now_ns(self) -> int:
        """The present time of the robot's clock: that of the newest message, and what has passed since."""
        return self._times.now_ns()

    # --- what the user should know --------------------------------------------------------------------

    def _name_silent(self, now_s: float) -> None:
        """Name the topic without messages."""
        silent_s = now_s - self._heard_s
        if silent_s < self._parameters.silent_s or not self.feed.connected:
            return
        if self._reading is None:
            self.feed.news.tell(self._silence())
            return
        self.feed.news.tell(f"{self._reading.plan.scans.topic}: no message for {silent_s:.0f} s", again=True)
        self._heard_s = now_s

    def _silence(self) -> str:
        """Why there is no plan yet."""
        there = self.feed.topics()
        if not there:
            return f"{self.feed.name}: no topics yet"
        heard = {a.message.channel.topic for a in self._held}
        scans = topics.usable(there, self._config.topic)
        if not scans:
            listed = ", ".join(f"{t.topic} ({t.type})" for t in there[:12])
            return f"{self.feed.name}: no topic with scans yet; there is: {listed}"
        silent = ", ".join(t.topic for t in scans if t.topic not in heard)
        if not silent:
            return f"{', '.join(t.topic for t in scans)}: too few messages so far"
        return f"{silent}: no message yet (is the sensor's driver running? does its QoS fit?)"


def _named(message: RawMessage, topic_of: Mapping[tuple[str, str], TopicInfo]) -> RawMessage:
    """The message with one of the topics, by name and type."""
    key = message.channel.topic, message.channel.type
    return message._replace(channel=topic_of.get(key, message.channel))
