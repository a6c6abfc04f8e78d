"""The submap database: sessions, their grids and submaps, and the signatures to search in.

`open_database` and `create_database` hand out something with the protocol `SubmapDatabase`; the only
engine so far is one SQLite file.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.errors import DatabaseError
from signature.database.protocol import Problem, Provenance, SessionInfo, SubmapDatabase

if TYPE_CHECKING:
    from signature.database.sqlite import SqliteDatabase

__all__ = [
    "Problem",
    "Provenance",
    "SessionInfo",
    "SubmapDatabase",
    "create_database",
    "open_database",
]


def open_database(path_or_url: str | Path, *, writable: bool = False) -> SqliteDatabase:
    """Open an existing database; without `writable` nothing can change it, and no query does.

    Raises NotADatabase, DatabaseCorrupt, DatabaseVersion, or DatabaseError for a URL of an engine that
    this version does not know.
    """
    from signature.database.sqlite import SqliteDatabase

    return SqliteDatabase(_local(path_or_url), writable=writable)


def create_database(path_or_url: str | Path, *, force: bool = False) -> SqliteDatabase:
    """Make an empty database and open it for writing; an existing one is replaced only with `force`.

    Raises OutputError if the file is there already or cannot be written, DatabaseBusy if another
    process is writing it.
    """
    from signature.database.sqlite import SqliteDatabase

    return SqliteDatabase.create(_local(path_or_url), force=force)


def _local(path_or_url: str | Path) -> Path:
    """A path, or the complaint that the engine of a URL is not there."""
    scheme, separator, _ = str(path_or_url).partition("://")
    if isinstance(path_or_url, str) and separator:
        raise DatabaseError(
            f"{scheme}:// databases are not supported by this version",
            hint="give the path of a .submaps file",
        )
    return Path(path_or_url)
