"""A database in one SQLite file, which is changed as a whole: in a copy that replaces it when it is complete.

A finished `*.submaps` file is never written to again. A reader keeps the file it opened, complete and
unlocked, on any file system and any read-only medium; a file opened later has the new content. A writer that
is killed at any moment leaves the old content. There is one writer at a time: it holds a lock on a file
beside the database, which the system releases when the process ends. The header and the tables of a file are
examined before anything else is read.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from typing_extensions import Self

from pc2grid.errors import DatabaseBusy, DatabaseCorrupt, DatabaseError, NotADatabase, OutputError
from pc2grid.io.atomic import is_at, replace_file
from pc2grid.io.source import LFS_HINT, is_lfs_pointer
from signature.database.database import SubmapDatabase, definitions
from signature.database.document import SALVAGE, DatabaseDamage
from signature.database.protocol import (
    APPLICATION_ID,
    BUSY_TIMEOUT_S,
    FORMAT,
    Location,
    Problem,
    no_utf8,
    refuse_other_format,
)

_MAPPED_BYTES = 1 << 30
"""How much of a file SQLite maps into memory at most; chosen by hand."""


class SqliteDatabase(SubmapDatabase):
    """A `*.submaps` file. Finished files are never written again, so readers need no locks."""

    @classmethod
    def open(cls, place: Location, *, damaged: bool = False) -> Self:
        """Open the file for reading, see `SubmapDatabase.open`. The connection cannot change it."""
        path = local(place)
        with contextlib.suppress(*[DatabaseCorrupt] if damaged else []):
            inspect_header(path)
        connection = sqlite3.connect(
            f"file:{quote(os.path.realpath(path))}?mode=ro&immutable=1",
            uri=True,
            isolation_level=None,
            check_same_thread=False,
        )
        with contextlib.ExitStack() as undo:
            undo.callback(connection.close)
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute(f"PRAGMA mmap_size = {_MAPPED_BYTES}")
            if not damaged:
                inspect_tables(connection, path)
            undo.pop_all()
        return cls(str(path), connection, damaged=damaged)

    @classmethod
    def change(
        cls,
        place: Location,
        action: Callable[[SubmapDatabase], None],
        *,
        keep: bool = True,
        create: bool = False,
    ) -> None:
        """Change a copy of the file that replaces it, see `SubmapDatabase.change`. Deleted rows take no place
        in it.

        Raises DatabaseBusy if another writer does not finish within `BUSY_TIMEOUT_S`.
        """
        path = local(place)
        if not create:
            inspect_header(path)
        target = Path(os.path.realpath(path))
        with hold(target, BUSY_TIMEOUT_S), replace_file(target, alone=True) as copy:
            kept = keep and target.exists() and target.stat().st_size > 0
            if kept:
                inspect_header(target)
                shutil.copyfile(target, copy)
            with (
                contextlib.closing(sqlite3.connect(copy, isolation_level=None)) as connection,
                _explained(path),
            ):
                if kept:
                    inspect_tables(connection, path)
                # Journal and fsync are off: the temporary copy is renamed only when it is complete.
                connection.execute("PRAGMA journal_mode = OFF")
                connection.execute("PRAGMA synchronous = OFF")
                connection.execute("PRAGMA trusted_schema = OFF")
                if not kept:
                    initialise(connection)
                connection.execute("BEGIN")
                action(cls(str(path), connection))
                connection.execute("COMMIT")
                if connection.execute("PRAGMA freelist_count").fetchone() != (0,):
                    connection.execute("VACUUM")

    @classmethod
    def exists(cls, place: Location) -> bool:
        """Return True if there is a file, other than an empty one."""
        path = local(place)
        return path.exists() and not (path.is_file() and path.stat().st_size == 0)

    def _select(self, statement: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query. Raises DatabaseCorrupt if SQLite finds the file damaged."""
        try:
            # `yield from` would close the cursor of an unfinished generator, perhaps after the connection.
            for row in self.connection.execute(statement, values):  # noqa: UP028
                yield row
        except UnicodeEncodeError:
            raise no_utf8(self.location) from None
        except sqlite3.ProgrammingError:
            raise  # the use of a closed database is a mistake of the caller, not damage
        except DAMAGE as error:
            raise DatabaseDamage(self.location, "file", f"{type(error).__name__}: {error}") from error

    def execute(self, statement: str, *values: Any) -> None:
        """Change rows. Raises sqlite3.Error, which `change` explains."""
        self.connection.execute(statement, values)

    def new_id(self) -> int:
        """Return a number for a further session."""
        ((largest,),) = self._select("SELECT coalesce(max(id), 0) FROM session")
        return int(largest) + 1

    def _damaged_structure(self) -> Iterator[Problem]:
        """Yield a wrong header, tables that are not those of the format, and the findings of SQLite
        itself."""
        try:
            inspect_header(Path(self.location))
            inspect_tables(self.connection, Path(self.location))
        except DatabaseCorrupt as error:
            yield Problem("file", error.message)
        for (message,) in self._select("PRAGMA integrity_check"):
            yield from (Problem("file", line) for line in str(message).splitlines() if line != "ok")


def local(place: Location) -> Path:
    """Return the path of a file. Raises DatabaseError for a URL of an unknown engine."""
    scheme, separator, _ = str(place).partition("://")
    if isinstance(place, str) and separator:
        raise DatabaseError(
            f"{scheme}:// databases are not supported by this version",
            hint="give the path of a .submaps file, or postgresql://user@host/database",
        )
    return Path(place)


# --- writing ------------------------------------------------------------------------------------------

_POLL_S = 0.05


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn errors of SQLite into our own: about the medium, or about the content that was to be kept."""
    try:
        yield
    except sqlite3.OperationalError as error:
        raise OutputError(
            f"{path}: cannot write: {error}", hint="free some space, or write to another disk"
        ) from error
    except DAMAGE as error:
        raise DatabaseDamage(path, "file", str(error)) from error


@contextlib.contextmanager
def hold(target: Path, timeout_s: float) -> Iterator[None]:
    """Lock `target` while the body runs; wait up to `timeout_s` for another writer.

    Raises DatabaseBusy naming the other writer, OutputError if the folder is not writable.
    """
    lock_path = target.with_name(f".{target.name}.lock")
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            descriptor = os.open(lock_path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise OutputError(
                f"{target}: cannot write: {error.strerror}",
                hint="choose a folder that exists and you may write to",
            ) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip()
            os.close(descriptor)
            if time.monotonic() >= deadline:
                raise DatabaseBusy(
                    f"{target}: being written by {holder or 'another process'}",
                    hint="try again when it is done",
                ) from None
            time.sleep(_POLL_S)
            continue
        if is_at(descriptor, lock_path):
            break
        os.close(descriptor)  # the previous holder removed this file: lock the new one
    try:
        with contextlib.suppress(OSError):  # on a full disk the lock holds, but does not name its holder
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        yield
    finally:
        lock_path.unlink(missing_ok=True)
        os.close(descriptor)


# --- the file -----------------------------------------------------------------------------------------

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
    DatabaseVersion, DatabaseCorrupt (shorter than its header claims).
    """
    header, size = _header(path)
    if len(header) < 100:
        raise DatabaseCorrupt(f"{path}: truncated to {size} bytes, not even the header is whole")
    application_id, version = (int.from_bytes(header[at : at + 4], "big") for at in (68, 60))
    if application_id != APPLICATION_ID:
        raise NotADatabase(
            f"{path}: not a pc2grid database, but another program's SQLite file (application id"
            f" {application_id:#x})",
            hint=CONVERT,
        )
    refuse_other_format(path, version)
    page_size = int.from_bytes(header[16:18], "big")
    promised = (65536 if page_size == 1 else page_size) * int.from_bytes(header[28:32], "big")
    if size != promised:
        raise DatabaseCorrupt(
            f"{path}: {size} bytes where its header promises {promised}: truncated or damaged", hint=SALVAGE
        )


def _header(path: Path) -> tuple[bytes, int]:
    """Return the header of an SQLite file, and the size of the file. Raises NotADatabase."""
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
