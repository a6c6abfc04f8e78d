"""The submap database in PostgreSQL: one for a whole fleet, with many writers at once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from pc2grid.errors import DatabaseError, NotADatabase
from signature.database.database import SubmapDatabase
from signature.database.postgres import server
from signature.database.postgres.server import served
from signature.database.protocol import Label, Place, Problem, SessionInfo, none_there
from signature.database.rows import Rows, SessionRow

if TYPE_CHECKING:
    from psycopg import Connection
    from typing_extensions import Self

_ATTEMPTS = 5
"""How often a transaction is tried that conflicts with one of another writer; chosen by hand."""


class PostgresRows(Rows):
    """The rows of a database on a server."""

    for_update = " FOR UPDATE"

    def __init__(self, where: str, connection: Connection[Any]) -> None:
        super().__init__(where)
        self.connection = connection

    def select(self, statement: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """The rows of a query. Raises the errors of `served`."""
        with served(self.location), self.connection.cursor(binary=True) as cursor:
            found = cursor.execute(statement.replace("?", "%s"), values).fetchall()
        yield from found

    def execute(self, statement: str, *values: Any) -> None:
        """Change rows. Raises the errors of `served`."""
        with served(self.location):
            self.connection.execute(statement.replace("?", "%s"), values)

    def new_id(self) -> int:
        """A number for a further session."""
        ((number,),) = self.select("SELECT nextval('session_id')")
        return int(number)

    def other(self, info: SessionInfo) -> SessionInfo | None:
        """Any session of another name, locked against removal until this transaction ends.

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

    def orphans(self) -> Iterator[Problem]:
        """None: the server keeps no part without its session."""
        return iter(())


class PostgresDatabase(SubmapDatabase):
    """A schema `pc2grid` on a PostgreSQL server. See `SubmapDatabase` for what the methods promise.

    A handle sees the database as it was when it was opened: one snapshot, for which the server keeps deleted
    rows, so services should open a new handle now and then. `add` lets its own handle see the new state.
    """

    _building: str | None = None
    _floor: str | None = None

    @classmethod
    def open(cls, place: Place, *, writable: bool = False, damaged: bool = False) -> Self:
        """See `SubmapDatabase.open`. Raises DatabaseUnreachable, NotADatabase, DatabaseVersion."""
        psycopg = server.driver()
        with contextlib.ExitStack() as undo:
            connection = server.connect(str(place))
            undo.callback(connection.close)
            rows = PostgresRows(server.location(str(place)), connection)
            server.inspect(connection, rows.location)
            connection.set_autocommit(False)
            connection.set_isolation_level(psycopg.IsolationLevel.REPEATABLE_READ)
            connection.set_read_only(True)
            database = cls(place, rows, writable=writable, damaged=damaged)
            database._renew()
            undo.pop_all()
        return database

    @classmethod
    def change(
        cls, place: Place, action: Callable[[Rows], None], *, keep: bool = True, create: bool = False
    ) -> None:
        """See `SubmapDatabase.change`. Any number of processes may write at once; they wait for each other
        only if they store sessions of one name, or while the database is empty."""
        psycopg = server.driver()
        again = (psycopg.errors.UniqueViolation, psycopg.errors.DeadlockDetected)
        with _connected(place) as rows:
            if create:
                server.initialise(rows.connection, rows.location)
            server.inspect(rows.connection, rows.location)
            for attempt in range(1, _ATTEMPTS + 1):
                try:
                    with served(rows.location), rows.connection.transaction():
                        if not keep:
                            rows.execute("SELECT 1 FROM about FOR UPDATE")
                            rows.execute("DELETE FROM part")
                            rows.execute("DELETE FROM session")
                        action(rows)
                    return
                except DatabaseError as error:
                    # Another writer has just stored a session of that name: compare with it.
                    if attempt == _ATTEMPTS or not isinstance(error.__cause__, again):
                        raise

    @classmethod
    def exists(cls, place: Place) -> bool:
        """Whether the database holds sessions. Raises DatabaseUnreachable if the server does not answer."""
        with _connected(place) as rows:
            try:
                server.inspect(rows.connection, rows.location)
            except NotADatabase:
                return False
            return next(rows.select("SELECT 1 FROM session LIMIT 1"), None) is not None

    @classmethod
    def problems_of(cls, place: Place) -> tuple[Problem, ...]:
        """All damage of a database; see `SubmapDatabase.problems_of`."""
        with cls.open(place) as database:
            return tuple(dict.fromkeys(database._damaged_rows()))

    def keep_only(self, *, building: str | None = None, floor: str | None = None) -> None:
        """From now on, know only some sessions; see `SubmapDatabase.keep_only`."""
        before = self._building, self._floor
        self._building, self._floor = building, floor
        if next(self._known(), None) is None:
            self._building, self._floor = before
            found = self._rows.select("SELECT DISTINCT building, floor FROM session ORDER BY 1, 2 LIMIT 20")
            labels = [Label(building=b or None, floor=f or None) for b, f in found]
            raise none_there(self.location, building, floor, labels)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    @property
    def _connection(self) -> Connection[Any]:
        assert isinstance(self._rows, PostgresRows)
        return self._rows.connection

    def _all(self, condition: str = "true", *values: Any) -> Iterator[SessionRow]:
        """The rows of the sessions of the building and floor: a fleet has too many to look at all of them."""
        for column, wanted in (("building", self._building), ("floor", self._floor)):
            if wanted is not None:
                condition, values = f"{condition} AND {column} = ?", (*values, wanted)
        return self._rows.sessions(condition, *values)

    def _renew(self) -> None:
        with served(self.location):
            self._connection.rollback()
            self._connection.execute("SELECT 1 FROM about")  # takes the snapshot


@contextlib.contextmanager
def _connected(place: Place) -> Iterator[PostgresRows]:
    with server.connect(str(place)) as connection:
        yield PostgresRows(server.location(str(place)), connection)
