"""What makes a file a `*.submaps` file: its header and tables, examined before anything else is read."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from pc2grid.errors import DatabaseCorrupt, NotADatabase
from pc2grid.io.error_translation import LFS_HINT, is_lfs_pointer
from signature.database.arrays import SALVAGE, DatabaseDamage
from signature.database.protocol import APPLICATION_ID, FORMAT, refuse_other_format
from signature.database.rows import definitions

_CONVERTED = (".mcap", ".bag", ".db3", ".yaml", ".yml", ".pcd", ".ply", ".obj", ".stl")
CONVERT = "make one with `pc2grid convert LOG -o BUILDING.submaps`"

TABLES = definitions("blob", "id integer PRIMARY KEY")
"""The statement that creates each table: table -> SQL."""

DAMAGE = (sqlite3.Error, UnicodeDecodeError)
"""What SQLite raises for damaged content: the second where its message would quote bytes that are no text."""


def initialise(connection: sqlite3.Connection) -> None:
    """Turn an empty file into a database of this format."""
    connection.execute("PRAGMA page_size = 4096")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {FORMAT}")
    for statement in TABLES.values():
        connection.execute(statement)


def inspect_header(path: Path) -> None:
    """Examine the first 100 bytes of a file, before SQLite opens it.

    Raises NotADatabase (missing, empty, another kind of file, another program's SQLite file),
    DatabaseVersion, DatabaseCorrupt (shorter than it says).
    """
    header, size = _header(path)
    if len(header) < 100:
        raise DatabaseCorrupt(f"{path}: truncated to {size} bytes, not even the header is whole")
    _check_format(path, *(int.from_bytes(header[at : at + 4], "big") for at in (68, 60)))
    page_size = int.from_bytes(header[16:18], "big")
    promised = (65536 if page_size == 1 else page_size) * int.from_bytes(header[28:32], "big")
    if size != promised:
        raise DatabaseCorrupt(
            f"{path}: {size} bytes where its header promises {promised}: truncated or damaged", hint=SALVAGE
        )


def _header(path: Path) -> tuple[bytes, int]:
    """The header of an SQLite file, and the size of the file. Raises NotADatabase."""
    try:
        with path.open("rb") as file:
            header = file.read(100)
            size = file.seek(0, 2)
    except FileNotFoundError:
        raise NotADatabase(f"{path}: no such database", hint=CONVERT) from None
    except IsADirectoryError:
        raise NotADatabase(f"{path}: is a folder, not a submap database", hint=CONVERT) from None
    except (OSError, ValueError) as error:
        raise NotADatabase(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not header:
        raise NotADatabase(f"{path}: empty file, a database that was never filled", hint=CONVERT)
    if is_lfs_pointer(header):
        raise NotADatabase(f"{path}: a Git LFS pointer to a database", hint=LFS_HINT)
    if not header.startswith(b"SQLite format 3\0"):
        raise NotADatabase(
            f"{path}: not a pc2grid database",
            hint=f"make one of it: pc2grid convert {path} -o {path.with_suffix('.submaps')}"
            if path.suffix.lower() in _CONVERTED
            else CONVERT,
        )
    return header, size


def _check_format(path: Path, application_id: int, version: int) -> None:
    """Raises NotADatabase or DatabaseVersion unless both are those of this format."""
    if application_id != APPLICATION_ID:
        raise NotADatabase(
            f"{path}: not a pc2grid database, but another program's SQLite file (application id"
            f" {application_id:#x})",
            hint=CONVERT,
        )
    refuse_other_format(path, version)


def inspect_tables(connection: sqlite3.Connection, path: Path) -> None:
    """Compare the tables with those of the format: no views or triggers of others, no damage.

    Raises DatabaseCorrupt.
    """
    try:
        found = {
            str(name): str(sql)
            for name, sql in connection.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL")
        }
    except DAMAGE as error:
        raise DatabaseDamage(path, "file", f"{type(error).__name__}: {error}") from error
    if found != TABLES:
        odd = sorted(name for name in found.keys() | TABLES if found.get(name) != TABLES.get(name))
        raise DatabaseCorrupt(
            f"{path}: its tables are not those of format {FORMAT} ({', '.join(map(repr, odd))})",
            hint=f"convert the recordings again, with `pc2grid convert`; {SALVAGE}",
        )
