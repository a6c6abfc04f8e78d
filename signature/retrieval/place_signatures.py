"""A first look at all places of a database: the three signatures as in the paper, by which most are left out.

A place has one signature (III-B to III-D): its boundary is sampled evenly with a KD-tree, the lengths of its
shortest paths are those of a `networkx` graph of its free space, and its walls are mirrored. It is stored
once, where viewpoints, which are compared afterwards, are a dozen a place. A place stays if it is among those
that are most like any view of the query: views that have seen little are far from all places.

The bins are weighed as in `signature.seen_likelihood`, by what was learned from places and views of real
logs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, BoolGrid
from signature.retrieval.view import View
from signature.seen_likelihood import SeenWeights, learned, seen_weights
from signature.similarity import SignatureTable

_BRIGHTEST = 255.0
"""Largest symmetry score: the brightness of a white pixel."""
_AT_ONCE = 65_536
"""Places at a time, so that intermediate results stay small."""


SHARE = 0.1
"""Each view keeps this share of the places, the nearest; eight views together keep 0.3 of them. With half of
it a fortieth more of the queries of real logs lose their place; with twice of it, no fewer."""


@dataclass(frozen=True, slots=True)
class PlaceSignatures:
    """The signatures of N places as vectors (N, D), float16, whose distance tells places apart."""

    vectors: NDArray[np.float16]
    weights: SeenWeights

    @staticmethod
    def of(table: SignatureTable, names: Sequence[str] = ()) -> PlaceSignatures | None:
        """The places of a table; None if its bins are not those that the weights were learned for (`--preset
        paper`). names : of the signatures that are compared, by default all."""
        if tuple(learned("places").sizes) != columns_of(table):
            return None
        weights = seen_weights(*names, of="places")
        parts = [slice(at, at + _AT_ONCE) for at in range(0, len(table), _AT_ONCE)]
        vectors = [weights.of_places(table_rows(table, part)).astype(np.float16) for part in parts]
        empty = np.empty((0, weights.matrix.shape[1]), np.float16)
        return PlaceSignatures(np.concatenate((empty, *vectors)), weights)

    def likely(self, views: Sequence[View], most: int) -> BoolGrid:
        """Which of the places (N,) stay: `SHARE` of them for each view, and no fewer than `most`."""
        count = len(self.vectors)
        kept = max(math.ceil(SHARE * count), most)
        if kept >= count or not views:
            return np.ones(count, bool)
        stays = np.zeros(count, bool)
        for apart in self.distances(views).T:
            stays[np.argpartition(apart, kept)[:kept]] = True
        return stays

    def distances(self, views: Sequence[View]) -> F32:
        """(N, V) squared distance of each place and each view, but for what is the same for all places."""
        queries = self.weights.of_queries(view_rows(views))
        found = np.empty((len(self.vectors), len(views)), np.float32)
        for at in range(0, len(found), _AT_ONCE):
            vectors = self.vectors[at : at + _AT_ONCE].astype(np.float32)
            squares = np.einsum("nd,nd->n", vectors, vectors)[:, None]
            found[at : at + _AT_ONCE] = squares - 2.0 * (vectors @ queries.T)
        return found


def table_rows(table: SignatureTable, part: slice = slice(None)) -> F32:
    """Signatures of N places as rows (N, C + 1): square roots of the shares, symmetry up to 1, and a last
    column of ones: all is known, see `signature.seen.seen_signatures`."""
    symmetry = table.symmetry[part] / np.float32(_BRIGHTEST)
    seen = np.ones((len(symmetry), 1), np.float32)
    return np.concatenate(
        (np.sqrt(table.boundary[part]), np.sqrt(table.freespace[part]), symmetry, seen), axis=1
    )


def view_rows(views: Sequence[View]) -> F32:
    """The same of views; the last column is the share of what surrounds each that was seen."""
    at_m = np.array([view.center_m for view in views])
    rows = table_rows(SignatureTable.of([view.signature for view in views], at_m))
    rows[:, -1] = [view.profile.observed for view in views]
    return rows


def columns_of(table: SignatureTable) -> tuple[int, int, int]:
    """How many columns the boundary, the free space and the symmetry have."""
    return table.boundary.shape[1], table.freespace.shape[1], table.symmetry.shape[1]
