"""Which places of the database look like the query's views?

Two steps, cheap first. The three signatures (Eq. 6) rank all places; they know no direction and no
order, so one matrix product serves a million of them. For the places on that shortlist the isovists'
ranges are laid over each other at every rotation, rays that either side has not observed left out; the
best overlap re-ranks them, and says how the query would have to be turned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, I64, OccupancyGrid
from pc2grid.visibility import HIDDEN, isovist
from signature.config import RelocalizeConfig, SignatureConfig
from signature.nearest import SignatureIndex
from signature.query import PROFILE_BEARINGS, QueryMap
from signature.similarity import SignatureTable

RANGE_SCALE_M = 0.4
"""Half of the likeness is gone at this difference of two ranges: about the offset between a view and the
nearest place of the database."""
_SPREAD_FLOOR = 1e-3
PRIOR_SHARE = 0.15
"""Rays' worth of doubt, as a share of the circle: a likeness of few common rays counts for less."""


class Places:
    """The places of a database, ready for retrieval.

    table : their signatures. sight_m : how far their isovists reach.

    A place is looked around at when it is first on a shortlist, so a large database is not gone through
    before the first question, and what nobody asks for takes no memory.
    """

    def __init__(self, table: SignatureTable, grids: Mapping[int, OccupancyGrid], sight_m: float) -> None:
        """grids : the map of each session, by session_index."""
        self.table = table
        self.sight_m = sight_m
        self.index = SignatureIndex.of(table)
        self._grids = grids
        shape = (len(table), PROFILE_BEARINGS)
        self._ranges_m, self._seen = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
        self._known = np.zeros(len(table), np.bool_)

    def around(self, rows: I64) -> tuple[F32, NDArray[np.bool_]]:
        """Isovists of places: how far each ray reaches (K, B), and whether its end is known (K, B)."""
        for i in rows[~self._known[rows]]:
            x, y = self.table.center_m[i]
            grid = self._grids[int(self.table.session_index[i])]
            view = isovist(grid, (float(x), float(y)), self.sight_m, bearings=PROFILE_BEARINGS)
            self._ranges_m[i], self._seen[i], self._known[i] = view.ranges_m, view.ends != HIDDEN, True
        return self._ranges_m[rows], self._seen[rows]


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """A view of the query may be at a place of the database.

    view : index into the query's views. row : row of the table.
    likeness : standard deviations above what the view finds on its whole shortlist.
    yaw_rad : rotations from the query's frame into the map's under which they look alike, best first.
    """

    view: int
    row: int
    likeness: float
    yaw_rad: tuple[float, ...]


def retrieve(
    query: QueryMap,
    places: Places,
    *,
    signature: SignatureConfig,
    config: RelocalizeConfig,
    top_k: int | None = None,
) -> tuple[Proposal, ...]:
    """The `top_k` (default `config.top_k`) most promising places, each with the view that likes it best.

    Ties are broken by row, so equal inputs give equal answers.
    """
    if not query.views or not len(places.table):
        return ()
    best: dict[int, Proposal] = {}
    for index, view in enumerate(query.views):
        found = places.index.nearest(view.signature, config.shortlist, signature)
        rows, apart = found.rows, (found.scores - found.mean) / max(found.spread, 1e-12)
        overlap = rotate_and_compare(view.profile.ranges_m, view.profile.ends != HIDDEN, *places.around(rows))
        turns = peaks(overlap)
        # The signatures keep their say: two places whose ranges agree are told apart by what lies between.
        likeness = overlap.max(axis=1) * np.exp(-config.signature_weight * apart)
        # A view that looks like everywhere says little, so each speaks by how far a place stands out to it.
        likeness = (likeness - likeness.mean()) / (likeness.std() + _SPREAD_FLOOR)
        for position, row in enumerate(rows):
            value = float(likeness[position])
            if int(row) not in best or value > best[int(row)].likeness:
                best[int(row)] = Proposal(
                    view=index, row=int(row), likeness=value, yaw_rad=tuple(turns[position].tolist())
                )
    ranked = sorted(best.values(), key=lambda p: (-p.likeness, p.row))
    return tuple(ranked[: top_k or config.top_k])


@numba.njit(cache=True, nogil=True, fastmath=True)
def _overlap(
    ranges: F32,
    seen: NDArray[np.bool_],
    others: F32,
    others_seen: NDArray[np.bool_],
    scale: float,
    doubt: float,
) -> F32:
    n, bearings = others.shape
    out = np.empty((n, bearings), np.float32)
    inverse, one = np.float32(1.0 / scale), np.float32(1.0)
    own, counts = ranges * inverse, seen.astype(np.float32)
    # The other's rays twice over, so that every rotation is one straight run of them.
    other, known = np.empty(2 * bearings, np.float32), np.empty(2 * bearings, np.float32)
    for i in range(n):
        for k in range(bearings):
            other[k] = other[k + bearings] = others[i, k] * inverse
            known[k] = known[k + bearings] = others_seen[i, k]
        for shift in range(bearings):
            turned, both = other[shift : shift + bearings], known[shift : shift + bearings]
            total, count = np.float32(0.0), np.float32(doubt)
            for k in range(bearings):
                weight = counts[k] * both[k]
                d = own[k] - turned[k]
                total += weight / (one + d * d)
                count += weight
            out[i, shift] = total / count
    return out


def rotate_and_compare(
    ranges_m: F32, seen: NDArray[np.bool_], others_m: F32, others_seen: NDArray[np.bool_]
) -> F32:
    """Likeness (N, B), 0..1, of one isovist (B,) with others (N, B), for each rotation by 2 pi s / B.

    Only rays whose ends both sides know are compared, by a Cauchy kernel of their difference.
    """
    result: F32 = _overlap(
        np.ascontiguousarray(ranges_m),
        np.ascontiguousarray(seen),
        np.ascontiguousarray(others_m),
        np.ascontiguousarray(others_seen),
        RANGE_SCALE_M,
        PRIOR_SHARE * len(ranges_m),
    )
    return result


def peaks(overlap: F32, most: int = 4) -> F64:
    """The rotations (N, most), radians, at which each row of `overlap` (N, B) has its highest local maxima.

    A row with fewer maxima repeats its highest one.
    """
    local = (overlap >= np.roll(overlap, 1, axis=1)) & (overlap >= np.roll(overlap, -1, axis=1))
    height = np.where(local, overlap, -1.0)
    shifts = np.argsort(-height, axis=1, kind="stable")[:, :most]
    missing = np.take_along_axis(height, shifts, axis=1) < 0
    shifts = np.where(missing, shifts[:, :1], shifts)
    return np.asarray(shifts * (2.0 * math.pi / overlap.shape[1]))
