"""Changing a database as a whole: in a copy that replaces the file when it is complete.

A finished `*.submaps` file is never written to again. A reader keeps the file it opened, complete and
unlocked, on any file system and any read-only medium; a file opened later has the new content. A writer
that is killed at any moment leaves the old content. There is one writer at a time: it holds a lock on a file
beside the database, which the system releases when the process ends.
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

from pc2grid.errors import DatabaseBusy, OutputError
from pc2grid.io.atomic import is_at, replace_file
from signature.database.arrays import DatabaseDamage
from signature.database.protocol import BUSY_TIMEOUT_S
from signature.database.sqlite import schema

_POLL_S = 0.05


@contextlib.contextmanager
def rewrite(path: Path, *, keep: bool) -> Iterator[sqlite3.Connection]:
    """Give the body a connection to change; when it ends without an error, `path` holds the result.

    keep : start from the content of `path`; otherwise, or if there is none yet, from an empty database.

    Raises DatabaseBusy if another writer does not finish within `BUSY_TIMEOUT_S`, OutputError if the file
    cannot be written, and NotADatabase, DatabaseVersion or DatabaseCorrupt if the content of `path` cannot
    be kept.
    """
    target = Path(os.path.realpath(path))
    with hold(target, BUSY_TIMEOUT_S), replace_file(target, alone=True) as copy:
        kept = keep and target.exists() and target.stat().st_size > 0
        if kept:
            schema.inspect_header(target)
            shutil.copyfile(target, copy)
        with contextlib.closing(sqlite3.connect(copy, isolation_level=None)) as connection, _explained(path):
            if kept:
                schema.inspect_tables(connection, path)
            # Journal and fsync are off: the temporary copy is renamed only when it is complete.
            connection.execute("PRAGMA journal_mode = OFF")
            connection.execute("PRAGMA synchronous = OFF")
            connection.execute("PRAGMA trusted_schema = OFF")
            if not kept:
                schema.initialise(connection)
            connection.execute("BEGIN")
            yield connection
            connection.execute("COMMIT")


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn errors of SQLite into our own: about the medium, or about the content that was to be kept."""
    try:
        yield
    except sqlite3.OperationalError as error:
        raise OutputError(
            f"{path}: cannot write: {error}", hint="free some space, or write to another disk"
        ) from error
    except schema.DAMAGE as error:
        raise DatabaseDamage(path, "file", str(error)) from error


@contextlib.contextmanager
def hold(target: Path, timeout_s: float) -> Iterator[None]:
    """Be the only writer of `target` while the body runs; wait up to `timeout_s` for another writer.

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
