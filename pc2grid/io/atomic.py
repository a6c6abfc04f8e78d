"""Files that are either whole or not there.

A result is written to a temporary file in the folder of its target, flushed to the disk and renamed
over it, so a reader (or a crash) sees the old content or the new, never a part.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from pc2grid.errors import OutputError

_MARK = ".pc2grid-"


@contextlib.contextmanager
def replace_file(path: str | Path) -> Iterator[Path]:
    """Give the body a temporary path; when it ends well, that file becomes `path`.

    The body may open, write and close the temporary file as it likes. If the body raises, or the process
    dies, `path` keeps its old content; the temporary is removed (after a kill: by the next writer of the
    same target). A symbolic link is followed, not replaced.

    Raises OutputError if the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}{_MARK}{os.getpid()}.tmp")
    if target.is_dir():
        raise OutputError(f"{path}: is a folder", hint="name a file to write to")
    _sweep(target)
    try:
        # Not mkstemp: the result shall have the permissions that the user's umask asks for.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, target)  # noqa: PTH105 - Path.replace hides which of the two is missing
        _fsync_folder(target.parent)
    except OSError as error:
        ours = (None, temporary, str(temporary))
        # copyfile names its source first, and complains about a full disk with both names.
        if error.filename not in ours and error.filename2 not in ours[1:]:
            raise  # the body failed on some other file: not ours to explain
        raise OutputError(f"{path}: cannot write: {error.strerror or error}", hint=_advice(error)) from error
    finally:
        temporary.unlink(missing_ok=True)


def refuse_existing(path: str | Path, force: bool) -> None:
    """Raise OutputError if `path` exists and `force` is not set."""
    if not force and Path(path).exists():
        raise OutputError(f"{path}: exists already", hint="--force replaces it")


def _advice(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some space, or write to another disk"
    if error.errno == errno.ENOENT:
        return "create the folder first"
    return "choose a folder you may write to"


def _fsync_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):  # some network file systems cannot; the data itself is safe
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _sweep(target: Path) -> None:
    """Remove temporaries of `target` whose writer is no longer alive."""
    prefix = f".{target.name}{_MARK}"
    with contextlib.suppress(OSError):
        for left_over in target.parent.iterdir():
            name = left_over.name
            if name.startswith(prefix) and name.endswith(".tmp"):
                pid = name[len(prefix) : -len(".tmp")]
                if pid.isdecimal() and not _alive(int(pid)):
                    left_over.unlink(missing_ok=True)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return pid != os.getpid()
