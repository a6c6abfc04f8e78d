"""A database on a PostgreSQL server: one for a whole fleet, with many writers at once.

Everything is in a schema of its own, `pc2grid`, so the database may hold other tables, too.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from pc2grid.errors import (
    DatabaseBusy,
    DatabaseCorrupt,
    DatabaseError,
    DatabaseUnreachable,
    NotADatabase,
    OutputError,
    Pc2GridError,
)
from pc2grid.libraries import require
from signature.database.database import SubmapDatabase, definitions
from signature.database.protocol import (
    APPLICATION_ID,
    BUSY_TIMEOUT_S,
    CONNECT_TIMEOUT_S,
    FORMAT,
    Location,
    Problem,
    SessionInfo,
    no_utf8,
    refuse_other_format,
)

if TYPE_CHECKING:
    from psycopg import Connection, Error
    from typing_extensions import Self


class PostgresDatabase(SubmapDatabase):
    """A schema `pc2grid` on a PostgreSQL server; read in one snapshot."""

    @classmethod
    def open(cls, place: Location, *, damaged: bool = False) -> Self:
        """Open the database for reading, see `SubmapDatabase.open`."""
        with contextlib.ExitStack() as undo:
            database = cls(*connect(str(place)), damaged=damaged)
            undo.callback(database.close)
            inspect(database.connection, database.location)
            database.connection.set_autocommit(False)
            database.connection.set_isolation_level(driver().IsolationLevel.REPEATABLE_READ)
            database.connection.set_read_only(True)
            database.execute("SELECT 1 FROM about")  # takes the snapshot
            undo.pop_all()
        return database

    @classmethod
    def change(
        cls,
        place: Location,
        action: Callable[[SubmapDatabase], None],
        *,
        keep: bool = True,
        create: bool = False,
    ) -> None:
        """Change the rows, see `SubmapDatabase.change`.

        Any number of processes may write at once; they wait for each other only if they store sessions of one
        name, or while the database is empty.
        """
        errors = driver().errors
        with cls(*connect(str(place))) as database:
            database.for_update = " FOR UPDATE"
            if create:
                initialise(database.connection, database.location)
            inspect(database.connection, database.location)
            while True:
                try:
                    with served(database.location), database.connection.transaction():
                        if not keep:
                            database.execute("SELECT 1 FROM about FOR UPDATE")
                            database.execute("DELETE FROM part")
                            database.execute("DELETE FROM session")
                        action(database)
                    return
                except DatabaseError as error:
                    # Another writer has just stored a session of that name: compare with it.
                    if not isinstance(error.__cause__, errors.UniqueViolation | errors.DeadlockDetected):
                        raise

    @classmethod
    def exists(cls, place: Location) -> bool:
        """Return True if the database holds sessions. Raises DatabaseUnreachable if the server does not
        answer."""
        with cls(*connect(str(place))) as database:
            try:
                inspect(database.connection, database.location)
            except NotADatabase:
                return False
            return next(database._select("SELECT 1 FROM session LIMIT 1"), None) is not None

    def _select(self, statement: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query. Raises the errors of `served`."""
        with served(self.location), self.connection.cursor(binary=True) as cursor:
            found = cursor.execute(statement.replace("?", "%s"), values).fetchall()
        yield from found

    def execute(self, statement: str, *values: Any) -> None:
        """Change rows. Raises the errors of `served`."""
        with served(self.location):
            self.connection.execute(statement.replace("?", "%s"), values)

    def new_id(self) -> int:
        """Return a number for a further session."""
        ((number,),) = self._select("SELECT nextval('session_id')")
        return int(number)

    def other(self, info: SessionInfo) -> SessionInfo | None:
        """Return any session of another name, locked against removal until this transaction ends.

        None: there is no other, and no writer can add one until then.
        """
        with self.connection.transaction() as attempt:
            # A shared lock: writers do not wait for each other once there is a session to compare with.
            self.execute("SELECT 1 FROM about FOR SHARE")
            found = super().other(info)
            if found is not None:
                return found
            attempt.force_rollback = True  # two holders could not both make the lock exclusive
        self.execute("SELECT 1 FROM about FOR UPDATE")
        return super().other(info)

    def _orphans(self) -> Iterator[Problem]:
        """Yield nothing: a foreign key excludes orphaned parts."""
        return iter(())


TABLES = definitions(
    "bytea",
    "id bigint NOT NULL",
    session_key=", PRIMARY KEY (building, id)",
    part_key=", FOREIGN KEY (building, session_id) REFERENCES session (building, id)",
)
"""The statement that creates each table: table -> SQL. The keys begin with the building, so that a cluster
can keep a whole building on one node (examples/buildings.md)."""
CONVERT = "make one with `pc2grid convert LOG -o URL`"
EXAMPLE = "postgresql://user@host:5432/database, the password in PGPASSWORD or ~/.pgpass"


def is_url(path_or_url: object) -> bool:
    """Return True if this names a PostgreSQL database and not a file."""
    return isinstance(path_or_url, str) and path_or_url.startswith(("postgresql://", "postgres://"))


def location(url: str) -> str:
    """Return the URL without password and options, which may be shown and logged.

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
        raise no_utf8(where) from None


def connect(url: str) -> tuple[str, Connection[Any]]:
    """Return the `location` of a URL, and a connection to it in autocommit mode.

    Raises DatabaseUnreachable or NotADatabase.
    """
    psycopg, where = driver(), location(url)
    parts = psycopg.conninfo.conninfo_to_dict(url)
    defaults = {"connect_timeout": round(CONNECT_TIMEOUT_S), "application_name": "pc2grid"}
    try:
        connection: Connection[Any] = psycopg.connect(
            url, autocommit=True, **{k: v for k, v in defaults.items() if k not in parts}
        )
    except psycopg.Error as error:
        raise _refused(error, where, parts) from None
    with served(where):
        connection.execute(f"SET lock_timeout = '{BUSY_TIMEOUT_S:.0f}s'")
        connection.execute("SET search_path = pc2grid")
    return where, connection


def inspect(connection: Connection[Any], where: str) -> None:
    """Check that this is a submap database of this format. Raises NotADatabase, DatabaseVersion,
    DatabaseCorrupt."""
    with served(where):
        if not _exists(connection):
            raise NotADatabase(f"{where}: holds no submap database yet", hint=CONVERT)
        found = connection.execute("SELECT format FROM pc2grid.about").fetchall()
        if len(found) != 1:
            raise DatabaseCorrupt(f"{where}: damaged: pc2grid.about has {len(found)} rows instead of one")
        refuse_other_format(where, int(found[0][0]))


def initialise(connection: Connection[Any], where: str) -> None:
    """Make the tables unless they are there."""
    with served(where), connection.transaction():
        # Without this lock, two processes at once would both find no tables and both create them.
        connection.execute("SELECT pg_advisory_xact_lock(%s)", [APPLICATION_ID])
        if _exists(connection):
            return
        connection.execute("CREATE SCHEMA pc2grid")
        connection.execute(
            "CREATE TABLE pc2grid.about"
            " (one boolean PRIMARY KEY DEFAULT true CHECK (one), format integer NOT NULL)"
        )
        connection.execute("INSERT INTO pc2grid.about (format) VALUES (%s)", [FORMAT])
        connection.execute("CREATE SEQUENCE pc2grid.session_id")
        for statement in TABLES.values():
            connection.execute(statement)


def _exists(connection: Connection[Any]) -> bool:
    row = connection.execute("SELECT to_regclass('pc2grid.about') IS NOT NULL").fetchone()
    return bool(row and row[0])


def driver() -> Any:
    """Import the module psycopg. Raises DatabaseError with the package to install if it is missing."""
    require({"postgres": "postgresql://"})
    import psycopg
    import psycopg.conninfo

    return psycopg


def _refused(error: Error, where: str, parts: dict[str, Any]) -> Pc2GridError:
    """Return the error for a connection that failed. libpq gives no error codes for this, only text."""
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
