"""Queries of the command line: a recording or a map, and the answer to it."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.geometry import SE2, wrap_angle
from pc2grid.io import open_log
from pc2grid.mapping.drawn_map import load_drawn_map
from pc2grid.model import Health, Trajectory
from pc2grid.observer import Observer
from pc2grid.time_span import TimeSpan
from pc2grid_cli.known_pose import KnownPose
from signature.files import locate_log, open_places, query_config
from signature.localization.answering import locate_map
from signature.localization.hypotheses import HYPOTHESES
from signature.localization.map_index import MapIndex
from signature.localization.prior import PRIOR

if TYPE_CHECKING:
    from pc2grid.arrays import F64, I64
    from pc2grid.io import Log
    from pc2grid.model import OccupancyGrid, ReadReport, RegisteredScan
    from pc2grid_cli.json_schemas import QueryRecording
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer
    from signature.localization.localizer import Estimate
    from signature.localization.pose_check import PoseCheck


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """An answer and the query it is about.

    poses : the query in its own frame, see `followed`; empty for a map. drawn : the query if it is a map.
    about : the description of the query in the JSON document.
    report : what was read of a recording, and what was lost; None for a map.
    """

    answer: Answer
    poses: Trajectory
    about: QueryRecording
    drawn: OccupancyGrid | None = None
    report: ReadReport | None = None


@contextlib.contextmanager
def searched(
    database: str, building: str | None, floor: str | None
) -> Iterator[tuple[SubmapDatabase, list[str]]]:
    """A database, or a map as one, to look in; only the sessions of a building and floor if they are given.

    Yields it, and what is damaged in it and left out.
    """
    with open_places(database) as opened:
        if building is not None or floor is not None:
            opened.keep_only(building=building, floor=floor)
        yield opened, [f"{problem.where}: {problem.what}" for problem in opened.leave_out_damaged()]


def find_log(
    path: Path,
    database: SubmapDatabase,
    config: Config,
    *,
    span: TimeSpan = TimeSpan(),
    recover: bool = False,
    observer: Observer = Observer(),
    see: Callable[[RegisteredScan, Estimate | None], None] = lambda registered, estimate: None,
    known: KnownPose = KnownPose(),
    index: MapIndex | None = None,
) -> Found:
    """Locate a recording, or the part of it that `span` names.

    see : see `signature.files.locate_log`. index : of the database, if it is prepared.
    """
    config = query_config(database, config)
    seen: list[RegisteredScan] = []

    def keep(registered: RegisteredScan, estimate: Estimate | None) -> None:
        seen.append(_without_points(registered))
        see(registered, estimate)

    with open_log(path, config.read, recover=recover) as log:
        prior = known.prior(log, span)
        index = index or MapIndex.of(database, config, observer)
        index = index if prior is None else index.within(prior)
        answer = locate_log(log, index, config, span=span, see=keep, observer=observer)
        poses = Trajectory(
            stamps_ns=np.array([s.scan.stamp_ns for s in seen], np.int64),
            T_session_base=np.array([s.T_session_base for s in seen]).reshape(-1, 4, 4),
            health=tuple(s.health for s in seen),
        )
        about = about_log(path, log, answer, scans=len(poses), span=span)
        return Found(answer=answer, poses=followed(poses, answer), about=about, report=log.report())


def about_log(
    path: Path, query: Log, answer: Answer | PoseCheck, *, scans: int, span: TimeSpan
) -> QueryRecording:
    """The description of a recording, or of a part of it, in the JSON document of the answer."""
    report = query.report()
    return {
        "path_m": answer.path_m,
        "stamp_ns": answer.stamp_ns,
        "source": path.name,
        "start_s": span.start_s,
        "duration_s": span.duration_s,
        "scans": scans,
        "sensor": query.choose().sensor,
        "lossy": report.lossy,
        "warnings": list(report.warnings),
    }


def find_map(path: Path, database: SubmapDatabase, config: Config, index: MapIndex | None = None) -> Found:
    """Locate a map: of nav2, or a cloud or mesh. index : of the database, if it is prepared."""

    made_with = database.config().model_copy(update={"read": config.read})
    drawn = load_drawn_map(path, made_with)
    answer = locate_map(drawn.grid, index or MapIndex.of(database, config))
    poses = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    about: QueryRecording = {
        "path_m": answer.path_m,
        "stamp_ns": answer.stamp_ns,
        "source": path.name,
        "start_s": 0.0,
        "duration_s": None,
        "scans": 0,
        "sensor": "map",
        "lossy": False,
        "warnings": list(drawn.warnings),
    }
    return Found(answer=answer, poses=poses, about=about, drawn=drawn.grid)


def in_map(poses: Trajectory, answer: Answer) -> Trajectory | None:
    """The query's poses in the map frame; None without an answer."""
    if answer.T_map_odom is None:
        return None
    return replace(poses, T_session_base=answer.T_map_odom.lift() @ poses.T_session_base)


def followed(poses: Trajectory, answer: Answer) -> Trajectory:
    """The query's poses (odometry frame of its last scan), corrected by where it was located on the way.

    Between two located moments the correction is interpolated along the travel, in position and heading of
    the base; before the first one it is that of the first. Where registration was lost the motion is not
    known, so nothing is interpolated across. A moment counts if the one before or after it agrees with it, by
    the motion between them.

    Without an answer: as they are.
    """

    if answer.T_map_odom is None:
        return poses
    planar = poses.planar()
    travel_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(planar[:, :2], axis=0).T))))
    # Scans of a standing robot get increasing values, too.
    travel_m += 1e-9 * np.arange(len(travel_m))
    health = poses.health or (Health.FINE,) * len(poses)
    part = np.cumsum([h is Health.LOST for h in health])
    at, moments = _located_moments(poses, travel_m, part, answer)
    T_odom_map = answer.T_map_odom.inverse()
    corrections = [T_odom_map @ pose @ SE2(*planar[k]).inverse() for k, pose in zip(at, moments, strict=True)]
    turns = np.unwrap([T.yaw for T in corrections])
    moved = np.array([T.apply(planar[:, :2]) for T in corrections])
    corrected = poses.T_session_base.copy()
    for number in np.unique(part):
        here = np.flatnonzero(part == number)
        own = np.flatnonzero(part[at] == number)
        if not len(own):
            own = np.abs(at - here.mean()).argmin(keepdims=True)
        # How much each of the moments counts at each of the scans: between two of them, both.
        shares = [np.interp(travel_m[here], travel_m[at[own]], one) for one in np.eye(len(own))]
        for k, share in zip(here, np.transpose(shares), strict=True):
            height_m = corrected[k, 2, 3]
            corrected[k] = SE2(0.0, 0.0, share @ turns[own]).lift() @ corrected[k]
            corrected[k, :3, 3] = *(share @ moved[own, k]), height_m
    return replace(poses, T_session_base=corrected)


def _located_moments(poses: Trajectory, travel_m: F64, part: I64, answer: Answer) -> tuple[I64, list[SE2]]:
    """The scans at which the query was located in the session of the answer, and the base in its map."""

    planar = poses.planar()
    found = [
        (int(np.searchsorted(poses.stamps_ns, moment.stamp_ns)), moment.pose)
        for moment in answer.history
        if moment.status == "located" and moment.session == answer.session and moment.pose is not None
    ]

    def agree(a: tuple[int, SE2], b: tuple[int, SE2]) -> bool:
        if part[a[0]] != part[b[0]]:
            return False
        expected = a[1] @ SE2(*planar[a[0]]).inverse() @ SE2(*planar[b[0]])
        apart_m = math.hypot(expected.x - b[1].x, expected.y - b[1].y)
        limit_m = HYPOTHESES.same_m + PRIOR.drift * (travel_m[b[0]] - travel_m[a[0]])
        return apart_m <= limit_m and abs(wrap_angle(expected.yaw - b[1].yaw)) <= HYPOTHESES.same_rad

    agrees = [agree(a, b) for a, b in itertools.pairwise(found)]
    kept = [
        here
        for here, before, after in zip(found, [False, *agrees], [*agrees, True], strict=True)
        if before or after  # the last one is the answer
    ]
    return np.array([k for k, _ in kept], np.int64), [pose for _, pose in kept]


def _without_points(registered: RegisteredScan) -> RegisteredScan:
    """Only the pose is needed later; a long query must not keep all its points."""

    scan = replace(registered.scan, points_m=np.empty((0, 3), np.float32), offsets_s=None)
    return replace(registered, scan=scan)
