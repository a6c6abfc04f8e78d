"""`pc2grid db copy`: a compact copy of a database, of a damaged one too."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli.db import written
from pc2grid_cli.options import AsJson, Database, Force, WrittenDatabase
from pc2grid_cli.plural import counted
from signature.database import open_database
from signature.database.maintenance import copy, shown


def db_copy_command(
    database: Database,
    output: WrittenDatabase,
    recover: Annotated[bool, typer.Option("--recover", help="leave damaged parts out; exit code 3")] = False,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Write a compact copy of a database.

    Example: pc2grid db copy --recover damaged.submaps -o good.submaps
    """
    problems = copy(database, output, recover=recover, force=force)
    for problem in problems:
        console.warn(f"left out: {problem.where}: {problem.what}")
    if json:
        console.print_json(written(output, problems))
    else:
        print(f"{shown(output)}: {_size(output)}")
    if problems:
        raise typer.Exit(console.LOSSY)


def _size(output: str) -> str:
    """The size of a copy: of a file in bytes, of anything else in sessions."""
    path = Path(output)
    if path.is_file():
        return f"{path.stat().st_size / 1e6:.1f} MB"
    with open_database(output) as opened:
        return counted(len(opened.sessions()), "session")
