"""The one place where exceptions of the reading stack become ours.

What other people's decoders raise on damaged bytes is of a dozen unrelated families; a user is to see one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from pc2grid.errors import LogCorrupt, LogError, Pc2GridError, one_line

T = TypeVar("T")


def adapted(path: Path, error: Exception) -> Pc2GridError:
    """The error to show for one that a decoder raised; ours only learn which recording they are about."""
    if isinstance(error, LogError) and one_line(path.name) not in error.message:
        return type(error)(f"{path}: {error.message}", hint=error.hint)
    if isinstance(error, Pc2GridError):
        return error
    if isinstance(error, OSError):
        return LogCorrupt(f"{path}: cannot be read: {error.strerror or error}")
    return LogCorrupt(
        f"{path}: damaged ({type(error).__name__}: {' '.join(str(error).split())[:120]})",
        hint="--recover reads what is whole",
    )


def guarded(path: Path, action: Callable[[], T]) -> T:
    """The result of an action; what it raises is adapted."""
    try:
        return action()
    except MemoryError:
        raise
    except Exception as error:
        ours = adapted(path, error)
        if ours is error:
            raise
        raise ours from error


def guarded_stream(path: Path, stream: Iterator[T]) -> Iterator[T]:
    """The same for a generator; exceptions thrown in by its consumer never pass through here."""
    while True:
        try:
            item = next(stream)
        except StopIteration:
            return
        except MemoryError:
            raise
        except Exception as error:
            ours = adapted(path, error)
            if ours is error:
                raise
            raise ours from error
        yield item
