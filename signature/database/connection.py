"""Connections to SQLite files that may lie: no statement gives more than the file can hold.

SQLite follows the pages of a table from its root. Where a damaged or crafted page leads back to pages that
were there before, it meets the same rows again, and with them the same page: more rows than memory holds,
out of a few kilobytes. Rows that are different share no bytes, so the size of the file bounds them all.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Any

# A file is never asked for its size by statements that give less than this.
_LITTLE_BYTES = 1 << 16
_ROW_BYTES = 8


class BoundedConnection(sqlite3.Connection):
    """Every statement raises sqlite3.DatabaseError once it has given more than is in the file."""

    def execute(self, statement: str, values: Sequence[Any] = ()) -> BoundedCursor:  # type: ignore[override]
        """Run a statement; its rows are counted."""
        return self.cursor(BoundedCursor).execute(statement, values)

    def size_bytes(self) -> int:
        """Of the file, with what is written to it at the moment."""
        ((pages,), (page_size,)) = (
            self.cursor().execute(f"PRAGMA {word}").fetchone() for word in ("page_count", "page_size")
        )
        return int(pages) * int(page_size)


class BoundedCursor(sqlite3.Cursor):
    """Iterates over rows, and counts their bytes."""

    _given, _most = 0, _LITTLE_BYTES

    def __next__(self) -> Any:
        """The next row."""
        row = super().__next__()
        self._given += _ROW_BYTES + sum(len(value) for value in row if isinstance(value, bytes | str))
        if self._given > self._most:
            assert isinstance(self.connection, BoundedConnection)
            self._most = max(self.connection.size_bytes(), _LITTLE_BYTES)
            if self._given > self._most:
                raise sqlite3.DatabaseError("more rows than fit into the file: some of its pages come twice")
        return row
