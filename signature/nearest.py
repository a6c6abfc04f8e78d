"""The submaps nearest to a query by Eq. 6, of a million, without looking at all of them closely.

Merging bins never lowers the Bhattacharyya coefficient of two histograms (Cauchy-Schwarz, group by group).
So a sketch of each submap, its merged histograms in 16 bits a bin, bounds its distance to any query from
below. All sketches are read; the distance itself is worked out only where the bound leaves it open. What
comes back is the exact answer, not an approximate one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, I64
from signature.config import SignatureConfig
from signature.describe import Signature
from signature.similarity import FARTHEST, SignatureTable, distances

DIRECT = 4096
"""Tables up to this size are compared row by row, which takes no longer."""
_BOUNDARY_BINS, _FREESPACE_BINS = 2, 6
"""Bins in a group; the free-space histogram has a tenth of the say and may be coarser."""
_UNIT = np.float32(1.0 / 65535)
_BLOCK = 1024  # rows at a time, so that their sums stay in the first cache
_SLACK = np.float32(1e-5)  # more than float32 rounds away of a coefficient


class Nearest(NamedTuple):
    """The rows nearest to a query.

    rows (K,), scores (K,) : by Eq. 6, nearest first. mean, spread : of the scores of the whole table, from
    every so many rows if it is larger than `DIRECT`.
    """

    rows: I64
    scores: F64
    mean: float
    spread: float

    def only(self, kept: NDArray[np.bool_]) -> Nearest:
        """Those of the rows that are `kept` (K,)."""
        return self._replace(rows=self.rows[kept], scores=self.scores[kept])


def sessions_by_likeness(found: Sequence[Nearest], session_index: NDArray[np.int32]) -> I64:
    """The sessions (S,) of all the rows in `found`, likeliest first.

    A session is as likely as the nearest of its rows stand out, in standard deviations, in all the lists
    together; where it has none, it counts as the last row there.
    """
    sessions = np.unique(session_index[np.concatenate([near.rows for near in found])])
    total = np.zeros(len(sessions))
    for near in found:
        apart = (near.scores - near.mean) / max(near.spread, 1e-12)
        best = np.full(len(sessions), apart.max())
        np.minimum.at(best, np.searchsorted(sessions, session_index[near.rows]), apart)
        total += best
    return sessions[np.argsort(total, kind="stable")].astype(np.int64)


@dataclass(frozen=True, slots=True)
class SignatureIndex:
    """A table with sketches of its rows.

    sketch : (G, N) uint16, square roots of the merged bins in units of 1 / 65535, rounded up; boundary
        first. Empty for tables of up to `DIRECT` rows.
    """

    table: SignatureTable
    sketch: NDArray[np.uint16]

    @staticmethod
    def of(table: SignatureTable) -> SignatureIndex:
        """Sketch every row. ValueError if a histogram sums to more than 1."""
        if len(table) <= DIRECT:
            return SignatureIndex(table, np.empty((0, 0), np.uint16))
        parts = (table.boundary, _BOUNDARY_BINS), (table.freespace, _FREESPACE_BINS)
        sketch = np.empty((sum(-(-h.shape[1] // merged) for h, merged in parts), len(table)), np.uint16)
        done = 0
        for histograms, merged in parts:
            rows = sketch[done : done + -(-histograms.shape[1] // merged)]
            if _sketch(np.ascontiguousarray(histograms), merged, rows) > 1.0 + 1e-4:
                raise ValueError("a histogram that sums to more than 1")
            done += len(rows)
        return SignatureIndex(table, sketch)

    def nearest(self, query: Signature, k: int, config: SignatureConfig) -> Nearest:
        """The first `k` rows by (distance, row): as if all had been compared."""
        n = len(self.table)
        if n <= DIRECT or 2 * k >= n:
            score = distances(query, self.table, config)
            rows = np.argsort(score, kind="stable")[:k]
            return Nearest(rows, score[rows], float(score.mean()), float(score.std()))
        bound = self._bounds(query, config)
        # A sample of the bounds says where to cut for the k best of them and some more.
        step = n // DIRECT
        sample = np.sort(bound[::step])
        cut = sample[min(2 * k // step + 8, len(sample) - 1)]
        rows = np.flatnonzero(bound <= cut)
        if len(rows) < k:
            cut = np.partition(bound, k)[k]
            rows = np.flatnonzero(bound <= cut)
        score = self._scores(query, rows, config)
        farthest = np.partition(score, k - 1)[k - 1]
        if farthest > cut:
            left = np.flatnonzero((bound > cut) & (bound <= farthest))
            rows = np.concatenate((rows, left))
            score = np.concatenate((score, self._scores(query, left, config)))
        order = np.lexsort((rows, score))[:k]
        sampled = self._scores(query, np.arange(0, n, step), config)
        return Nearest(rows[order], score[order], float(sampled.mean()), float(sampled.std()))

    def _scores(self, query: Signature, rows: I64, config: SignatureConfig) -> F64:
        """What `distances` says of some rows, read where they lie."""
        out = np.empty(len(rows))
        _score(
            self.table.boundary,
            self.table.freespace,
            self.table.symmetry,
            rows,
            np.sqrt(query.boundary.astype(np.float64)),
            np.sqrt(query.freespace.astype(np.float64)),
            query.symmetry.astype(np.float64),
            0.5 / config.symmetry_sigma**2,
            config.weight_boundary,
            config.symmetry_scale**2,
            config.histogram_distance == "hellinger",
            out,
        )
        return out

    def _bounds(self, query: Signature, config: SignatureConfig) -> F32:
        """(N,) no more than the distance of each row to the query."""
        boundary, freespace = (
            np.sqrt(np.add.reduceat(h, np.arange(0, len(h), merged), dtype=np.float64))
            for h, merged in ((query.boundary, _BOUNDARY_BINS), (query.freespace, _FREESPACE_BINS))
        )
        weights = np.concatenate((boundary, freespace)).astype(np.float32) * _UNIT
        if len(weights) != len(self.sketch):
            raise ValueError("histograms of another number of bins: other radius or bin width")
        out = np.empty(len(self.table), np.float32)
        _bound(
            self.sketch,
            weights,
            len(boundary),
            self.table.symmetry,
            query.symmetry.astype(np.float32),
            np.float32(0.5 / config.symmetry_sigma**2),
            np.float32(config.weight_boundary),
            np.float32(config.symmetry_scale**2),
            config.histogram_distance == "hellinger",
            out,
        )
        return out


@numba.njit(cache=True, nogil=True)
def _sketch(histograms: F32, merged: int, out: NDArray[np.uint16]) -> float:
    """Fill `out` (G, N); returns the largest sum of a histogram."""
    n, bins = histograms.shape
    largest = np.float32(0.0)
    for first in range(0, n, _BLOCK):
        for i in range(first, min(first + _BLOCK, n)):
            total = np.float32(0.0)
            for g in range(len(out)):
                mass = np.float32(0.0)
                for b in range(g * merged, min((g + 1) * merged, bins)):
                    mass += histograms[i, b]
                out[g, i] = np.uint16(min(np.ceil(np.sqrt(mass) / _UNIT), np.float32(65535)))
                total += mass
            largest = max(largest, total)
    return float(largest)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _bound(
    sketch: NDArray[np.uint16],
    weights: F32,
    boundary_groups: int,
    symmetry: F32,
    own_symmetry: F32,
    sharpness: np.float32,
    weight_boundary: np.float32,
    scale: np.float32,
    hellinger: bool,
    out: F32,
) -> None:
    groups, n = sketch.shape
    zero, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    b, f = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    for first in range(0, n, _BLOCK):
        size = min(_BLOCK, n - first)
        s, o = symmetry[first : first + size], out[first : first + size]
        b[:], f[:] = _SLACK, _SLACK
        for g in range(boundary_groups):
            weight, row = weights[g], sketch[g, first : first + size]
            for i in range(size):
                b[i] += weight * np.float32(row[i])
        for g in range(boundary_groups, groups):
            weight, row = weights[g], sketch[g, first : first + size]
            for i in range(size):
                f[i] += weight * np.float32(row[i])
        # One loop for each distance: a choice inside would keep it from being vectorised.
        if hellinger:
            for i in range(size):
                d = weight_boundary * np.sqrt(max(one - b[i], zero))
                o[i] = d + (one - weight_boundary) * np.sqrt(max(one - f[i], zero))
        else:
            for i in range(size):
                d = weight_boundary * min(-np.log(min(b[i], one)), np.float32(FARTHEST))
                o[i] = d + (one - weight_boundary) * min(-np.log(min(f[i], one)), np.float32(FARTHEST))
        for i in range(size):
            d0, d1 = s[i, 0] - own_symmetry[0], s[i, 1] - own_symmetry[1]
            x = min((d0 * d0 + d1 * d1) * sharpness, np.float32(300.0))
            o[i] *= scale * (one + x + half * x * x)  # exp(x) and no more, and much sooner done


@numba.njit(cache=True, nogil=True)
def _score(
    boundary: F32,
    freespace: F32,
    symmetry: F32,
    rows: I64,
    own_boundary: F64,
    own_freespace: F64,
    own_symmetry: F64,
    sharpness: float,
    weight_boundary: float,
    scale: float,
    hellinger: bool,
    out: F64,
) -> None:
    for k in range(len(rows)):
        i = rows[k]
        d = weight_boundary * _distance(own_boundary, boundary[i], hellinger)
        d += (1.0 - weight_boundary) * _distance(own_freespace, freespace[i], hellinger)
        d0, d1 = own_symmetry[0] - symmetry[i, 0], own_symmetry[1] - symmetry[i, 1]
        out[k] = scale * math.exp(min((d0 * d0 + d1 * d1) * sharpness, 300.0)) * d


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _distance(roots: F64, histogram: F32, hellinger: bool) -> float:
    coefficient = 0.0
    for b in range(len(roots)):
        coefficient += roots[b] * math.sqrt(np.float64(histogram[b]))
    if coefficient > 1.0 - 1e-7:
        return 0.0
    return math.sqrt(1.0 - coefficient) if hellinger else -math.log(max(coefficient, math.exp(-FARTHEST)))
