"""The rows of one SQLite file."""

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
from signature.database.protocol import Place, Problem, no_utf8
from signature.database.rows import Rows
from signature.database.sqlite import schema
from signature.database.sqlite.atomic_update import rewrite

if TYPE_CHECKING:
    from typing_extensions import Self

_MAPPED_BYTES = 1 << 30
"""How much of a file SQLite maps into memory at most; chosen by hand."""


class SqliteRows(Rows):
    """The rows of a `*.submaps` file. Finished files are never written again, so readers need no locks."""

    @classmethod
    def open(cls, place: Place, *, damaged: bool = False) -> Self:
        """See `Rows.open`."""
        path = local(place)
        with contextlib.suppress(*[DatabaseCorrupt] if damaged else []):
            schema.inspect_header(path)
        rows = cls(path, str(path), _connect(path))
        if not damaged:
            with contextlib.ExitStack() as undo:
                undo.callback(rows.close)
                rows._inspect_tables()
                undo.pop_all()
        return rows

    @classmethod
    def change(
        cls, place: Place, action: Callable[[Rows], None], *, keep: bool = True, create: bool = False
    ) -> None:
        """See `Rows.change`. What was deleted takes no place in the new file."""
        path = local(place)
        if not create:
            schema.inspect_header(path)
        with rewrite(path, keep=keep) as connection:
            action(cls(path, str(path), connection))
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

    def renew(self) -> None:
        """Open the file that is there now."""
        self.close()
        self.connection = self.open(self.source).connection

    def damaged_structure(self) -> Iterator[Problem]:
        """A wrong header, tables that are not those of the format, and what SQLite itself finds wrong."""
        try:
            schema.inspect_header(local(self.source))
            self._inspect_tables()
        except DatabaseCorrupt as error:
            yield Problem("file", error.message)
        for (message,) in self.select("PRAGMA integrity_check"):
            yield from (Problem("file", line) for line in str(message).splitlines() if line != "ok")

    def _inspect_tables(self) -> None:
        schema.inspect_tables(self.connection, local(self.source))


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
    """A connection that cannot change the file."""
    connection = sqlite3.connect(
        f"file:{quote(os.path.realpath(path))}?mode=ro&immutable=1",
        uri=True,
        isolation_level=None,
        check_same_thread=False,
    )
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute(f"PRAGMA mmap_size = {_MAPPED_BYTES}")
    return connection
