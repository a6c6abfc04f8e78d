"""The answers to one query in several maps, each by a `Localizer` of its own."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import cv2
import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.model import UNKNOWN, OccupancyGrid, RegisteredScan
from pc2grid.submaps.submaps import partition
from signature.config import Config
from signature.localization.answer import Answer
from signature.localization.localizer import Localizer
from signature.localization.map_index import MapIndex
from signature.localization.query import QueryMap
from signature.paper import SignatureTable, describe

T = TypeVar("T")
_WALL_M = 0.4
"""What a query has seen is widened by this: the far side of a wall does not count as unseen. By hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers:
    """The answers to a query after `scans` of its scans, one for each index. elapsed_ms : time of each."""

    scans: int
    query: QueryMap
    answers: tuple[Answer, ...]
    elapsed_ms: tuple[float, ...]


def localize(
    scans: Iterable[tuple[RegisteredScan, PlanarScan]],
    indexes: Sequence[MapIndex],
    *,
    after: Collection[int] | None = None,
) -> Iterator[Answers]:
    """Find where a registered recording was made, in each of several indexes separately.

    scans : with their planar scans, from `pc2grid.pipeline.follow`, in any frame of their own.
    indexes : at least one, of databases made with the same settings.
    after : numbers of scans after which the answers are wanted; by default after the last scan.

    Raises NoScans if an answer is due and no scan could be used.
    """
    localizers = [Localizer(index) for index in indexes]
    count, added_ms = 0, [0.0] * len(localizers)

    def answers() -> Answers:
        found = [_timed(localizer.answer) for localizer in localizers]
        return Answers(
            scans=count,
            query=localizers[0].query.map(),
            answers=tuple(answer for answer, _ in found),
            elapsed_ms=tuple(ms + add_ms for (_, ms), add_ms in zip(found, added_ms, strict=True)),
        )

    for count, scan in enumerate(scans, start=1):
        # After every metre this is a search, which is then the answer.
        added_ms = [_timed(partial(localizer.add, *scan))[1] for localizer in localizers]
        if after is not None and count in after:
            yield answers()
    if after is None:
        yield answers()


def _timed(action: Callable[[], T]) -> tuple[T, float]:
    """What an action returns, and its time in milliseconds."""
    begin = time.perf_counter()
    done = action()
    return done, 1000.0 * (time.perf_counter() - begin)


def index_of(name: str, grid: OccupancyGrid, config: Config) -> MapIndex:
    """A database of one map."""
    submaps = partition(grid, config.partition)
    table = SignatureTable.of([describe(s, config.signature) for s in submaps], [s.center_m for s in submaps])
    return MapIndex({name: grid}, table, config, config)


def unseen_by(query: QueryMap, grid: OccupancyGrid, T_map_query: SE2) -> OccupancyGrid:
    """A map in which all that a query has seen, placed at a pose, is made unknown."""
    n = math.ceil(_WALL_M / grid.resolution_m)
    known = (query.grid.cells != UNKNOWN).astype(np.uint8)
    known = cv2.dilate(known, np.ones((2 * n + 1, 2 * n + 1), np.uint8))
    cells = np.argwhere(grid.cells != UNKNOWN)
    at = query.grid.to_cell(T_map_query.inverse().apply(grid.to_point(cells)))
    inside = np.all((at >= 0) & (at < known.shape), axis=1)
    seen = cells[inside][known[tuple(at[inside].T)] > 0]
    left = grid.cells.copy()
    left[tuple(seen.T)] = UNKNOWN
    return replace(grid, cells=left)
