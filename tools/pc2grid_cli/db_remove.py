"""`pc2grid db remove`: a database without some of its sessions."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid.errors import DatabaseError
from pc2grid_cli import console
from pc2grid_cli.db import written
from pc2grid_cli.options import AsJson, Database
from pc2grid_cli.plural import counted
from signature.database import open_database
from signature.database.maintenance import remove


def db_remove_command(
    database: Database,
    sessions: Annotated[list[str], typer.Argument(metavar="SESSION...", help="which to remove")],
    force: Annotated[bool, typer.Option("--force", help="also if no session is left")] = False,
    json: AsJson = False,
) -> None:
    """Remove sessions from a database, all or none; they cannot be brought back.

    Example: pc2grid db remove building.submaps monday
    """
    if not force:
        _refuse_all(database, sessions)
    remove(database, sessions)
    document = written(database)
    if json:
        console.print_json(document)
    else:
        print(f"{document['database']}: {counted(document['sessions'], 'session')} left")


def _refuse_all(database: str, sessions: list[str]) -> None:
    """Raises DatabaseError if no session of the database would be left."""
    with open_database(database) as opened:
        known = {info.name for info in opened.sessions()}
        if known and known <= set(sessions):
            raise DatabaseError(
                f"{opened.location}: no session would be left, and they cannot be brought back",
                hint="--force removes them all the same; `pc2grid db copy` keeps a copy",
            )
