"""`pc2grid export`: the sessions of a database in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid._version import __version__
from pc2grid.errors import ConfigError, DatabaseError, one_line
from pc2grid.io.export.cloud import write_cloud
from pc2grid.io.export.g2o import write_g2o
from pc2grid.io.export.graphml import write_graph
from pc2grid.io.nav2_map import is_map_file, save_map
from pc2grid.io.trajectory import write_trajectory
from pc2grid.model import THING, MapOf, OccupancyGrid
from pc2grid_cli import console, options
from pc2grid_cli.foxglove import write_session
from pc2grid_cli.output_files import check_file, written_files
from pc2grid_cli.session_documents import OfDatabase
from signature.localization.joining.building_map import floors_of, map_of
from signature.localization.shown.picture import draw_building, draw_session
from signature.localization.shown.report import write_report

if TYPE_CHECKING:
    from pc2grid.model import Trajectory
    from signature.database import SubmapDatabase
    from signature.database.protocol import BuildingFrame, SessionInfo


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
