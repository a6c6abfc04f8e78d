"""Files that exist completely or not at all.

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
    temporary = _temporary(target)
    if target.is_dir():
        raise OutputError(f"{path}: is a folder", hint="name a file to write to")
    _remove_left_over(target)
    try:
        # Not mkstemp, which ignores the user's umask.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
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
        raise OutputError(f"{path}: cannot write: {error.strerror or error}", hint=_advice(error)) from error
    finally:
        temporary.unlink(missing_ok=True)


def refuse_existing(path: str | Path, force: bool) -> None:
    """Raise OutputError if `path` exists and `force` is not set."""
    if not force and Path(path).exists():
        raise OutputError(f"{path}: exists already", hint="--force replaces it")


def require_writable(path: str | Path, force: bool) -> None:
    """Refuse a target that cannot be written, before the work for it begins.

    A temporary file is made in the folder of the target and removed: permissions alone do not tell, for
    example on a read-only disk.

    Raises OutputError if `path` exists and `force` is not set, if it is a folder, or if its folder is missing
    or not writable.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder", hint="name a file to write to")
        refuse_existing(path, force)
        temporary = _temporary(Path(os.path.realpath(path)))
        if not temporary.parent.is_dir():
            raise OutputError(
                f"{path}: cannot write: no folder {path.parent}", hint="create the folder first"
            )
        os.close(os.open(temporary, os.O_CREAT | os.O_WRONLY, 0o666))
        temporary.unlink()
    except OSError as error:
        raise OutputError(f"{path}: cannot write: {error.strerror or error}", hint=_advice(error)) from error


def _temporary(target: Path) -> Path:
    return target.with_name(f".{target.name}{_MARK}{os.getpid()}.tmp")


def _advice(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some space, or write to another disk"
    if error.errno == errno.ENOENT:
        return "create the folder first"
    return "choose a folder you may write to"


def _fsync_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):  # some network file systems refuse it; the file itself is on disk
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _remove_left_over(target: Path) -> None:
    """Remove the temporary files of `target` whose process does not exist any more."""
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
