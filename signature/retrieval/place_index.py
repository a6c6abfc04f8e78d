"""Very many places, and those of them that are worth a closer look.

Of each place 24 numbers are kept (the signatures of what was seen) and its isovist, a byte for each ray: 160
bytes a place. A query selects places in three steps, each slower and better than the one before:

1. for each view, the places with the nearest signatures, which contain no direction;
2. of these, the places whose isovists are most alike at their best rotations;
3. each of those lays the whole query on a map. What the other views would see there is compared with the
   isovists of the places beside them, and all views vote.

Places are a metre apart, so a view may be 0.7 m from the nearest one, and the comparison is coarse. It only
has to bring the right place among those that are compared again from many viewpoints (`retrieve`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, U8
from pc2grid.submaps.isovist import HIDDEN
from signature.retrieval.likeness import LIKENESS, peaks, rotate_and_compare
from signature.retrieval.seen_index import SeenIndex
from signature.retrieval.signature_index import Nearest
from signature.retrieval.view import View
from signature.seen_likelihood import SeenWeights, seen_weights
from signature.seen_places import PROFILE_BEARINGS, RANGE_UNITS, UNSEEN, SeenPlaces, in_units


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectionParameters:
    """How places are selected. All chosen by hand; `compared` and `candidates` by the time that they take, on
    sessions of csail, office 2, office 101 and aces among 500,000 places.

    compared, compared_share : places whose isovists are compared with each view, at most so many and at most
        this share of all; 10,000 take 4 ms.
    candidates : placements that each view proposes, as a share of these.
    beside_m : a place so near to where a view would be tells what it would see; places are 1 m apart.
    least_vote : lower bound of a view's vote (standard deviations).
    apart_m, apart_rad : placements in one cell of this size are one.
    whole : share of the selected places that is spent on the places of all views of the best placements; of
        the others only the place of the view that proposed them is selected.
    """

    compared: int = 10_000
    compared_share: float = 0.2
    candidates: float = 0.25
    beside_m: float = 1.0
    least_vote: float = -1.0
    apart_m: float = 1.5
    apart_rad: float = math.radians(22.5)
    whole: float = 0.25


SELECTION = SelectionParameters()
_MANY = 1 << 20
"""More cells than any map has along an axis."""
_SQUARE_M = 0.5
"""Width of the squares in which places are looked up: half of their distance."""


class PlaceBlock(NamedTuple):
    """Some places: what is seen from them, positions (N, 2) in the map of a session (N,)."""

    seen: SeenPlaces
    center_m: F64
    session: I64

    @staticmethod
    def concatenated(blocks: Sequence[PlaceBlock]) -> PlaceBlock:
        """The places of all blocks, in their order."""
        return PlaceBlock(
            seen=SeenPlaces.concatenated([block.seen for block in blocks]),
            center_m=np.concatenate([block.center_m for block in blocks]),
            session=np.concatenate([block.session for block in blocks]),
        )


class Placements(NamedTuple):
    """Ways to lay the query on a map, best first, no two alike.

    votes (C,). row (C,) : the place that proposed it. beside (C, V) : the place next to each view, -1: none.
    """

    votes: F64
    row: I64
    beside: I64

    def rows(self, most: int) -> I64:
        """The places of the best placements, best first, at most `most`."""
        views = np.where(self.beside >= 0, self.beside, self.row[:, None])
        whole = _first_unique(views.ravel(), max(1, round(SELECTION.whole * most)))
        return _first_unique(np.concatenate((whole, self.row, views.ravel())), most)


@dataclass(frozen=True, slots=True)
class PlaceIndex:
    """N places: vectors of their signatures, ranges (N, B) as in `SeenPlaces`, and where they are, (N, 2)
    float32 in the map of a session (N,) int32."""

    seen: SeenIndex
    ranges: U8
    center_m: F32
    session: NDArray[np.int32]
    sight_m: float
    raster: PlaceRaster

    @staticmethod
    def of(blocks: Iterable[PlaceBlock], sight_m: float, weights: SeenWeights | None = None) -> PlaceIndex:
        """An index of all places of the blocks, of which one is in memory at a time."""
        weights = weights or seen_weights()
        parts = [
            (
                weights.of_places(block.seen.shares),
                block.seen.ranges,
                np.asarray(block.center_m, np.float32),
                np.asarray(block.session, np.int32),
            )
            for block in blocks
        ]
        vectors, ranges, center_m, session = (
            (np.concatenate(column) for column in zip(*parts, strict=True))
            if parts
            else (
                np.empty((0, weights.matrix.shape[1]), np.float32),
                np.empty((0, PROFILE_BEARINGS), np.uint8),
                np.empty((0, 2), np.float32),
                np.empty(0, np.int32),
            )
        )
        raster = PlaceRaster.of(center_m, session)
        return PlaceIndex(SeenIndex.of_vectors(vectors, weights), ranges, center_m, session, sight_m, raster)

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        seen = self.seen.vectors.nbytes + self.seen.half_squares.nbytes
        return (
            seen + self.ranges.nbytes + self.center_m.nbytes + self.session.nbytes + self.raster.rows.nbytes
        )

    def nearest_to_each(self, views: Sequence[View]) -> tuple[Nearest, ...]:
        """For each view, the places by their signatures whose isovists are compared."""
        most = min(SELECTION.compared, math.ceil(SELECTION.compared_share * len(self)))
        return self.seen.nearest_to_each([view.profile for view in views], most)

    def select(self, views: Sequence[View], near: Sequence[Nearest], most: int) -> I64:
        """The at most `most` places, likeliest first, that are worth a closer look for these views.

        near : of `nearest_to_each`; only these places and those beside them are selected. Equal inputs give
        equal places. If fewer than `most` are proposed, those with the nearest signatures are added, and the
        others if all are asked for.
        """
        rows = self.placements(views, near).rows(most)
        if len(rows) < most:
            each = np.stack([found.rows for found in near], axis=1).ravel()
            others = np.arange(len(self) if most >= len(self) else 0)
            rows = _first_unique(np.concatenate((rows, each, others)), most)
        return rows

    def placements(self, views: Sequence[View], near: Sequence[Nearest]) -> Placements:
        """The ways to lay a query on the maps, by the votes of its views.

        near : for each view, the places on which it is tried.
        """
        ranges_m = np.stack([view.profile.ranges_m for view in views])
        seen = np.stack([view.profile.ends != HIDDEN for view in views])
        # One view at a time: the likenesses of all places at all rotations are 2 MB each.
        proposed = [self._proposed(ranges_m[[i]], seen[[i]], found.rows) for i, found in enumerate(near)]
        view = np.repeat(np.arange(len(views)), [len(row) for row, *_ in proposed])
        row, shift, own = (np.concatenate(column) for column in list(zip(*proposed, strict=True))[:3])
        mean, spread = (np.array(column) for column in list(zip(*proposed, strict=True))[3:])
        yaw = shift * (2.0 * math.pi / PROFILE_BEARINGS)
        points_m = np.array([v.center_m for v in views])
        steps = points_m[None] - points_m[view][:, None]
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        turned = np.stack((c * steps[..., 0] - s * steps[..., 1], s * steps[..., 0] + c * steps[..., 1]), -1)
        there = self.center_m[row][:, None] + turned
        beside = self.raster.beside(there, self.session[row])
        beside[np.arange(len(row)), view] = row
        own_units = np.where(seen, in_units(ranges_m, self.sight_m), np.uint8(UNSEEN))
        likeness = likeness_beside(own_units, self.ranges, shift, beside, self._width, LIKENESS.prior_share)
        likeness[np.arange(len(row)), view] = own
        votes = summed_votes((likeness - mean) / spread, beside >= 0)
        order = np.argsort(-votes, kind="stable")
        # The middle of the views stands for the query.
        cell = np.rint(there.mean(axis=1) / SELECTION.apart_m).astype(np.int64)
        turns = round(2.0 * math.pi / SELECTION.apart_rad)
        turn = np.rint(yaw / SELECTION.apart_rad).astype(np.int64) % turns
        session = self.session[row].astype(np.int64)
        key = ((session * _MANY + cell[:, 0]) * _MANY + cell[:, 1]) * turns + turn
        chosen = _first_rows(key, order)
        return Placements(votes[chosen], row[chosen], beside[chosen])

    @property
    def _width(self) -> int:
        """Difference in units at which two ranges are not alike at all."""
        return int(2.0 * LIKENESS.range_scale_m * RANGE_UNITS / self.sight_m)

    def _proposed(
        self, ranges_m: F32, seen: NDArray[np.bool_], rows: I64
    ) -> tuple[I64, I64, F32, float, float]:
        """Places, rotations and likenesses of the placements that one view (1, B) proposes, and mean and
        standard deviation of the likeness over all of the `rows`."""
        known = self.ranges[rows] != UNSEEN
        others_m = self.ranges[rows].astype(np.float32) * np.float32(self.sight_m / RANGE_UNITS)
        likeness = rotate_and_compare(ranges_m, seen, others_m, known)[0]
        best = likeness.max(axis=0)
        most = max(1, round(SELECTION.candidates * len(rows)))
        at, shift = peaks(likeness, _highest(best, most))
        own = likeness[shift, at]
        chosen = _highest(own, most)
        spread = max(float(best.std(dtype=np.float64)), 1e-3)
        return rows[at[chosen]], shift[chosen], own[chosen], float(best.mean(dtype=np.float64)), spread


@dataclass(frozen=True, slots=True)
class PlaceRaster:
    """The place next to the centre of each square of `_SQUARE_M`.

    sessions (S,) : their numbers, ascending. low, shape (S, 2) : the first square of each session, and how
    many there are. first (S,) : where its squares begin in `rows`, which holds the place of each, -1: none
    within `SelectionParameters.beside_m`.
    """

    sessions: NDArray[np.int32]
    low: I64
    shape: I64
    first: I64
    rows: NDArray[np.int32]

    @staticmethod
    def of(center_m: F32, session: NDArray[np.int32]) -> PlaceRaster:
        """Of places at (N, 2) in the map of a session (N,)."""
        reach = math.ceil(SELECTION.beside_m / _SQUARE_M)
        sessions, number = np.unique(session, return_inverse=True)
        square = np.floor(center_m / _SQUARE_M).astype(np.int64)
        low = np.full((len(sessions), 2), np.iinfo(np.int64).max)
        high = np.full((len(sessions), 2), np.iinfo(np.int64).min)
        np.minimum.at(low, number, square - reach)
        np.maximum.at(high, number, square + reach)
        shape = high - low + 1
        ends = np.cumsum(shape.prod(axis=1))
        first = ends - shape.prod(axis=1)
        rows = np.full(ends[-1] if len(ends) else 0, -1, np.int32)
        nearest = np.full(len(rows), SELECTION.beside_m, np.float32)
        for step in np.ndindex(2 * reach + 1, 2 * reach + 1):
            at = square + np.array(step) - reach
            apart = np.hypot(*((at + 0.5) * _SQUARE_M - center_m).T).astype(np.float32)
            inside = at - low[number]
            at_row = first[number] + inside[:, 0] * shape[number, 1] + inside[:, 1]
            np.minimum.at(nearest, at_row, apart)
            best = apart <= nearest[at_row]
            rows[at_row[best]] = np.flatnonzero(best)
        return PlaceRaster(sessions, low, shape, first, rows)

    def beside(self, there: F64, session: NDArray[np.int32]) -> I64:
        """(C, V) the place of the square of each point (C, V, 2) in the map of a session (C,), -1: none."""
        number = np.searchsorted(self.sessions, session)[:, None]
        inside = np.floor(there / _SQUARE_M).astype(np.int64) - self.low[number]
        known = ((inside >= 0) & (inside < self.shape[number])).all(axis=2)
        at = self.first[number] + inside[..., 0] * self.shape[number, 1] + inside[..., 1]
        return np.where(known, self.rows[np.where(known, at, 0)], -1).astype(np.int64)


def summed_votes(evidence: F64, known: NDArray[np.bool_]) -> F64:
    """(C,) the votes of all views on each placement, in standard deviations.

    evidence : (C, V) of each view, of mean 0 and standard deviation 1 over all places; at least
    `SelectionParameters.least_vote` is counted. known : (C, V) whether there is a place beside the view.

    The sum divided by the square root of the number of summands (Stouffer's method), so that a query whose
    path leaves the mapped part of its building is not behind placements in maps that are known all around.
    """
    votes = np.where(known, np.maximum(evidence, SELECTION.least_vote), 0.0).sum(axis=1)
    return np.asarray(votes / np.sqrt(np.maximum(known.sum(axis=1), 1)))


def likeness_beside(
    own: NDArray[np.uint8],
    ranges: NDArray[np.uint8],
    shift: I64,
    beside: I64,
    width: int,
    prior_share: float,
) -> F64:
    """(C, V) likeness of each view (V, B) with the place (N, B) `beside` it, -1: none; 0 there.

    The same as `likeness.rotate_and_compare`, the best of the rotation `shift` (C,) and those next to it.
    """
    from signature.retrieval._kernels import compare_beside

    turned = np.stack([np.roll(own, turn, axis=1) for turn in range(own.shape[1])], axis=1)
    found = np.zeros(beside.shape)
    compare_beside(turned, ranges, shift, beside, width, prior_share * own.shape[1], found)
    return found


def plain_likeness_beside(
    own: NDArray[np.uint8],
    ranges: NDArray[np.uint8],
    shift: I64,
    beside: I64,
    width: int,
    prior_share: float,
) -> F64:
    """The definition of `likeness_beside`."""
    bearings = own.shape[1]
    found = np.zeros(beside.shape)
    for placement, view in np.argwhere(beside >= 0).tolist():
        place = ranges[beside[placement, view]].astype(np.int64)
        for turn in (-1, 0, 1):
            mine = np.roll(own[view].astype(np.int64), shift[placement] + turn)
            both = (mine != UNSEEN) & (place != UNSEEN)
            alike = np.maximum(width - np.abs(mine - place), 0)[both].sum() / width
            likeness = alike / (both.sum() + prior_share * bearings)
            found[placement, view] = max(found[placement, view], likeness)
    return found


def _highest(values: F32, most: int) -> I64:
    """Where the `most` highest values stand, in no order."""
    return np.arange(len(values)) if most >= len(values) else np.argpartition(-values, most - 1)[:most]


def _first_unique(rows: I64, most: int) -> I64:
    """The first `most` different ones, in their order."""
    return rows[np.sort(np.unique(rows, return_index=True)[1])[:most]]


def _first_rows(key: I64, order: I64) -> I64:
    """The rows in `order` whose key is not that of one before."""
    return order[np.sort(np.unique(key[order], return_index=True)[1])]
