"""`pc2grid export`: what is in a database, in the formats of others."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli.settings import Force

if TYPE_CHECKING:
    from signature.database import SubmapDatabase


def export_command(
    database: Annotated[Path, typer.Argument(metavar="BUILDING.submaps", help="the database")],
    map_: Annotated[
        Path | None, typer.Option("--map", metavar="STEM", help="STEM.yaml and STEM.pgm for nav2")
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option("--trajectory", metavar="OUT.tum", help="poses of the base, for evo")
    ] = None,
    mcap: Annotated[
        Path | None, typer.Option("--mcap", metavar="OUT.mcap", help="map and path for Foxglove")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="OUT.png", help="a picture of the map")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="OUT.html", help="a page to look into the database")
    ] = None,
    session: Annotated[str | None, typer.Option("--session", help="which, if there are several")] = None,
    force: Force = False,
) -> None:
    """Write a session's map, trajectory or picture, or a page that shows all sessions.

    Example: pc2grid export building.submaps --map building --trajectory building.tum
    """
    from pc2grid.errors import ConfigError, DatabaseError
    from pc2grid.io.atomic import refuse_existing
    from signature.database import open_database

    targets = [path for path in (trajectory, mcap, plot, report) if path is not None]
    if map_ is not None:
        targets += [map_.with_name(map_.name + ".yaml"), map_.with_name(map_.name + ".pgm")]
    if not targets:
        raise ConfigError(
            "nothing to export", hint="name at least one of --map, --trajectory, --mcap, --plot, --report"
        )
    for path in targets:
        refuse_existing(path, force)
    with open_database(database) as opened:
        names = [info.name for info in opened.sessions()]
        if targets != [report] and session is None and len(names) != 1:
            there = ", ".join(names) or "none"
            raise DatabaseError(
                f"{database}: holds {len(names)} sessions: {there}", hint="choose one with --session"
            )
        if report is not None:
            from pc2grid_cli.report import write_report

            write_report(report, opened)
        if targets != [report]:
            _export_session(opened, session or names[0], map_, trajectory, mcap, plot, force)
    for path in targets:
        console.note(f"wrote {path}")


def _export_session(
    database: SubmapDatabase,
    name: str,
    map_: Path | None,
    trajectory: Path | None,
    mcap: Path | None,
    plot: Path | None,
    force: bool,
) -> None:
    """One session in the formats of others."""
    from pc2grid.errors import DatabaseError

    grid, poses = database.grid(name), database.trajectory(name)
    if map_ is not None:
        from pc2grid.io.nav2_map import save_map

        save_map(grid, map_)
    if trajectory is not None:
        if not len(poses):
            raise DatabaseError(
                f"{database.location}: session {name!r} is an imported map and has no trajectory"
            )
        from pc2grid.io.trajectory import write_tum

        write_tum(trajectory, poses)
    if mcap is not None:
        from pc2grid.io.mcap_out import LogWriter

        with LogWriter(mcap, force=force) as writer:
            writer.occupancy_grid("/map", int(poses.stamps_ns[0]) if len(poses) else 0, grid)
            if len(poses):
                writer.path("/path", poses)
            for stamp_ns, T_map_base in zip(poses.stamps_ns, poses.T_map_base, strict=True):
                writer.tf(int(stamp_ns), "map", "base_link", T_map_base)
    if plot is not None:
        from pc2grid_cli.picture import draw_session

        draw_session(plot, database, name)
