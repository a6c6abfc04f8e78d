"""`pc2grid export`: the sessions of a database in the formats of other programs.

Databases and answers as MCAP for Foxglove and rerun: `examples/foxglove.json` is a layout for Foxglove.

Topics: /map, /points (if the session has them), /path, /submaps; for an answer /query_path, /hypotheses,
/pose and /initialpose too, and map -> odom -> base_link over time. For a map located in another one
/query_map.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid._version import __version__
from pc2grid.errors import ConfigError, DatabaseError, one_line
from pc2grid.io.export import LogWriter, Marker, write_cloud, write_g2o, write_graph
from pc2grid.io.maps import is_map_file, save_map
from pc2grid.io.trajectory import write_trajectory
from pc2grid.model import THING, MapOf, OccupancyGrid
from pc2grid_cli import console, options
from pc2grid_cli.documents import OfDatabase
from pc2grid_cli.output import check_file, written_files
from signature.localization.joining.building import floors_of, map_of
from signature.localization.shown.page import write_report
from signature.localization.shown.picture import draw_building, draw_session

if TYPE_CHECKING:
    from pc2grid.geometry import F64
    from pc2grid.model import MapOf, OccupancyGrid, Trajectory
    from signature.database import SubmapDatabase
    from signature.database.protocol import BuildingFrame, SessionInfo
    from signature.localization.answer import Answer


class Export(OfDatabase):
    """`pc2grid export --json`; session is null if only a report was written."""

    session: str | None
    written: list[str]


SHOWN: dict[MapOf, str] = {
    "everything": "what stands there is an obstacle, walls and things such as tables alike",
    "walls": "things such as tables are unknown, and no obstacles",
    "raw": f"in percent, {THING} is a thing such as a table; nav2 takes what is below 100 for free",
}


def check(
    outputs: Mapping[str, Path], of: MapOf | None, format_: options.TrajectoryFormat | None, force: bool
) -> None:
    """Raises ConfigError if there is nothing to write, OutputError if a target cannot be written."""
    if of is not None and not {"map", "mcap"} & outputs.keys():
        raise ConfigError("--map-of: no map is written", hint="name --map or --mcap, too")
    if not outputs:
        raise ConfigError(
            "nothing to export",
            hint="name one of --map, --trajectory, --cloud, --graph, --g2o, --mcap, --plot, --report",
        )
    for option, named in outputs.items():
        for path in written_files({option: named}):
            check_file(option, path, force, any_suffix=option == "trajectory" and format_ is not None)


@dataclass(frozen=True, slots=True)
class As:
    """How it is written: what maps show, the format of the trajectory (None: by its suffix), --force."""

    of: MapOf
    format: options.TrajectoryFormat | None
    force: bool


def write(
    outputs: Mapping[str, Path],
    as_told: As,
    database: SubmapDatabase,
    session: str | None,
    frames: Mapping[str, BuildingFrame],
    terminal: console.Console,
) -> str | None:
    """Write all files. Returns the session that was written; None if it was a whole building, or none."""
    floors, of_sessions = floors_of(database, frames), outputs.keys() - {"report"}
    name, of_one = None, of_sessions - {"map", "cloud", "plot"}
    if of_sessions and session is None and not of_one and len(floors) == 1:
        _write_building(outputs, as_told, database, floors[0], frames, terminal)
    elif of_sessions:
        name = session or _only_session(database, of_one, joined=bool(floors))
        _write_session(outputs, as_told, database, name, frames.get(name), terminal)
    if "report" in outputs:
        write_report(outputs["report"], database)
    return name


def _only_session(database: SubmapDatabase, of_one: Collection[str], *, joined: bool) -> str:
    """The session to write if none is named. Raises DatabaseError if there is not exactly one.

    of_one : the options that write a session and no building. joined : whether sessions are.
    """
    names = [info.name for info in database.sessions()]
    if len(names) == 1:
        return names[0]
    why, hint = "", "for one map of all: `pc2grid db join`, --building, --floor"
    if joined:
        why = f"; --{min(of_one)} is of one session" if of_one else "; several floors are joined"
        hint = "of a floor, --map, --cloud and --plot alone show all: --building, --floor"
    raise DatabaseError(
        f"{database.location}: holds {len(names)} sessions: {', '.join(names) or 'none'}{why}",
        hint=f"choose one with --session; {hint}",
    )


def _write_building(
    outputs: Mapping[str, Path],
    as_told: As,
    database: SubmapDatabase,
    names: Sequence[str],
    frames: Mapping[str, BuildingFrame],
    terminal: console.Console,
) -> None:
    """Write the map, the cloud and the picture of the sessions of a floor, in the frame of their building."""
    others = [info.name for info in database.sessions() if info.name not in frames]
    if others:
        console.warn(f"not joined, and left out: {', '.join(others)}")
    if "map" in outputs:
        _write_map(outputs["map"], database, names, frames, as_told.of)
    if "cloud" in outputs:
        _write_cloud(outputs["cloud"], database, names, frames, terminal)
    if "plot" in outputs:
        maps = {name: (database.grid(name), frames[name]) for name in names}
        draw_building(outputs["plot"], frames[names[0]].name, maps)


def _write_session(
    outputs: Mapping[str, Path],
    as_told: As,
    database: SubmapDatabase,
    name: str,
    frame: BuildingFrame | None,
    terminal: console.Console,
) -> None:
    """Write all files of a session. frame : of its building; None: its own map frame."""
    # A session without a trajectory is refused before anything is written.
    poses = database.trajectory(name)
    if not len(poses) and {"trajectory", "g2o"} & outputs.keys():
        raise DatabaseError(f"{database.location}: session {name!r} is an imported map and has no trajectory")
    frames = {} if frame is None else {name: frame}
    writers: dict[str, Callable[[Path], object]] = {
        "trajectory": lambda path: write_trajectory(path, _in_building(poses, frame), as_told.format),
        "cloud": lambda path: _write_cloud(path, database, [name], frames, terminal),
        "graph": lambda path: write_graph(path, database.graph(name)),
        "g2o": lambda path: write_g2o(path, poses, database.loops(name)),
        "mcap": lambda path: write_session(path, database, name, as_told.force, as_told.of),
        "plot": lambda path: draw_session(path, database, name),
        "map": lambda stem: _write_map(stem, database, [name], frames, as_told.of),
    }
    for option, write in writers.items():
        if option in outputs:
            write(outputs[option])


def _write_map(
    stem: Path,
    database: SubmapDatabase,
    names: Sequence[str],
    frames: Mapping[str, BuildingFrame],
    of: MapOf,
) -> None:
    """The map of a session, or of all of a floor that are joined, and what it shows."""
    planes = dict.fromkeys(_plane(info, database.grid(info.name)) for info in database.sessions(names))
    save_map(
        map_of(database, names[0], frames),
        stem,
        mode="raw" if of == "raw" else "trinary",
        of=of,
        comment=f"pc2grid {__version__}, {' and '.join(planes)}:\n{SHOWN[of]}",
    )


def _plane(info: SessionInfo, grid: OccupancyGrid) -> str:
    """At which heights the plan of a session is cut."""
    if is_map_file(Path(info.provenance.source)):
        return f"heights as in {one_line(info.provenance.source)}"
    if info.sensor == "laser":
        above = "" if grid.height_m is None else f", {grid.height_m:.2f} m above the base"
        return f"cut in the plane of a laser{above}"
    band = info.provenance.config.projection
    return f"cut from {band.band_min_m:g} to {band.band_max_m:g} m above the floor"


def _in_building(poses: Trajectory, frame: BuildingFrame | None) -> Trajectory:
    if frame is None:
        return poses
    T = np.array([at.lift() for at in frame.around(poses.planar()[:, :2])])
    return replace(poses, T_session_base=T @ poses.T_session_base)


def _write_cloud(
    path: Path,
    database: SubmapDatabase,
    sessions: Sequence[str],
    frames: Mapping[str, BuildingFrame],
    terminal: console.Console,
) -> None:
    """The points in space of the sessions that have them; if none has, a point for each occupied cell."""
    clouds, walls, voxel_m = [np.empty((0, 3))], [np.empty((0, 3))], 0.0
    for name in sessions:
        placed = frames[name].apply if name in frames else np.asarray
        points, grid = database.points(name), database.grid(name)
        if points is not None:
            voxel_m = max(voxel_m, points.voxel_m)
            clouds.append(placed(points.points_m()))
        flat = grid.to_point(np.argwhere(grid.occupied))
        walls.append(placed(np.column_stack((flat, np.zeros(len(flat))))))
    cloud, wall = np.concatenate(clouds), np.concatenate(walls)
    if len(cloud):
        write_cloud(path, cloud)
        terminal.note(f"{path}: {len(cloud)} points, one a voxel of {voxel_m:g} m")
        return
    write_cloud(path, wall)
    terminal.note(f"{path}: {len(wall)} occupied cells at z = 0; the database keeps no 3D points")


# Okabe and Ito's green, grey and purple.
_GREEN, _GREY, _PURPLE = (0.0, 0.62, 0.45, 1.0), (0.4, 0.4, 0.4, 0.6), (0.8, 0.47, 0.65, 1.0)


def write_session(
    path: Path, database: SubmapDatabase, session: str, force: bool, of: MapOf = "everything"
) -> None:
    """A session's map, path and submaps, and the poses of its robot over time. of : what the map shows."""
    poses = database.trajectory(session)
    with LogWriter(path, overwrite=force) as writer:
        _write_map_message(writer, database, session, int(poses.stamps_ns[0]) if len(poses) else 0, of)
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
        _write_map_message(writer, database, answer.session, first)
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
        _write_map_message(writer, database, answer.session, 0)
        writer.occupancy_grid("/query_map", 0, query, frame="query_map")
        writer.tf_static(0, "map", "query_map", answer.T_map_odom.lift())
        writer.markers("/hypotheses", 0, [_hypotheses(answer)])
        writer.pose_with_covariance("/pose", 0, answer.T_map_odom, answer.covariance)


def _write_map_message(
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
