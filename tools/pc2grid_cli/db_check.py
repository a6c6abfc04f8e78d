"""`pc2grid db check`: all damage in a database."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from pc2grid.errors import one_line
from pc2grid_cli import console
from pc2grid_cli.db import damage
from pc2grid_cli.options import AsJson, Database
from signature.database.maintenance import check, shown

if TYPE_CHECKING:
    from pc2grid_cli.json_schemas import DbCheck


def db_check_command(database: Database, json: AsJson = False) -> None:
    """Read everything in a database and list all damage; exit code 1 if there is any.

    Example: pc2grid db check building.submaps
    """
    problems = check(database)
    if json:
        document: DbCheck = {
            "schema_version": 1,
            "database": shown(database),
            "problems": [damage(problem) for problem in problems],
        }
        console.print_json(document)
    elif not problems:
        print(f"{shown(database)}: sound")
    else:
        for problem in problems:
            print(one_line(f"{problem.where}: {problem.what}"))
    if problems:
        raise typer.Exit(console.FAILED)
