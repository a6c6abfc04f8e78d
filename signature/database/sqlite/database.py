"""The submap database as one SQLite file."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from pc2grid.errors import DatabaseCorrupt, DatabaseError
from signature.database.arrays import DatabaseDamage
from signature.database.database import SubmapDatabase
from signature.database.protocol import Place, Problem, no_utf8
from signature.database.rows import Rows
from signature.database.sqlite import schema
from signature.database.sqlite.atomic_update import rewrite
from signature.database.sqlite.connection import BoundedConnection

if TYPE_CHECKING:
    from typing_extensions import Self

_MAPPED_BYTES = 1 << 30
"""How much of a file SQLite maps into memory at most; chosen by hand."""


class SqliteRows(Rows):
    """The rows of a file."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        super().__init__(str(path))
        self.connection = connection

    def select(self, statement: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """The rows of a query. Raises DatabaseCorrupt where SQLite finds the file damaged."""
        try:
            # `yield from` would close the cursor of an unfinished generator, perhaps after the connection.
            for row in self.connection.execute(statement, values):  # noqa: UP028
                yield row
        except UnicodeEncodeError:
            raise no_utf8(self.location) from None
        except sqlite3.ProgrammingError:
            raise  # the use of a closed database is a mistake of the caller, not damage
        except schema.DAMAGE as error:
            raise DatabaseDamage(self.location, "file", f"{type(error).__name__}: {error}") from error

    def execute(self, statement: str, *values: Any) -> None:
        """Change rows. Raises sqlite3.Error, which `rewrite` explains."""
        self.connection.execute(statement, values)

    def new_id(self) -> int:
        """A number for a further session."""
        ((largest,),) = self.select("SELECT coalesce(max(id), 0) FROM session")
        return int(largest) + 1


class SqliteDatabase(SubmapDatabase):
    """A `*.submaps` file. See `SubmapDatabase` for what the methods promise.

    An open handle sees the file as it was when it was opened; `add` lets its own handle see the new file.
    """

    @classmethod
    def open(cls, place: Place, *, writable: bool = False, damaged: bool = False) -> Self:
        """See `SubmapDatabase.open`. Raises NotADatabase, DatabaseVersion, DatabaseCorrupt."""
        path = local(place)
        rows = SqliteRows(path, _open(path, "&immutable=1") if damaged else _connect(path))
        return cls(path, rows, writable=writable, damaged=damaged)

    @classmethod
    def change(
        cls, place: Place, action: Callable[[Rows], None], *, keep: bool = True, create: bool = False
    ) -> None:
        """See `SubmapDatabase.change`. What was deleted takes no place in the new file."""
        path = local(place)
        if not create:
            schema.inspect_header(path)
        with rewrite(path, keep=keep) as connection:
            action(SqliteRows(path, connection))
            # The copy that is worked on is nobody else's: the change may end before the file is made compact.
            connection.execute("COMMIT")
            if connection.execute("PRAGMA freelist_count").fetchone() != (0,):
                connection.execute("VACUUM")
            connection.execute("BEGIN")

    @classmethod
    def exists(cls, place: Place) -> bool:
        """Whether there is a file, other than an empty one."""
        path = local(place)
        return path.exists() and not (path.is_file() and path.stat().st_size == 0)

    @classmethod
    def problems_of(cls, place: Place) -> tuple[Problem, ...]:
        """All damage of a file, in whatever state it is; see `SubmapDatabase.problems_of`."""
        problems: list[Problem] = []
        try:
            schema.inspect_header(local(place))
        except DatabaseCorrupt as error:
            problems.append(Problem("file", error.message))
        with cls.open(place, damaged=True) as database:
            try:
                problems += database._damaged_structure()
                problems += database._damaged_rows()
            except DatabaseDamage as error:
                problems.append(error.problem)
        return tuple(dict.fromkeys(problems))

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def _renew(self) -> None:
        self.close()
        self._rows = SqliteRows(local(self._place), _connect(local(self._place)))

    @property
    def _connection(self) -> sqlite3.Connection:
        assert isinstance(self._rows, SqliteRows)
        return self._rows.connection

    def _damaged_structure(self) -> Iterator[Problem]:
        """What SQLite itself finds wrong, and tables that are not those of the format."""
        try:
            schema.inspect_tables(self._connection, local(self._place))
            for (message,) in self._connection.execute("PRAGMA integrity_check"):
                yield from (Problem("file", line) for line in str(message).splitlines() if line != "ok")
        except DatabaseCorrupt as error:
            yield Problem("file", error.message)
        except schema.DAMAGE as error:
            yield Problem("file", str(error))


def local(place: Place) -> Path:
    """The path of a file. Raises DatabaseError for a URL of an unknown engine."""
    scheme, separator, _ = str(place).partition("://")
    if isinstance(place, str) and separator:
        raise DatabaseError(
            f"{scheme}:// databases are not supported by this version",
            hint="give the path of a .submaps file, or postgresql://user@host/database",
        )
    return Path(place)


def _connect(path: Path) -> sqlite3.Connection:
    """A connection that cannot change the file. Raises NotADatabase, DatabaseVersion, DatabaseCorrupt."""
    schema.inspect_header(path)
    # Finished files are never written again, so readers need no locks. Only a journal that another
    # program left beside the file calls for them.
    real = os.path.realpath(path)
    journals = [Path(real + suffix) for suffix in ("-wal", "-journal")]
    with contextlib.ExitStack() as undo:
        try:
            connection = _open(path, "" if any(journal.exists() for journal in journals) else "&immutable=1")
            undo.callback(connection.close)
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute(f"PRAGMA mmap_size = {_MAPPED_BYTES}")
            schema.inspect_tables(connection, path)
        except schema.DAMAGE as error:
            raise DatabaseDamage(path, "header", f"{type(error).__name__}: {error}") from error
        undo.pop_all()
    return connection


def _open(path: Path, options: str) -> sqlite3.Connection:
    return sqlite3.connect(
        f"file:{quote(os.path.realpath(path))}?mode=ro{options}",
        uri=True,
        isolation_level=None,
        check_same_thread=False,
        factory=BoundedConnection,
    )
