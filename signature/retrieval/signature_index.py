"""The submaps nearest to a query by Eq. 6, of a million, without comparing all of them closely.

Merging bins never lowers the Bhattacharyya coefficient of two histograms (Cauchy-Schwarz, group by group).
So a sketch of each submap, the square roots of its merged histograms, bounds its distance to any query from
below. All sketches are compared, by one matrix product; the distance itself is computed only where the bound
does not exclude a row. The result is exact, not approximate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64
from signature.config import SignatureConfig
from signature.describe import Signature
from signature.similarity import FARTHEST, SignatureTable, distances

DIRECT = 4096
"""Tables up to this size are compared row by row, which takes no longer."""
_BOUNDARY_BINS, _FREESPACE_BINS = 2, 6
"""Bins merged into one; the free-space histogram has a tenth of the weight and may be coarser. Chosen by the
time of a query on a million rows."""
_CHUNK = 8_192  # rows at a time, so that intermediate results stay small
_BOUND_SAMPLE, _SCORE_SAMPLE = 32_768, 2048  # rows
_SLACK = 1e-5  # more than the rounding error of a coefficient in float32
_LARGEST_SUM = 1.0 + 1e-4


class Nearest(NamedTuple):
    """The rows nearest to a query.

    rows (K,), scores (K,) : by Eq. 6, nearest first. mean, spread : mean and standard deviation of the scores
    of the whole table, estimated from every n-th row if it is larger than `DIRECT`.
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

    The likeness of a session is that of its nearest row in each list, in standard deviations, summed over the
    lists; a list without a row of the session counts with its last row.
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

    boundary (Gb, N), freespace (Gf, N) : float32, square roots of the merged bins. Empty for tables of up to
    `DIRECT` rows.
    """

    table: SignatureTable
    boundary: F32
    freespace: F32

    @staticmethod
    def of(table: SignatureTable) -> SignatureIndex:
        """Sketch every row. Raises ValueError if a histogram sums to more than 1."""
        if len(table) <= DIRECT:
            empty = np.empty((0, 0), np.float32)
            return SignatureIndex(table, empty, empty)
        return SignatureIndex(
            table, _sketch(table.boundary, _BOUNDARY_BINS), _sketch(table.freespace, _FREESPACE_BINS)
        )

    def nearest(self, query: Signature, k: int, config: SignatureConfig) -> Nearest:
        """The first `k` rows by (distance, row), as if all had been compared."""
        return self.nearest_to_each((query,), k, config)[0]

    def nearest_to_each(
        self, queries: Sequence[Signature], k: int, config: SignatureConfig
    ) -> tuple[Nearest, ...]:
        """`nearest` for several queries, which share the reading of the sketches."""
        n = len(self.table)
        if n <= DIRECT or 2 * k >= n:
            return tuple(self._nearest_directly(query, k, config) for query in queries)
        bounds = self.bounds(queries, config)
        return tuple(
            self._nearest_by_bound(query, bound, k, config)
            for query, bound in zip(queries, bounds, strict=True)
        )

    def _nearest_directly(self, query: Signature, k: int, config: SignatureConfig) -> Nearest:
        score = distances(query, self.table, config)
        rows = np.argsort(score, kind="stable")[:k]
        return Nearest(rows, score[rows], float(score.mean()), float(score.std()))

    def _nearest_by_bound(self, query: Signature, bound: F32, k: int, config: SignatureConfig) -> Nearest:
        # A sample of the bounds estimates the one that the k best rows, and some more, do not exceed.
        step = -(-len(bound) // _BOUND_SAMPLE)
        sample = bound[::step]
        rank = min(2 * k // step + 8, len(sample) - 1)
        cut = np.partition(sample, rank)[rank]
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
        sampled = self._scores(query, np.arange(0, len(bound), -(-len(bound) // _SCORE_SAMPLE)), config)
        return Nearest(rows[order], score[order], float(sampled.mean()), float(sampled.std()))

    def bounds(self, queries: Sequence[Signature], config: SignatureConfig) -> F32:
        """(Q, N) lower bounds of the distance of each row to each query. Raises ValueError for other bins."""
        boundary = np.stack([_roots(query.boundary, _BOUNDARY_BINS) for query in queries])
        freespace = np.stack([_roots(query.freespace, _FREESPACE_BINS) for query in queries])
        if (boundary.shape[1], freespace.shape[1]) != (len(self.boundary), len(self.freespace)):
            raise ValueError("histograms of another number of bins: other radius or bin width")
        own = np.stack([query.symmetry.astype(np.float32) for query in queries])[:, None]
        weight, sharpness = np.float32(config.weight_boundary), np.float32(0.5 / config.symmetry_sigma**2)
        out = np.empty((len(queries), len(self.table)), np.float32)
        for first in range(0, len(self.table), _CHUNK):
            part = np.s_[first : first + _CHUNK]
            bound = weight * _least_distance(boundary @ self.boundary[:, part], config)
            bound += (np.float32(1.0) - weight) * _least_distance(freespace @ self.freespace[:, part], config)
            across, along = np.moveaxis(self.table.symmetry[part] - own, -1, 0)
            exponent = np.minimum(sharpness * (across * across + along * along), np.float32(300.0))
            # exp(x) >= 1 + x + x^2 / 2, which takes a tenth of the time.
            bound *= 1.0 + exponent * (1.0 + 0.5 * exponent)
            np.multiply(bound, np.float32(config.symmetry_scale**2), out=out[:, part])
        return out

    def _scores(self, query: Signature, rows: I64, config: SignatureConfig) -> F64:
        """`distances` of some rows (K,)."""
        chosen = {f.name: getattr(self.table, f.name)[rows] for f in fields(SignatureTable)}
        return distances(query, SignatureTable(**chosen), config)


def _roots(histogram: F32, merged: int) -> F32:
    """Square roots of a histogram (bins,), `merged` bins in one."""
    return np.sqrt(np.add.reduceat(histogram, np.arange(0, len(histogram), merged)), dtype=np.float32)


def _sketch(histograms: F32, merged: int) -> F32:
    """`_roots` of each row: (G, N), a row of the sketch for each group of bins."""
    n, bins = histograms.shape
    first = np.arange(0, bins, merged)
    out = np.empty((len(first), n), np.float32)
    for at in range(0, n, _CHUNK):
        masses = np.add.reduceat(histograms[at : at + _CHUNK], first, axis=1)
        if masses.sum(axis=1).max(initial=0.0) > _LARGEST_SUM:
            raise ValueError("a histogram that sums to more than 1")
        out[:, at : at + _CHUNK] = np.sqrt(masses).T
    return out


def _least_distance(coefficient: F32, config: SignatureConfig) -> F32:
    """(Q, N) the histogram distance at the largest coefficient that rounding may have hidden."""
    coefficient += np.float32(_SLACK)
    if config.histogram_distance == "hellinger":
        np.subtract(np.float32(1.0), coefficient, out=coefficient)
        np.maximum(coefficient, np.float32(0.0), out=coefficient)
        return np.sqrt(coefficient, out=coefficient)
    np.minimum(coefficient, np.float32(1.0), out=coefficient)
    np.log(coefficient, out=coefficient)
    np.negative(coefficient, out=coefficient)
    return np.minimum(coefficient, np.float32(FARTHEST), out=coefficient)
