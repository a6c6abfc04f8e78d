"""Scans of messages that arrive while they are used.

Topics, odometry and transforms are chosen by the code that reads recordings. For that, the first seconds of
messages are held back, looked at as a short recording, and then used like all others.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from pc2grid.arrays import F64
from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, NoScans, TopicError
from pc2grid.io import topics
from pc2grid.io.error_translation import guarded, guarded_stream
from pc2grid.io.frames import FrameTree
from pc2grid.io.live.feed import Arrived, Feed
from pc2grid.io.map_pose import MapPose, MapPoses, map_poses
from pc2grid.io.message_source import Choice, LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.read_plan import Plan, make_plan, published_once
from pc2grid.io.scan_stream import Stream, StreamParameters
from pc2grid.model import ReadReport, Scan


@dataclass(frozen=True, slots=True)
class LiveParameters:
    """When the plan is made, and what is reported; chosen by hand.

    hold_s : log time behind the first scan that is held back for the plan; most transforms are published
    several times in it. retry_s, most_tries : after a plan that failed, how long until the next one, and how
    many are made. poll_s : longest time without a look at the clock. silent_s : time after which a topic that
    says nothing is named. catch_up_s : time for the scans that were held back to be used up, before scans are
    dropped. clock_scans : so many scans in a row with stamps that go back or jump mean that the clock was
    set. gap_s : after a longer time without scans, the pose of a robot without odometry is not known any
    more.
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


class LiveLog:
    """Scans from a feed. Use as a context manager.

    feed : where the messages arrive. lag_s : time from the arrival of the last scan to the end of its use.
    keeps_up : whether the scans that were held back for the plan are used up, so that late ones are dropped.
    believed : the newest pose of the base in the map, by the robot's own localization, on the topic given to
    `listen_to_pose`; None before the first.
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
        self.lag_s = 0.0
        self.on_poll: Callable[[], bool] = lambda: False
        self.believed: MapPose | None = None
        self._pose_topic: str | None = None
        self._poses: MapPoses | None = None
        self._stopped = False
        self._config, self._parameters, self._clock = config, parameters, clock
        self._frames = FrameTree()
        self._held: deque[Arrived] = deque()
        self._source: _Held | None = None
        self._plan: Plan | None = None
        self._stream: Stream | None = None
        self._topic_of: dict[tuple[str, str], TopicInfo] = {}
        self._begin_s = clock()
        self._planned_s = self._heard_s = self._begin_s
        self.keeps_up = False
        self._newest = (0, self._begin_s)
        self._arrived_s: dict[int, float] = {}

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

    def report(self) -> ReadReport:
        """Counts of what was read and of what was lost, so far."""
        tally = self._source.tally if self._source is not None else Tally()
        return ReadReport(
            scans_read=tally.scans_read,
            points_dropped=tally.points_dropped,
            scans_skipped=dict(tally.skipped),
            bytes_lost=tally.bytes_lost,
            warnings=tuple(dict.fromkeys((*tally.warnings, *self._frames.warnings))),
        )

    # --- the plan -------------------------------------------------------------------------------------

    def choose(self) -> Choice:
        """Hold back the first seconds of messages, and decide by them which topics are used.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        p = self._parameters
        tries = 0
        ready_s: float | None = None
        while self._plan is None:
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
                try:
                    self._make_plan()
                except (FrameError, NoScans):
                    if tries >= p.most_tries or self.feed.ended:
                        raise
                    ready_s = now_s + p.retry_s
            if self._plan is None and self.on_poll():
                self._stopped = True
                raise NoScans(self._silence(), hint="--topic chooses another one")
        return self._plan.choice

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

    def _make_plan(self) -> None:
        counts: dict[tuple[str, str], int] = {}
        for message, _ in self._held:
            key = message.channel.topic, message.channel.type
            counts[key] = counts.get(key, 0) + 1
        self._topic_of = {
            (t.topic, t.type): replace(t, message_count=counts.get((t.topic, t.type), 0))
            for t in self.feed.topics()
        }
        held = deque(Arrived(self._named(a.message), a.arrived_s) for a in self._held)
        times = [a.message.log_time_ns for a in held]
        info = LogInfo(
            path=Path(self.feed.name),
            format="live",
            size_bytes=0,
            start_ns=min(times, default=0),
            end_ns=max(times, default=0),
            message_count=len(held),
            topics=tuple(sorted(self._topic_of.values(), key=lambda t: (t.topic, t.type))),
        )
        source = _Held(info, [a.message for a in held])
        self._frames = FrameTree()
        plan = guarded(Path(self.feed.name), lambda: make_plan(source, self._config, self._frames))
        self._held, self._source, self._plan = held, source, plan
        self._new_stream()
        assert self._stream is not None
        self._want()
        source.found = [m for m in source.found if published_once(m.channel)]
        self._planned_s = self._heard_s = self._clock()

    def _want(self) -> None:
        assert self._stream is not None
        self.feed.want(self._stream.topics | (self._poses.topics if self._poses is not None else frozenset()))

    def _new_stream(self) -> None:
        assert self._source is not None and self._plan is not None
        self._stream = Stream(self._source, self._config, self._frames, self._plan, parameters=STREAM)

    def _named(self, message: RawMessage) -> RawMessage:
        """The message with the topic as the plan knows it."""
        key = message.channel.topic, message.channel.type
        return message._replace(channel=self._topic_of.get(key, message.channel))

    # --- scans ----------------------------------------------------------------------------------------

    def scans(self) -> Iterator[Scan]:
        """The scans that belong together, as they arrive, until there are no more or they do not go on.

        They do not go on when the clock was set, or after a gap if there is no odometry: what comes then is
        given by the next call, unless `ended`.

        Raises LogError as `Log.scans` does.
        """
        if self._plan is None:
            self.choose()
        assert self._plan is not None and self._stream is not None
        p = self._parameters
        stream = self._stream
        scans_topic = self._plan.scans
        last_scan_ns: int | None = None
        while True:
            arrived = self._next()
            self._stopped = self._stopped or self.on_poll()
            if arrived is None or self._stopped:
                if self.ended:
                    yield from self._used(stream.release_all())
                    return
                continue
            message = arrived.message
            self._hear_pose(message)
            if message.channel == scans_topic:
                gap_ns = 0 if last_scan_ns is None else message.log_time_ns - last_scan_ns
                last_scan_ns = message.log_time_ns
                if gap_ns > p.gap_s * 1e9 and stream.newest_odometry_ns() is None:
                    self.feed.news.tell(
                        f"{scans_topic.topic}: no scan for {gap_ns * 1e-9:.1f} s; the search starts again",
                        again=True,
                    )
                    yield from self._used(stream.release_all())
                    self._held.appendleft(arrived)
                    self._new_stream()
                    return
                self._arrived_s[message.log_time_ns] = arrived.arrived_s
            yield from self._used(stream.take(message))
            if stream.out_of_time >= p.clock_scans:
                self.feed.news.tell("the clock of the scans was set; the search starts again", again=True)
                self._frames.forget_moving()
                self._new_stream()
                return

    def _used(self, scans: Iterator[Scan]) -> Iterator[Scan]:
        """The scans; when the next one is asked for, the last one was used."""
        assert self._stream is not None
        stream = self._stream
        for scan in guarded_stream(Path(self.feed.name), scans):
            arrived_s = self._arrived_s.pop(stream.last_log_ns, None)
            if len(self._arrived_s) > _MOST_UNDER_WAY:  # of scans that were skipped
                self._arrived_s.clear()
            yield scan
            if arrived_s is not None:
                self.lag_s = self._clock() - arrived_s
                if self.lag_s < self._parameters.caught_up_s:
                    self._keep_up()

    def _next(self) -> Arrived | None:
        """The next message: of those held back, then of those that arrive."""
        if self._held:
            return self._held.popleft()
        arrived = self.feed.receive(self._parameters.poll_s)
        now_s = self._clock()
        if arrived is None:
            self._keep_up()
            self._name_silent(now_s)
            self._find_pose_topic(now_s)
            return None
        if now_s - self._planned_s > self._parameters.catch_up_s:
            self._keep_up()
        if arrived.message.log_time_ns > self._newest[0]:
            self._newest = arrived.message.log_time_ns, arrived.arrived_s
        if self._plan is not None and arrived.message.channel.topic == self._plan.scans.topic:
            self._heard_s = now_s
        return Arrived(self._named(arrived.message), arrived.arrived_s)

    def _keep_up(self) -> None:
        if not self.keeps_up:
            self.keeps_up = True
            self.feed.keep_up()

    # --- the pose that the robot believes in ----------------------------------------------------------

    def listen_to_pose(self, topic: str) -> None:
        """Keep `believed` up to date from a topic of a pose, an odometry or tf, also if it begins later."""
        self._pose_topic = topic

    def _find_pose_topic(self, now_s: float) -> None:
        """Ask for the messages of the pose's topic as soon as it is there."""
        if self._pose_topic is None or self._poses is not None or self._plan is None:
            return
        try:
            base_frame = self._plan.choice.base_frame
            self._poses = map_poses(self.feed.topics(), self._pose_topic, base_frame)
        except TopicError as error:
            if now_s - self._planned_s > self._parameters.silent_s or self.feed.ended:
                self.feed.news.tell(str(error))
            return
        self._want()

    def _hear_pose(self, message: RawMessage) -> None:
        self._find_pose_topic(self._clock())
        if self._poses is None or message.channel.topic not in self._poses.topics:
            return
        self._poses.take(message)
        try:
            self.believed = self._poses.newest(message.log_time_ns)
        except NoScans:
            return
        except FrameError as error:  # tf of the map may begin later
            if self._clock() - self._planned_s > self._parameters.silent_s:
                self.feed.news.tell(str(error))

    # --- odometry, now --------------------------------------------------------------------------------

    @property
    def odometry_frame(self) -> str | None:
        """The parent frame of the robot's odometry, such as `odom`; None if there is none."""
        return None if self._stream is None else self._stream.odometry_frame

    def newest_odometry(self) -> tuple[int, F64] | None:
        """The newest odometry that has arrived, used or not: its stamp and `T_odom_base` (4, 4)."""
        stream = self._stream
        if stream is None:
            return None
        for message in (*(a.message for a in self._held), *self.feed.pending(stream.topics)):
            stream.absorb(self._named(message))
        return stream.newest_odometry()

    def now_ns(self) -> int:
        """The present time of the robot's clock: that of the newest message, and what has passed since."""
        newest_ns, arrived_s = self._newest
        return newest_ns + round((self._clock() - arrived_s) * 1e9)

    # --- what the user should know --------------------------------------------------------------------

    def _name_silent(self, now_s: float) -> None:
        """Name the topic that says nothing."""
        since_s = self._begin_s if self._plan is None else self._heard_s
        if now_s - since_s < self._parameters.silent_s or not self.feed.connected:
            return
        if self._plan is not None:
            self.feed.news.tell(
                f"{self._plan.scans.topic}: no message for {now_s - since_s:.0f} s", again=True
            )
            self._heard_s = now_s
            return
        self.feed.news.tell(self._silence())

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
