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
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np

from pc2grid import libraries
from pc2grid.display import plain, probability
from pc2grid.errors import ConfigError, TrackingLost, one_line
from pc2grid.estimation.tracker import follow
from pc2grid.geometry import SE2
from pc2grid.io.live.live_log import LiveLog, is_robot, open_live
from pc2grid.io.live.nav2 import Nav2Publisher, Outlet
from pc2grid.io.recording import ScanSource, open_log
from pc2grid.model import RegisteredScan
from pc2grid.observer import Observer
from pc2grid_cli import console, known_pose, options
from pc2grid_cli.output import Document
from signature.config import Config
from signature.database import SubmapDatabase
from signature.join.building import map_of
from signature.localization.answer import Answer, answer_in_building, pose_text
from signature.localization.localizer import Follower, Localizer, ResetPolicy
from signature.localization.pose_check import PoseCheck, PoseWatch
from signature.places.map_index import MapIndex, Prior
from signature.sessions import query_config

ResultT = TypeVar("ResultT")


def run(given: options.Watch, terminal: console.Console) -> int | None:
    """Follow a robot or a recording, and print what is found. Return the exit code."""
    libraries.require(libraries.of_addresses(given.source, given.database))
    settings, prior, check_topic = given.settings(), known_pose.region(given), given.check_topic
    _check_options(given)
    end_s = math.inf if given.timeout is None else time.monotonic() + given.timeout
    as_robot = given.real_time or is_robot(given.source)
    with (
        known_pose.searched(given) as (opened, _),
        (open_live if as_robot else open_log)(given.source, settings.read) as drive,
    ):
        following = Following(given, drive, opened, query_config(opened, settings), end_s, terminal)
        if check_topic is not None:
            good = _check(following, check_topic)
        else:
            # The region is that of the first scan.
            good = _search(following, prior and replace(prior, stamp_ns=0))
        _summarize(drive, terminal)
    return None if good else console.UNSURE


def _check_options(given: options.Watch) -> None:
    """Raise ConfigError for options that do not go together."""
    if given.first and (given.publish == "tf" or given.check_topic is not None):
        goes_on = "--publish tf" if given.publish == "tf" else "--check-topic"
        raise ConfigError(f"--first: {goes_on} goes on until it is stopped", hint="leave --first out")
    if given.publish != "none" or given.publish_map:
        if given.check_topic is not None:
            raise ConfigError("--check-topic and --publish do not go together", hint="run `watch` twice")
        if not is_robot(given.source):
            raise ConfigError(f"--publish: {given.source} takes no messages", hint="ws://ROBOT:8765 does")


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
        """Search after each metre. searcher : what `Follower` takes. use : see `feed`."""
        beside, step_m = isinstance(self.drive, LiveLog), self.config.relocalize.step_m
        with Follower(searcher, beside=beside, step_m=step_m) as follower:
            feed(self.drive, follower, self.config, use, end_s=self.end_s, observer=self.terminal)


def _search(following: Following, prior: Prior | None) -> bool:
    """Follow the robot. Return whether it is located at last.

    prior : where the robot is at the beginning, as far as it is known.
    """
    given, index, located = following.given, following.index, False
    robot = _Robot(following)

    def use(found: Answer, lock: threading.Lock) -> bool:
        nonlocal located
        answer = answer_in_building(replace(found, history=()), robot.frames)
        published = robot.tell(answer, lock)
        document = _document(answer, following.drive, robot, published)
        console.print_result(document if given.json else as_text(answer, published), indent=None)
        located = answer.status == "located"
        return answer.is_told and given.first

    with robot.publisher or contextlib.nullcontext():
        following.run(Localizer(index if prior is None else index.within(prior)), use)
    return located


def _check(following: Following, topic: str) -> bool:
    """Follow the robot, and judge the pose that it believes in. Return whether the last one was fine."""
    given, drive, fine = following.given, following.drive, False
    believed = drive.listen_to_pose(topic)

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

    following.run(PoseWatch(following.index, lambda: believed.newest, given.session), use)
    if believed.newest is None:
        console.warn(f"{topic}: no pose of the robot in a map; nothing was checked")
    return fine


class _Robot:
    """The robot that is told where it is.

    sessions : of the database, by name. frames : of the buildings that answers are in, by session.
    publisher : None if it is not told anything.
    """

    publisher: Nav2Publisher | None = None

    def __init__(self, following: Following) -> None:
        """Announce what is published. Raises LiveError if the robot takes no messages."""
        given, drive, database = following.given, following.drive, following.database
        self._given, self._drive, self.database = given, drive, database
        self.sessions = {info.name: info for info in database.sessions()}
        self.frames = database.frames() if given.frame == "building" else {}
        self._resets, self._map_session = ResetPolicy(), ""
        topics = [f"/{given.publish}"] * (given.publish != "none") + ["/map"] * given.publish_map
        if topics and isinstance(drive, LiveLog):
            self.publisher = Nav2Publisher(cast(Outlet, drive.feed), given.map_frame)
            self.publisher.announce(*topics)

    def tell(self, answer: Answer, lock: threading.Lock) -> list[str]:
        """Publish what follows from an answer. Return the topics. lock : is held to read the database."""
        publisher, live, session = self.publisher, self._drive, answer.session
        if publisher is None or not isinstance(live, LiveLog):
            return []
        if answer.state == "lost":
            publisher.stop_tf()
        may_reset = self._resets.allows(answer.state)
        if session is None or not answer.is_told:
            return []
        told = self._tell_map(publisher, answer, session, lock)
        if self._given.publish == "initialpose" and may_reset:
            assert answer.covariance is not None
            publisher.initialpose(*_now(answer, live), answer.covariance)
            told.append("/initialpose")
        if self._given.publish == "tf":
            T_map_odom, odom_frame = answer.T_map_odometry, live.poses.frame
            if T_map_odom is None or odom_frame is None:
                console.warn("--publish tf: the robot has no odometry; nothing is published")
            else:
                publisher.start_tf(odom_frame, T_map_odom, live.now_ns)
                told.append("/tf")
        return told

    def _tell_map(
        self, publisher: Nav2Publisher, answer: Answer, session: str, lock: threading.Lock
    ) -> list[str]:
        if not self._given.publish_map or session == self._map_session:
            return []
        self._map_session = session
        with lock:
            grid = map_of(self.database, session, self.frames)
        publisher.map(answer.stamp_ns, grid)
        return ["/map"]


def _now(answer: Answer, live: LiveLog) -> tuple[int, SE2]:
    """Return the stamp of the newest odometry, and the pose of the base there: the answer is older."""
    T_map_odom, newest = answer.T_map_odometry, live.poses.newest_odometry()
    if T_map_odom is None or newest is None:
        assert answer.T_map_base is not None
        return answer.stamp_ns, answer.T_map_base
    stamp_ns, T_odom_base = newest
    return stamp_ns, T_map_odom @ SE2.from_matrix(T_odom_base)


def _summarize(drive: ScanSource, terminal: console.Console) -> None:
    """Print what was left out, at the end."""
    report, dropped = drive.report(), drive.tally.dropped
    for warning in (*drive.tally.take_news(), *report.warnings):
        console.warn(warning)
    skipped = sum(report.scans_skipped.values())
    if dropped or skipped:
        reasons = ", ".join(f"{count} {reason}" for reason, count in report.scans_skipped.items())
        terminal.note(
            f"{report.scans_read} scans used, {dropped} dropped to keep up, {skipped} unusable"
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
            "database": robot.database.location,
            "session": session,
            "building": answer.label.building,
            "floor": answer.label.floor,
            "digest": robot.sessions[session].provenance.digest,
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


def feed(
    drive: ScanSource,
    follower: Follower[ResultT],
    config: Config,
    use: Callable[[ResultT, threading.Lock], bool | None],
    *,
    end_s: float = math.inf,
    see: Callable[[RegisteredScan | None], None] = lambda registered: None,
    observer: Observer = Observer(),
) -> None:
    """Feed a follower with all scans of a robot or a recording, and print its news.

    use : called with each result of the follower, and with the lock that is held to read the database; true
    if that was enough. end_s : of `time.monotonic`. see : called with each registered scan; None: what
    follows does not go on from what was before.
    """
    over = False

    def poll() -> bool:
        nonlocal over
        for sentence in drive.tally.take_news():
            console.warn(sentence)
        for result in follower.take():
            over = over or bool(use(result, follower.lock))
        over = over or time.monotonic() > end_s
        return over

    drive.on_poll = poll  # a robot may be silent from the beginning
    choice = drive.choose()
    observer.on_note(f"{drive.name}: {choice.topic} ({choice.sensor}): {choice.reason}")
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
        "scans": drive.tally.scans_read,
        "dropped": drive.tally.dropped,
        "reconnected": drive.tally.reconnected,
        "lag_s": drive.lag_s,
        "elapsed_s": elapsed_s,
    }
