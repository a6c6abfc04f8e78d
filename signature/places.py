"""The places of a database, looked around at from many points when they are asked for.

A signature hardly minds whether it is taken half a metre off; what the eye sees in a cluttered room does.
So a place has one signature and many standpoints, close enough together for every view of a query to have
one beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, I64, BoolGrid, OccupancyGrid
from pc2grid.visibility import HIDDEN, look_around
from signature.config import SignatureConfig
from signature.nearest import Nearest, SignatureIndex, sessions_by_likeness
from signature.query import PROFILE_BEARINGS, QueryMap
from signature.similarity import SignatureTable

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

LATTICE_M = 0.4
"""Between standpoints: a view is at most 0.28 m from one of them, about what ranges are compared by."""
AT_ONCE_M2 = 200_000.0
"""A query is looked for in so much free floor at once: of a larger database, where it looks likeliest."""
_AROUND_M = 1.2
"""A standpoint farther than this from every place belongs to none."""
_CLEARANCE_M = 0.2


@dataclass(frozen=True, slots=True)
class Standpoints:
    """Points to stand at, K of them, at some places of the database.

    place : (K,) which of the places asked for each belongs to. at_m : (K, 2) in the map of `session` (K,).
    ranges_m : (K, B) float32, how far each ray reaches. seen : (K, B) whether its end is known.
    rasters : by session, the index of the standpoint in each square of the lattice, K where there is none,
    and the (column, row) of its first square.
    """

    place: I64
    at_m: F64
    session: I64
    ranges_m: F32
    seen: NDArray[np.bool_]
    rasters: Mapping[int, tuple[I64, I64]]

    @staticmethod
    def of(place: I64, at_m: F64, session: I64, ranges_m: F32, seen: NDArray[np.bool_]) -> Standpoints:
        """Standpoints with their rasters; in a square with several the one next to its middle counts."""
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
        return Standpoints(place, at_m, session, ranges_m, seen, rasters)

    def beside(self, at_m: F64, session: I64) -> I64:
        """Index of the standpoint in the square of each of the points (..., 2) in the maps of `session`
        (...), or K where there is none."""
        found = np.full(session.shape, len(self.at_m), np.int64)
        squares = np.rint(at_m / LATTICE_M).astype(np.int64)
        for number, (raster, low) in self.rasters.items():
            index = squares - low
            inside = (session == number) & ((index >= 0) & (index < raster.shape)).all(axis=-1)
            found[inside] = raster[tuple(index[inside].T)]
        return found


class Places:
    """All places, ready for retrieval.

    table : their signatures. sight_m : how far their isovists reach.

    A place is looked around at when it is first on a shortlist, so a large database is not gone through
    before the first question, and what nobody asks for takes no memory.
    """

    def __init__(
        self,
        table: SignatureTable,
        grids: Sequence[OccupancyGrid],
        sight_m: float,
        areas_m2: Sequence[float],
    ) -> None:
        """grids, areas_m2 : the map of each session and its free space, by session_index."""
        self.table = table
        self.sight_m = sight_m
        self.index = SignatureIndex.of(table)
        self._grids = grids
        self._areas_m2 = np.asarray(areas_m2, np.float64)
        self._grounds: dict[int, _Ground] = {}
        self._known: dict[int, tuple[F64, F32, NDArray[np.bool_]]] = {}
        self._last: tuple[I64, Standpoints] | None = None

    def shortlists(self, query: QueryMap, k: int, config: SignatureConfig) -> tuple[Nearest, ...]:
        """For each view of a query the `k` places nearest by their signatures; in a database of more than
        `AT_ONCE_M2`, those of them that lie in the likeliest sessions."""
        found = tuple(self.index.nearest(view.signature, k, config) for view in query.views)
        if self._areas_m2.sum() <= AT_ONCE_M2 or not found:
            return found
        sessions = sessions_by_likeness(found, self.table.session_index)
        chosen = sessions[np.cumsum(self._areas_m2[sessions]) <= max(AT_ONCE_M2, self._areas_m2[sessions[0]])]
        return tuple(near.only(np.isin(self.table.session_index[near.rows], chosen)) for near in found)

    def sessions(self, query: QueryMap, k: int, config: SignatureConfig) -> list[int]:
        """Where the whole query may be looked for: all sessions, or those of its `shortlists`."""
        if self._areas_m2.sum() <= AT_ONCE_M2:
            return list(range(len(self._areas_m2)))
        rows = [near.rows for near in self.shortlists(query, k, config)]
        return np.unique(self.table.session_index[np.concatenate(rows)]).tolist() if rows else []

    def around(self, rows: I64) -> Standpoints:
        """The standpoints at places (R,), and what is seen from there."""
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
        standpoints = Standpoints.of(place, at_m, session, ranges_m, seen)
        self._last = rows.copy(), standpoints
        return standpoints

    def _look_around(self, row: int) -> tuple[F64, F32, NDArray[np.bool_]]:
        """The place itself, and the points of a lattice over its map that no other place is nearer to."""
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
    """A session's map as what can be stood on, and whose it is.

    roomy : (H, W) free cells with room around them. rows : its places (N,), and their search tree.
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
