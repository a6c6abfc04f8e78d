"""Files that exist completely or not at all.

A result is written to a temporary file in the folder of its target, flushed to the disk and renamed
over it, so a reader (or a crash) sees the old content or the new, never a part.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path

from pc2grid.errors import OutputError

_MARK = ".pc2grid-"


@contextlib.contextmanager
def replace_file(path: str | Path, *, alone: bool = False) -> Iterator[Path]:
    """Give the body a temporary path; when it ends well, that file becomes `path`.

    The body opens, writes and closes the temporary file. If the body raises, or the process dies, `path`
    keeps its old content; the temporary is removed (after a kill: by the next writer of the same target). A
    symbolic link is followed, not replaced.

    The writer of a temporary file holds a lock on that file as long as it works. The number of its process
    would not do: processes of two containers that share a folder may both be number 1.

    alone : the caller keeps all other writers of `path` away. Then every other temporary file was left over,
        and this one is not locked: on NFS, SQLite could not lock it.

    Raises OutputError if the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise OutputError(f"{path}: is a folder", hint="name a file to write to")
    _remove_left_over(target, alone)
    try:
        temporary, descriptor = _create(target, lock=not alone)
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, target)  # noqa: PTH105 - Path.replace hides which of the two is missing
        _fsync_folder(target.parent)
    except OSError as error:
        ours = (None, temporary, str(temporary))
        # On a full disk shutil.copyfile raises an error with both names, the source first.
        if error.filename not in ours and error.filename2 not in ours[1:]:
            raise  # the body failed on another file
        raise _cannot_write(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)
        os.close(descriptor)


def refuse_existing(path: str | Path, overwrite: bool) -> None:
    """Raise OutputError if `path` exists and `overwrite` is not set."""
    if not overwrite and Path(path).exists():
        raise OutputError(f"{path}: exists already", hint="--force replaces it")


def require_writable(path: str | Path, overwrite: bool) -> None:
    """Refuse a target that cannot be written, before the work for it begins.

    A temporary file is made in the folder of the target and removed: permissions alone are not enough, for
    example on a read-only disk.

    Raises OutputError if `path` exists and `overwrite` is not set, if it is a folder, or if its folder is
    missing or not writable.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder", hint="name a file to write to")
        refuse_existing(path, overwrite)
        target = Path(os.path.realpath(path))
        temporary, descriptor = _create(target, lock=True)
        os.close(descriptor)
        temporary.unlink(missing_ok=True)  # the next writer may have seen that nobody locks it
    except OSError as error:
        raise _cannot_write(path, error) from error


def _create(target: Path, *, lock: bool) -> tuple[Path, int]:
    """Create an empty file beside `target`; returns it and a descriptor, which may hold a lock on it."""
    while True:
        temporary = target.with_name(f".{target.name}{_MARK}{secrets.token_hex(4)}.tmp")
        try:
            # Not mkstemp, which ignores the user's umask.
            descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        except FileExistsError:
            continue
        if not lock:
            return temporary, descriptor
        with contextlib.suppress(OSError):  # some network file systems have no locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if is_at(descriptor, temporary):
            return temporary, descriptor
        os.close(descriptor)  # another writer found it before it was locked


def is_at(descriptor: int, path: Path) -> bool:
    """Return True if `path` still names the open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _cannot_write(path: Path, error: OSError) -> OutputError:
    if error.errno == errno.ENOENT and not path.parent.is_dir():
        return OutputError(f"{path}: cannot write: no folder {path.parent}", hint="create the folder first")
    return OutputError(f"{path}: cannot write: {error.strerror or error}", hint=_advice(error))


def _advice(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some space, or write to another disk"
    return "choose a folder you may write to"


def _fsync_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):  # some network file systems refuse it; the file itself is on disk
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _remove_left_over(target: Path, alone: bool) -> None:
    """Remove the temporary files of `target` that nobody writes any more."""
    name = re.compile(re.escape(f".{target.name}{_MARK}") + r"[0-9a-f]+\.tmp")
    with contextlib.suppress(OSError):
        for left_over in target.parent.iterdir():
            if not name.fullmatch(left_over.name):
                continue
            if alone:
                left_over.unlink(missing_ok=True)
            else:
                _remove_unlocked(left_over)


def _remove_unlocked(path: Path) -> None:
    """Remove a file that nobody holds a lock on; not, if that cannot be told.

    It is removed while it is locked here: a writer that has just made it waits for the lock, and then sees
    that the file is gone (`_create`).
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return
    with contextlib.suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink(missing_ok=True)
    os.close(descriptor)
