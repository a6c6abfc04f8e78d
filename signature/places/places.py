"""The places of a database: which of them a robot may stand next to, and the free ground there.

The signatures of viewpoints select the places. Walls are aligned on the free ground next to these alone. The
maps are read and prepared when they are first needed. One index serves databases of every size.

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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pc2grid.geometry import F32, F64, I64, cells_of
from pc2grid.libraries import compiled
from pc2grid.model import OccupancyGrid
from signature.config import RelocalizeConfig, ShortlistBy
from signature.paper import PlaceTable
from signature.visible import LATTICE_M, SeenPlaces, View, seen_signatures
from signature.weights import SeenWeights, Spread, seen_spread, seen_weights

FIRST_PLACES = 100
"""So many places are searched before it is asked whether one is certain, then ten times as many each time. By
hand, by the time: places that are searched later share tiles of the search with those before."""
AT_ONCE_M2 = 200_000.0
"""So much free floor is searched at once; of a larger database, the sessions that look likeliest. Chosen by
the time of a look-up."""
SQUARE_M = 0.8
"""Side of the squares of free ground that are searched. By hand."""
_KEPT_SESSIONS = 1000
"""Sessions whose free ground is kept: 0.1 MB each, of floors of 40 x 60 m."""
_APART_M = 1e6
"""Puts the places of different sessions far apart in one KD-tree."""
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


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderParameters:
    """How much the signatures say: the mass of a place is (1 - astray) exp(L / dependent) / sum + astray / N.

    dependent : of the views of a query, so many repeat what one says. astray : share of the queries of which
        the signatures say nothing. With these 0.14 of 54 real windows are said to have their place behind the
        first 100, and 0.15 have; chosen by their likelihood, which leaves out a building at a time.
    """

    dependent: float = 1.5
    astray: float = 0.05


ORDER = OrderParameters()


class Area(NamedTuple):
    """Where the robot may stand in one session: squares of `SQUARE_M` with the centres (K, 2), map frame."""

    session: int
    squares_m: F64


class Order(NamedTuple):
    """Places (R,), likeliest first, and the share (R,) of the mass that each has by the signatures."""

    rows: I64
    mass: F64


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
    """K viewpoints of some maps.

    vectors : (K, D) float16, of their signatures. hidden : (K,) share of the rays whose ends are not known.
    at_m : (K, 2) in the map of a block (K,).
    """

    vectors: NDArray[np.float16]
    hidden: F32
    at_m: F32
    block: NDArray[np.int32]
    raster: Raster
    weights: SeenWeights
    spread: Spread

    @staticmethod
    def of(blocks: Iterable[SeenPlaces], names: Sequence[str] = ()) -> PlaceIndex:
        """Return an index of all viewpoints of the blocks, one a map, of which one is in memory at a time.

        names : of the signatures that are compared, as the program has learned it; by default all three.
        """
        weights, spread = seen_weights(*names), seen_spread(*names)
        dimensions = weights.matrix.shape[1]
        vectors, hidden = [np.empty((0, dimensions), np.float16)], [np.empty(0, np.float32)]
        at_m, number = [np.empty((0, 2), np.float32)], [np.empty(0, np.int32)]
        count = 0
        for seen in blocks:
            shares = seen.shares
            vectors.append(weights.of_places(shares).astype(np.float16))
            hidden.append(1.0 - shares[:, -1])
            at_m.append(seen.at_m)
            number.append(np.full(len(seen), count, np.int32))
            count += 1
        at, block = np.concatenate(at_m), np.concatenate(number)
        return PlaceIndex(
            vectors=np.concatenate(vectors),
            hidden=np.concatenate(hidden),
            at_m=at,
            block=block,
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


class Places:
    """All places of a database, ready for retrieval.

    table : where they are. sight_m : length of the rays by which they are described.
    ground : of a session, by its index, the squares (K, 2) that hold free ground, and the places next to them
        (K,).
    """

    def __init__(
        self,
        table: PlaceTable,
        grid_of: Callable[[int], OccupancyGrid],
        sight_m: float,
        areas_m2: Sequence[float],
        stored: Callable[[int], SeenPlaces | None] = lambda session: None,
    ) -> None:
        """Prepare the places of some sessions.

        grid_of, areas_m2 : the map of each session and its free space in m^2, by session_index.
        stored : what is seen from the places of a session, if it need not be computed from the map.
        """
        self.table = table
        self.sight_m = sight_m
        self._grid_of, self._stored = grid_of, stored
        self._chance = np.random.default_rng(0)
        self._areas_m2 = np.asarray(areas_m2, np.float64)
        self._session_of_block = np.unique(table.session_index)
        self.ground = lru_cache(_KEPT_SESSIONS)(self._ground)
        self._indexes: dict[ShortlistBy, PlaceIndex] = {}
        self._ordered: tuple[Sequence[View], RelocalizeConfig, Order] | None = None

    def order(self, views: Sequence[View], base_m: tuple[float, float], config: RelocalizeConfig) -> Order:
        """Return the places by how likely the robot at `base_m` stands next to them: by `PlaceIndex.poses`,
        or by a control (`RelocalizeConfig.shortlist_by`). Of a large database those in the likeliest maps, up
        to `AT_ONCE_M2`.
        """
        if self._ordered is None or self._ordered[0] is not views or self._ordered[1] is not config:
            self._ordered = views, config, self._order(views, base_m, config)
        return self._ordered[2]

    def _order(self, views: Sequence[View], base_m: tuple[float, float], config: RelocalizeConfig) -> Order:
        every = np.arange(len(self.table))
        if not views or not len(every):
            return self._at_once(every, np.zeros(len(every)))
        if config.shortlist_by == "random":
            return self._at_once(self._chance.permutation(every), np.zeros(len(every)))
        likelihood = self.next_to(self.index(config.shortlist_by).poses(views, base_m))
        rows = np.argsort(-likelihood, kind="stable")
        return self._at_once(rows, likelihood[rows])

    def next_to(self, poses: Poses) -> F64:
        """Return the log-likelihood (N,) of the likeliest pose next to each place. Without a pose there, it
        is that of the least likely one: no more are proposed."""
        away_m, row = self.nearest(self._session_of_block[poses.block], poses.base_m)
        likelihood = np.full(len(self.table), poses.likelihood.min(initial=0.0), np.float64)
        near = away_m <= self.sight_m
        np.maximum.at(likelihood, row[near], poses.likelihood[near])
        return likelihood

    def _at_once(self, rows: I64, likelihood: F64) -> Order:
        """Return the order of those of the places (R,) of such log-likelihoods that are in the maps that are
        searched at once."""
        if self._areas_m2.sum() > AT_ONCE_M2:
            of = self.table.session_index[rows]
            sessions = np.array(list(dict.fromkeys(of.tolist())))
            areas_m2 = self._areas_m2[sessions]
            kept = np.isin(of, sessions[np.cumsum(areas_m2) <= max(AT_ONCE_M2, areas_m2[0])])
            rows, likelihood = rows[kept], likelihood[kept]
        mass = np.exp((likelihood - likelihood.max(initial=-math.inf)) / ORDER.dependent)
        mass = (1.0 - ORDER.astray) * mass / mass.sum() + ORDER.astray / max(len(mass), 1)
        return Order(rows, mass)

    def index(
        self, by: ShortlistBy = "signatures", on_progress: Callable[[float], None] = lambda share: None
    ) -> PlaceIndex:
        """Return the viewpoints of all places with all their signatures, or as a control wants them; made by
        the first call.

        on_progress : is told the share of the places that is done.
        """
        if by not in self._indexes:
            names = [] if by == "signatures" else by.split("+")
            self._indexes[by] = (
                self.index().shuffled(self._chance)
                if by == "shuffled"
                else PlaceIndex.of(self.blocks(on_progress), names)
            )
        return self._indexes[by]

    def blocks(self, on_progress: Callable[[float], None] = lambda share: None) -> Iterator[SeenPlaces]:
        """Yield the isovists of the places of each session: as stored, or else computed from the map."""
        starts = np.flatnonzero(np.diff(self.table.session_index, prepend=-1)).tolist()
        # Those of a session are side by side.
        for begin, end in pairwise((*starts, len(self.table))):
            session = int(self.table.session_index[begin])
            seen = self._stored(session)
            if seen is None or (len(seen) and seen.place[-1] >= end - begin):
                grid, centers_m = self._grid_of(session), self.table.center_m[begin:end]
                seen = SeenPlaces.of(grid, centers_m, self.sight_m)
            on_progress((begin + len(np.unique(seen.place))) / len(self.table))
            yield seen
        on_progress(1.0)

    def areas(self, rows: I64) -> Iterator[Area]:
        """Yield the free ground next to the places `rows`, in the order of their sessions."""
        chosen = np.zeros(len(self.table), bool)
        chosen[rows] = True
        for session in dict.fromkeys(self.table.session_index[rows].tolist()):
            squares_m, nearest = self.ground(session)
            yield Area(session, squares_m[chosen[nearest]])

    def nearest(self, session: int | NDArray[np.integer], at_m: NDArray[np.floating]) -> tuple[F64, I64]:
        """Return the distance (K,) of the place of a session that is next to points (K, 2), and its row (K,),
        -1 if the session has no places."""
        apart_m = np.broadcast_to(np.asarray(session, np.float64) * _APART_M, len(at_m))
        away_m, row = self._tree.query(np.column_stack((at_m, apart_m)))
        return away_m, np.where(away_m < 0.5 * _APART_M, row, -1)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(np.column_stack((self.table.center_m, self.table.session_index * _APART_M)))

    def _ground(self, session: int) -> tuple[F64, I64]:
        """Return the centres (K, 2) of the squares of `SQUARE_M` of a map that hold any ground, and the
        places next to them (K,)."""
        grid = self._grid_of(session)
        n = max(1, round(SQUARE_M / grid.resolution_m))
        height, width = grid.cells.shape
        ground = np.zeros((math.ceil(height / n), math.ceil(width / n)), bool)
        ground[tuple((cells_of(grid.ground) // n).T)] = True
        corners = cells_of(ground)[:, ::-1] * (n * grid.resolution_m)
        squares_m = np.asarray(corners + 0.5 * n * grid.resolution_m + np.asarray(grid.origin_m))
        return squares_m, self.nearest(session, squares_m)[1]


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
