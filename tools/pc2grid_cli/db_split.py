"""`pc2grid db split`: some sessions of a database become one of their own."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli.db import written
from pc2grid_cli.options import AsJson, Database, Force, WrittenDatabase
from pc2grid_cli.plural import counted
from signature.database.maintenance import shown, split


def db_split_command(
    database: Database,
    sessions: Annotated[list[str], typer.Argument(metavar="SESSION...", help="which to copy")],
    output: WrittenDatabase,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Copy sessions of a database into a new one; the first stays as it is.

    Example: pc2grid db split building.submaps monday -o monday.submaps
    """
    count = split(database, sessions, output, force=force)
    if json:
        console.print_json(written(output))
    else:
        print(f"{shown(output)}: {counted(count, 'session')}")
