"""`pc2grid export`: the sessions of a database in the formats of other programs.

Sessions and answers as MCAP, for Foxglove (`examples/foxglove.json` is a layout for it) and rerun: /map,
/points (if the session has them), /path and /submaps; for an answer also /query_path, /hypotheses, /pose and
/initialpose, and map -> odom -> base_link over time; for a map that was located in another one /query_map.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pc2grid import libraries
from pc2grid._version import __version__
from pc2grid.display import plain
from pc2grid.errors import ConfigError, DatabaseError, one_line
from pc2grid.geometry import F64
from pc2grid.io import export
from pc2grid.io.export import LogWriter, Marker, write_cloud, write_g2o, write_graph
from pc2grid.io.maps import is_map_file, save_map
from pc2grid.io.trajectory import write_trajectory
from pc2grid.model import THING, MapOf, OccupancyGrid, Trajectory
from pc2grid_cli import console, options, output
from signature.database import SubmapDatabase, open_database
from signature.database.protocol import BuildingFrame, SessionInfo
from signature.localization.answer import Answer
from signature.shown.page import Found, write_report
from signature.shown.picture import draw_building, draw_session

BuildingFrames = Mapping[str, BuildingFrame]
"""Of the buildings that sessions are joined in, by session."""


SHOWN: dict[MapOf, str] = {
    "everything": "what stands there is an obstacle, walls and things such as tables alike",
    "walls": "things such as tables are unknown, and no obstacles",
    "raw": f"in percent, {THING} is a thing such as a table; nav2 takes what is below 100 for free",
}
_FILES = ("trajectory", "cloud", "graph", "g2o", "mcap", "plot", "map", "report")
"""Options that name what is written, in this order."""
_OF_FLOORS = {"map", "cloud", "plot"}
"""Those that also show all joined sessions of a floor."""


def run(given: options.Export, terminal: console.Console) -> None:
    """Write all files, and print what was written."""
    outputs = output.files_of(given, _FILES)
    if "map" in outputs:
        outputs["map"] = output.map_stem(outputs["map"])
    _check(outputs, given)
    libraries.require(libraries.of_addresses(given.database))
    # Only maps of buildings need what joins them.
    from signature.join.building import floors_of

    with open_database(given.database) as opened:
        if given.building is not None or given.floor is not None:
            opened.keep_only(building=given.building, floor=given.floor)
        frames = opened.frames() if given.frame == "building" else {}
        floors, of_sessions = floors_of(opened, frames), outputs.keys() - {"report"}
        whole = given.session is None and of_sessions <= _OF_FLOORS and len(floors) == 1
        name = None
        if of_sessions and not whole:
            name = given.session or _only_session(
                opened, sorted(of_sessions - _OF_FLOORS), joined=bool(floors)
            )
        if of_sessions:
            names = floors[0] if name is None else [name]
            _write(outputs, given, opened, names, frames, terminal, whole=name is None)
        if "report" in outputs:
            write_report(outputs["report"], opened)
        written = output.written_files(outputs)
        about = {"database": opened.location, "session": name, "written": [*map(str, written)]}
    if given.map_of not in (None, "everything"):
        terminal.note(f"--map-of {given.map_of}: {SHOWN[given.map_of]}")
    for path in written:
        terminal.note(f"wrote {path}")
    if given.json:
        console.print_result(plain(about))


def _check(outputs: Mapping[str, Path], given: options.Export) -> None:
    """Raise ConfigError if there is nothing to write, OutputError if a target cannot be written."""
    if given.map_of is not None and not {"map", "mcap"} & outputs.keys():
        raise ConfigError("--map-of: no map is written", hint="name --map or --mcap, too")
    if not outputs:
        raise ConfigError(
            "nothing to export",
            hint="name one of --map, --trajectory, --cloud, --graph, --g2o, --mcap, --plot, --report",
        )
    for option, named in outputs.items():
        for path in output.written_files({option: named}):
            output.check_file(option, path, given.force)


def _only_session(database: SubmapDatabase, of_one: Sequence[str], *, joined: bool) -> str:
    """Return the session to write if none is named. Raises DatabaseError if there is not exactly one.

    of_one : the options that write a session and no building. joined : whether sessions are.
    """
    names = [info.name for info in database.sessions()]
    if len(names) == 1:
        return names[0]
    why, hint = "", "for one map of all: `pc2grid db join`, --building, --floor"
    if joined:
        why = f"; --{of_one[0]} is of one session" if of_one else "; several floors are joined"
        hint = "of a floor, --map, --cloud and --plot alone show all: --building, --floor"
    raise DatabaseError(
        f"{database.location}: holds {len(names)} sessions: {', '.join(names) or 'none'}{why}",
        hint=f"choose one with --session; {hint}",
    )


def _write(
    outputs: Mapping[str, Path],
    given: options.Export,
    database: SubmapDatabase,
    names: Sequence[str],
    frames: BuildingFrames,
    terminal: console.Console,
    *,
    whole: bool,
) -> None:
    """Write all files of a session, or with `whole` those that show all sessions of a floor.

    They are in the frame of the building; of a session that is not joined, in its own.
    """
    if whole and (others := [info.name for info in database.sessions() if info.name not in frames]):
        console.warn(f"not joined, and left out: {', '.join(others)}")
    # A session without a trajectory is refused before anything is written.
    name, poses = names[0], database.trajectory(names[0])
    if not len(poses) and {"trajectory", "g2o"} & outputs.keys():
        raise DatabaseError(f"{database.location}: session {name!r} is an imported map and has no trajectory")
    placed = {session: frames[session] for session in names if session in frames}

    def draw(path: Path) -> None:
        if whole:
            maps = {session: (database.grid(session), at) for session, at in placed.items()}
            draw_building(path, frames[name].name, maps)
        else:
            draw_session(path, database, name)

    writers: dict[str, Callable[[Path], object]] = {
        "trajectory": lambda path: write_trajectory(path, _in_building(poses, frames.get(name))),
        "cloud": lambda path: _write_cloud(path, database, names, placed, terminal),
        "graph": lambda path: write_graph(path, database.graph(name)),
        "g2o": lambda path: write_g2o(path, poses, database.loops(name)),
        "mcap": lambda path: _write_mcap(path, database, name, given),
        "plot": draw,
        "map": lambda stem: _write_map(stem, database, names, placed, given.map_of),
    }
    for option, write in writers.items():
        if option in outputs:
            write(outputs[option])


def _write_map(
    stem: Path, database: SubmapDatabase, names: Sequence[str], frames: BuildingFrames, of: MapOf | None
) -> None:
    """Write the map of a session, or of all of a floor that are joined. of : what it shows."""
    from signature.join.building import map_of

    planes = dict.fromkeys(_plane(info, database.grid(info.name)) for info in database.sessions(names))
    save_map(
        map_of(database, names[0], frames),
        stem,
        mode="raw" if of == "raw" else "trinary",
        of=of or "everything",
        comment=f"pc2grid {__version__}, {' and '.join(planes)}:\n{SHOWN[of or 'everything']}",
    )


def _plane(info: SessionInfo, grid: OccupancyGrid) -> str:
    """Return at which heights the plan of a session is cut."""
    if is_map_file(Path(info.provenance.source)):
        return f"heights as in {one_line(info.provenance.source)}"
    if info.sensor == "laser":
        above = "" if grid.height_m is None else f", {grid.height_m:.2f} m above the base"
        return f"cut in the plane of a laser{above}"
    band = info.provenance.config.projection
    return f"cut from {band.band_min_m:g} to {band.band_max_m:g} m above the floor"


def _in_building(poses: Trajectory, frame: BuildingFrame | None) -> Trajectory:
    """Return poses of a session in the frame of its building; without one, as they are."""
    if frame is None:
        return poses
    T = np.array([at.lift() for at in frame.around(poses.planar()[:, :2])])
    return replace(poses, T_session_base=T @ poses.T_session_base)


def _write_cloud(
    path: Path,
    database: SubmapDatabase,
    sessions: Sequence[str],
    frames: BuildingFrames,
    terminal: console.Console,
) -> None:
    """Write the points in space of the sessions that have them; of none, a point for each occupied cell."""
    clouds, walls, voxel_m = [np.empty((0, 3))], [np.empty((0, 3))], 0.0
    for name in sessions:
        placed = frames[name].apply if name in frames else np.asarray
        points, grid = database.points(name), database.grid(name)
        if points is not None:
            voxel_m = max(voxel_m, points.voxel_m)
            clouds.append(placed(points.points_m()))
        walls.append(placed(_lift(grid.to_point(np.argwhere(grid.occupied)))))
    cloud, wall = np.concatenate(clouds), np.concatenate(walls)
    write_cloud(path, cloud if len(cloud) else wall)
    if len(cloud):
        terminal.note(f"{path}: {len(cloud)} points, one a voxel of {voxel_m:g} m")
    else:
        terminal.note(f"{path}: {len(wall)} occupied cells at z = 0; the database keeps no 3D points")


# Okabe and Ito's green, grey and purple.
_GREEN, _GREY, _PURPLE = (0.0, 0.62, 0.45, 1.0), (0.4, 0.4, 0.4, 0.6), (0.8, 0.47, 0.65, 1.0)


def _write_mcap(path: Path, database: SubmapDatabase, session: str, given: options.Export) -> None:
    """Write a session's map, path and submaps, and the poses of its robot over time."""
    poses = database.trajectory(session)
    with LogWriter.to(path, overwrite=given.force) as writer:
        first_ns = int(poses.stamps_ns[0]) if len(poses) else 0
        _write_map_message(writer, database, session, first_ns, given.map_of or "everything")
        if len(poses):
            writer.path("/path", poses)
        for stamp_ns, T_session_base in zip(poses.stamps_ns, poses.T_session_base, strict=True):
            writer.tf(int(stamp_ns), "map", "base_link", T_session_base)


def write_answer(
    path: Path, database: SubmapDatabase, answer: Found, located: Trajectory, force: bool
) -> None:
    """Write what was located in the map: a recording, whose poses there are `located`; or another map, with
    map -> query_map between them."""
    assert answer.session is not None and answer.covariance is not None
    assert answer.T_map_base is not None and answer.T_map_odom is not None
    first, last = (int(located.stamps_ns[k]) for k in (0, -1)) if len(located) else (0, 0)
    with LogWriter.to(path, overwrite=force) as writer:
        _write_map_message(writer, database, answer.session, first)
        T_map_odom, T_odom_map = answer.T_map_odom.lift(), answer.T_map_odom.inverse().lift()
        if answer.drawn is not None:
            writer.write("/query_map", 0, export.occupancy_grid(0, answer.drawn, "query_map"))
            writer.tf_static(0, "map", "query_map", T_map_odom)
            writer.markers("/hypotheses", 0, [_hypotheses(answer)])
            writer.write("/pose", 0, export.pose_with_covariance(0, answer.T_map_odom, answer.covariance))
            return
        way = database.trajectory(answer.session)
        if len(way):
            writer.path("/path", way, stamp_ns=first)
        writer.path("/query_path", located, stamp_ns=first)
        for stamp_ns, T_map_base in zip(located.stamps_ns, located.T_session_base, strict=True):
            # Each time anew: tf2 does not extrapolate from one transform on /tf.
            writer.tf(int(stamp_ns), "map", "odom", T_map_odom)
            writer.tf(int(stamp_ns), "odom", "base_link", T_odom_map @ T_map_base)
        writer.markers("/hypotheses", last, [_hypotheses(answer)])
        pose = last, answer.T_map_base, answer.covariance
        writer.write("/pose", last, export.pose_with_covariance(*pose))
        writer.write("/initialpose", last, export.initialpose(*pose))


def _write_map_message(
    writer: LogWriter, database: SubmapDatabase, session: str, stamp_ns: int, of: MapOf = "everything"
) -> None:
    """Write the map of a session, its points and its submaps. of : what the map shows."""
    writer.write("/map", stamp_ns, export.occupancy_grid(stamp_ns, database.grid(session), of=of))
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
    """Return markers of the hypotheses, the best first."""
    poses = [hypothesis.T_map_query @ answer.T_odom_base for hypothesis in answer.hypotheses]
    same = [answer.sessions[h.session_index] == answer.session for h in answer.hypotheses]
    points = [(pose.x, pose.y) for pose, here in zip(poses, same, strict=True) if here]
    return Marker(name="hypotheses", kind="spheres", points_m=_lift(points), size_m=0.4, color=_PURPLE)


def _lift(points_m: F64 | list[tuple[float, float]]) -> F64:
    """Return points (N, 2) as (N, 3) at z = 0."""
    return np.pad(np.asarray(points_m, np.float64).reshape(-1, 2), ((0, 0), (0, 1)))
