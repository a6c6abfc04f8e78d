"""Databases and answers as MCAP for Foxglove and rerun: `examples/foxglove.json` is a layout for Foxglove.

Topics: /map, /points (if the session has them), /path, /submaps; for an answer /query_path, /hypotheses,
/pose and /initialpose too, and map -> odom -> base_link over time. For a map located in another one
/query_map.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.io.export.mcap import LogWriter, Marker

if TYPE_CHECKING:
    from pc2grid.arrays import F64
    from pc2grid.model import MapOf, OccupancyGrid, Trajectory
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer

# Okabe and Ito's green, grey and purple.
_GREEN, _GREY, _PURPLE = (0.0, 0.62, 0.45, 1.0), (0.4, 0.4, 0.4, 0.6), (0.8, 0.47, 0.65, 1.0)


def write_session(
    path: Path, database: SubmapDatabase, session: str, force: bool, of: MapOf = "everything"
) -> None:
    """A session's map, path and submaps, and the poses of its robot over time. of : what the map shows."""
    poses = database.trajectory(session)
    with LogWriter(path, overwrite=force) as writer:
        _write_map(writer, database, session, int(poses.stamps_ns[0]) if len(poses) else 0, of)
        if len(poses):
            writer.path("/path", poses)
        for stamp_ns, T_session_base in zip(poses.stamps_ns, poses.T_session_base, strict=True):
            writer.tf(int(stamp_ns), "map", "base_link", T_session_base)


def write_answer(
    path: Path, database: SubmapDatabase, answer: Answer, located: Trajectory, force: bool
) -> None:
    """A located recording in the map: `located` are its poses there."""
    assert answer.session is not None
    assert answer.T_map_base is not None
    assert answer.T_map_odom is not None
    assert answer.covariance is not None
    first, last = int(located.stamps_ns[0]), int(located.stamps_ns[-1])
    with LogWriter(path, overwrite=force) as writer:
        _write_map(writer, database, answer.session, first)
        way = database.trajectory(answer.session)
        if len(way):
            writer.path("/path", way, stamp_ns=first)
        writer.path("/query_path", located, stamp_ns=first)
        T_map_odom, T_odom_map = answer.T_map_odom.lift(), answer.T_map_odom.inverse().lift()
        for stamp_ns, T_map_base in zip(located.stamps_ns, located.T_session_base, strict=True):
            # Each time anew: tf2 does not extrapolate from one transform on /tf.
            writer.tf(int(stamp_ns), "map", "odom", T_map_odom)
            writer.tf(int(stamp_ns), "odom", "base_link", T_odom_map @ T_map_base)
        writer.markers("/hypotheses", last, [_hypotheses(answer)])
        writer.pose_with_covariance("/pose", last, answer.T_map_base, answer.covariance)
        writer.initialpose(last, answer.T_map_base, answer.covariance)


def write_located_map(
    path: Path, database: SubmapDatabase, answer: Answer, query: OccupancyGrid, force: bool
) -> None:
    """A map that was located in another one: both grids, and map -> query_map between them."""
    assert answer.session is not None
    assert answer.T_map_odom is not None
    assert answer.covariance is not None
    with LogWriter(path, overwrite=force) as writer:
        _write_map(writer, database, answer.session, 0)
        writer.occupancy_grid("/query_map", 0, query, frame="query_map")
        writer.tf_static(0, "map", "query_map", answer.T_map_odom.lift())
        writer.markers("/hypotheses", 0, [_hypotheses(answer)])
        writer.pose_with_covariance("/pose", 0, answer.T_map_odom, answer.covariance)


def _write_map(
    writer: LogWriter, database: SubmapDatabase, session: str, stamp_ns: int, of: MapOf = "everything"
) -> None:
    writer.occupancy_grid("/map", stamp_ns, database.grid(session), of=of)
    points = database.points(session)
    if points is not None:
        writer.point_cloud("/points", stamp_ns, "map", points.points_m().astype(np.float32))
    table = database.signatures()
    index = [info.name for info in database.sessions()].index(session)
    graph = database.graph(session)
    ways = [graph.nodes[node]["center_m"] for edge in graph.edges for node in edge]
    centers = Marker(
        name="submaps",
        kind="spheres",
        points_m=_lift(table.center_m[table.session_index == index]),
        size_m=0.25,
        color=_GREEN,
    )
    lines = Marker(name="ways", kind="lines", points_m=_lift(ways), size_m=0.06, color=_GREY)
    writer.markers("/submaps", stamp_ns, [centers, lines])


def _hypotheses(answer: Answer) -> Marker:
    """Markers of the hypotheses, the best first."""
    poses = [hypothesis.fit.T_map_query @ answer.T_odom_base for hypothesis in answer.hypotheses]
    same = [answer.sessions[h.session_index] == answer.session for h in answer.hypotheses]
    points = [(pose.x, pose.y) for pose, here in zip(poses, same, strict=True) if here]
    return Marker(name="hypotheses", kind="spheres", points_m=_lift(points), size_m=0.4, color=_PURPLE)


def _lift(points_m: F64 | list[tuple[float, float]]) -> F64:
    """Points (N, 2) as (N, 3) at z = 0."""
    flat = np.asarray(points_m, np.float64).reshape(-1, 2)
    return np.column_stack((flat, np.zeros(len(flat))))
