"""`pc2grid db`: look after databases."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pc2grid.errors import one_line
from pc2grid_cli import console
from pc2grid_cli.settings import DATABASE, AsJson, Database, Force, WrittenDatabase

if TYPE_CHECKING:
    from signature.database import Problem


def info_command(database: Database, json: AsJson = False) -> None:
    """Show the sessions of a database.

    Example: pc2grid db info building.submaps
    """
    from signature.database import open_database

    with open_database(database) as opened:
        sessions, where = opened.sessions(), opened.location
    if json:
        documents = [
            {
                "name": s.name,
                "sensor": s.sensor,
                "building": s.provenance.label.building,
                "floor": s.provenance.label.floor,
                "source": s.provenance.source,
                "digest": s.digest,
                "submaps": s.submaps,
                "resolution_m": s.resolution_m,
                "area_m2": s.area_m2,
                "path_m": s.path_m,
                "duration_s": s.duration_s,
                "scans": s.scans,
                "lossy": s.lossy,
                "warnings": list(s.warnings),
                "versions": dict(s.provenance.versions),
                "config": s.provenance.config.model_dump(mode="json"),
            }
            for s in sessions
        ]
        console.print_json({"schema_version": 1, "database": where, "sessions": documents})
        return
    print(f"{where}: {_count(len(sessions))}, {sum(s.submaps for s in sessions)} submaps")
    for s in sessions:
        travel = f", {s.scans} scans, {s.path_m:.1f} m in {s.duration_s:.0f} s" if s.scans else ""
        line = f"  {s.name} ({s.sensor}): {s.submaps} submaps, {s.area_m2:.0f} m2 free{travel}"
        print(one_line(line))


def check_command(database: Database, json: AsJson = False) -> None:
    """Read everything in a database and list all damage; exit code 1 if there is any.

    Example: pc2grid db check building.submaps
    """
    from signature.database.transfer import check, shown

    problems = check(database)
    if json:
        found = [{"where": p.where, "what": p.what} for p in problems]
        console.print_json({"schema_version": 1, "database": shown(database), "problems": found})
    elif not problems:
        print(f"{shown(database)}: sound")
    else:
        for problem in problems:
            print(one_line(f"{problem.where}: {problem.what}"))
    if problems:
        raise typer.Exit(console.FAILED)


def merge_command(
    databases: Annotated[list[str], typer.Argument(metavar=f"{DATABASE} ...", help="what to merge")],
    output: WrittenDatabase,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Put the sessions of several databases into a new one.

    Example: pc2grid db merge monday.submaps tuesday.submaps -o week.submaps
    """
    from signature.database.transfer import merge, shown

    count = merge(databases, output, force=force)
    if json:
        console.print_json(_written(output))
    else:
        print(f"{shown(output)}: {_count(count)}")


def copy_command(
    database: Database,
    output: WrittenDatabase,
    recover: Annotated[bool, typer.Option("--recover", help="leave damaged parts out; exit code 3")] = False,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Write a compact copy of a database.

    Example: pc2grid db copy --recover damaged.submaps -o good.submaps
    """
    from signature.database.transfer import copy, shown

    problems = copy(database, output, recover=recover, force=force)
    for problem in problems:
        console.warn(f"left out: {problem.where}: {problem.what}")
    if json:
        console.print_json(_written(output, problems))
    else:
        print(f"{shown(output)}: {_size(output)}")
    if problems:
        raise typer.Exit(console.LOSSY)


def _size(output: str) -> str:
    """How big the copy is: a file in bytes, anything else in sessions."""
    from signature.database import open_database

    path = Path(output)
    if path.is_file():
        return f"{path.stat().st_size / 1e6:.1f} MB"
    with open_database(output) as opened:
        return _count(len(opened.sessions()))


def _written(output: str, left_out: Sequence[Problem] = ()) -> dict[str, Any]:
    """What a command says of the database it made."""
    from signature.database import open_database

    with open_database(output) as opened:
        count, where = len(opened.sessions()), opened.location
    return {
        "schema_version": 1,
        "database": where,
        "sessions": count,
        "left_out": [{"where": problem.where, "what": problem.what} for problem in left_out],
    }


def _count(sessions: int) -> str:
    return f"{sessions} session{'' if sessions == 1 else 's'}"
