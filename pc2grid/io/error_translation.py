"""The one place where exceptions of the libraries that read recordings become errors of pc2grid.

Decoders of other projects raise a dozen unrelated types for damaged bytes (17 were counted for `mcap` alone);
a user gets one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeVar, cast

from pc2grid.errors import LogCorrupt, LogError, Pc2GridError, one_line

RECOVER_HINT = "--recover reads what is whole"
LFS_HINT = "`git lfs pull` in its repository fetches the file itself"

T = TypeVar("T")


def is_lfs_pointer(head: bytes) -> bool:
    """Whether a file that begins so is what Git leaves in place of a large file that was not fetched."""
    return head.startswith(b"version https://git-lfs")


def translated(path: Path, error: Exception, hint: str | None = None) -> Pc2GridError:
    """The error to show for one that a decoder raised; a LogError gets the path of its recording added.

    hint : what helps against damage in this kind of file; `--recover` if it is None.
    """
    if isinstance(error, LogError) and one_line(path.name) not in error.message:
        return type(error)(f"{path}: {error.message}", hint=error.hint or hint)
    if isinstance(error, Pc2GridError):
        return error
    if isinstance(error, OSError):
        return LogCorrupt(f"{path}: cannot be read: {error.strerror or error}")
    return LogCorrupt(
        f"{path}: damaged ({type(error).__name__}: {' '.join(str(error).split())[:120]})",
        hint=hint or RECOVER_HINT,
    )


def guarded(path: Path, action: Callable[[], T], hint: str | None = None) -> T:
    """The result of an action; an exception in it is translated."""
    try:
        return action()
    except MemoryError:
        raise
    except Exception as error:
        ours = translated(path, error, hint)
        try:
            if ours is error:
                raise
            raise ours from error
        finally:
            # Its traceback holds this frame, and what was read. A name of it here would keep both alive.
            del ours


def guarded_stream(path: Path, stream: Iterator[T], hint: str | None = None) -> Iterator[T]:
    """The same for an iterator; exceptions of its consumer do not pass through here."""
    end = object()
    following = partial(next, stream, end)
    while (item := guarded(path, following, hint)) is not end:
        yield cast("T", item)
