"""Changing a database as a whole: on a copy that takes the file's place at the end.

A finished `*.submaps` file is never written to again. Readers keep the file they opened, complete and
unlocked, on any file system and any read-only medium; whoever opens it later sees the next state. A
writer that dies at any moment leaves the old state. One writer at a time: it holds a lock file beside
the database, which the system releases with the process.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path

from pc2grid.errors import DatabaseBusy, DatabaseCorrupt, OutputError
from pc2grid.io.atomic import replace_file
from signature.database import schema
from signature.database.connection import BoundedConnection
from signature.database.older import bring_along

BUSY_TIMEOUT_S = 30.0


@contextlib.contextmanager
def rewrite(path: Path, *, keep: bool, timeout_s: float = BUSY_TIMEOUT_S) -> Iterator[sqlite3.Connection]:
    """Give the body a connection to change; when it ends well, `path` holds the result.

    keep : start from what `path` holds; otherwise, or if there is nothing yet, from an empty database. What
        is of an older format becomes one of this; the file as it was stays beside it as `NAME.format1`.

    Raises DatabaseBusy if another writer does not finish within `timeout_s`, OutputError if the file
    cannot be written, NotADatabase, DatabaseCorrupt and their like if `path` cannot be kept.
    """
    target = Path(os.path.realpath(path))
    with hold(target, timeout_s), replace_file(target) as copy:
        kept = keep and target.exists() and target.stat().st_size > 0
        if kept:
            schema.inspect_header(target)
            shutil.copyfile(target, copy)
        connection = sqlite3.connect(copy, isolation_level=None, factory=BoundedConnection)
        try:
            # The copy is nobody's yet: neither journal nor flushing has anything to protect.
            connection.execute("PRAGMA journal_mode = OFF")
            connection.execute("PRAGMA synchronous = OFF")
            connection.execute("PRAGMA trusted_schema = OFF")
            if kept:
                schema.inspect_tables(connection, path)
            else:
                schema.initialise(connection)
            version = schema.version_of(connection)
            connection.execute("BEGIN")
            bring_along(connection)
            yield connection
            connection.execute("COMMIT")
            if version < schema.FORMAT:
                with replace_file(target.with_name(f"{target.name}.format{version}")) as before:
                    shutil.copyfile(target, before)
        except schema.COMPLAINTS as error:
            raise _explained(error, path, kept) from error
        finally:
            connection.close()


def _explained(error: Exception, path: Path, kept: bool) -> Exception:
    """SQLite's complaint as ours: about the disk, or about the content that was to be kept."""
    disk = any(words in str(error) for words in ("is full", "disk I/O", "unable to open", "readonly"))
    if isinstance(error, sqlite3.OperationalError) and (disk or not kept):
        return OutputError(f"{path}: cannot write: {error}", hint="free some space, or write to another disk")
    if kept:
        return DatabaseCorrupt(f"{path}: damaged: {error}", hint=schema.SALVAGE)
    return error  # what we wrote ourselves cannot be damaged: a mistake of ours


@contextlib.contextmanager
def hold(target: Path, timeout_s: float) -> Iterator[None]:
    """Be the only writer of `target`; wait up to `timeout_s` for the one before.

    Raises DatabaseBusy naming the holder, OutputError if the folder is not writable.
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
            time.sleep(0.05)
            continue
        if _is_at(descriptor, lock_path):
            break
        os.close(descriptor)  # the holder before us removed it: lock the new one
    try:
        with contextlib.suppress(OSError):  # on a full disk the lock still holds, it only has no name
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        yield
    finally:
        lock_path.unlink(missing_ok=True)
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether `path` still names the file that is open."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
