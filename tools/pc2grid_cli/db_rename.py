"""`pc2grid db rename`: another name for a session."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid.errors import one_line
from pc2grid_cli import console
from pc2grid_cli.db import written
from pc2grid_cli.options import AsJson, Database
from signature.database.maintenance import rename, shown


def db_rename_command(
    database: Database,
    old: Annotated[str, typer.Argument(metavar="OLD", help="the session")],
    new: Annotated[str, typer.Argument(metavar="NEW", help="its new name")],
    json: AsJson = False,
) -> None:
    """Give a session another name, for example before databases with equal names are merged.

    Example: pc2grid db rename building.submaps monday first-floor
    """
    rename(database, old, new)
    if json:
        console.print_json(written(database))
    else:
        print(one_line(f"{shown(database)}: {old} is now {new}"))
