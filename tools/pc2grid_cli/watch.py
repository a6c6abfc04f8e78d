"""`pc2grid watch`: where in the database is the robot that is running now?

What is followed is a robot, or a finished recording of one, of which every scan is used. After each metre the
database is searched, or with --check-topic the pose is judged that the robot believes in; a line is printed,
and the robot is told, if that is asked for.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from pc2grid import libraries
from pc2grid.display import plain, probability
from pc2grid.errors import ConfigError, TrackingLost, one_line
from pc2grid.geometry import SE2
from pc2grid.io.live.live_log import FeedCounts, LiveLog, News, is_robot, open_live
from pc2grid.io.live.nav2 import Nav2Publisher, Outlet
from pc2grid.io.map_pose import BelievedPose, MapPose
from pc2grid.io.recording import Log, open_log
from pc2grid.io.source import Choice, RawMessage
from pc2grid.model import ReadReport, RegisteredScan, Scan
from pc2grid.observer import Observer
from pc2grid.pipeline import follow
from pc2grid.settings import ReadConfig
from pc2grid_cli import console, known_pose, options
from pc2grid_cli.documents import Document
from signature.config import Config
from signature.database import SubmapDatabase
from signature.database.protocol import BuildingFrame, SessionInfo
from signature.localization.answer import Answer, answer_in_building, pose_text
from signature.localization.joining.building import map_of
from signature.localization.localizer import Follower, Localizer, ResetPolicy
from signature.localization.map_index import MapIndex
from signature.localization.pose_check import PoseCheck, PoseWatch
from signature.localization.posterior import Prior
from signature.sessions import query_config

ResultT = TypeVar("ResultT")


def run(given: options.Watch, terminal: console.Console) -> int | None:
    """Follow a robot or a recording, and print what is found. Return the exit code."""
    libraries.require(libraries.of_addresses(given.source, given.database))
    settings = given.settings()
    prior, check_topic = known_pose.region(given), given.check_topic
    if given.first and (given.publish == "tf" or check_topic is not None):
        goes_on = "--publish tf" if given.publish == "tf" else "--check-topic"
        raise ConfigError(f"--first: {goes_on} goes on until it is stopped", hint="leave --first out")
    if given.publish != "none" or given.publish_map:
        if check_topic is not None:
            raise ConfigError("--check-topic and --publish do not go together", hint="run `watch` twice")
        if not is_robot(given.source):
            raise ConfigError(f"--publish: {given.source} takes no messages", hint="ws://ROBOT:8765 does")
    end_s = math.inf if given.timeout is None else time.monotonic() + given.timeout
    with (
        known_pose.searched(given) as (opened, _),
        followed(given.source, settings.read, real_time=given.real_time) as drive,
    ):
        following = Following(given, drive, opened, query_config(opened, settings), end_s, terminal)
        if check_topic is not None:
            good = _check(following, check_topic)
        else:
            with _robot_of(following) as robot:
                # The region is that of the first scan.
                good = _search(following, robot, prior and replace(prior, stamp_ns=0))
        _summarize(drive, terminal)
    return None if good else console.UNSURE


@dataclass(frozen=True)
class Following:
    """A robot, or a recording of one, that is followed until `end_s` of `time.monotonic`, or to its end.

    config : see `query_config`.
    """

    given: options.Watch
    drive: ScanSource
    database: SubmapDatabase
    config: Config
    end_s: float
    terminal: console.Console

    @property
    def index(self) -> MapIndex:
        """Return the maps, prepared for searches."""
        return MapIndex.of(self.database, self.config, self.terminal)

    def run(self, searcher: Any, use: Callable[[ResultT, threading.Lock], bool]) -> None:
        """Search after each metre.

        searcher : what `Follower` takes. use : what to do with each result, and with the lock that is held
        to read the database; true if that was enough.
        """
        drive, over, step_m = self.drive, False, self.config.relocalize.step_m
        with Follower(searcher, beside=drive.realtime, step_m=step_m) as follower:

            def poll() -> bool:
                nonlocal over
                _print_news(drive)
                for result in follower.take():
                    over = over or use(result, follower.lock)
                over = over or time.monotonic() > self.end_s
                return over

            drive.on_poll = poll  # a robot may be silent from the beginning
            choice = drive.choose()
            self.terminal.note(f"{drive.name}: {choice.topic} ({choice.sensor}): {choice.reason}", level=1)
            feed(drive, follower, self.config, poll, observer=self.terminal)


def _search(following: Following, robot: _Robot, prior: Prior | None) -> bool:
    """Follow the robot. Return whether it is located at last.

    prior : where the robot is at the beginning, as far as it is known.
    """
    given, index, located = following.given, following.index, False

    def use(found: Answer, lock: threading.Lock) -> bool:
        nonlocal located
        answer = answer_in_building(replace(found, history=()), robot.frames)
        published = robot.tell(answer, lock)
        document = _document(answer, following.drive, robot, published)
        console.print_result(document if given.json else as_text(answer, published), indent=None)
        located = answer.status == "located"
        return answer.is_told and given.first

    following.run(Localizer(index if prior is None else index.within(prior)), use)
    return located


def _check(following: Following, topic: str) -> bool:
    """Follow the robot, and judge the pose that it believes in. Return whether the last one was fine."""
    given, drive, fine = following.given, following.drive, False
    drive.listen_to_pose(topic)

    def use(checked: PoseCheck, lock: threading.Lock) -> bool:
        nonlocal fine
        fine = checked.status == "fine"
        document = {
            **known_pose.judgement(checked, following.database.location),
            **live(drive, checked.elapsed_s),
            "path_m": checked.path_m,
        }
        said = plain(document) if given.json else known_pose.as_text(checked)
        console.print_result(said, indent=None)
        return False

    following.run(PoseWatch(following.index, lambda: drive.believed, given.session), use)
    if drive.believed is None:
        console.warn(f"{topic}: no pose of the robot in a map; nothing was checked")
    return fine


@dataclass(kw_only=True)
class _Robot:
    """The robot that is told where it is.

    sessions : of the database, by name. frames : of the buildings that answers are in, by session.
    publisher : None if it is not told anything. map_session : the session whose map was published.
    """

    following: Following
    sessions: Mapping[str, SessionInfo]
    frames: Mapping[str, BuildingFrame]
    publisher: Nav2Publisher | None = None
    resets: ResetPolicy = field(default_factory=ResetPolicy)
    map_session: str | None = None

    def tell(self, answer: Answer, lock: threading.Lock) -> list[str]:
        """Publish what follows from an answer. Return the topics. lock : is held to read the database."""
        publisher, live, session = self.publisher, self.following.drive, answer.session
        if publisher is None or not isinstance(live, LiveLog):
            return []
        if answer.state == "lost":
            publisher.stop_tf()
        may_reset = self.resets.allows(answer.state)
        if session is None or not answer.is_told:
            return []
        return [
            *self._tell_map(publisher, answer, session, lock),
            *self._tell_pose(publisher, live, answer, may_reset),
        ]

    def _tell_map(
        self, publisher: Nav2Publisher, answer: Answer, session: str, lock: threading.Lock
    ) -> list[str]:
        if not self.following.given.publish_map or session == self.map_session:
            return []
        self.map_session = session
        with lock:
            grid = map_of(self.following.database, session, self.frames)
        publisher.map(answer.stamp_ns, grid)
        return ["/map"]

    def _tell_pose(
        self, publisher: Nav2Publisher, live: LiveLog, answer: Answer, may_reset: bool
    ) -> list[str]:
        publish = self.following.given.publish
        if publish == "initialpose" and may_reset:
            assert answer.covariance is not None
            stamp_ns, T_map_base = _now(answer, live)
            publisher.initialpose(stamp_ns, T_map_base, answer.covariance)
            return ["/initialpose"]
        if publish != "tf":
            return []
        T_map_odom, odom_frame = answer.T_map_odometry, live.odometry_frame
        if T_map_odom is None or odom_frame is None:
            console.warn("--publish tf: the robot has no odometry; nothing is published")
            return []
        publisher.start_tf(odom_frame, T_map_odom, live.now_ns)
        return ["/tf"]


@contextlib.contextmanager
def _robot_of(following: Following) -> Iterator[_Robot]:
    """Yield the robot, ready to be told where it is. Raises LiveError if it takes no messages."""
    given, drive = following.given, following.drive
    robot = _Robot(
        following=following,
        sessions={info.name: info for info in following.database.sessions()},
        frames=following.database.frames() if given.frame == "building" else {},
    )
    topics = [f"/{given.publish}"] * (given.publish != "none") + ["/map"] * given.publish_map
    with contextlib.ExitStack() as stack:
        if topics and isinstance(drive, LiveLog):
            robot.publisher = stack.enter_context(Nav2Publisher(cast(Outlet, drive.feed), given.map_frame))
            robot.publisher.announce(*topics)
        yield robot


def _now(answer: Answer, live: LiveLog) -> tuple[int, SE2]:
    """Return the stamp of the newest odometry, and the pose of the base there: the answer is older."""
    T_map_odom, newest = answer.T_map_odometry, live.newest_odometry()
    if T_map_odom is None or newest is None:
        assert answer.T_map_base is not None
        return answer.stamp_ns, answer.T_map_base
    stamp_ns, T_odom_base = newest
    return stamp_ns, T_map_odom @ SE2.from_matrix(T_odom_base)


def _print_news(drive: ScanSource) -> None:
    for sentence in drive.news.take():
        console.warn(sentence)


def _summarize(drive: ScanSource, terminal: console.Console) -> None:
    """Print what was left out, at the end."""
    _print_news(drive)
    report, counts = drive.report(), drive.counts
    for warning in report.warnings:
        console.warn(warning)
    skipped = sum(report.scans_skipped.values())
    if counts.dropped or skipped:
        reasons = ", ".join(f"{count} {reason}" for reason, count in report.scans_skipped.items())
        terminal.note(
            f"{report.scans_read} scans used, {counts.dropped} dropped to keep up, {skipped} unusable"
            + (f" ({reasons})" if reasons else "")
        )


def as_text(answer: Answer, published: list[str]) -> str:
    """Return an answer in one line."""
    begin = f"after {answer.path_m:.1f} m: {str(answer.state).replace('_', ' the ')}"
    away = answer.beside_map
    if away is not None:
        (fit,) = away.fits
        sigmas = np.sqrt(np.diag(fit.covariance))
        return one_line(
            f"{begin} of {answer.sessions[fit.session_index]}: by odometry"
            f" {pose_text(fit.T_map_query @ answer.T_odom_base)}, give or take {sigmas[:2].max():.2f} m and"
            f" {math.degrees(sigmas[2]):.1f} deg, confidence {probability(away.mass)}"
        )
    if answer.T_map_base is None:
        places = len(answer.places)
        return f"{begin}, {places} places fit" if answer.status == "ambiguous" else f"{begin}, no place fits"
    told = f", published {' and '.join(published)}" if published else ""
    begin += "" if answer.is_told else ", perhaps"
    return one_line(
        f"{begin} in {answer.session}: {pose_text(answer.T_map_base)},"
        f" confidence {probability(answer.confidence)}{told}"
    )


def _document(answer: Answer, drive: ScanSource, robot: _Robot, published: list[str]) -> Any:
    session = answer.session
    watched = None
    if session is not None:
        watched = {
            "database": robot.following.database.location,
            "session": session,
            "building": answer.label.building,
            "floor": answer.label.floor,
            "digest": robot.sessions[session].digest,
        }
    document = {
        "state": answer.state,
        "status": answer.status,
        "stamp_ns": answer.stamp_ns,
        "path_m": answer.path_m,
        "map": watched,
        "frame": robot.frames[session].name if session and session in robot.frames else None,
        "pose": answer.stamped_pose,
        "T_map_odom": answer.T_map_odometry,
        "in_space": None if answer.in_space is None else answer.in_space.to_json(),
        "off_map": answer.off_map_pose,
        "confidence": answer.confidence,
        "published": published,
        **live(drive, answer.elapsed_s),
    }
    return plain(document)


@contextlib.contextmanager
def followed(source: str, config: ReadConfig, *, real_time: bool = False) -> Iterator[ScanSource]:
    """Open a robot by its address, or a recording by its path.

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
        """Return the newest pose that was recorded before the last scan."""
        if self._pose is None:
            return None
        while self._next is not None and self._next.log_time_ns <= self._log.last_scan_ns:
            self._pose.take(self._next)
            self._next = next(self._messages, None)
        return self._pose.newest


ScanSource = LiveLog | WholeRecording
"""Scans, part after part, and what is known of how they come."""


def feed(
    drive: ScanSource,
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


def live(drive: ScanSource, elapsed_s: float) -> Document:
    """Return how it is followed so far. elapsed_s : time that the search took."""
    return {
        "scans": drive.report().scans_read,
        "dropped": drive.counts.dropped,
        "reconnected": drive.counts.reconnected,
        "lag_s": drive.lag_s,
        "elapsed_s": elapsed_s,
    }
