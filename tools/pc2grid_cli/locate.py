"""Queries as the command line knows them: a recording or a map, and the answer to it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.observer import Observer
from pc2grid.time_span import TimeSpan
from pc2grid_cli.known_pose import KnownPose

if TYPE_CHECKING:
    from pc2grid.io import Log
    from pc2grid.model import OccupancyGrid, ReadReport, RegisteredScan, Trajectory
    from pc2grid_cli.json_schemas import Query
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.relocalization.answer import Moment
    from signature.relocalization.map_index import MapIndex
    from signature.relocalization.prior import Prior
    from signature.relocalization.relocalizer import Answer, Watch


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """An answer and the query it is about.

    poses : the query in its own frame; empty for a map. drawn : the query if it is a map.
    about : the description of the query in the JSON document.
    report : what was read of a recording, and what was lost; None for a map.
    asked : what the answer would have been after every metre or so; empty if this was not wanted.
    """

    answer: Answer
    poses: Trajectory
    about: Query
    drawn: OccupancyGrid | None = None
    report: ReadReport | None = None
    asked: tuple[Moment, ...] = ()


def find_log(
    path: Path,
    database: SubmapDatabase,
    config: Config,
    *,
    span: TimeSpan,
    recover: bool,
    observer: Observer = Observer(),
    watch: Watch | None = None,
    known: KnownPose = KnownPose(),
    ask: bool = False,
    index: MapIndex | None = None,
) -> Found:
    """Locate a recording, or the part of it that `span` names.

    ask : find out, too, what the answer would have been on the way (`Found.asked`, and what `watch` gets).
    index : of the database, if it is prepared.
    """
    from pc2grid.io import open_log

    asked: list[Moment] = []

    def see(registered: RegisteredScan, moment: Moment | None) -> None:
        if ask and moment is not None:
            asked.append(moment)
        if watch is not None:
            watch(registered, moment)

    with open_log(path, config.read, recover=recover) as query:
        prior = known.prior(query, span)
        answer, poses = locate(
            query,
            database,
            config,
            span=span,
            observer=observer,
            watch=see,
            prior=prior,
            ask=ask,
            index=index,
        )
        about = about_log(path, query, answer, scans=len(poses))
        report = query.report()
        return Found(answer=answer, poses=poses, about=about, report=report, asked=tuple(asked))


def about_log(path: Path, query: Log, answer: Answer, *, scans: int) -> Query:
    """The description of a recording in the JSON document of the answer."""
    report = query.report()
    return {
        "path_m": answer.path_m,
        "stamp_ns": answer.stamp_ns,
        "source": path.name,
        "scans": scans,
        "sensor": query.choose().sensor,
        "lossy": report.lossy,
        "warnings": list(report.warnings),
    }


def find_map(path: Path, database: SubmapDatabase, config: Config) -> Found:
    """Locate a map: of nav2, or a cloud or mesh."""
    import numpy as np

    from pc2grid.mapping.drawn_map import load_drawn_map
    from pc2grid.model import Trajectory
    from signature.relocalization.relocalizer import MapIndex, locate_map

    made_with = database.config().model_copy(update={"read": config.read})
    drawn = load_drawn_map(path, made_with)
    answer = locate_map(drawn.grid, MapIndex.of(database, config))
    poses = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    about: Query = {
        "path_m": answer.path_m,
        "stamp_ns": answer.stamp_ns,
        "source": path.name,
        "scans": 0,
        "sensor": "map",
        "lossy": False,
        "warnings": list(drawn.warnings),
    }
    return Found(answer=answer, poses=poses, about=about, drawn=drawn.grid)


def locate(
    query: Log,
    database: SubmapDatabase,
    config: Config,
    *,
    span: TimeSpan = TimeSpan(),
    observer: Observer = Observer(),
    watch: Watch | None = None,
    prior: Prior | None = None,
    ask: bool = False,
    index: MapIndex | None = None,
) -> tuple[Answer, Trajectory]:
    """The answer for a recording, and its poses in its own odometry frame.

    watch : called with each scan, and with the state of the answer if the database was asked after it.
    prior : what is known of the pose beforehand. ask : see `signature.relocalization.relocalizer.localize`.
    index : of the database, if it is prepared.

    config : see `query_config`.
    """
    import numpy as np

    from pc2grid.model import Trajectory
    from signature.files import locate_log, query_config
    from signature.relocalization.map_index import MapIndex

    config = query_config(database, config)
    index = index or MapIndex.of(database, config, observer)
    seen: list[RegisteredScan] = []

    def see(registered: RegisteredScan, moment: Moment | None) -> None:
        seen.append(_without_points(registered))
        if watch is not None:
            watch(registered, moment)

    answer = locate_log(
        query,
        index if prior is None else index.within(prior),
        config,
        span=span,
        watch=see,
        ask=ask,
        observer=observer,
    )
    poses = Trajectory(
        stamps_ns=np.array([s.scan.stamp_ns for s in seen], np.int64),
        T_session_base=np.array([s.T_session_base for s in seen]).reshape(-1, 4, 4),
        health=tuple(s.health for s in seen),
    )
    return answer, poses


def in_map(poses: Trajectory, answer: Answer) -> Trajectory | None:
    """The query's poses in the map frame; None without an answer."""
    from dataclasses import replace

    if answer.T_map_odom is None:
        return None
    return replace(poses, T_session_base=answer.T_map_odom.lift() @ poses.T_session_base)


def _without_points(registered: RegisteredScan) -> RegisteredScan:
    """Only the pose is needed later; a long query must not keep all its points."""
    from dataclasses import replace

    import numpy as np

    scan = replace(registered.scan, points_m=np.empty((0, 3), np.float32), offsets_s=None)
    return replace(registered, scan=scan)
