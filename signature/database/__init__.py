"""The submap database: sessions, their grids and submaps, and the signatures to search in.

`open_database` and `create_database` return a `SubmapDatabase`: one SQLite file for a path, a PostgreSQL
database for a postgresql:// URL.
"""

from __future__ import annotations

from pc2grid.errors import OutputError
from signature.database.database import SubmapDatabase
from signature.database.postgres import PostgresRows, is_url, location
from signature.database.protocol import Label, Location, Problem, Provenance, SessionInfo
from signature.database.rows import Rows
from signature.database.sqlite import SqliteRows

__all__ = [
    "Label",
    "Problem",
    "Provenance",
    "SessionInfo",
    "SubmapDatabase",
    "create_database",
    "open_database",
]


def open_database(path_or_url: Location, *, writable: bool = False) -> SubmapDatabase:
    """Open an existing database; only with `writable` can it be changed, and only by `add`.

    Raises NotADatabase, DatabaseCorrupt, DatabaseVersion, DatabaseUnreachable for a server that does not
    answer or refuses the connection, or DatabaseError for a URL of an engine that this version does not know.

    >>> with open_database("building.submaps") as database:
    ...     session = database.sessions()[0].name
    ...     session, database.grid(session).resolution_m, len(database.signatures()) > 10
    ('monday', 0.05, True)
    """
    return SubmapDatabase(engine_of(path_or_url).open(path_or_url), writable=writable)


def create_database(path_or_url: Location, *, overwrite: bool = False) -> SubmapDatabase:
    """Make an empty database and open it for writing; an existing one is replaced only with `overwrite`.

    Raises OutputError if the file is there already or cannot be written, DatabaseBusy if another
    process is writing it.

    >>> with create_database("empty.submaps") as database:
    ...     database.sessions()
    ()
    """
    refuse_existing(path_or_url, overwrite)
    engine_of(path_or_url).change(path_or_url, lambda rows: None, keep=False, create=True)
    return open_database(path_or_url, writable=True)


def refuse_existing(place: Location, overwrite: bool) -> None:
    """Raise OutputError if there is something already, and `overwrite` is not set."""
    if not overwrite and engine_of(place).exists(place):
        where = location(str(place)) if is_url(place) else str(place)
        raise OutputError(f"{where}: exists already", hint="--force replaces it")


def engine_of(place: Location) -> type[Rows]:
    """Return the engine of a path or URL."""
    return PostgresRows if is_url(place) else SqliteRows
