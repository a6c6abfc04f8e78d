"""The places of a database, and those of them where a query may lie: one index for every size.

Each viewpoint has a short vector of its three signatures (`signature.weights`), which contain no
direction. The positions of a query's views relative to each other do contain one. So

1. each view is compared with the viewpoints, by one matrix product, and stands at those that are most alike;
2. each of these, at each of some headings, is a pose of the whole query: it says at which viewpoints the
   other views stand. The log-likelihoods of all views there are added up;
3. the best heading of each pose says where the robot stands: the places that it stands next to in the best
   poses are selected. Only there are its walls aligned, with any heading, as signatures say little about it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64, I64
from pc2grid.libraries import compiled
from signature.visible import LATTICE_M, SeenPlaces, View, seen_signatures
from signature.weights import SeenWeights, Spread, seen_spread, seen_weights

_AT_ONCE = 65_536
"""Viewpoints at a time, so that intermediate results stay in the cache of the processor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseParameters:
    """How poses of a query are proposed and compared. Recall of real logs hardly depends on any of them.

    proposed : viewpoints that each view is put on: the likeliest.
    headings : that are tried at each: one every 15 degrees, which moves a view 3 m away by a lattice.
    least : lower bound of the log-likelihood ratio of a view that a pose puts on a viewpoint, so that what
        has changed around one view does not exclude the place. A view where the map has no viewpoint counts
        0: what is unknown says nothing.
    """

    proposed: int = 2000
    headings: int = 24
    least: float = -2.0


POSES = PoseParameters()


class PlaceBlock(NamedTuple):
    """The viewpoints of one map, and the row of its first place in the table of all."""

    seen: SeenPlaces
    first_row: int


class Raster(NamedTuple):
    """The viewpoint in each square of the lattice, of all maps.

    low, shape (S, 2) : the first square of each map, and how many there are. first (S,) : where they begin in
    `at` (Q,), which holds the number of the viewpoint in each square, -1: none.
    """

    low: I64
    shape: I64
    first: I64
    at: NDArray[np.int32]

    @staticmethod
    def of(at_m: F32, block: NDArray[np.int32], blocks: int) -> Raster:
        """Return the raster of viewpoints (K, 2) of maps (K,)."""
        square = np.rint(at_m / LATTICE_M).astype(np.int64)
        low, high = np.zeros((blocks, 2), np.int64), np.full((blocks, 2), -1)
        starts = np.flatnonzero(np.diff(block, prepend=-1))
        if len(block):
            low[block[starts]] = np.minimum.reduceat(square, starts)
            high[block[starts]] = np.maximum.reduceat(square, starts)
        shape = high - low + 1
        ends = np.cumsum(shape.prod(axis=1))
        first = ends - shape.prod(axis=1)
        at = np.full(ends[-1] if blocks else 0, -1, np.int32)
        inside = square - low[block]
        at[first[block] + inside[:, 0] * shape[block, 1] + inside[:, 1]] = np.arange(len(at_m))
        return Raster(low, shape, first, at)


class Poses(NamedTuple):
    """P poses of a query.

    likelihood (P,) : sum of the log-likelihood ratios of its views. base_m (P, 2) : where the robot stands in
    the map of a block (P,).
    """

    likelihood: F32
    base_m: F64
    block: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class PlaceIndex:
    """K viewpoints of N places.

    vectors : (K, D) float16, of their signatures. hidden : (K,) share of the rays whose ends are not known.
    at_m : (K, 2) in the map of a block (K,). row : (K,) the place in the table.
    """

    vectors: NDArray[np.float16]
    hidden: F32
    at_m: F32
    block: NDArray[np.int32]
    row: NDArray[np.int32]
    raster: Raster
    weights: SeenWeights
    spread: Spread

    @staticmethod
    def of(
        blocks: Iterable[PlaceBlock], weights: SeenWeights | None = None, spread: Spread | None = None
    ) -> PlaceIndex:
        """Return an index of all viewpoints of the blocks, of which one is in memory at a time.

        weights, spread : how signatures are compared; by default all three, as the program has learned it.
        """
        weights, spread = weights or seen_weights(), spread or seen_spread()
        dimensions = weights.matrix.shape[1]
        vectors, hidden = [np.empty((0, dimensions), np.float16)], [np.empty(0, np.float32)]
        at_m, number, row = [np.empty((0, 2), np.float32)], [np.empty(0, np.int32)], [np.empty(0, np.int32)]
        count = 0
        for seen, first_row in blocks:
            shares = seen.shares
            vectors.append(weights.of_places(shares).astype(np.float16))
            hidden.append(1.0 - shares[:, -1])
            at_m.append(seen.at_m)
            number.append(np.full(len(seen), count, np.int32))
            row.append((seen.place + first_row).astype(np.int32))
            count += 1
        at, block = np.concatenate(at_m), np.concatenate(number)
        return PlaceIndex(
            vectors=np.concatenate(vectors),
            hidden=np.concatenate(hidden),
            at_m=at,
            block=block,
            row=np.concatenate(row),
            raster=Raster.of(at, block, count),
            weights=weights,
            spread=spread,
        )

    def shuffled(self, rng: np.random.Generator) -> PlaceIndex:
        """Return the same viewpoints, each with the signatures of another one."""
        order = rng.permutation(len(self))
        return replace(self, vectors=self.vectors[order], hidden=self.hidden[order])

    def __len__(self) -> int:
        return len(self.vectors)

    @property
    def nbytes(self) -> int:
        """Return the memory that it takes, bytes."""
        columns = (self.vectors, self.hidden, self.at_m, self.block, self.row, self.raster.at)
        return sum(column.nbytes for column in columns)

    def scores(self, views: Sequence[View]) -> F32:
        """Return the log-likelihood ratio (K, V) of each viewpoint and each view showing one place, by
        signatures."""
        signatures = seen_signatures(
            np.stack([view.profile.ranges_m for view in views]),
            np.stack([view.profile.ends for view in views]),
            views[0].profile.sight_m,
        )
        queries, hidden = self.weights.of_queries(signatures), 1.0 - signatures[:, -1]
        squares = np.einsum("vd,vd->v", queries, queries)
        found = np.empty((len(self), len(views)), np.float32)
        for at in range(0, len(self), _AT_ONCE):
            part = slice(at, at + _AT_ONCE)
            vectors = self.vectors[part].astype(np.float32)
            squared = squares - 2.0 * (vectors @ queries.T)
            squared += np.einsum("kd,kd->k", vectors, vectors)[:, None]
            found[part] = self.spread.log_ratio(squared, hidden + self.hidden[part, None])
        return found

    def poses(self, views: Sequence[View], base_m: tuple[float, float]) -> Poses:
        """Return the poses of the query that its views propose.

        base_m : (x, y) of the robot in the query's frame.
        """

        if not views or not len(self):
            return Poses(np.empty(0, np.float32), np.empty((0, 2)), np.empty(0, np.int32))
        most = min(POSES.proposed, len(self))
        scores = self.scores(views)
        likeliest = [np.argpartition(-column, most - 1)[:most] for column in scores.T]
        viewpoint, view = np.concatenate(likeliest), np.repeat(np.arange(len(views)), most)
        found, heading = np.empty(len(viewpoint), np.float32), np.empty(len(viewpoint), np.int64)
        floored = np.maximum(scores, np.float32(POSES.least))
        squares = self.at_m / np.float32(LATTICE_M)
        points_m = np.array([one.center_m for one in views])
        steps = turned(points_m[None] - points_m[:, None]) / LATTICE_M
        on = floored, squares, self.block, *self.raster
        best_headings(*on, viewpoint, view, steps, found, heading)
        to_base = turned(np.asarray(base_m) - points_m)[heading, view]
        return Poses(found, self.at_m[viewpoint] + to_base, self.block[viewpoint])


def turned(steps_m: F64) -> F64:
    """Return the steps (..., 2) at each heading of the query: (H, ..., 2)."""
    turns = 2.0 * math.pi * np.arange(POSES.headings) / POSES.headings
    turn = np.stack((np.cos(turns), -np.sin(turns), np.sin(turns), np.cos(turns)), axis=1).reshape(-1, 2, 2)
    return np.asarray(np.einsum("hij,...j->h...i", turn, steps_m), np.float64)


@compiled(nogil=True)
def best_headings(
    scores: F32,
    squares: F32,
    block: NDArray[np.int32],
    low: I64,
    shape: I64,
    first: I64,
    at: NDArray[np.int32],
    viewpoint: I64,
    view: I64,
    steps: F64,
    out: F32,
    at_best: I64,
) -> None:
    """Add up the `scores` (K, V) of all views at the best heading, into `out` (P,), and write the number of
    that heading into `at_best` (P,).

    squares : (K, 2) viewpoints in units of the lattice. block, low, shape, first, at : as in `Raster`.
    viewpoint, view : (P,) which view is put on which viewpoint. steps : from there to the other views, at
    each heading, in units of the lattice.
    """
    headings, views = steps.shape[0], steps.shape[1]
    for pose in range(len(viewpoint)):
        here, own = viewpoint[pose], view[pose]
        number = block[here]
        rows, columns = shape[number, 0], shape[number, 1]
        best = -np.inf
        for heading in range(headings):
            total = scores[here, own]
            for other in range(views):
                if other == own:
                    continue
                x = np.int64(np.rint(squares[here, 0] + steps[heading, own, other, 0])) - low[number, 0]
                y = np.int64(np.rint(squares[here, 1] + steps[heading, own, other, 1])) - low[number, 1]
                if 0 <= x < rows and 0 <= y < columns:
                    beside = at[first[number] + x * columns + y]
                    if beside >= 0:
                        total += scores[beside, other]
            if total > best:
                best, at_best[pose] = total, heading
        out[pose] = best
