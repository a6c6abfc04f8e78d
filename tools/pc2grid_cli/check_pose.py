"""`relocalize --check`, `--check-topic`, `watch --check-topic`: is the robot's own pose right?"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pc2grid.display import probability
from pc2grid.errors import one_line
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.observer import Observer, TimeSpan
from pc2grid_cli import console
from pc2grid_cli.known_pose import KnownPose, end_s
from pc2grid_cli.windows import Followed, Live, live
from signature.localization.answer_json import (
    Labelled,
    Pose,
    QueryRecording,
    StampedPose,
    TypedDict,
    plain,
    stamped_pose,
)
from signature.localization.map_index import MapIndex
from signature.localization.pose_check import CheckStatus, check_pose
from signature.sessions import about_log, query_config, tracked

if TYPE_CHECKING:
    from pc2grid.clouds.planar_scan import PlanarScan
    from pc2grid.io import Log
    from pc2grid.model import Health, RegisteredScan
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.localization.pose_check import PoseCheck


class CheckedPose(Pose):
    """The pose at the last scan, in the map frame."""

    stamp_ns: int


class BetterPlace(Labelled):
    """Where the query is instead, with certainty."""

    session: str | None
    pose: StampedPose | None
    confidence: float


class CheckedAgainst(TypedDict):
    """The database."""

    path: str


class CheckedPoseJudgement(TypedDict):
    """What is said of a pose that the robot believes in.

    status: fine, lost, or unsure. probability: that the pose is right; an upper bound unless it is fine.
    off_m, off_rad: from the pose to the best fit near it, null if nothing fits there. comparable: false if
    registration was lost after the time of the pose. better: null unless another place is certain.
    """

    status: CheckStatus
    probability: float
    session: str
    pose: CheckedPose
    off_m: float | None
    off_rad: float | None
    comparable: bool
    better: BetterPlace | None
    database: CheckedAgainst


class RelocalizeCheck(CheckedPoseJudgement):
    """`pc2grid relocalize --check` and `--check-topic`, with `--json`."""

    query: QueryRecording


class WatchCheck(CheckedPoseJudgement, Live):
    """A line of `pc2grid watch --check-topic --json`. path_m: travel that the judgement rests on."""

    path_m: float


def check_log(
    path: Path,
    database: SubmapDatabase,
    config: Config,
    known: KnownPose,
    *,
    span: TimeSpan,
    recover: bool,
    observer: Observer = Observer(),
) -> tuple[PoseCheck, RelocalizeCheck]:
    """Check the pose at the end of a recording, or of the part of it that `span` names."""
    config = query_config(database, config)
    with open_log(path, config.read, recover=recover) as log:
        T_map_base, stamp_ns = _believed(log, known, span)
        health: list[Health] = []

        def counted() -> Iterator[tuple[RegisteredScan, PlanarScan]]:
            for registered, planar_scan in tracked(log, config, span, observer):
                health.append(registered.health)
                yield registered, planar_scan

        with observer.step("check", span.length_ns(log.info.start_ns, log.info.end_ns) * 1e-9):
            index = MapIndex.of(database, config)
            checked = check_pose(counted(), index, T_map_base, stamp_ns=stamp_ns, session=known.session)
        about = about_log(path, log, checked, span, health)
        document: RelocalizeCheck = {**_judgement(checked, database.location), "query": about}
        return checked, plain(RelocalizeCheck, document)


def _believed(log: Log, known: KnownPose, span: TimeSpan) -> tuple[SE2, int | None]:
    """The pose to be checked, and its time; None: the last scan."""
    if known.check_topic is not None:
        pose = log.map_pose(known.check_topic, end_s(span))
        return pose.T_map_base, pose.stamp_ns
    assert known.check is not None
    x_m, y_m, yaw_deg = known.check
    return SE2(x_m, y_m, math.radians(yaw_deg)), None


def live_document(checked: PoseCheck, drive: Followed, where: str) -> Any:
    """The document of one check of a running robot's own pose."""
    document: WatchCheck = {
        **_judgement(checked, where),
        **live(drive, checked.elapsed_s),
        "path_m": checked.path_m,
    }
    return plain(WatchCheck, document)


def _judgement(checked: PoseCheck, where: str) -> CheckedPoseJudgement:
    pose, better = checked.T_map_base, checked.better
    return {
        "status": checked.status,
        "probability": checked.probability,
        "session": checked.session,
        "pose": {"x": pose.x, "y": pose.y, "yaw": pose.yaw, "stamp_ns": checked.stamp_ns},
        "off_m": checked.off_m,
        "off_rad": checked.off_rad,
        "comparable": not checked.lapsed,
        "better": None
        if better is None
        else {
            "session": better.session,
            "building": better.label.building,
            "floor": better.label.floor,
            "pose": stamped_pose(better),
            "confidence": better.confidence,
        },
        "database": {"path": where},
    }


def as_text(checked: PoseCheck) -> str:
    """The judgement in one or two lines."""
    pose = checked.T_map_base
    where = f"x {pose.x:.2f} m, y {pose.y:.2f} m, yaw {math.degrees(pose.yaw):.1f} deg"
    told = f"{checked.status}: {where} in {one_line(checked.session)}"
    if checked.lapsed:
        return f"{told}: registration was lost after that pose, so it cannot be compared"
    told += f", right with probability {_bound(checked)}"
    if checked.off_m is not None and checked.off_rad is not None and checked.status == "fine":
        told += f", {checked.off_m:.2f} m and {math.degrees(checked.off_rad):.1f} deg from the best fit"
    told += f", after {checked.path_m:.1f} m of travel"
    better = checked.better
    if better is not None and better.T_map_base is not None:
        pose = better.T_map_base
        told += (
            f"\n  better, in {one_line(better.session or '')}: x {pose.x:.2f} m, y {pose.y:.2f} m,"
            f" yaw {math.degrees(pose.yaw):.1f} deg, confidence {probability(better.confidence)}"
        )
    return told


def _bound(checked: PoseCheck) -> str:
    """The probability in words: an upper bound unless the pose is fine."""
    told = probability(checked.probability)
    return told if checked.status == "fine" or told.startswith("<") else f"at most {told}"


def report_check(checked: PoseCheck, document: RelocalizeCheck, *, as_json: bool) -> int:
    """Print the judgement; returns the exit code: 0 if the pose is fine."""
    console.print_result(document if as_json else as_text(checked))
    for warning in document["query"]["warnings"]:
        console.warn(warning)
    return console.OK if checked.status == "fine" else console.UNSURE
