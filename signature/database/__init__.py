"""The submap database: sessions, their grids and submaps, and the signatures to search in.

`open_database` and `create_database` return an object with the protocol `SubmapDatabase`: one SQLite file for
a path, a PostgreSQL database with pgvector for a postgresql:// URL.
"""

from __future__ import annotations

from pathlib import Path

from pc2grid.errors import DatabaseError
from signature.database.postgres.schema import is_url
from signature.database.protocol import Label, Neighbour, Problem, Provenance, SessionInfo, SubmapDatabase

__all__ = [
    "Label",
    "Neighbour",
    "Problem",
    "Provenance",
    "SessionInfo",
    "SubmapDatabase",
    "create_database",
    "open_database",
]


def open_database(path_or_url: str | Path, *, writable: bool = False) -> SubmapDatabase:
    """Open an existing database; only with `writable` can it be changed, and only by `add`.

    Raises NotADatabase, DatabaseCorrupt, DatabaseVersion, DatabaseUnreachable for a server that does not
    answer or refuses the connection, or DatabaseError for a URL of an engine that this version does not know.

    >>> with open_database("building.submaps") as database:
    ...     session = database.sessions()[0].name
    ...     session, database.grid(session).resolution_m, len(database.signatures()) > 10
    ('monday', 0.05, True)
    """
    if is_url(path_or_url):
        from signature.database.postgres.database import PostgresDatabase

        return PostgresDatabase(str(path_or_url), writable=writable)
    from signature.database.sqlite.database import SqliteDatabase

    return SqliteDatabase(_local(path_or_url), writable=writable)


def create_database(path_or_url: str | Path, *, force: bool = False) -> SubmapDatabase:
    """Make an empty database and open it for writing; an existing one is replaced only with `force`.

    Raises OutputError if the file is there already or cannot be written, DatabaseBusy if another
    process is writing it.

    >>> with create_database("empty.submaps") as database:
    ...     database.sessions()
    ()
    """
    if is_url(path_or_url):
        from signature.database.postgres.database import PostgresDatabase

        return PostgresDatabase.create(str(path_or_url), force=force)
    from signature.database.sqlite.database import SqliteDatabase

    return SqliteDatabase.create(_local(path_or_url), force=force)


def _local(path_or_url: str | Path) -> Path:
    """The path of a file. Raises DatabaseError for a URL of an unknown engine."""
    scheme, separator, _ = str(path_or_url).partition("://")
    if isinstance(path_or_url, str) and separator:
        raise DatabaseError(
            f"{scheme}:// databases are not supported by this version",
            hint="give the path of a .submaps file, or postgresql://user@host/database",
        )
    return Path(path_or_url)
