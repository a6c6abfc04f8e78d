"""Connections to SQLite files that may be damaged: no statement returns more than the file can hold.

SQLite follows the pages of a table from its root. If a damaged or crafted page refers back to earlier pages,
SQLite returns the same rows again and again: from a few kilobytes, more rows than memory holds. Different
rows share no bytes of the file, so the size of the file bounds the size of all rows of a statement.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Any

_UNCHECKED_BYTES = 1 << 16
"""Statements that return less than this are not compared with the size of the file."""
_ROW_BYTES = 8
"""Counted for each row besides its text and blobs: its numbers; chosen by hand."""


class BoundedConnection(sqlite3.Connection):
    """Every statement raises sqlite3.DatabaseError once it has returned more bytes than the file has."""

    def execute(self, statement: str, values: Sequence[Any] = ()) -> BoundedCursor:  # type: ignore[override]
        """Run a statement; the bytes of its rows are counted."""
        return self.cursor(BoundedCursor).execute(statement, values)

    def size_bytes(self) -> int:
        """Size of the file, with the changes of the open transaction."""
        ((pages,), (page_size,)) = (
            self.cursor().execute(f"PRAGMA {word}").fetchone() for word in ("page_count", "page_size")
        )
        return int(pages) * int(page_size)


class BoundedCursor(sqlite3.Cursor):
    """A cursor that counts the bytes of the rows it returns."""

    _returned, _most = 0, _UNCHECKED_BYTES

    def __next__(self) -> Any:
        """The next row."""
        row = super().__next__()
        self._returned += _ROW_BYTES + sum(len(value) for value in row if isinstance(value, bytes | str))
        if self._returned > self._most:
            assert isinstance(self.connection, BoundedConnection)
            self._most = max(self.connection.size_bytes(), _UNCHECKED_BYTES)
            if self._returned > self._most:
                raise sqlite3.DatabaseError("more rows than fit into the file: some of its pages come twice")
        return row
