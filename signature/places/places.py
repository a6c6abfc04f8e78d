"""The places of a database: which of them a robot may stand next to, and the free ground there.

The signatures of viewpoints select the places. Walls are aligned on the free ground next to these alone. The
maps are read and prepared when they are first needed.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, I64, cells_of
from pc2grid.model import OccupancyGrid
from signature.config import RelocalizeConfig, ShortlistBy
from signature.paper import PlaceTable
from signature.places.index import PlaceBlock, PlaceIndex, Poses
from signature.visible import SeenPlaces, View
from signature.weights import seen_spread, seen_weights

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

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
        self.ground = functools.lru_cache(_KEPT_SESSIONS)(self._ground)
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
                else PlaceIndex.of(self.blocks(on_progress), seen_weights(*names), seen_spread(*names))
            )
        return self._indexes[by]

    def blocks(self, on_progress: Callable[[float], None] = lambda share: None) -> Iterator[PlaceBlock]:
        """Yield the isovists of the places of each session: as stored, or else computed from the map."""
        starts = np.flatnonzero(np.diff(self.table.session_index, prepend=-1)).tolist()
        # Those of a session are side by side.
        for begin, end in itertools.pairwise((*starts, len(self.table))):
            session = int(self.table.session_index[begin])
            seen = self._stored(session)
            if seen is None or (len(seen) and seen.place[-1] >= end - begin):
                grid, centers_m = self._grid_of(session), self.table.center_m[begin:end]
                seen = SeenPlaces.of(grid, centers_m, self.sight_m)
            on_progress((begin + len(np.unique(seen.place))) / len(self.table))
            yield PlaceBlock(seen, begin)
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
        from scipy.spatial import cKDTree

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
