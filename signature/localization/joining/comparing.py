"""Pairs of sessions compared: one after the other in this process, or in several processes at once.

A pair is compared alone, so the result is the same wherever it is compared.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

from pc2grid.errors import ClusterError
from signature.cluster import connected
from signature.database import open_database
from signature.localization.joining.join import Join, JoinableMap, join_maps

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

_KEPT = 8
"""Prepared maps that stay in the memory of a process."""
_AT_ONCE = 8
"""Pairs that a process is given at once: several share a map, and few are lost if all is killed."""


@dataclass(frozen=True, slots=True)
class ToCompare:
    """Two sessions by their names. labelled : labels say that both are of one floor of one building."""

    target: str
    source: str
    labelled: bool


Compare = Callable[[Sequence[ToCompare]], Iterator[Join]]
"""What compares pairs, and yields their joins in their order."""


def compare_here(database: SubmapDatabase, pairs: Sequence[ToCompare]) -> Iterator[Join]:
    """Compare pairs one after the other."""
    sight_m = database.config().partition.radius_m

    @functools.lru_cache(_KEPT)
    def prepared(name: str) -> JoinableMap:
        return JoinableMap.of(database.grid(name), database.graph(name), sight_m)

    for pair in pairs:
        yield join_maps(prepared(pair.target), prepared(pair.source), labelled=pair.labelled)


@contextlib.contextmanager
def comparing_in_processes(place: str, address: str, processes: int) -> Iterator[Compare]:
    """What compares pairs on the workers of a Dask scheduler. They read the database themselves.

    place : absolute path or URL of the database. address, processes : see `signature.cluster.connected`.

    Raises ClusterError if the cluster cannot be reached or goes away.
    """
    with connected(address, processes) as client:

        def compare(pairs: Sequence[ToCompare]) -> Iterator[Join]:
            parts = [pairs[k : k + _AT_ONCE] for k in range(0, len(pairs), _AT_ONCE)]
            futures = [client.submit(_compare_there, place, part, pure=False) for part in parts]
            return chain.from_iterable(map(_result, futures))

        yield compare


def _compare_there(place: str, pairs: Sequence[ToCompare]) -> list[Join]:
    with open_database(place) as database:
        return list(compare_here(database, pairs))


def _result(future: Any) -> list[Join]:
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError

    try:
        joins: list[Join] = future.result()
    except (KilledWorker, FutureCancelledError, OSError) as error:
        raise ClusterError(
            "the processes that compare sessions went away",
            hint="what was compared is kept; the same command continues from there",
        ) from error
    return joins
