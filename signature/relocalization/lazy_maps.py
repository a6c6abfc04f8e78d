"""The maps of a database, read and prepared when they are first asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar, overload

from pc2grid.model import OccupancyGrid

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

T = TypeVar("T")


class LazySequence(Sequence[T]):
    """A sequence of `count` items, each made when it is first asked for, and kept."""

    def __init__(self, make: Callable[[int], T], count: int) -> None:
        self._make, self._count = make, count
        self._made: dict[int, T] = {}

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[T, ...]: ...

    def __getitem__(self, index: int | slice) -> T | tuple[T, ...]:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(self._count)))
        index = range(self._count)[index]
        if index not in self._made:
            self._made[index] = self._make(index)
        return self._made[index]


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
