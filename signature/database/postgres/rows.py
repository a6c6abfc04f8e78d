"""The rows of a database in PostgreSQL: one for a whole fleet, with many writers at once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from pc2grid.errors import DatabaseError, NotADatabase
from signature.database.postgres import server
from signature.database.postgres.server import served
from signature.database.protocol import Place, Problem, SessionInfo
from signature.database.rows import Rows

if TYPE_CHECKING:
    from typing_extensions import Self

_ATTEMPTS = 5
"""How often a transaction is tried that conflicts with one of another writer; chosen by hand."""


class PostgresRows(Rows):
    """The rows of a schema `pc2grid` on a PostgreSQL server; read in one snapshot."""

    for_update = " FOR UPDATE"

    @classmethod
    def open(cls, place: Place, *, damaged: bool = False) -> Self:
        """See `Rows.open`."""
        with contextlib.ExitStack() as undo:
            rows = cls._connected(place)
            undo.callback(rows.close)
            server.inspect(rows.connection, rows.location)
            rows.connection.set_autocommit(False)
            rows.connection.set_isolation_level(server.driver().IsolationLevel.REPEATABLE_READ)
            rows.connection.set_read_only(True)
            rows.renew()
            undo.pop_all()
        return rows

    @classmethod
    def change(
        cls, place: Place, action: Callable[[Rows], None], *, keep: bool = True, create: bool = False
    ) -> None:
        """See `Rows.change`. Any number of processes may write at once; they wait for each other only if they
        store sessions of one name, or while the database is empty."""
        errors = server.driver().errors
        with contextlib.closing(cls._connected(place)) as rows:
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
                    again = isinstance(error.__cause__, errors.UniqueViolation | errors.DeadlockDetected)
                    if attempt == _ATTEMPTS or not again:
                        raise

    @classmethod
    def exists(cls, place: Place) -> bool:
        """Whether the database holds sessions. Raises DatabaseUnreachable if the server does not answer."""
        with contextlib.closing(cls._connected(place)) as rows:
            try:
                server.inspect(rows.connection, rows.location)
            except NotADatabase:
                return False
            return next(rows.select("SELECT 1 FROM session LIMIT 1"), None) is not None

    @classmethod
    def _connected(cls, place: Place) -> Self:
        return cls(place, server.location(str(place)), server.connect(str(place)))

    def renew(self) -> None:
        """Take the snapshot of now."""
        with served(self.location):
            self.connection.rollback()
            self.connection.execute("SELECT 1 FROM about")

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
