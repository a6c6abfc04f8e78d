"""`pc2grid db update`: one living map for each floor, made of its joined sessions."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid.errors import one_line
from pc2grid_cli import console
from pc2grid_cli.json_schemas import DbUpdate, plain
from pc2grid_cli.options import AsJson, Database
from pc2grid_cli.session_documents import living_as_text, living_document
from pc2grid_cli.tables import show
from signature import living
from signature.database import maintenance


def db_update_command(
    database: Database,
    undo: Annotated[
        bool, typer.Option("--undo", help="search all sessions again, and remove the living maps")
    ] = False,
    json: AsJson = False,
) -> None:
    """Keep one living map of each floor, made of its joined sessions, and search it instead of them.

    The newest session that is sure of a cell decides. The sessions retire: of each its map, its name and a
    pose a metre are kept, and --undo makes the rest of them anew; the poses of all scans, the loops and
    the 3D points are then only in the recording.

    Example: pc2grid db update building.submaps
    """
    back = living.undo(database) if undo else ()
    made = () if undo else living.update(database)
    if json:
        document: DbUpdate = {
            "schema_version": 1,
            "database": maintenance.shown(database),
            "living": list(map(living_document, made)),
            "back": list(back),
        }
        console.print_json(plain(DbUpdate, document))
    elif undo:
        show(one_line(f"searched again: {', '.join(back) or 'nothing had retired'}"))
    else:
        for one in made:
            show(living_as_text(one))
