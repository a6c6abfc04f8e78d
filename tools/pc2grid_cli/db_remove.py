"""`pc2grid db remove`: a database without some of its sessions."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli.db import written
from pc2grid_cli.options import AsJson, Database
from pc2grid_cli.plural import counted


def db_remove_command(
    database: Database,
    sessions: Annotated[list[str], typer.Argument(metavar="SESSION...", help="which to remove")],
    json: AsJson = False,
) -> None:
    """Remove sessions from a database, all or none; they cannot be brought back.

    Example: pc2grid db remove building.submaps monday
    """
    from signature.database.maintenance import remove

    remove(database, sessions)
    document = written(database)
    if json:
        console.print_json(document)
    else:
        print(f"{document['database']}: {counted(document['sessions'], 'session')} left")
