"""The places that look most like a view of a query, by the signatures of what was seen.

Each place has one short vector (`signature.seen_likelihood`), and so has each view; the nearest by Euclidean
distance are found by one matrix product.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32
from pc2grid.submaps.isovist import Isovist
from signature.retrieval.signature_index import Nearest
from signature.seen import seen_signatures
from signature.seen_likelihood import SeenWeights, seen_weights

_CHUNK = 65_536
"""Places at a time, so that intermediate results stay in the cache of the processor."""
_SAMPLE = 20_000
"""Scores from which mean, spread and a first bound are estimated."""


@dataclass(frozen=True, slots=True)
class SeenIndex:
    """Vectors (N, D) of places, half of their squared lengths (N,), and the weights they were made with."""

    vectors: F32
    half_squares: F32
    weights: SeenWeights

    @staticmethod
    def of(signatures: F32, weights: SeenWeights | None = None) -> SeenIndex:
        """An index of places by their signatures of what was seen, (N, K)."""
        weights = weights or seen_weights()
        chunks = range(0, max(len(signatures), 1), _CHUNK)
        vectors = np.concatenate([weights.of_places(signatures[at : at + _CHUNK]) for at in chunks])
        return SeenIndex.of_vectors(vectors, weights)

    @staticmethod
    def of_vectors(vectors: F32, weights: SeenWeights) -> SeenIndex:
        """An index of places by the vectors (N, D) that `weights` have made."""
        return SeenIndex(vectors, 0.5 * np.einsum("nd,nd->n", vectors, vectors), weights)

    def nearest_to_each(self, profiles: Sequence[Isovist], k: int) -> tuple[Nearest, ...]:
        """For each view, given by its isovist, the first `k` places by (distance, row)."""
        if not profiles:
            return ()
        signatures = seen_signatures(
            np.stack([profile.ranges_m for profile in profiles]),
            np.stack([profile.ends for profile in profiles]),
            profiles[0].sight_m,
        )
        queries = self.weights.of_queries(signatures)
        # Half of the squared distance, less the part that is the same for all places.
        scores = self.half_squares - queries @ self.vectors.T
        scores += 0.5 * np.einsum("vd,vd->v", queries, queries)[:, None]
        return tuple(_nearest(row, k) for row in scores)


def _nearest(scores: F32, k: int) -> Nearest:
    if not len(scores):
        return Nearest(np.empty(0, np.int64), np.empty(0), 0.0, 0.0)
    # A sample bounds the scores of the first k, and some more, without a look at all the others.
    sample = scores[:: max(1, len(scores) // _SAMPLE)]
    rank = min(round(1.5 * k * len(sample) / len(scores)) + 8, len(sample) - 1)
    rows = np.flatnonzero(scores <= np.partition(sample, rank)[rank])
    if len(rows) < min(k, len(scores)):
        rows = np.arange(len(scores))
    if k < len(rows):
        rows = rows[scores[rows] <= np.partition(scores[rows], k - 1)[k - 1]]
    rows = rows[np.argsort(scores[rows], kind="stable")][:k]
    return Nearest(rows, scores[rows].astype(np.float64), float(sample.mean()), float(sample.std()))
