"""The submap database: sessions, their grids and submaps, and the signatures to search in.

`open_database` returns a `SubmapDatabase`: of one SQLite file for a path, of a PostgreSQL database for a
postgresql:// URL. `signature.add_session` stores in it.
"""

from __future__ import annotations

from signature.database.database import SubmapDatabase
from signature.database.postgres import PostgresDatabase, is_url
from signature.database.protocol import Label, Location, Problem, Provenance, SessionInfo
from signature.database.sqlite import SqliteDatabase

__all__ = [
    "Label",
    "Problem",
    "Provenance",
    "SessionInfo",
    "SubmapDatabase",
    "open_database",
]


def open_database(path_or_url: Location) -> SubmapDatabase:
    """Open an existing database for reading.

    Raises NotADatabase, DatabaseCorrupt, DatabaseVersion, DatabaseUnreachable for a server that does not
    answer or refuses the connection, or DatabaseError for a URL of an engine that this version does not know.

    >>> with open_database("building.submaps") as database:
    ...     session = database.sessions()[0].name
    ...     session, database.grid(session).resolution_m, len(database.signatures()) > 10
    ('monday', 0.05, True)
    """
    return engine_of(path_or_url).open(path_or_url)


def engine_of(place: Location) -> type[SubmapDatabase]:
    """Return the engine of a path or URL."""
    return PostgresDatabase if is_url(place) else SqliteDatabase
