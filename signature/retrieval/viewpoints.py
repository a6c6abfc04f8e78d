"""The places of a database: which of them a query is compared with, and what is seen around those.

A first look at the signatures of all places leaves out most, the signatures of viewpoints select from the
rest. Only around the selected places are isovists compared at every rotation, which says how the query lies
there; they are computed when a place is first selected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, BoolGrid
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import HIDDEN, look_around
from signature.config import RelocalizeConfig
from signature.retrieval.place_index import PlaceBlock, PlaceIndex
from signature.retrieval.place_signatures import PlaceSignatures
from signature.retrieval.view import View
from signature.seen_places import LATTICE_M, PROFILE_BEARINGS, SeenPlaces
from signature.similarity import SignatureTable

T = TypeVar("T")

AT_ONCE_M2 = 200_000.0
"""So much free floor is searched at once; of a larger database, the sessions that look likeliest. Chosen by
the time of a look-up."""
_KEPT_PLACES, _KEPT_SESSIONS = 50_000, 1000
"""Places whose isovists are kept, and sessions whose viewpoints are: 0.5 MB each, of floors of 40 x 60 m."""


@dataclass(frozen=True, slots=True)
class Viewpoints:
    """K viewpoints at some places of the database.

    place : (K,) index into the places asked for. at_m : (K, 2) in the map of `session` (K,).
    ranges_m : (K, B) float32, length of each ray of the isovist. seen : (K, B) whether its end is known.
    rasters : by session, the index of the viewpoint in each square of the lattice, K where there is none,
    and the (column, row) of its first square.
    """

    place: I64
    at_m: F64
    session: I64
    ranges_m: F32
    seen: NDArray[np.bool_]
    rasters: Mapping[int, tuple[I64, I64]]

    @staticmethod
    def of(place: I64, at_m: F64, session: I64, ranges_m: F32, seen: NDArray[np.bool_]) -> Viewpoints:
        """Viewpoints with their rasters; a square with several viewpoints holds the one next to its
        centre."""
        squares = np.rint(at_m / LATTICE_M)
        off = np.abs(squares * LATTICE_M - at_m).max(axis=1)
        rasters = {}
        for number in np.unique(session).tolist():
            members = np.flatnonzero(session == number)
            members = members[np.argsort(-off[members], kind="stable")]
            inside = squares[members].astype(np.int64)
            low = inside.min(axis=0)
            raster = np.full(inside.max(axis=0) - low + 1, len(at_m), np.int64)
            raster[tuple((inside - low).T)] = members
            rasters[number] = raster, low
        return Viewpoints(place, at_m, session, ranges_m, seen, rasters)

    def beside(self, at_m: F64, session: I64) -> I64:
        """Index (...) of the viewpoint in the square of each of the points (..., 2), which lie in the maps
        of `session` (...); K where there is none."""
        found = np.full(session.shape, len(self.at_m), np.int64)
        squares = np.rint(at_m / LATTICE_M).astype(np.int64)
        for number, (raster, low) in self.rasters.items():
            index = squares - low
            inside = (session == number) & ((index >= 0) & (index < raster.shape)).all(axis=-1)
            found[inside] = raster[tuple(index[inside].T)]
        return found


@dataclass(frozen=True, slots=True)
class Selected:
    """The places, ascending, that are compared with a query, and the sessions that are searched, likeliest
    first."""

    rows: I64
    sessions: I64


class Places:
    """All places of a database, ready for retrieval.

    table : their signatures. sight_m : length of the rays of their isovists.

    The isovists around a place are computed when it is first selected, so that a large database answers its
    first question soon and places that are not asked for take no memory.
    """

    def __init__(
        self,
        table: SignatureTable,
        grids: Sequence[OccupancyGrid],
        sight_m: float,
        areas_m2: Sequence[float],
        fewer: Places | None = None,
        stored: Callable[[int], SeenPlaces | None] = lambda session: None,
    ) -> None:
        """grids, areas_m2 : the map of each session and its free space in m^2, by session_index.

        fewer : the places of the first of these sessions; viewpoints that it has computed are taken over.
        stored : what is seen from the places of a session, if it need not be computed from the map.
        """
        self.table = table
        self.sight_m = sight_m
        self._grids, self._stored = grids, stored
        self._index: PlaceIndex | None = None
        self._chance = np.random.default_rng(0)
        self._described: dict[int, SeenPlaces] = {} if fewer is None else dict(fewer._described)
        self._areas_m2 = np.asarray(areas_m2, np.float64)
        self._known: dict[int, tuple[F64, F32, NDArray[np.bool_]]] = (
            {} if fewer is None else dict(fewer._known)
        )
        self._last: tuple[I64, Viewpoints] | None = None
        self._selected: tuple[Sequence[View], RelocalizeConfig, Selected] | None = None

    @property
    def is_large(self) -> bool:
        """Whether there is more free floor than is searched at once."""
        return bool(self._areas_m2.sum() > AT_ONCE_M2)

    def select(self, views: Sequence[View], config: RelocalizeConfig) -> Selected:
        """The places to compare with a query, `shortlist_size` of them, by `PlaceSignatures.likely` and then
        `PlaceIndex.select`, or by a control (`RelocalizeConfig.shortlist_by`). The sessions are those of the
        places, in a large database up to `AT_ONCE_M2`.
        """
        if self._selected is None or self._selected[0] is not views or self._selected[1] is not config:
            self._selected = views, config, self._select(views, config)
        return self._selected[2]

    def _select(self, views: Sequence[View], config: RelocalizeConfig) -> Selected:
        session_index, most = self.table.session_index, shortlist_size(len(self.table), config)
        if config.shortlist_by == "random":
            best = self._chance.permutation(len(self.table))[:most]
        else:
            shuffled = config.shortlist_by == "shuffled"
            likely = None if shuffled else self.likely(views, most)
            best = (self._shuffled if shuffled else self.index()).select(views, most, likely)
        rows, sessions = np.sort(best), _in_order(session_index[best])
        if not self.is_large or not len(sessions):
            return Selected(rows, sessions)
        areas_m2 = self._areas_m2[sessions]
        sessions = sessions[np.cumsum(areas_m2) <= max(AT_ONCE_M2, areas_m2[0])]
        return Selected(rows[np.isin(session_index[rows], sessions)], sessions)

    def likely(self, views: Sequence[View], most: int) -> BoolGrid | None:
        """The places (N,) that a first look by the signatures of the places leaves; None if it cannot be
        taken, because they were made with other bins."""
        return None if self._first_look is None else self._first_look.likely(views, most)

    @cached_property
    def _first_look(self) -> PlaceSignatures | None:
        return PlaceSignatures.of(self.table)

    def without_histograms(self) -> None:
        """Forget the histograms of the places, which a large database has no memory for; their short vectors
        stay."""
        assert self._first_look is None or len(self._first_look.vectors) == len(self.table)
        self.table = self.table.without_histograms()

    def index(self, on_progress: Callable[[float], None] = lambda share: None) -> PlaceIndex:
        """The viewpoints of all places with their signatures; made when first asked for.

        on_progress : is told the share of the places that is done.
        """
        if self._index is None:
            self._index = PlaceIndex.of(self.blocks(on_progress))
        return self._index

    @cached_property
    def _shuffled(self) -> PlaceIndex:
        """The same viewpoints, each with the signatures of another one: a control."""
        return self.index().shuffled(self._chance)

    def blocks(self, on_progress: Callable[[float], None] = lambda share: None) -> Iterator[PlaceBlock]:
        """What is seen from the places of each session: as stored, or else computed from the map."""
        starts = np.flatnonzero(np.diff(self.table.session_index, prepend=-1))
        for begin in starts.tolist():
            seen = self._seen(int(self.table.session_index[begin]))
            on_progress((begin + len(np.unique(seen.place))) / len(self.table))
            yield PlaceBlock(seen, begin)
        on_progress(1.0)

    def _seen(self, session: int) -> SeenPlaces:
        """What is seen from the places of a session; kept."""
        if session not in self._described:
            rows = self._rows(session)
            seen = self._stored(session)
            if seen is None or (len(seen) and seen.place[-1] >= rows.stop - rows.start):
                seen = SeenPlaces.of(self._grids[session], self.table.center_m[rows], self.sight_m)
            _forget(self._described, _KEPT_SESSIONS - 1)
            self._described[session] = seen
        return self._described[session]

    def _rows(self, session: int) -> slice:
        """The places of a session in the table, which are side by side."""
        first, end = np.searchsorted(self.table.session_index, (session, session + 1))
        return slice(int(first), int(end))

    def sessions(self, views: Sequence[View], config: RelocalizeConfig) -> list[int]:
        """Indices of the sessions to be searched as a whole: all, or those of the selected places."""
        if not self.is_large:
            return list(range(len(self._areas_m2)))
        return self.select(views, config).sessions.tolist() if views else []

    def around(self, rows: I64) -> Viewpoints:
        """The viewpoints at the places `rows` (R,) of the table, with their isovists."""
        if self._last is not None and np.array_equal(self._last[0], rows):
            return self._last[1]
        self._look_around(np.array([row for row in rows.tolist() if row not in self._known], np.int64))
        found = [self._known[row] for row in rows.tolist()]
        counts = np.array([len(at) for at, _, _ in found], np.int64)
        at_m, ranges_m, seen = (np.concatenate(part) for part in zip(*found, strict=True))
        session = np.repeat(self.table.session_index[rows].astype(np.int64), counts)
        place = np.repeat(np.arange(len(rows)), counts)
        viewpoints = Viewpoints.of(place, at_m, session, ranges_m, seen)
        self._last = rows.copy(), viewpoints
        _forget(self._known, _KEPT_PLACES)
        return viewpoints

    def _look_around(self, rows: I64) -> None:
        """Cast the rays at the viewpoints of places: positions (K, 2), ranges (K, B) and whether the ends of
        the rays are known (K, B), for each."""
        for session in np.unique(self.table.session_index[rows]).tolist():
            seen, first = self._seen(session), self._rows(session).start
            asked = np.sort(rows[self.table.session_index[rows] == session])
            chosen = np.flatnonzero(np.isin(seen.place, asked - first))
            at_m = seen.at_m[chosen].astype(np.float64)
            ranges_m, ends = look_around(self._grids[session], at_m, self.sight_m, bearings=PROFILE_BEARINGS)
            known = ends != HIDDEN
            bounds = np.searchsorted(seen.place[chosen] + first, asked, side="left").tolist()
            for row, begin, end in zip(asked.tolist(), bounds, [*bounds[1:], len(chosen)], strict=True):
                self._known[row] = at_m[begin:end], ranges_m[begin:end], known[begin:end]


def shortlist_size(places: int, config: RelocalizeConfig) -> int:
    """How many places are compared with a query."""
    return max(config.shortlist, min(math.ceil(config.shortlist_share * places), config.shortlist_most))


def _in_order(sessions: NDArray[np.int32]) -> I64:
    """The different sessions, in the order in which they come first."""
    unique, first = np.unique(sessions, return_index=True)
    return unique[np.argsort(first)].astype(np.int64)


def _forget(kept: dict[int, T], most: int) -> None:
    """Leave the `most` entries that were added last."""
    for key in list(kept)[: max(0, len(kept) - most)]:
        del kept[key]
