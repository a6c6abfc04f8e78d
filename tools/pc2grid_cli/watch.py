"""`pc2grid watch`: where in the database is the robot that is running now?"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from pc2grid.display import probability
from pc2grid.errors import ConfigError, one_line
from pc2grid.geometry import SE2
from pc2grid.io.live.live_log import LiveLog, is_robot
from pc2grid.io.live.nav2 import Nav2Publisher
from pc2grid_cli import console
from pc2grid_cli import options as options
from pc2grid_cli.check_pose import as_text as check_as_text
from pc2grid_cli.check_pose import live_document
from pc2grid_cli.windows import Followed, Live, live, run
from signature.localization.answer import answer_in_building
from signature.localization.answer_json import (
    Labelled,
    OffMap,
    PoseInSpace,
    StampedPose,
    Status,
    in_space_document,
    off_map_document,
    plain,
    stamped_pose,
)
from signature.localization.belief import State
from signature.localization.joining.building import map_of
from signature.localization.localizer import Follower, Localizer, ResetPolicy
from signature.localization.map_index import MapIndex
from signature.localization.pose_check import PoseCheck, PoseWatch

if TYPE_CHECKING:
    from pc2grid.io.live.nav2 import Outlet
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.database.protocol import BuildingFrame, SessionInfo
    from signature.localization.localizer import Estimate
    from signature.localization.posterior import Prior


class WatchedMap(Labelled):
    """The map that a pose is in: its session, and the sha256 of what the session was made from, hex."""

    database: str
    session: str
    digest: str


class Watch(Live):
    """A line of `pc2grid watch --json`: what one search of the database said. state: searching (not located
    yet), located, off_map (the map does not show what it sees), doubtful (certain neither where it was nor
    elsewhere), lost, recovered (located elsewhere or again). pose: of the base at `stamp_ns`; null unless the
    status is `located`. The state is that only when a second search agrees, or beyond doubt; no other pose
    is published. T_map_odom: of the robot's own odometry frame. frame: of the building, in which the pose is;
    null: the map frame of the session. in_space: null if the map or the scans have no points. off_map: where
    odometry says that it is; null unless the map shows too little there. confidence: the probability that
    the best place is right. published: topics on which it was said."""

    state: State
    status: Status
    stamp_ns: int
    path_m: float
    map: WatchedMap | None
    frame: str | None
    pose: StampedPose | None
    T_map_odom: SE2 | None
    in_space: PoseInSpace | None
    off_map: OffMap | None
    confidence: float
    published: list[str]


EstimateT = TypeVar("EstimateT")


def check_publishes(source: str, check_topic: str | None) -> None:
    """Raises ConfigError if nothing can be published."""
    if check_topic is not None:
        raise ConfigError("--check-topic and --publish do not go together", hint="run `watch` twice")
    if not is_robot(source):
        raise ConfigError(f"--publish: {source} takes no messages", hint="ws://ROBOT:8765 does")


@dataclass(frozen=True)
class Following:
    """A robot, or a recording of one, that is followed until `end_s` of `time.monotonic`, or to its end.

    config : see `query_config`.
    """

    drive: Followed
    database: SubmapDatabase
    config: Config
    end_s: float
    terminal: console.Console

    def run(self, follower: Follower[EstimateT], use: Callable[[EstimateT], bool]) -> None:
        """Feed `follower` with scans. use : what to do with each estimate; true if that was enough."""
        drive, over = self.drive, False

        def poll() -> bool:
            nonlocal over
            _tell_news(drive)
            for estimate in follower.take():
                over = over or use(estimate)
            over = over or time.monotonic() > self.end_s
            return over

        drive.on_poll = poll  # a robot may be silent from the beginning
        choice = drive.choose()
        self.terminal.note(f"{drive.name}: {choice.topic} ({choice.sensor}): {choice.reason}", level=1)
        run(drive, follower, self.config, poll, observer=self.terminal.observer())


def search(following: Following, robot: _Robot, prior: Prior | None, *, first: bool, as_json: bool) -> bool:
    """Follow the robot; whether it is located at last.

    prior : where the robot is at the beginning, as far as it is known. first : stop when it is located.
    """
    drive, config = following.drive, following.config
    index = MapIndex.of(following.database, config, following.terminal.observer())
    localizer = Localizer(index if prior is None else index.within(prior))
    located = False
    with Follower(localizer, beside=drive.realtime, step_m=config.relocalize.step_m) as follower:

        def use(estimate: Estimate) -> bool:
            nonlocal located
            estimate = replace(estimate, answer=answer_in_building(estimate.answer, robot.frames))
            published = robot.tell(estimate, follower.lock)
            document = _document(estimate, drive, robot, published)
            console.print_result(document if as_json else as_text(estimate, published), indent=None)
            located = estimate.answer.status == "located"
            return estimate.is_told and first

        following.run(follower, use)
    return located


def check(following: Following, topic: str, session: str | None, *, as_json: bool) -> bool:
    """Follow the robot, and judge the pose that it believes in; whether the last one was fine."""
    drive, config = following.drive, following.config
    drive.listen_to_pose(topic)
    index = MapIndex.of(following.database, config, following.terminal.observer())
    watch = PoseWatch(index, lambda: drive.believed, session)
    fine = False
    with Follower(watch, beside=drive.realtime, step_m=config.relocalize.step_m) as follower:

        def use(checked: PoseCheck) -> bool:
            nonlocal fine
            fine = checked.status == "fine"
            document = live_document(checked, drive, following.database.location)
            console.print_result(document if as_json else check_as_text(checked), indent=None)
            return False

        following.run(follower, use)
    if drive.believed is None:
        console.warn(f"{topic}: no pose of the robot in a map; nothing was checked")
    return fine


@dataclass(kw_only=True)
class _Robot:
    """The robot that is told where it is.

    publisher : None if it is not told anything.
    map_session : the session whose map was published. sessions : of the database, by name. frames : of the
    buildings that answers are in, by session.
    """

    drive: Followed
    database: SubmapDatabase
    sessions: dict[str, SessionInfo]
    publish: options.Publish
    publish_map: bool
    frames: Mapping[str, BuildingFrame]
    publisher: Nav2Publisher | None = None
    resets: ResetPolicy = field(default_factory=ResetPolicy)
    map_session: str | None = None

    def about_map(self, session: str) -> WatchedMap:
        """The map of a session, as a document says it."""
        info = self.sessions[session]
        label = info.provenance.label
        return {
            "database": self.database.location,
            "session": session,
            "building": label.building,
            "floor": label.floor,
            "digest": info.digest,
        }

    def tell(self, estimate: Estimate, lock: threading.Lock) -> list[str]:
        """Publish what follows from an estimate; returns the topics. lock : is held to read the database."""
        publisher, live, session = self.publisher, self.drive, estimate.answer.session
        if publisher is None or not isinstance(live, LiveLog):
            return []
        if estimate.state == "lost":
            publisher.stop_tf()
        may_reset = self.resets.allows(estimate.state)
        if session is None or not estimate.is_told:
            return []
        return [
            *self._tell_map(publisher, estimate, session, lock),
            *self._tell_pose(publisher, live, estimate, may_reset),
        ]

    def _tell_map(
        self, publisher: Nav2Publisher, estimate: Estimate, session: str, lock: threading.Lock
    ) -> list[str]:
        if not self.publish_map or session == self.map_session:
            return []
        self.map_session = session
        with lock:
            grid = map_of(self.database, session, self.frames)
        publisher.map(estimate.registered.scan.stamp_ns, grid)
        return ["/map"]

    def _tell_pose(
        self, publisher: Nav2Publisher, live: LiveLog, estimate: Estimate, may_reset: bool
    ) -> list[str]:
        if self.publish == "initialpose" and may_reset:
            assert estimate.answer.covariance is not None
            stamp_ns, T_map_base = _now(estimate, live)
            publisher.initialpose(stamp_ns, T_map_base, estimate.answer.covariance)
            return ["/initialpose"]
        if self.publish != "tf":
            return []
        T_map_odom, odom_frame = estimate.T_map_odom, live.odometry_frame
        if T_map_odom is None or odom_frame is None:
            console.warn("--publish tf: the robot has no odometry; nothing is published")
            return []
        publisher.start_tf(odom_frame, T_map_odom, live.now_ns)
        return ["/tf"]


@contextlib.contextmanager
def robot_of(
    drive: Followed,
    database: SubmapDatabase,
    publish: options.Publish,
    publish_map: bool,
    map_frame: str,
    frames: Mapping[str, BuildingFrame],
) -> Iterator[_Robot]:
    """The robot, ready to be told where it is. Raises LiveError if it takes no messages."""
    robot = _Robot(
        drive=drive,
        database=database,
        sessions={info.name: info for info in database.sessions()},
        publish=publish,
        publish_map=publish_map,
        frames=frames,
    )
    topics = [*([f"/{publish}"] if publish != "none" else []), *(["/map"] if publish_map else [])]
    with contextlib.ExitStack() as stack:
        if topics and isinstance(drive, LiveLog):
            robot.publisher = stack.enter_context(Nav2Publisher(cast("Outlet", drive.feed), map_frame))
            robot.publisher.announce(*topics)
        yield robot


def _now(estimate: Estimate, live: LiveLog) -> tuple[int, SE2]:
    """The newest odometry: its stamp, and the pose of the base there: the estimate is older."""
    T_map_odom, newest = estimate.T_map_odom, live.newest_odometry()
    if T_map_odom is None or newest is None:
        assert estimate.answer.T_map_base is not None
        return estimate.registered.scan.stamp_ns, estimate.answer.T_map_base
    stamp_ns, T_odom_base = newest
    return stamp_ns, T_map_odom @ SE2.from_matrix(T_odom_base)


def _tell_news(drive: Followed) -> None:
    for sentence in drive.news.take():
        console.warn(sentence)


def summarize(drive: Followed, terminal: console.Console) -> None:
    """What was left out, at the end."""
    _tell_news(drive)
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


def as_text(estimate: Estimate, published: list[str]) -> str:
    """An estimate in one line."""
    answer = estimate.answer
    begin = f"after {answer.path_m:.1f} m: {estimate.state.replace('_', ' the ')}"
    away = answer.beside_map
    if away is not None:
        fit = away.hypothesis.fit
        at, sigmas = fit.T_map_query @ answer.T_odom_base, np.sqrt(np.diag(fit.covariance))
        return one_line(
            f"{begin} of {answer.sessions[away.hypothesis.session_index]}: by odometry x {at.x:.2f} m,"
            f" y {at.y:.2f} m, yaw {math.degrees(at.yaw):.1f} deg, give or take {sigmas[:2].max():.2f} m and"
            f" {math.degrees(sigmas[2]):.1f} deg, confidence {probability(away.mass)}"
        )
    if answer.T_map_base is None:
        places = len(set(answer.places))
        return f"{begin}, {places} places fit" if answer.status == "ambiguous" else f"{begin}, no place fits"
    pose = answer.T_map_base
    told = f", published {' and '.join(published)}" if published else ""
    yaw_deg = math.degrees(pose.yaw)
    begin += "" if estimate.is_told else ", perhaps"
    return one_line(
        f"{begin} in {answer.session}: x {pose.x:.2f} m, y {pose.y:.2f} m, yaw {yaw_deg:.1f} deg,"
        f" confidence {probability(answer.confidence)}{told}"
    )


def _document(estimate: Estimate, drive: Followed, robot: _Robot, published: list[str]) -> Any:
    answer, session = estimate.answer, estimate.answer.session
    document: Watch = {
        "state": estimate.state,
        "status": answer.status,
        "stamp_ns": answer.stamp_ns,
        "path_m": answer.path_m,
        "map": None if session is None else robot.about_map(session),
        "frame": robot.frames[session].name if session and session in robot.frames else None,
        "pose": stamped_pose(answer),
        "T_map_odom": estimate.T_map_odom,
        "in_space": in_space_document(answer),
        "off_map": off_map_document(answer),
        "confidence": answer.confidence,
        "published": published,
        **live(drive, estimate.elapsed_s),
    }
    return plain(Watch, document)
