"""Databases and answers as `.rrd` files for the rerun viewer (`rerun OUT.rrd`); needs the extra `viz`.

Entities: map/walls, map/submaps, map/ways, map/path; for an answer query/path, query/hypotheses, and
query/base, which moves over the timeline `time`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.errors import ConfigError
from pc2grid.io.atomic import replace_file
from pc2grid_cli.picture import BLUE, GREEN, PURPLE, VERMILLION

if TYPE_CHECKING:
    from pc2grid.geometry import F64
    from pc2grid.model import Trajectory
    from signature.answer import Answer
    from signature.database import SubmapDatabase


def require_rerun() -> Any:
    """The rerun module. Raises ConfigError, saying what to install, if it is not there."""
    try:
        import rerun
    except ImportError:
        raise ConfigError("--rerun needs the package rerun-sdk", hint="pip install 'pc2grid[viz]'") from None
    return rerun


def write_session(path: Path, database: SubmapDatabase, session: str) -> None:
    """A session's map, submaps and path."""
    with _recording(path, session) as recording:
        _log_map(recording, database, session)
        _log_moving(recording, "map/base", database.trajectory(session), BLUE)


def write_answer(path: Path, database: SubmapDatabase, answer: Answer, located: Trajectory) -> None:
    """A located recording in the map: `located` are its poses there."""
    rr = require_rerun()
    assert answer.session is not None
    with _recording(path, answer.session) as recording:
        _log_map(recording, database, answer.session)
        recording.log(
            "query/path",
            rr.LineStrips3D([located.T_map_base[:, :3, 3]], colors=_rgb(VERMILLION)),
            static=True,
        )
        poses = [hypothesis.fit.T_map_query @ answer.T_odom_base for hypothesis in answer.hypotheses]
        here = [answer.sessions[h.session_index] == answer.session for h in answer.hypotheses]
        places = [(pose.x, pose.y, 0.0) for pose, shown in zip(poses, here, strict=True) if shown]
        recording.log("query/hypotheses", rr.Points3D(places, colors=_rgb(PURPLE), radii=0.2), static=True)
        _log_moving(recording, "query/base", located, VERMILLION)


@contextlib.contextmanager
def _recording(path: Path, name: str) -> Iterator[Any]:
    """A recording that becomes `path` when the block ends well."""
    # Named after the content, so that the same data does not open as something new every time.
    stream = require_rerun().RecordingStream("pc2grid", recording_id=name)
    with replace_file(path) as temporary:
        stream.save(temporary)
        try:
            yield stream
        finally:
            stream.flush()
            stream.disconnect()


def _log_map(recording: Any, database: SubmapDatabase, session: str) -> None:
    from pc2grid.partition import junction_graph

    rr = require_rerun()
    grid, table = database.grid(session), database.signatures()
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    walls = _lift(grid.to_point(np.argwhere(grid.occupied)))
    recording.log(
        "map/walls", rr.Points3D(walls, colors=_rgb("#555555"), radii=grid.resolution_m / 2), static=True
    )
    index = [info.name for info in database.sessions()].index(session)
    centers = _lift(table.center_m[table.session_index == index])
    recording.log("map/submaps", rr.Points3D(centers, colors=_rgb(GREEN), radii=0.12), static=True)
    graph = junction_graph(grid, database.config().partition)
    ways = [_lift(np.array([graph.nodes[n]["center_m"] for n in edge])) for edge in graph.edges]
    recording.log("map/ways", rr.LineStrips3D(ways, colors=_rgb("#999999")), static=True)
    way = database.trajectory(session).T_map_base[:, :3, 3]
    recording.log("map/path", rr.LineStrips3D([way], colors=_rgb(BLUE)), static=True)


def _log_moving(recording: Any, entity: str, poses: Trajectory, color: str) -> None:
    """The base over time, as an arrow of half a metre."""
    from pc2grid.geometry import quat_xyzw_from_pose

    rr = require_rerun()
    if not len(poses):
        return
    recording.log(entity, rr.Arrows3D(vectors=[[0.5, 0.0, 0.0]], colors=_rgb(color), radii=0.06), static=True)
    recording.send_columns(
        entity,
        indexes=[rr.TimeColumn("time", timestamp=poses.stamps_ns.astype("datetime64[ns]"))],
        columns=rr.Transform3D.columns(
            translation=poses.T_map_base[:, :3, 3],
            quaternion=[quat_xyzw_from_pose(T) for T in poses.T_map_base],
        ),
    )


def _lift(points_m: F64) -> F64:
    """Points (N, 2) as (N, 3) at z = 0."""
    return np.column_stack((points_m, np.zeros(len(points_m))))


def _rgb(color: str) -> list[tuple[int, ...]]:
    """A colour "#RRGGBB" as rerun takes it, for all parts of an entity."""
    return [tuple(bytes.fromhex(color[1:]))]
