"""`pc2grid db merge`: several databases become one."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli.db import written
from pc2grid_cli.options import DATABASE, AsJson, Force, WrittenDatabase
from pc2grid_cli.plural import counted
from signature.database.maintenance import merge, shown


def db_merge_command(
    databases: Annotated[list[str], typer.Argument(metavar=f"{DATABASE} ...", help="what to merge")],
    output: WrittenDatabase,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Put the sessions of several databases into a new one.

    Example: pc2grid db merge monday.submaps tuesday.submaps -o week.submaps
    """
    count = merge(databases, output, force=force)
    if json:
        console.print_json(written(output))
    else:
        print(f"{shown(output)}: {counted(count, 'session')}")
