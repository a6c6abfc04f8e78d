"""The database on a PostgreSQL server: its tables, the connection to it, and the meaning of its errors.

Everything is in a schema of its own, `pc2grid`, so the database may hold other things too. The key of every
table begins with the building, so that a cluster can keep a whole building on one node (examples/fleet.md).
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from pc2grid import extras
from pc2grid.errors import (
    DatabaseBusy,
    DatabaseCorrupt,
    DatabaseError,
    DatabaseUnreachable,
    DatabaseVersion,
    NotADatabase,
    OutputError,
    Pc2GridError,
)
from signature.database.migrations import FORMAT, tables_of
from signature.database.protocol import APPLICATION_ID, BUSY_TIMEOUT_S

if TYPE_CHECKING:
    from psycopg import Connection, Error

PGVECTOR = (0, 8)
"""The first version that continues its search when a filter leaves too few rows (hnsw.iterative_scan)."""
SHORTLIST = 400
"""Candidates from the index that Eq. 6 ranks: recall@20 above 0.99 of 100,000 submaps (examples/fleet.md)."""
CONVERT = "make one with `pc2grid convert LOG -o URL`"
EXAMPLE = "postgresql://user@host:5432/database, the password in PGPASSWORD or ~/.pgpass"
_CONNECT_TIMEOUT_S = 10
"""Chosen by hand."""

# Every row ends with the crc32 of its other columns, as in a file. Units are in the names.
_GRID = (
    "height integer NOT NULL, width integer NOT NULL, resolution_m float8 NOT NULL,"
    " origin_x_m float8 NOT NULL, origin_y_m float8 NOT NULL, cells bytea NOT NULL"
)
_OF_SESSION = "building text NOT NULL, session_id bigint NOT NULL"
_REFERENCES = "FOREIGN KEY (building, session_id) REFERENCES pc2grid.session ON DELETE CASCADE"
TABLES = {
    "session": "building text NOT NULL, id bigint NOT NULL, floor text NOT NULL, name text NOT NULL UNIQUE,"
    " sensor text NOT NULL, document text NOT NULL, crc32 bigint NOT NULL, PRIMARY KEY (building, id)",
    "grid": f"{_OF_SESSION}, {_GRID}, crc32 bigint NOT NULL,"
    f" PRIMARY KEY (building, session_id), {_REFERENCES}",
    "trajectory": f"{_OF_SESSION}, count integer NOT NULL, stamps_ns bytea NOT NULL, poses bytea NOT NULL,"
    f" health bytea NOT NULL, crc32 bigint NOT NULL, PRIMARY KEY (building, session_id), {_REFERENCES}",
    "loop": f"{_OF_SESSION}, count integer NOT NULL, pairs bytea NOT NULL, measured bytea NOT NULL,"
    f" information bytea NOT NULL, accepted bytea NOT NULL, crc32 bigint NOT NULL,"
    f" PRIMARY KEY (building, session_id), {_REFERENCES}",
    "graph": f"{_OF_SESSION}, nodes integer NOT NULL, edges integer NOT NULL, points integer NOT NULL,"
    " center_m bytea NOT NULL, kind bytea NOT NULL, pixels bytea NOT NULL, ends bytea NOT NULL,"
    " length_m bytea NOT NULL, path_start bytea NOT NULL, path_m bytea NOT NULL, crc32 bigint NOT NULL,"
    f" PRIMARY KEY (building, session_id), {_REFERENCES}",
    "points": f"{_OF_SESSION}, count integer NOT NULL, voxel_m float8 NOT NULL, origin_x_m float8 NOT NULL,"
    " origin_y_m float8 NOT NULL, origin_z_m float8 NOT NULL, voxels bytea NOT NULL, within bytea NOT NULL,"
    f" crc32 bigint NOT NULL, PRIMARY KEY (building, session_id), {_REFERENCES}",
    "isovist": f"{_OF_SESSION}, count integer NOT NULL, bearings integer NOT NULL, columns integer NOT NULL,"
    " sight_m float8 NOT NULL, ranges bytea NOT NULL, seen bytea NOT NULL, crc32 bigint NOT NULL,"
    f" PRIMARY KEY (building, session_id), {_REFERENCES}",
    "submap": f"{_OF_SESSION}, submap_id integer NOT NULL, center_x_m float8 NOT NULL, center_y_m float8 NOT"
    f" NULL, radius_m float8 NOT NULL, {_GRID}, crc32 bigint NOT NULL,"
    f" PRIMARY KEY (building, session_id, submap_id), {_REFERENCES}",
    # Apart from the submaps: a search reads hundreds of signatures and no cells. The floor of the session is
    # repeated because a search filters by it. `embedding` is under no checksum: the histograms determine it.
    "signature": f"{_OF_SESSION}, submap_id integer NOT NULL, floor text NOT NULL,"
    " center_x_m float8 NOT NULL, center_y_m float8 NOT NULL,"
    " boundary bytea NOT NULL, freespace bytea NOT NULL, symmetry bytea NOT NULL,"
    " crc32 bigint NOT NULL, embedding halfvec NOT NULL,"
    f" PRIMARY KEY (building, session_id, submap_id), {_REFERENCES}",
}
_NO_COLUMNS = ("crc32", "embedding", "PRIMARY", "FOREIGN")
TYPES = {
    name: {
        words[0]: words[1]
        for words in (column.split() for column in re.sub(r"\([^)]*\)", "", columns).split(", "))
        if words[0] not in _NO_COLUMNS
    }
    for name, columns in TABLES.items()
}
"""What the checksum covers, with the types: table -> column -> type."""


def is_url(path_or_url: object) -> bool:
    """Whether this names a PostgreSQL database and not a file."""
    return isinstance(path_or_url, str) and path_or_url.startswith(("postgresql://", "postgres://"))


def location(url: str) -> str:
    """The URL without password and options, which may be shown and logged.

    Raises DatabaseError for a URL that PostgreSQL does not accept, without quoting it.
    """
    psycopg = driver()
    rest = url.partition("://")[2]
    authority = re.split("[/?#]", rest, maxsplit=1)[0]
    # After an unescaped @ or / in a password, its rest would be taken for the host name, and shown.
    if authority.count("@") > 1 or rest.count("@") > authority.count("@"):
        raise DatabaseError(
            "not a PostgreSQL URL: an @ where none can be",
            hint="in user and password write %40 for @, %3A for :, %2F for /, %3F for ?, %23 for #",
        )
    try:
        parts = psycopg.conninfo.conninfo_to_dict(url)
    except psycopg.Error:
        raise DatabaseError("not a PostgreSQL URL", hint=f"it looks like {EXAMPLE}") from None
    user, host = (str(parts.get(name, "")) for name in ("user", "host"))
    name = f"{quote(user)}@" if user else ""
    port = f":{parts['port']}" if parts.get("port") else ""
    database = f"/{quote(str(parts.get('dbname', '')))}"
    if host.startswith("/"):
        return f"postgresql://{name}{port}{database}?host={host}"
    return f"postgresql://{name}{host}{port}{database}"


@contextlib.contextmanager
def served(where: str) -> Iterator[None]:
    """Turn the errors of the driver and the server into errors of this package, for the database `where`."""
    psycopg = driver()
    try:
        yield
    except psycopg.Error as error:
        raise _translated(error, where) from error
    except UnicodeEncodeError:
        raise DatabaseError(
            f"{where}: holds UTF-8 only, and a name is none", hint="rename the recording, or use --name"
        ) from None


def connect(url: str, where: str) -> Connection[Any]:
    """A connection in autocommit mode. Raises DatabaseUnreachable or NotADatabase."""
    psycopg = driver()
    parts = psycopg.conninfo.conninfo_to_dict(url)
    defaults = {"connect_timeout": _CONNECT_TIMEOUT_S, "application_name": "pc2grid"}
    try:
        connection: Connection[Any] = psycopg.connect(
            url, autocommit=True, **{k: v for k, v in defaults.items() if k not in parts}
        )
    except psycopg.Error as error:
        raise _refused(error, where, parts) from None
    with served(where):
        connection.execute(f"SET lock_timeout = '{BUSY_TIMEOUT_S:.0f}s'")
    return connection


def tables(version: int = FORMAT) -> tuple[str, ...]:
    """Names of the tables of a format."""
    return tuple(tables_of(version, TABLES))


def inspect(connection: Connection[Any], where: str) -> int:
    """Check that this is a submap database, register its vector type with the connection, return its format.

    Raises NotADatabase, DatabaseVersion, DatabaseError without pgvector, DatabaseCorrupt.
    """
    from pgvector.psycopg import register_vector

    with served(where):
        if not _exists(connection):
            raise NotADatabase(f"{where}: holds no submap database yet", hint=CONVERT)
        found = connection.execute("SELECT format FROM pc2grid.about").fetchall()
        if len(found) != 1:
            raise DatabaseCorrupt(f"{where}: damaged: pc2grid.about has {len(found)} rows instead of one")
        version = int(found[0][0])
        if version > FORMAT:
            raise DatabaseVersion(
                f"{where}: database format {version}; this pc2grid reads up to {FORMAT}",
                hint="use a newer pc2grid",
            )
        if version < 1:
            raise DatabaseCorrupt(f"{where}: damaged: database format {version} never existed")
        extension = connection.execute(
            "SELECT n.nspname, e.extversion FROM pg_extension e JOIN pg_namespace n ON n.oid = e.extnamespace"
            " WHERE e.extname = 'vector'"
        ).fetchone()
        if extension is None:
            raise _no_pgvector(where)
        namespace, installed = extension
        if tuple(int(part) for part in re.findall(r"\d+", installed)[:2]) < PGVECTOR:
            needed = ".".join(map(str, PGVECTOR))
            raise DatabaseError(
                f"{where}: the server has pgvector {installed}; needed is {needed} or newer",
                hint="install it on the server, then `ALTER EXTENSION vector UPDATE` in the database",
            )
        connection.execute("SELECT set_config('search_path', %s, false)", [f"pc2grid, {namespace}"])
        register_vector(connection)
        # The settings exist only once the library is loaded, which this query does.
        connection.execute("SELECT '[1]'::halfvec <#> '[1]'")
        connection.execute(f"SET hnsw.ef_search = {SHORTLIST}")
        connection.execute("SET hnsw.iterative_scan = strict_order")
    return version


def initialise(connection: Connection[Any], where: str) -> None:
    """Make the tables unless they are there. Raises DatabaseError if the server has no pgvector."""
    psycopg = driver()
    with served(where), connection.transaction():
        # Without this lock, two processes at once would both find no tables and both create them.
        connection.execute("SELECT pg_advisory_xact_lock(%s)", [APPLICATION_ID])
        if _exists(connection):
            return
        try:
            with connection.transaction():
                connection.execute("CREATE EXTENSION IF NOT EXISTS vector")
        except (psycopg.errors.FeatureNotSupported, psycopg.errors.UndefinedFile):
            raise _no_pgvector(where) from None
        except psycopg.errors.InsufficientPrivilege:
            raise DatabaseError(
                f"{where}: pgvector is not enabled in this database",
                hint="let an administrator run `CREATE EXTENSION vector` in it",
            ) from None
        connection.execute("CREATE SCHEMA pc2grid")
        connection.execute(
            "CREATE TABLE pc2grid.about"
            " (one boolean PRIMARY KEY DEFAULT true CHECK (one), format integer NOT NULL)"
        )
        connection.execute("INSERT INTO pc2grid.about (format) VALUES (%s)", [FORMAT])
        connection.execute("CREATE SEQUENCE pc2grid.session_id")
        for table, columns in TABLES.items():
            connection.execute(f"CREATE TABLE pc2grid.{table} ({columns})")


def add_missing_tables(connection: Connection[Any]) -> list[str]:
    """Within a transaction: create the tables that a database of an older format lacks; returns their names.

    Readers that have the database open keep it as they opened it.
    """
    (version,) = connection.execute("SELECT format FROM pc2grid.about FOR UPDATE").fetchone() or (FORMAT,)
    missing = [table for table in tables() if table not in tables(version)]
    for table in missing:
        connection.execute(f"CREATE TABLE pc2grid.{table} ({TABLES[table]})")
    connection.execute("UPDATE pc2grid.about SET format = %s", [FORMAT])
    return missing


def index_embeddings(connection: Connection[Any], dimensions: int) -> None:
    """Make the index for vectors of this many dimensions, unless there is one."""
    row = connection.execute("SELECT pg_get_indexdef(to_regclass('pc2grid.signature_embedding'))").fetchone()
    if row and row[0]:
        if f"halfvec({dimensions})" in row[0]:
            return
        connection.execute("DROP INDEX pc2grid.signature_embedding")
    connection.execute(
        "CREATE INDEX signature_embedding ON pc2grid.signature"
        f" USING hnsw ((embedding::halfvec({dimensions})) halfvec_ip_ops)"
        # Rows of other dimensions that were just deleted are still indexed, which would fail.
        f" WHERE vector_dims(embedding) = {dimensions}"
    )


def _exists(connection: Connection[Any]) -> bool:
    row = connection.execute("SELECT to_regclass('pc2grid.about') IS NOT NULL").fetchone()
    return bool(row and row[0])


def driver() -> Any:
    """The module psycopg. Raises DatabaseError with what to install if it is missing."""
    extras.require({"postgres": "postgresql://"})
    import psycopg
    import psycopg.conninfo

    return psycopg


def _no_pgvector(where: str) -> DatabaseError:
    return DatabaseError(
        f"{where}: the server has no pgvector extension",
        hint="install pgvector on the server, then `CREATE EXTENSION vector` in the database",
    )


def _refused(error: Error, where: str, parts: dict[str, Any]) -> Pc2GridError:
    """Why the connection failed. libpq gives no error codes for this, only text."""
    text = str(error)
    said = text.rpartition("FATAL:")[2].strip().splitlines()[0] if "FATAL:" in text else ""
    if "password" in text:
        return DatabaseUnreachable(
            f"{where}: user or password is not accepted",
            hint="set PGUSER and PGPASSWORD, or write the password to ~/.pgpass",
        )
    if "database" in said and "does not exist" in said:
        name = parts.get("dbname", "")
        return NotADatabase(f"{where}: {said}", hint=f"make it with `createdb {name}` and convert into it")
    if said:
        return DatabaseUnreachable(f"{where}: the server refuses us: {said}")
    reason = (text.removeprefix("connection failed: ").splitlines() or ["no answer"])[0]
    return DatabaseUnreachable(f"{where}: {reason}", hint=f"is the server up, and the URL right? {EXAMPLE}")


def _translated(error: Error, where: str) -> Pc2GridError:
    psycopg = driver()
    errors = psycopg.errors
    said = (str(error).splitlines() or [type(error).__name__])[0]
    if isinstance(error, errors.InsufficientPrivilege):
        return DatabaseError(f"{where}: {said}", hint="ask an administrator for rights on schema pc2grid")
    if isinstance(error, errors.LockNotAvailable | errors.QueryCanceled | errors.DeadlockDetected):
        return DatabaseBusy(f"{where}: {said}", hint="try again when the other writers are done")
    if isinstance(error, errors.DiskFull | errors.ReadOnlySqlTransaction):
        return OutputError(f"{where}: cannot write: {said}")
    if isinstance(error, psycopg.OperationalError | errors.AdminShutdown):
        return DatabaseUnreachable(
            f"{where}: the server went away: {said}",
            hint="what was stored is whole; try again when the server is back",
        )
    if isinstance(error, errors.UndefinedTable | errors.UndefinedColumn | errors.DataCorrupted):
        return DatabaseCorrupt(f"{where}: its tables are not those of format {FORMAT}: {said}")
    return DatabaseError(f"{where}: {said}")
