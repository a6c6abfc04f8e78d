"""`pc2grid export`: what is in a database, in the formats of others."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli.settings import AsJson, Database, Force, Rerun

if TYPE_CHECKING:
    from pc2grid.model import Trajectory
    from signature.database import SubmapDatabase


class TrajectoryKind(str, enum.Enum):
    """Formats of trajectories."""

    tum = "tum"
    kitti = "kitti"


def export_command(
    database: Database,
    map_: Annotated[
        Path | None, typer.Option("--map", metavar="STEM", help="STEM.yaml and STEM.pgm for nav2")
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option("--trajectory", metavar="OUT.tum", help="poses of the base, for evo")
    ] = None,
    format_: Annotated[
        TrajectoryKind | None,
        typer.Option("--format", help="of the trajectory; default: kitti for OUT.kitti, else tum"),
    ] = None,
    cloud: Annotated[
        Path | None,
        typer.Option("--cloud", metavar="OUT.ply|.pcd", help="the map's walls as points at z = 0"),
    ] = None,
    graph: Annotated[
        Path | None,
        typer.Option("--graph", metavar="OUT.graphml|.json", help="junctions, ends, and the ways between"),
    ] = None,
    g2o: Annotated[
        Path | None, typer.Option("--g2o", metavar="OUT.g2o", help="the pose graph: steps and loops")
    ] = None,
    mcap: Annotated[
        Path | None, typer.Option("--mcap", metavar="OUT.mcap", help="map, path, submaps for Foxglove")
    ] = None,
    rerun: Rerun = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="OUT.png", help="a picture of the map")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="OUT.html", help="a page to look into the database")
    ] = None,
    session: Annotated[str | None, typer.Option("--session", help="which, if there are several")] = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Write a session's map, trajectory or picture, or a page that shows all sessions.

    Example: pc2grid export building.submaps --map building --trajectory building.tum
    """
    from pc2grid.errors import ConfigError, DatabaseError
    from pc2grid.io.atomic import refuse_existing
    from signature.database import open_database

    of_session = [path for path in (trajectory, cloud, graph, g2o, mcap, plot) if path is not None]
    if map_ is not None:
        of_session += [map_.with_name(map_.name + ".yaml"), map_.with_name(map_.name + ".pgm")]
    targets = of_session + ([report] if report is not None else [])
    if not targets and rerun is None:
        raise ConfigError(
            "nothing to export",
            hint="name one of --map, --trajectory, --cloud, --graph, --g2o, --mcap, --rerun, --plot,"
            " --report",
        )
    for path in targets:
        refuse_existing(path, force)
    if rerun is not None:
        from pc2grid_cli.rerun_target import require_target, url_of

        require_target(rerun, force)
    with open_database(database) as opened:
        where = opened.location
        names = [info.name for info in opened.sessions()]
        if (of_session or rerun) and session is None and len(names) != 1:
            there = ", ".join(names) or "none"
            raise DatabaseError(
                f"{where}: holds {len(names)} sessions: {there}", hint="choose one with --session"
            )
        name = session or (names[0] if names else "")
        # What the session cannot give is refused before anything is written.
        poses = _poses(opened, name) if trajectory or g2o else None
        if map_ is not None:
            from pc2grid.io.nav2_map import save_map

            save_map(opened.grid(name), map_)
        if trajectory is not None and poses is not None:
            from pc2grid.io.trajectory import write_trajectory

            write_trajectory(trajectory, poses, None if format_ is None else format_.value)
        if cloud is not None:
            _write_cloud(cloud, opened, name)
        if graph is not None:
            from pc2grid.io.graph_out import write_graph
            from pc2grid.partition import junction_graph

            write_graph(graph, junction_graph(opened.grid(name), opened.config().partition))
        if g2o is not None and poses is not None:
            from pc2grid.io.g2o_out import write_g2o

            write_g2o(g2o, poses, opened.loops(name))
        if mcap is not None:
            from pc2grid_cli.foxglove import write_session

            write_session(mcap, opened, name, force)
        if rerun is not None:
            from pc2grid_cli.rerun_stream import write_session as stream_session

            stream_session(rerun, opened, name)
            if url_of(rerun) is None:
                targets.append(Path(rerun))
        if plot is not None:
            from pc2grid_cli.picture import draw_session

            draw_session(plot, opened, name)
        if report is not None:
            from pc2grid_cli.report import write_report

            write_report(report, opened)
    for path in targets:
        console.note(f"wrote {path}")
    if json:
        console.print_json(
            {
                "schema_version": 1,
                "database": where,
                "session": name if of_session or rerun else None,
                "written": [str(path) for path in targets],
            }
        )


def _poses(database: SubmapDatabase, session: str) -> Trajectory:
    from pc2grid.errors import DatabaseError

    poses = database.trajectory(session)
    if not len(poses):
        raise DatabaseError(
            f"{database.location}: session {session!r} is an imported map and has no trajectory"
        )
    return poses


def _write_cloud(path: Path, database: SubmapDatabase, session: str) -> None:
    """A database keeps the map, not the recording's points: one point for each occupied cell."""
    import numpy as np

    from pc2grid.io.cloud_out import write_cloud

    grid = database.grid(session)
    walls = grid.to_point(np.argwhere(grid.occupied))
    write_cloud(path, np.column_stack((walls, np.zeros(len(walls)))))
    console.note(f"{path}: {len(walls)} occupied cells at z = 0; a database holds no 3D points")
