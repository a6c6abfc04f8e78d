"""`pc2grid watch`: where in the database is the robot that is running now?"""

from __future__ import annotations

import contextlib
import enum
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, TypeVar, cast

import typer

from pc2grid import extras
from pc2grid.display import probability
from pc2grid.errors import ConfigError, TrackingLost, one_line
from pc2grid.geometry import SE2
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.nav2 import Nav2Publisher
from pc2grid.io.live.targets import is_robot
from pc2grid.pipeline import follow
from pc2grid_cli import console
from pc2grid_cli import options as options
from pc2grid_cli.check_pose import as_text as check_as_text
from pc2grid_cli.check_pose import live_document
from pc2grid_cli.followed import followed
from pc2grid_cli.known_pose import KnownPose
from pc2grid_cli.locate import searched
from signature.localization.answer_json import in_space_document
from signature.localization.follower import Follower
from signature.localization.in_building import answer_in_building
from signature.localization.joining.building_map import map_of
from signature.localization.localizer import Localizer
from signature.localization.map_index import MapIndex
from signature.localization.pose_check import PoseCheck, PoseWatch

if TYPE_CHECKING:
    from pc2grid.io.live.nav2 import Outlet
    from pc2grid_cli.followed import Followed
    from pc2grid_cli.json_schemas import Watch
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.database.protocol import BuildingFrame, SessionInfo
    from signature.localization.localizer import Estimate
    from signature.localization.prior import Prior


EstimateT = TypeVar("EstimateT")


class Publish(str, enum.Enum):
    """What the robot is told."""

    none = "none"
    initialpose = "initialpose"
    tf = "tf"


def watch_command(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="ws://ROBOT:8765|RECORDING",
            help="a robot with foxglove_bridge, or a finished recording, of which every scan is used",
        ),
    ],
    database: options.SearchedDatabase,
    building: options.Building = None,
    floor: options.Floor = None,
    near: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            "--near",
            metavar="X Y RADIUS",
            help="at the beginning, it is within RADIUS metres of X, Y of the map",
        ),
    ] = None,
    check_topic: Annotated[
        str | None,
        typer.Option(
            "--check-topic",
            metavar="TOPIC",
            help="judge the pose that the robot believes in, such as /amcl_pose or /tf: fine, lost or unsure",
        ),
    ] = None,
    session: Annotated[
        str | None,
        typer.Option("--session", metavar="NAME", help="whose map frame that or --near is in, if several"),
    ] = None,
    keep: Annotated[
        bool, typer.Option("--keep", help="go on when it is located, and say when it is somewhere else")
    ] = False,
    publish: Annotated[
        Publish,
        typer.Option(
            "--publish",
            help="tell the robot: /initialpose when it is located; or the transform map -> odom, with --keep",
        ),
    ] = Publish.none,
    publish_map: Annotated[
        bool, typer.Option("--publish-map", help="also /map, the map in which it is located")
    ] = False,
    map_frame: Annotated[
        str, typer.Option("--map-frame", metavar="FRAME", help="the frame of what is published")
    ] = "map",
    frame: options.Frame = options.FrameName.building,
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time", help="replay the recording at its own pace; scans may be dropped, as of a robot"
        ),
    ] = False,
    timeout: Annotated[
        float | None, typer.Option("--timeout", min=0.0, metavar="S", help="give up after so many seconds")
    ] = None,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    imu: options.ImuTopic = None,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    assume_identity: options.AssumeIdentity = False,
    json: Annotated[bool, typer.Option("--json", help="a JSON document on each line, one a search")] = False,
) -> None:
    """Find where a running robot is, while it drives, or was while it was recorded. Exit code 4: it was not
    located.

    With --check-topic, say after each metre whether it is where it believes to be. Exit code 4: at last it
    was not.

    Example: pc2grid watch ws://robot:8765 --database building.submaps --publish initialpose
    """
    extras.require(extras.of_addresses(source, database))
    settings = options.make_config(
        config, set_, topic=topic, odometry=odometry, imu=imu, assume_identity=assume_identity
    )
    known = KnownPose(near=near, check_topic=check_topic, session=session)
    prior = known.at_start()
    publishes = publish is not Publish.none or publish_map
    if publishes and check_topic is not None:
        raise ConfigError("--check-topic and --publish do not go together", hint="run `watch` twice")
    if publishes and not is_robot(source):
        raise ConfigError(f"--publish: {source} takes no messages", hint="ws://ROBOT:8765 does")
    terminal = console.of(context)
    end_s = math.inf if timeout is None else time.monotonic() + timeout
    with (
        searched(database, building, floor) as (opened, damaged),
        followed(source, settings.read, real_time=real_time) as drive,
    ):
        for damage in damaged:
            console.warn(f"{opened.location}: damaged and left out: {damage}")
        following = _Following(drive, opened, settings, end_s, terminal)
        if check_topic is not None:
            good = _check(following, check_topic, session, as_json=json)
        else:
            frames = opened.frames() if frame is options.FrameName.building else {}
            with _Robot.of(drive, opened, publish, publish_map, map_frame, frames) as robot:
                good = _search(following, robot, prior, keep or publish is Publish.tf, as_json=json)
        _summarize(drive, terminal)
    if not good:
        raise typer.Exit(console.UNSURE)


@dataclass(frozen=True)
class _Following:
    """A robot, or a recording of one, that is followed until `end_s` of `time.monotonic`, or to its end."""

    drive: Followed
    database: SubmapDatabase
    settings: Config
    end_s: float
    terminal: console.Console

    @property
    def config(self) -> Config:
        """That of the database, but for what is the user's to set of a query."""
        own = {name: getattr(self.settings, name) for name in ("read", "relocalize", "registration")}
        return self.database.config().model_copy(update=own)

    def run(self, follower: Follower[EstimateT], use: Callable[[EstimateT], bool]) -> None:
        """Feed `follower` with scans. use : what to do with each estimate; true if that was enough."""
        drive, config = self.drive, self.config
        over = False

        def poll() -> bool:
            nonlocal over
            _tell_news(drive)
            for estimate in follower.take():
                over = over or use(estimate)
            over = over or time.monotonic() > self.end_s
            return over

        drive.on_poll = poll
        choice = drive.choose()
        self.terminal.note(f"{drive.name}: {choice.topic} ({choice.sensor}): {choice.reason}", level=1)
        for scans in drive.parts():
            try:
                for registered, planar_scan in follow(scans, config, self.terminal.observer()):
                    follower.add(registered, planar_scan)
                    if poll():
                        break
            except TrackingLost as error:
                console.warn(error.in_short)
            if over:
                return
            follower.restart()
        follower.finish()
        poll()


def _search(
    following: _Following, robot: _Robot, prior: Prior | None, forever: bool, *, as_json: bool
) -> bool:
    """Follow the robot until it is located; whether it is.

    prior : where the robot is at the beginning, as far as it is known. forever : go on when it is located.
    """
    drive, config = following.drive, following.config
    index = MapIndex.of(following.database, config, following.terminal.observer())
    localizer = Localizer(index if prior is None else index.within(prior))
    located = False
    with Follower(localizer, beside=drive.realtime, step_m=config.relocalize.step_m) as follower:

        def use(estimate: Estimate) -> bool:
            nonlocal located
            estimate = replace(estimate, answer=answer_in_building(estimate.answer, robot.frames))
            _print(estimate, drive, robot, robot.tell(estimate, follower.lock), as_json=as_json)
            located = estimate.answer.status == "located"
            return located and not forever

        following.run(follower, use)
    return located


def _check(following: _Following, topic: str, session: str | None, *, as_json: bool) -> bool:
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
            if as_json:
                console.print_json_line(live_document(checked, drive, following.database.location))
            else:
                print(check_as_text(checked), flush=True)
            return False

        following.run(follower, use)
    if drive.believed is None:
        console.warn(f"{topic}: no pose of the robot in a map; nothing was checked")
    return fine


@dataclass(slots=True)
class ResetPolicy:
    """When the robot may be told a new place: not too often, and not for ever.

    Limits how often a new pose is published: repeated resets would keep navigation from continuing.

    pause_s : least time between two resets. most : resets until the robot has been located for `calm_s`.
    """

    pause_s: float = 10.0
    most: int = 5
    calm_s: float = 60.0
    clock: Callable[[], float] = time.monotonic
    _last_s: float | None = None
    _count: int = 0

    def allows(self) -> bool:
        """Whether a reset may be made now; it then counts as made."""
        now_s = self.clock()
        if self._last_s is not None:
            if now_s - self._last_s > self.calm_s:
                self._count = 0
            if now_s - self._last_s < self.pause_s or self._count >= self.most:
                return False
        self._last_s = now_s
        self._count += 1
        return True


@dataclass(kw_only=True)
class _Robot:
    """The robot that is told where it is.

    publisher : None if it is not told anything. pose_is_due : whether it is to be told its pose.
    map_session : the session whose map was published. sessions : of the database, by name. frames : of the
    buildings that answers are in, by session.
    """

    live: LiveLog | None
    database: SubmapDatabase
    sessions: dict[str, SessionInfo]
    publish: Publish
    publish_map: bool
    publisher: Nav2Publisher | None
    frames: Mapping[str, BuildingFrame]
    resets: ResetPolicy
    pose_is_due: bool = True
    map_session: str | None = None

    @staticmethod
    @contextlib.contextmanager
    def of(
        drive: Followed,
        database: SubmapDatabase,
        publish: Publish,
        publish_map: bool,
        map_frame: str,
        frames: Mapping[str, BuildingFrame],
    ) -> Iterator[_Robot]:
        """Raises LiveError if the robot takes no messages."""
        live = drive if isinstance(drive, LiveLog) else None
        robot = _Robot(
            live=live,
            database=database,
            sessions={info.name: info for info in database.sessions()},
            publish=publish,
            publish_map=publish_map,
            publisher=None,
            frames=frames,
            resets=ResetPolicy(),
        )
        topics = [f"/{publish.value}"] if publish is not Publish.none else []
        topics += ["/map"] if publish_map else []
        if live is None or not topics:
            yield robot
            return
        with Nav2Publisher(cast("Outlet", live.feed), map_frame) as robot.publisher:
            robot.publisher.announce(*topics)
            yield robot

    def tell(self, estimate: Estimate, lock: threading.Lock) -> list[str]:
        """Publish what follows from an estimate; returns the topics. lock : is held to read the database."""
        publisher, live, session = self.publisher, self.live, estimate.answer.session
        if publisher is None or live is None:
            return []
        if estimate.state == "lost":
            self.pose_is_due = True
            publisher.stop_tf()
        if session is None:
            return []
        told = []
        if self.publish_map and session != self.map_session:
            self.map_session = session
            with lock:
                grid = map_of(self.database, session, self.frames)
            publisher.map(estimate.registered.scan.stamp_ns, grid)
            told.append("/map")
        self.pose_is_due = self.pose_is_due or estimate.state == "recovered"
        if self.publish is Publish.initialpose and self.pose_is_due and self.resets.allows():
            self.pose_is_due = False
            assert estimate.answer.covariance is not None
            stamp_ns, T_map_base = _now(estimate, live)
            publisher.initialpose(stamp_ns, T_map_base, estimate.answer.covariance)
            told.append("/initialpose")
        elif self.publish is Publish.tf:
            T_map_odom, odom_frame = estimate.T_map_odom, live.odometry_frame
            if T_map_odom is None or odom_frame is None:
                console.warn("--publish tf: the robot has no odometry; nothing is published")
                return told
            publisher.start_tf(odom_frame, T_map_odom, live.now_ns)
            told.append("/tf")
        return told


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


def _summarize(drive: Followed, terminal: console.Console) -> None:
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


def _print(
    estimate: Estimate, drive: Followed, robot: _Robot, published: list[str], *, as_json: bool
) -> None:
    """An estimate on stdout."""
    if as_json:
        console.print_json_line(_document(estimate, drive, robot, published))
    else:
        print(as_text(estimate, published), flush=True)


def as_text(estimate: Estimate, published: list[str]) -> str:
    """An estimate in one line."""
    answer = estimate.answer
    begin = f"after {answer.path_m:.1f} m: {estimate.state}"
    if answer.T_map_base is None:
        places = len(set(answer.places))
        return f"{begin}, {places} places fit" if answer.status == "ambiguous" else f"{begin}, no place fits"
    pose = answer.T_map_base
    told = f", published {' and '.join(published)}" if published else ""
    yaw_deg = math.degrees(pose.yaw)
    return one_line(
        f"{begin} in {answer.session}: x {pose.x:.2f} m, y {pose.y:.2f} m, yaw {yaw_deg:.1f} deg,"
        f" confidence {probability(answer.confidence)}{told}"
    )


def _document(estimate: Estimate, drive: Followed, robot: _Robot, published: list[str]) -> Watch:
    answer, T_map_odom, counts = estimate.answer, estimate.T_map_odom, drive.counts
    session, pose = answer.session, answer.T_map_base
    document: Watch = {
        "schema_version": 1,
        "state": estimate.state,
        "status": answer.status,
        "stamp_ns": answer.stamp_ns,
        "path_m": answer.path_m,
        "map": None,
        "frame": None,
        "pose": None,
        "T_map_odom": None,
        "in_space": in_space_document(answer),
        "confidence": answer.confidence,
        "published": published,
        "scans": drive.report().scans_read,
        "dropped": counts.dropped,
        "reconnected": counts.reconnected,
        "lag_s": drive.lag_s,
        "elapsed_s": estimate.elapsed_s,
    }
    if session is not None and pose is not None and answer.covariance is not None:
        info = robot.sessions[session]
        label = info.provenance.label
        document["frame"] = robot.frames[session].name if session in robot.frames else None
        document["map"] = {
            "database": robot.database.location,
            "session": session,
            "building": label.building,
            "floor": label.floor,
            "digest": info.digest,
        }
        document["pose"] = {
            "stamp_ns": answer.stamp_ns,
            "x": float(pose.x),
            "y": float(pose.y),
            "yaw": float(pose.yaw),
            "covariance": answer.covariance.tolist(),
        }
    if T_map_odom is not None:
        x, y, yaw = float(T_map_odom.x), float(T_map_odom.y), float(T_map_odom.yaw)
        document["T_map_odom"] = {"x": x, "y": y, "yaw": yaw}
    return document
