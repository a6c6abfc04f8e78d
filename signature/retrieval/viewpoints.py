"""The places of a database, each with the isovists of many viewpoints around it.

Signatures change little within half a metre; isovists in a cluttered room change a lot. So a place has one
signature and several viewpoints, close enough together for every view of a query to have one beside it.
Isovists are computed when a place is first on a shortlist.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, BoolGrid
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import HIDDEN, look_around
from signature.config import RelocalizeConfig, SignatureConfig
from signature.retrieval.place_index import PlaceBlock, PlaceIndex
from signature.retrieval.seen_index import SeenIndex
from signature.retrieval.signature_index import Nearest, SignatureIndex, sessions_by_likeness
from signature.retrieval.view import View
from signature.seen_places import PROFILE_BEARINGS, SeenPlaces
from signature.similarity import SignatureTable

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

T = TypeVar("T")

LATTICE_M = 0.4
"""Distance of viewpoints: a view is at most 0.28 m from one of them, about the scale of `LIKENESS`."""
AT_ONCE_M2 = 200_000.0
"""So much free floor is searched at once; of a larger database, the sessions that look likeliest. Chosen by
the time of a look-up."""
_KEPT_PLACES, _KEPT_GROUNDS = 50_000, 200
"""Places whose viewpoints are kept, and sessions whose grounds are: 150 MB each, of floors of 40 x 60 m."""
_AROUND_M = 1.2
"""A viewpoint farther than this from every place is left out: places are 1 m apart by default."""
_CLEARANCE_M = 0.2
"""A viewpoint is at least so far from walls and unknown cells."""


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
    """The places, ascending, that are compared with a query; for each view those of them with the nearest
    signatures; and the sessions that are searched, likeliest first."""

    rows: I64
    near: tuple[Nearest, ...]
    sessions: I64


class Places:
    """All places of a database, ready for retrieval.

    table : their signatures. sight_m : length of the rays of their isovists.

    The viewpoints of a place are computed when it is first selected, so that a large database answers its
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
        self._paper: SignatureIndex | None = None
        self._index: PlaceIndex | None = None
        self._described: dict[int, SeenPlaces] = {} if fewer is None else dict(fewer._described)
        self._areas_m2 = np.asarray(areas_m2, np.float64)
        self._grounds: dict[int, _Ground] = {} if fewer is None else dict(fewer._grounds)
        self._known: dict[int, tuple[F64, F32, NDArray[np.bool_]]] = (
            {} if fewer is None else dict(fewer._known)
        )
        self._last: tuple[I64, Viewpoints] | None = None
        self._selected: tuple[Sequence[View], RelocalizeConfig, Selected] | None = None

    def may_all_be_compared(self, most: int) -> bool:
        """Whether there are at most `most` places, and at most `AT_ONCE_M2` of free floor."""
        return len(self.table) <= most and not self.is_large

    @property
    def is_large(self) -> bool:
        """Whether there is more free floor than is searched at once."""
        return bool(self._areas_m2.sum() > AT_ONCE_M2)

    def select(self, views: Sequence[View], signature: SignatureConfig, config: RelocalizeConfig) -> Selected:
        """The places to compare with a query, `config.shortlist` for each view, by `PlaceIndex.select`; by
        Eq. 6 alone where `config.select_by` says so. The sessions are those of the places, in a large
        database up to `AT_ONCE_M2`.
        """
        if self._selected is None or self._selected[0] is not views or self._selected[1] is not config:
            self._selected = views, config, self._select(views, signature, config)
        return self._selected[2]

    def _select(
        self, views: Sequence[View], signature: SignatureConfig, config: RelocalizeConfig
    ) -> Selected:
        session_index = self.table.session_index
        if config.select_by == "paper":
            near = self.nearest_by_paper(views, config.shortlist, signature)
            rows = np.unique(np.concatenate([found.rows for found in near]))
            sessions = sessions_by_likeness(near, session_index)
        else:
            near = self.index().nearest_to_each(views)
            best = self.index().select(views, near, config.shortlist * len(views))
            rows, sessions = np.sort(best), _in_order(session_index[best])
        areas_m2 = self._areas_m2[sessions]
        sessions = sessions[np.cumsum(areas_m2) <= max(AT_ONCE_M2, areas_m2[0])]
        return Selected(rows, tuple(found.only(np.isin(found.rows, rows)) for found in near), sessions)

    def nearest_by_paper(
        self, views: Sequence[View], k: int, signature: SignatureConfig
    ) -> tuple[Nearest, ...]:
        """For each view the `k` places that are nearest by Eq. 6."""
        if self._paper is None:
            self._paper = SignatureIndex.of(self.table)
        return self._paper.nearest_to_each([view.signature for view in views], k, signature)

    def seen(self) -> SeenIndex:
        """The places by the signatures of what was seen."""
        return self.index().seen

    def index(self, on_progress: Callable[[float], None] = lambda share: None) -> PlaceIndex:
        """The places by the signatures of what was seen and their isovists; made when first asked for.

        on_progress : is told the share of the places that is done.
        """
        if self._index is None:
            self._index = PlaceIndex.of(self._blocks(on_progress), self.sight_m)
        return self._index

    def described(self) -> PlaceBlock:
        """What is seen from each place."""
        return PlaceBlock.concatenated(list(self._blocks()))

    def _blocks(self, on_progress: Callable[[float], None] = lambda share: None) -> Iterator[PlaceBlock]:
        """What is seen from each place, session by session: as stored, or else computed from the map and
        kept."""
        session_index, centers_m = self.table.session_index, self.table.center_m
        first = np.flatnonzero(np.diff(session_index, prepend=-1))
        for begin, end in zip(first.tolist(), [*first[1:].tolist(), len(session_index)], strict=False):
            session = int(session_index[begin])
            seen = self._described.get(begin) or self._stored(session)
            if seen is None or len(seen) != end - begin:
                seen = SeenPlaces.of(self._grids[session], centers_m[begin:end], self.sight_m)
                self._described[begin] = seen
            on_progress(end / len(session_index))
            yield PlaceBlock(seen, centers_m[begin:end], session_index[begin:end].astype(np.int64))

    def sessions(
        self, views: Sequence[View], signature: SignatureConfig, config: RelocalizeConfig
    ) -> list[int]:
        """Indices of the sessions to be searched as a whole: all, or those of the selected places."""
        if not self.is_large:
            return list(range(len(self._areas_m2)))
        return self.select(views, signature, config).sessions.tolist() if views else []

    def around(self, rows: I64) -> Viewpoints:
        """The viewpoints at the places `rows` (R,) of the table."""
        if self._last is not None and np.array_equal(self._last[0], rows):
            return self._last[1]
        for row in rows.tolist():
            if row not in self._known:
                self._known[row] = self._look_around(row)
        found = [self._known[row] for row in rows.tolist()]
        counts = np.array([len(at) for at, _, _ in found], np.int64)
        at_m, ranges_m, seen = (np.concatenate(part) for part in zip(*found, strict=True))
        session = np.repeat(self.table.session_index[rows].astype(np.int64), counts)
        place = np.repeat(np.arange(len(rows)), counts)
        viewpoints = Viewpoints.of(place, at_m, session, ranges_m, seen)
        self._last = rows.copy(), viewpoints
        _forget(self._known, _KEPT_PLACES)
        return viewpoints

    def _look_around(self, row: int) -> tuple[F64, F32, NDArray[np.bool_]]:
        """Viewpoints of a place: its centre, and the points of a lattice over its map that it is nearest to.

        Returns their positions (K, 2), ranges (K, B) and whether the ends of the rays are known (K, B).
        """
        center, session = self.table.center_m[row], int(self.table.session_index[row])
        grid = self._grids[session]
        if session not in self._grounds:
            _forget(self._grounds, _KEPT_GROUNDS - 1)
            self._grounds[session] = _Ground.of(grid, self.table, session)
        ground = self._grounds[session]
        steps = np.arange(np.floor(-_AROUND_M / LATTICE_M), np.ceil(_AROUND_M / LATTICE_M) + 1)
        lattice = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        points = (np.round(center / LATTICE_M) + lattice) * LATTICE_M
        distance, owner = ground.places.query(points)
        cells = grid.to_cell(points)
        inside = ((cells >= 0) & (cells < grid.cells.shape)).all(axis=1)
        inside &= (ground.rows[owner] == row) & (distance <= _AROUND_M)
        inside[inside] = ground.roomy[cells[inside, 0], cells[inside, 1]]
        at_m = np.concatenate((center[None], points[inside]))
        ranges_m, ends = look_around(grid, at_m, self.sight_m, bearings=PROFILE_BEARINGS)
        return at_m, ranges_m, ends != HIDDEN


@dataclass(frozen=True, slots=True)
class _Ground:
    """Where viewpoints of a session may lie, and which place each belongs to.

    roomy : (H, W) cells with free cells around them. rows : (N,) its places. places : search tree of them.
    """

    roomy: BoolGrid
    rows: I64
    places: cKDTree

    @staticmethod
    def of(grid: OccupancyGrid, table: SignatureTable, session: int) -> _Ground:
        from scipy.spatial import cKDTree

        rows = np.flatnonzero(table.session_index == session)
        return _Ground(_roomy(grid), rows, cKDTree(table.center_m[rows]))


def _in_order(sessions: NDArray[np.int32]) -> I64:
    """The different sessions, in the order in which they come first."""
    unique, first = np.unique(sessions, return_index=True)
    return unique[np.argsort(first)].astype(np.int64)


def _forget(kept: dict[int, T], most: int) -> None:
    """Leave the `most` entries that were added last."""
    for key in list(kept)[: max(0, len(kept) - most)]:
        del kept[key]


def _roomy(grid: OccupancyGrid) -> BoolGrid:
    import cv2

    n = round(_CLEARANCE_M / grid.resolution_m)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * n + 1, 2 * n + 1))
    return np.asarray(cv2.erode(grid.free.astype(np.uint8), kernel), bool)
