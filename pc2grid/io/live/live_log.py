"""Scans of messages that arrive while they are used."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pc2grid.arrays import F64
from pc2grid.config import ReadConfig
from pc2grid.errors import NoScans, Pc2GridError, TopicError
from pc2grid.io.error_translation import guarded_stream
from pc2grid.io.live.feed import Feed, News
from pc2grid.io.live.first_messages import FirstMessages, Planned
from pc2grid.io.live.inbox import Arrived, FeedCounts
from pc2grid.io.map_pose import BelievedPose, MapPose
from pc2grid.io.message_source import Choice, RawMessage, Tally
from pc2grid.io.scan_stream import Stream, StreamParameters
from pc2grid.model import ReadReport, Scan


@dataclass(frozen=True, slots=True)
class LiveParameters:
    """What is reported, and when scans do not go on; chosen by hand.

    poll_s : longest time without a look at the clock. silent_s : time after which a topic without messages
    is named. clock_scans : so many scans in a row with stamps that go back or jump mean that the clock was
    set. gap_s : after a longer time without scans, the pose of a robot without odometry is not known any
    more.
    """

    poll_s: float = 0.2
    silent_s: float = 5.0
    clock_scans: int = 5
    gap_s: float = 2.0


LIVE = LiveParameters()
STREAM = StreamParameters(wait_ns=200_000_000, eager=True)
"""Scans wait for odometry, but not for scans with earlier stamps; and less long than in a recording."""
_MOST_UNDER_WAY = 1000
"""Scans whose time of arrival is remembered; chosen by hand: far more than ever wait."""


class _Times:
    """When scans arrived. lag_s : time from the arrival of the last one to the end of its use."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.lag_s = 0.0
        self._clock = clock
        self._newest = (0, clock())
        self._arrived_s: dict[int, float] = {}

    def arrived(self, arrived: Arrived) -> None:
        """Take note of a scan."""
        if len(self._arrived_s) > _MOST_UNDER_WAY:  # of scans that were skipped
            self._arrived_s.clear()
        log_time_ns = arrived.message.log_time_ns
        self._arrived_s[log_time_ns] = arrived.arrived_s
        self._newest = max(self._newest, (log_time_ns, arrived.arrived_s))

    def used(self, log_time_ns: int) -> None:
        """A scan was used."""
        arrived_s = self._arrived_s.pop(log_time_ns, None)
        if arrived_s is not None:
            self.lag_s = self._clock() - arrived_s

    def now_ns(self) -> int:
        """The present time of the robot's clock: that of the newest scan, and what has passed since."""
        newest_ns, arrived_s = self._newest
        return newest_ns + round((self._clock() - arrived_s) * 1e9)


class LiveLog:
    """Scans from a feed. Use as a context manager.

    feed : where the messages arrive. realtime : whether scans are lost that are not used in time.
    on_poll : called several times a second while scans are awaited and with each scan; if it returns true, no
    more scans are given.
    """

    realtime = True

    def __init__(
        self,
        feed: Feed,
        config: ReadConfig,
        parameters: LiveParameters = LIVE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.feed = feed
        self.on_poll: Callable[[], bool] = lambda: False
        self._config, self._parameters, self._clock = config, parameters, clock
        self._stopped = False
        self._first = FirstMessages(feed, config)
        self._held: deque[Arrived] = deque()  # of the first messages, those that are not used yet
        self._planned: Planned | None = None
        self._stream: Stream | None = None
        self._times = _Times(clock)
        self._pose: BelievedPose | None = None
        self._begun_s = self._heard_s = clock()

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
    def name(self) -> str:
        """For the user."""
        return self.feed.name

    @property
    def counts(self) -> FeedCounts:
        """Of messages that arrived and that were lost."""
        return self.feed.counts

    @property
    def news(self) -> News:
        """What the user should know."""
        return self.feed.news

    @property
    def lag_s(self) -> float:
        """Time from the arrival of the last scan to the end of its use."""
        return self._times.lag_s

    def report(self) -> ReadReport:
        """Counts of what was read and of what was lost, so far."""
        planned = self._planned
        return Tally().report() if planned is None else planned.source.tally.report(planned.frames.warnings)

    def choose(self) -> Choice:
        """Hold back the first seconds of messages, and decide by them which topics are used.

        Raises TopicError, NoScans, UnsupportedSchema or FrameError.
        """
        return self._chosen().plan.choice

    def _chosen(self) -> Planned:
        while self._planned is None:
            arrived = self.feed.receive(self._parameters.poll_s)
            if arrived is not None:
                self._first.add(arrived)
            now_s = self._clock()
            planned = self._first.planned(now_s)
            if planned is not None:
                self._begin(planned, now_s)
            elif self.on_poll():
                self._stopped = True
                raise NoScans(self._first.silence(), hint="--topic chooses another one")
            elif now_s - self._begun_s >= self._parameters.silent_s and self.feed.connected:
                self.news.tell(self._first.silence())
        return self._planned

    def _begin(self, planned: Planned, now_s: float) -> None:
        self._planned = planned
        self._held = deque(map(planned.arrived, self._first.held))
        self._begun_s = self._heard_s = now_s
        self._want(self._new_stream(planned))

    def _new_stream(self, planned: Planned) -> Stream:
        made = planned.source, self._config, planned.frames, planned.plan
        self._stream = Stream(*made, parameters=STREAM)
        return self._stream

    def _want(self, stream: Stream) -> None:
        """Ask for the messages that are used."""
        pose = frozenset() if self._pose is None else self._pose.topics
        self.feed.want(stream.topics | pose)

    # --- scans ----------------------------------------------------------------------------------------

    def parts(self) -> Iterator[Iterator[Scan]]:
        """Scans that belong together, again and again, see `scans`."""
        while not self.ended:
            yield self.scans()

    def scans(self) -> Iterator[Scan]:
        """The scans that belong together, as they arrive, until there are no more or they do not go on.

        They do not go on when the clock was set, or after a gap if there is no odometry: what comes then is
        given by the next call, unless `ended`.

        Raises LogError as `Log.scans` does.
        """
        planned = self._chosen()
        stream = self._stream
        assert stream is not None
        last_scan_ns: int | None = None
        while True:
            arrived = self._next(planned, stream)
            self._stopped = self._stopped or self.on_poll()
            if arrived is None or self._stopped:
                if self.ended:
                    yield from self._used(stream, stream.release_all())
                    return
                continue
            message = arrived.message
            self._hear_pose(message, planned, stream)
            if message.channel == planned.plan.scans:
                if last_scan_ns is not None and self._is_gap(message, last_scan_ns, stream):
                    yield from self._used(stream, stream.release_all())
                    self._held.appendleft(arrived)
                    break
                last_scan_ns = message.log_time_ns
                self._times.arrived(arrived)
            yield from self._used(stream, stream.take(message))
            if stream.out_of_time >= self._parameters.clock_scans:
                self.news.tell("the clock of the scans was set; the search starts again", again=True)
                planned.frames.forget_moving()
                break
        self._new_stream(planned)

    def _is_gap(self, message: RawMessage, last_scan_ns: int, stream: Stream) -> bool:
        """Whether the motion since the last scan is unknown: no scans, and no odometry."""
        gap_s = (message.log_time_ns - last_scan_ns) * 1e-9
        if gap_s <= self._parameters.gap_s or stream.newest_odometry_ns() is not None:
            return False
        self.news.tell(
            f"{message.channel.topic}: no scan for {gap_s:.1f} s; the search starts again", again=True
        )
        return True

    def _used(self, stream: Stream, scans: Iterator[Scan]) -> Iterator[Scan]:
        """The scans; when the next one is asked for, the last one was used."""
        for scan in guarded_stream(Path(self.feed.name), scans):
            log_time_ns = stream.last_log_ns
            yield scan
            self._times.used(log_time_ns)

    def _next(self, planned: Planned, stream: Stream) -> Arrived | None:
        """The next message: of those held back, then of those that arrive."""
        if self._held:
            return self._held.popleft()
        arrived = self.feed.receive(self._parameters.poll_s)
        now_s = self._clock()
        if arrived is None:
            self._name_silent(planned, now_s)
            self._find_pose_topic(planned, stream)
            return None
        arrived = planned.arrived(arrived)
        if arrived.message.channel == planned.plan.scans:
            self._heard_s = now_s
        return arrived

    def _name_silent(self, planned: Planned, now_s: float) -> None:
        """Say that no scan has come for a while."""
        silent_s = now_s - self._heard_s
        if silent_s >= self._parameters.silent_s and self.feed.connected:
            topic = planned.plan.scans.topic
            self.news.tell(f"{topic}: no message for {silent_s:.0f} s", again=True)
            self._heard_s = now_s

    # --- the pose by the robot's own localization ----------------------------------------------------------

    @property
    def believed(self) -> MapPose | None:
        """The newest pose of the base in the map, by the robot's own localization, on the topic given to
        `listen_to_pose`; None before the first."""
        return None if self._pose is None else self._pose.newest

    def listen_to_pose(self, topic: str) -> None:
        """Keep `believed` up to date from a topic of a pose, an odometry or tf, also if it begins later."""
        self._pose = BelievedPose(topic)

    def _find_pose_topic(self, planned: Planned, stream: Stream) -> None:
        """Ask for the messages of the pose's topic as soon as it is there."""
        if self._pose is None or self._pose.topics:
            return
        try:
            self._pose.find(self.feed.topics(), planned.plan.choice.base_frame)
            self._want(stream)
        except TopicError as error:
            self._tell_late(error)

    def _hear_pose(self, message: RawMessage, planned: Planned, stream: Stream) -> None:
        self._find_pose_topic(planned, stream)
        if self._pose is not None:
            self._pose.take(message)
            if self._pose.problem is not None:  # tf of the map may begin later
                self._tell_late(self._pose.problem)

    def _tell_late(self, error: Pc2GridError) -> None:
        """Report what is still missing, after `silent_s` or at the end of the feed."""
        if self._clock() - self._begun_s > self._parameters.silent_s or self.feed.ended:
            self.news.tell(error.in_short)

    # --- odometry, now --------------------------------------------------------------------------------

    @property
    def odometry_frame(self) -> str | None:
        """The parent frame of the robot's odometry, such as `odom`; None if there is none."""
        return None if self._stream is None else self._stream.odometry_frame

    def newest_odometry(self) -> tuple[int, F64] | None:
        """The newest odometry that has arrived, used or not: its stamp and `T_odom_base` (4, 4)."""
        planned, stream = self._planned, self._stream
        if planned is None or stream is None:
            return None
        for message in (*(a.message for a in self._held), *self.feed.pending(stream.topics)):
            stream.absorb(planned.named(message))
        return stream.newest_odometry()

    def now_ns(self) -> int:
        """The present time of the robot's clock: that of the newest scan, and what has passed since."""
        return self._times.now_ns()
