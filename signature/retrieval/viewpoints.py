"""The places of a database, each with the isovists of many viewpoints around it.

Signatures change little within half a metre; isovists in a cluttered room change a lot. So a place has one
signature and several viewpoints, close enough together for every view of a query to have one beside it.
Isovists are computed when a place is first on a shortlist.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, BoolGrid
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import HIDDEN, look_around
from signature.config import RelocalizeConfig, SelectBy, SignatureConfig
from signature.retrieval.place_index import PlaceBlock, PlaceIndex
from signature.retrieval.seen_index import SeenIndex
from signature.retrieval.signature_index import Nearest, SignatureIndex, sessions_by_likeness
from signature.retrieval.view import PROFILE_BEARINGS, View
from signature.seen import seen_signatures
from signature.similarity import SignatureTable

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

LATTICE_M = 0.4
"""Distance of viewpoints: a view is at most 0.28 m from one of them, about the scale of `LIKENESS`."""
AT_ONCE_M2 = 200_000.0
"""So much free floor is searched at once; of a larger database, the sessions that look likeliest. Chosen by
the time of a look-up."""
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


class Places:
    """All places of a database, ready for retrieval.

    table : their signatures. sight_m : length of the rays of their isovists.

    The isovists of a place are computed when it is first on a shortlist, so that a large database answers its
    first question soon and places that are not asked for take no memory.
    """

    def __init__(
        self,
        table: SignatureTable,
        grids: Sequence[OccupancyGrid],
        sight_m: float,
        areas_m2: Sequence[float],
        fewer: Places | None = None,
    ) -> None:
        """grids, areas_m2 : the map of each session and its free space in m^2, by session_index.

        fewer : the places of the first of these sessions; viewpoints that it has computed are taken over.
        """
        self.table = table
        self.sight_m = sight_m
        self._grids = grids
        self._paper: SignatureIndex | None = None
        self._index: PlaceIndex | None = None
        self._described: PlaceBlock | None = None if fewer is None else fewer._described
        self._areas_m2 = np.asarray(areas_m2, np.float64)
        self._grounds: dict[int, _Ground] = {} if fewer is None else dict(fewer._grounds)
        self._known: dict[int, tuple[F64, F32, NDArray[np.bool_]]] = (
            {} if fewer is None else dict(fewer._known)
        )
        self._last: tuple[I64, Viewpoints] | None = None

    def may_all_be_compared(self, most: int) -> bool:
        """Whether there are at most `most` places, and at most `AT_ONCE_M2` of free floor."""
        return len(self.table) <= most and self._areas_m2.sum() <= AT_ONCE_M2

    def select(
        self, views: Sequence[View], signature: SignatureConfig, config: RelocalizeConfig
    ) -> tuple[I64, tuple[Nearest, ...]]:
        """The places, ascending, to compare with a query, `config.shortlist` for each view; and for each view
        those of them with the nearest signatures.

        By `PlaceIndex.select`; by the signatures alone where `shortlists` uses Eq. 6.
        """
        if config.select_by == "paper" or self._areas_m2.sum() > AT_ONCE_M2:
            found = self.shortlists(views, config.shortlist, signature, config.select_by)
            return np.unique(np.concatenate([near.rows for near in found])), found
        index = self.index()
        near = index.nearest_to_each(views)
        rows = index.select(views, near, config.shortlist * len(views))
        return rows, tuple(found.only(np.isin(found.rows, rows)) for found in near)

    def shortlists(
        self, views: Sequence[View], k: int, config: SignatureConfig, select_by: SelectBy = "seen"
    ) -> tuple[Nearest, ...]:
        """For each view of a query the `k` places nearest by their signatures; in a database of more than
        `AT_ONCE_M2`, those of them that lie in the likeliest sessions.

        select_by : "seen", the signatures of what was seen, or "paper", Eq. 6. In a database of more than
        `AT_ONCE_M2` it is Eq. 6, because the others would have to be computed from all of its maps.
        """
        large = self._areas_m2.sum() > AT_ONCE_M2
        if select_by == "paper" or large:
            if self._paper is None:
                self._paper = SignatureIndex.of(self.table)
            found = self._paper.nearest_to_each([view.signature for view in views], k, config)
        else:
            found = self.seen().nearest_to_each([view.profile for view in views], k)
        if not large or not found:
            return found
        sessions = sessions_by_likeness(found, self.table.session_index)
        chosen = sessions[np.cumsum(self._areas_m2[sessions]) <= max(AT_ONCE_M2, self._areas_m2[sessions[0]])]
        return tuple(near.only(np.isin(self.table.session_index[near.rows], chosen)) for near in found)

    def seen(self) -> SeenIndex:
        """The places by the signatures of what was seen."""
        return self.index().seen

    def index(self) -> PlaceIndex:
        """The places by the signatures of what was seen and their isovists."""
        if self._index is None:
            self._index = PlaceIndex.of([self.described()], self.sight_m)
        return self._index

    def described(self) -> PlaceBlock:
        """What was seen from each place; computed from the maps when it is first asked for, 0.2 ms a
        place."""
        known = 0 if self._described is None else len(self._described.session)
        if self._described is None or known < len(self.table):
            sessions, centers_m = self.table.session_index[known:], self.table.center_m[known:]
            ranges_m = np.empty((len(sessions), PROFILE_BEARINGS), np.float32)
            ends = np.empty(ranges_m.shape, np.int8)
            for session in np.unique(sessions).tolist():
                here = sessions == session
                ranges_m[here], ends[here] = look_around(
                    self._grids[session], centers_m[here], self.sight_m, bearings=PROFILE_BEARINGS
                )
            signatures = seen_signatures(ranges_m, ends, self.sight_m)
            found = PlaceBlock(signatures, ranges_m, ends, centers_m, sessions.astype(np.int64))
            if self._described is not None:
                found = PlaceBlock.concatenated((self._described, found))
            self._described = found
        return self._described

    def sessions(self, views: Sequence[View], k: int, config: SignatureConfig) -> list[int]:
        """Indices of the sessions to be searched as a whole: all, or those of the `shortlists`."""
        if self._areas_m2.sum() <= AT_ONCE_M2:
            return list(range(len(self._areas_m2)))
        rows = [near.rows for near in self.shortlists(views, k, config)]
        return np.unique(self.table.session_index[np.concatenate(rows)]).tolist() if rows else []

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
        return viewpoints

    def _look_around(self, row: int) -> tuple[F64, F32, NDArray[np.bool_]]:
        """Viewpoints of a place: its centre, and the points of a lattice over its map that it is nearest to.

        Returns their positions (K, 2), ranges (K, B) and whether the ends of the rays are known (K, B).
        """
        center, session = self.table.center_m[row], int(self.table.session_index[row])
        grid = self._grids[session]
        if session not in self._grounds:
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


def _roomy(grid: OccupancyGrid) -> BoolGrid:
    import cv2

    n = round(_CLEARANCE_M / grid.resolution_m)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * n + 1, 2 * n + 1))
    return np.asarray(cv2.erode(grid.free.astype(np.uint8), kernel), bool)
