"""Queries as the command line knows them: a recording or a nav2 map, and the answer to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pc2grid_cli import console

if TYPE_CHECKING:
    from pc2grid.io import Log
    from pc2grid.model import OccupancyGrid, RegisteredScan, Trajectory
    from signature.answer import Moment
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.relocalize import Answer

    Watch = Callable[[RegisteredScan, Moment | None], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """An answer and the query it is about.

    poses : the query in its own frame; empty for a map. drawn : the query if it is a map.
    about : what the JSON document says of the query.
    """

    answer: Answer
    poses: Trajectory
    about: dict[str, Any]
    drawn: OccupancyGrid | None = None


def find_log(
    path: Path,
    database: SubmapDatabase,
    config: Config,
    *,
    start_s: float,
    duration_s: float | None,
    recover: bool,
    watch: Watch | None = None,
) -> Found:
    """Locate a recording, or the part of it from `start_s` on that is `duration_s` long."""
    from pc2grid.io import open_log

    with open_log(path, config.read, recover=recover) as query:
        answer, poses = locate(query, database, config, start_s=start_s, duration_s=duration_s, watch=watch)
        report = query.report()
        about = {
            "source": path.name,
            "scans": len(poses),
            "sensor": query.choose().sensor,
            "lossy": report.lossy,
            "warnings": list(report.warnings),
        }
    return Found(answer=answer, poses=poses, about=about)


def find_map(path: Path, database: SubmapDatabase, config: Config) -> Found:
    """Locate a nav2 map."""
    import numpy as np

    from pc2grid.io.nav2_map import load_map
    from pc2grid.model import Trajectory
    from signature.relocalize import Building, locate_map

    drawn = load_map(path)
    answer = locate_map(drawn, Building.of(database, config))
    poses = Trajectory(stamps_ns=np.empty(0, np.int64), T_map_base=np.empty((0, 4, 4)))
    about = {"source": path.name, "scans": 0, "sensor": "map", "lossy": False, "warnings": []}
    return Found(answer=answer, poses=poses, about=about, drawn=drawn)


def locate(
    query: Log,
    database: SubmapDatabase,
    config: Config,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    watch: Watch | None = None,
) -> tuple[Answer, Trajectory]:
    """The answer for a recording, and its poses in its own odometry frame.

    watch : is shown each scan, and what became of it if the database was asked.

    The query is registered and drawn with the settings that made the database; only how to read the
    recording and how to search are the caller's.
    """
    import numpy as np

    from pc2grid.model import Trajectory
    from pc2grid.pipeline import follow
    from signature.relocalize import Building, Relocalizer

    made_with = database.config()
    config = made_with.model_copy(
        update={"read": config.read, "relocalize": config.relocalize, "registration": config.registration}
    )
    seen: list[RegisteredScan] = []
    begin_ns = query.info.start_ns + int(start_s * 1e9)
    span_ns = max(query.info.end_ns - begin_ns if duration_s is None else int(duration_s * 1e9), 1)
    relocalizer = Relocalizer(Building.of(database, config))
    (search,) = relocalizer.searches
    with console.progress("locate", span_ns * 1e-9) as update:
        for registered, sweep in follow(query.scans(start_s, duration_s), config):
            seen.append(_without_points(registered))
            update(min((registered.scan.stamp_ns - begin_ns) / span_ns, 1.0))
            before = search.latest
            relocalizer.add(registered, sweep)
            if watch is not None:
                watch(registered, None if search.latest is before else search.latest)
        answer = relocalizer.answer()
    poses = Trajectory(
        stamps_ns=np.array([s.scan.stamp_ns for s in seen], np.int64),
        T_map_base=np.array([s.T_map_base for s in seen]).reshape(-1, 4, 4),
        health=tuple(s.health for s in seen),
    )
    return answer, poses


def in_map(poses: Trajectory, answer: Answer) -> Trajectory | None:
    """The query's poses in the map frame; None without an answer."""
    from dataclasses import replace

    if answer.T_map_odom is None:
        return None
    return replace(poses, T_map_base=answer.T_map_odom.lift() @ poses.T_map_base)


def _without_points(registered: RegisteredScan) -> RegisteredScan:
    """Only the pose is needed later; a long query must not keep all its points."""
    from dataclasses import replace

    import numpy as np

    scan = replace(registered.scan, points_m=np.empty((0, 3), np.float32), offsets_s=None)
    return replace(registered, scan=scan)
