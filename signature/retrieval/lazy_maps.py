"""The maps of a database, read and prepared when they are first asked for."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar, overload

from pc2grid.model import OccupancyGrid

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

T = TypeVar("T")


class LazySequence(Sequence[T]):
    """A sequence of `count` items, each made when it is first asked for; the `most` used last are kept."""

    def __init__(self, make: Callable[[int], T], count: int, most: int | None = None) -> None:
        """most : None: all are kept."""
        self._made, self._count = functools.lru_cache(maxsize=most)(make), count

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[T, ...]: ...

    def __getitem__(self, index: int | slice) -> T | tuple[T, ...]:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(self._count)))
        return self._made(range(self._count)[index])


class DatabaseGrids(Mapping[str, OccupancyGrid]):
    """The map of each session of a database, by name, read whenever it is asked for."""

    def __init__(self, database: SubmapDatabase, sessions: Sequence[str]) -> None:
        self._database, self._sessions = database, sessions

    def __getitem__(self, session: str) -> OccupancyGrid:
        return self._database.grid(session)

    def __iter__(self) -> Iterator[str]:
        return iter(self._sessions)

    def __len__(self) -> int:
        return len(self._sessions)
