"""Recognises places within a session while it is made, for loop closure.

The session is its own database: some metres of travel make a place map with a few described places, and
every new place map is looked up among those before it as a query is in a database
(`signature.places.hypotheses.look_up`). Signatures propose, the alignment of walls in both directions
verifies, and the evidence (`pc2grid.matching.evidence`) is that of an answer. Loop closure
(`signature.session.loops`), which knows the travel between the places, tells how likely each is.
"""

from __future__ import annotations

import pickle
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pc2grid.geometry import F64, I64, SE2, frozen_arrays
from pc2grid.matching.evidence import LEFT, Evidence, evidence_of, masses
from pc2grid.matching.search import SearchMap
from pc2grid.model import OccupancyGrid
from signature.config import Config
from signature.paper import PlaceTable
from signature.places.hypotheses import look_up
from signature.places.places import Places
from signature.places.query import QueryMap, query_of
from signature.visible import SeenPlaces


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionParameters:
    """Numbers of place recognition within a session, chosen by the time of `convert` on killian (1.9 km).

    views : places of a place map that are described. They are both what is asked and what is asked for.
    shortlist : so many earlier places are compared with it, those that are likeliest by their signatures.
    maps : prepared maps of earlier place maps that stay in memory, about 4 MB each.
    """

    views: int = 12
    shortlist: int = 10
    maps: int = 16


RECOGNITION = RecognitionParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(poses=(np.float64, "K", 3), scans=(np.int64, "K"))
class PlaceMap:
    """The map of a few metres of travel, long enough to be recognised.

    The last one of a session may be shorter, and overlap the one before.

    grid : its occupancy grid, in its own frame: the base at one of its keyframes, in the middle.
    poses : (K, 3) x, y, yaw of its keyframes in the same frame, metres and radians.
    scans : (K,) number of each keyframe's scan within the session.
    """

    grid: OccupancyGrid
    poses: F64
    scans: I64


@dataclass(frozen=True, slots=True, kw_only=True)
class Recognition:
    """An earlier place map that shows the place of the newest one, and their relative pose.

    older : its number in the order of travel, from 0.
    T_older_newer : the frame of the newest place map in that of the older one. Exact to some decimetres; loop
        closure refines it on the local maps.
    evidence : that both show the same place, by their appearance.

    At most one recognition of a place map is right, or those at one place that several older ones show.
    """

    older: int
    T_older_newer: SE2
    evidence: Evidence


class SessionRecognizer:
    """The place maps of one session as a database of places that grows.

    >>> import pc2grid, signature
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = pc2grid.build_map(log, signature.Config(), session="monday")
    >>> monday.session
    'monday'
    """

    def __init__(self, config: Config, parameters: RecognitionParameters = RECOGNITION) -> None:
        """Begin without any place map. config : they are described as the places of a database with this
        configuration."""
        self._made_with = config
        self._config = config.relocalize.model_copy(update={"views": parameters.views})
        self._parameters = parameters
        # Grids are kept compressed: some 10 kB each, so that a long session needs little memory.
        self._stored: list[bytes] = []
        self._seen: list[SeenPlaces] = []  # what is seen from the places of each
        self._map_of = lru_cache(parameters.maps)(lambda number: SearchMap.of(self._grid_of(number)))
        self._places: Places | None = None

    def recognize(self, newest: PlaceMap) -> Sequence[Recognition]:
        """Return the earlier place maps that look like the newest one, each place with its own evidence."""
        query = query_of(newest.grid, newest.poses[:, :2], self._made_with, self._config)
        found = [] if self._places is None else self._look_up(query, self._places)
        self._remember(newest.grid, query)
        return found

    def _look_up(self, query: QueryMap, places: Places) -> list[Recognition]:
        rows = places.order(query.views, query.center_m, self._config).rows[: self._parameters.shortlist]
        found = next(look_up(query, [places.areas(rows)], places, self._map_of, self._config))
        return [
            Recognition(older=h.session_index, T_older_newer=h.T_map_query, evidence=evidence)
            for h, evidence in zip(found, evidence_of(found, query.likeness), strict=True)
            if masses([evidence])[0] >= LEFT
        ]

    def _remember(self, grid: OccupancyGrid, query: QueryMap) -> None:
        """Add the newest place map to the places that later ones are looked up in."""
        count, sight_m = len(query.views), self._made_with.partition.radius_m
        table = PlaceTable(
            session_index=np.full(count, len(self._stored), np.int32),
            submap_id=np.arange(count, dtype=np.int32),
            center_m=np.array([view.center_m for view in query.views]).reshape(-1, 2),
        )
        self._stored.append(zlib.compress(pickle.dumps(grid), 1))
        self._seen.append(SeenPlaces.of(grid, table.center_m, sight_m))
        if not count:
            return
        if self._places is not None:
            table = PlaceTable.concatenated((self._places.table, table))
        areas_m2 = [0.0] * len(self._stored)
        self._places = Places(table, self._grid_of, sight_m, areas_m2, self._seen.__getitem__)

    def _grid_of(self, number: int) -> OccupancyGrid:
        grid: OccupancyGrid = pickle.loads(zlib.decompress(self._stored[number]))
        return grid
