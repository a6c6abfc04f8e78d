"""What the commands of `pc2grid db` share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from signature.database import open_database

if TYPE_CHECKING:
    from pc2grid_cli.json_schemas import Damage, DbWrite
    from signature.database import Problem


def damage(problem: Problem) -> Damage:
    """One thing that is wrong, for a JSON document."""
    return {"where": problem.where, "what": problem.what}


def written(output: str, left_out: Sequence[Problem] = ()) -> DbWrite:
    """The document about a database that was written."""
    with open_database(output) as opened:
        number, where = len(opened.sessions()), opened.location
    return {
        "schema_version": 1,
        "database": where,
        "sessions": number,
        "left_out": [damage(problem) for problem in left_out],
    }
