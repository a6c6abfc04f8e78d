"""The maps and places of a database, prepared to be searched, and what is known of a pose beforehand.

A prior is a region of a map. It excludes: a place outside has probability 0 and is no answer. Between places
that fit equally well it decides. But what scores differently outside still shows what wrong places score for
this query, so it remains evidence (`signature.localization.posterior`): a place that fits poorly is not
certain because few others are in the region, and if another place fits better by far, nothing inside is. That
place is reported (`Answer.excluded`).
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike

from pc2grid.errors import ConfigError, DatabaseCorrupt
from pc2grid.geometry import F64, I64, SE2
from pc2grid.libraries import one_blas_thread
from pc2grid.matching.icp_in_space import MapSurface
from pc2grid.matching.score import Fit
from pc2grid.matching.search import SearchMap
from pc2grid.model import OccupancyGrid
from pc2grid.observer import Observer
from signature.config import Config
from signature.database import SubmapDatabase
from signature.database.protocol import BuildingFrame, Label
from signature.paper import PlaceTable
from signature.places.hypotheses import HYPOTHESES, SAME, SIGMAS, is_inside, look_up
from signature.places.places import AT_ONCE_M2, FIRST_PLACES, SQUARE_M, Area, Places
from signature.places.query import QueryMap
from signature.visible import SeenPlaces


@dataclass(frozen=True, slots=True, kw_only=True)
class PriorParameters:
    """How a covariance becomes a region, and how the region grows with travel.

    A region is at least as wide on each side as the distance within which two poses are one place. A smaller
    one would exclude right places that are drawn a little off.

    drift, drift_rad_m : a region for an earlier time grows by this share of the way since, and turns by this
        much a metre. Tracking without loops is off, in four real logs with true poses, by at most 2.9 % of
        50 m and 2.0 % of 200 m, and by 0.07 and 0.03 degrees a metre.
    """

    drift: float = 0.03
    drift_rad_m: float = math.radians(0.3)


PRIOR = PriorParameters()


def drifted(way_m: float) -> F64:
    """Return the (3, 3) region of x, y, yaw that odometry adds over a way."""
    return np.diag(np.square((PRIOR.drift, PRIOR.drift, PRIOR.drift_rad_m))) * way_m**2


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """The base is in an ellipse around (x, y) of the map frame of a session, with a heading near `yaw`.

    T_map_base : the centre of the region. shape : (3, 3), see `is_inside`.
    stamp_ns : when; of the scans of a query the nearest one is meant. From then on the region is carried by
    the motion; before, it says nothing. None: the newest scan when `Localizer.answer` is asked.
    session : whose map frame; None if there is only one session.

    >>> near = Prior.around(3.0, 4.0, radius_m=2.0)
    >>> near.allows(SE2(4.0, 5.0, 3.0)), near.allows(SE2(6.0, 4.0, 0.0))
    (True, False)
    """

    T_map_base: SE2
    shape: F64
    stamp_ns: int | None = None
    session: str | None = None

    @staticmethod
    def around(
        x_m: float,
        y_m: float,
        radius_m: float,
        *,
        yaw_rad: float = 0.0,
        half_yaw_rad: float = math.pi,
        session: str | None = None,
    ) -> Prior:
        """Return a disc, with any heading unless `half_yaw_rad` limits it.

        Raises ConfigError for numbers that are not finite or a radius that is not positive.
        """
        if not all(map(math.isfinite, (x_m, y_m, yaw_rad))) or not 0.0 < radius_m < math.inf:
            raise ConfigError(
                f"near: expected x and y in metres and a radius > 0, found {x_m:g} {y_m:g} {radius_m:g}"
            )
        radius_m = max(radius_m, HYPOTHESES.around_m)
        shape = np.diag(np.square((radius_m, radius_m, half_yaw_rad)))
        return Prior(T_map_base=SE2(x_m, y_m, yaw_rad), shape=shape, session=session)

    @staticmethod
    def of_pose(
        T_map_base: SE2, covariance: ArrayLike, *, stamp_ns: int | None = None, session: str | None = None
    ) -> Prior:
        """Return the 99 % region of a pose with a covariance (3, 3) of x, y, yaw; m^2, m rad, rad^2.

        Raises ConfigError for a covariance of zeros, which says nothing, and for one that is none.
        """
        full = np.asarray(covariance, np.float64)
        full = 0.5 * (full + full.T)
        position = full[:2, :2]
        pose = (T_map_base.x, T_map_base.y, T_map_base.yaw)
        if not np.isfinite(full).all() or not np.isfinite(pose).all():
            raise ConfigError("near: the pose or its covariance is not finite")
        if not position.any() or np.linalg.eigvalsh(position)[0] < 0.0 or full[2, 2] < 0.0:
            raise ConfigError(
                "near: the covariance of the pose is zero or not a covariance, so it names no region",
                hint="--near X Y RADIUS names one",
            )
        # Added, not a lower bound of the axes, so that the shape of the ellipse stays.
        shape = SIGMAS**2 * full + SAME
        if not full[2, 2]:  # beside a position that is uncertain: the heading is not known
            shape[2, 2] = math.pi**2
        return Prior(T_map_base=T_map_base, shape=shape, stamp_ns=stamp_ns, session=session)

    @property
    def radius_m(self) -> float:
        """Return the distance of the farthest position in the region from its centre."""
        return math.sqrt(float(np.linalg.eigvalsh(self.shape[:2, :2])[1]))

    def allows(self, T_map_base: SE2, since_m: float = 0.0) -> bool:
        """Return whether the base can be there. since_m : way driven since `stamp_ns`, by which the region
        grows."""
        return is_inside(T_map_base, self.T_map_base, self.shape + drifted(since_m))

    def of_one(self, sessions: Sequence[str]) -> Prior:
        """Return the prior with the name of its session. Raises ConfigError if it does not name one where
        there are several, or names an unknown one."""
        names = ", ".join(sessions[:12]) + (", ..." if len(sessions) > 12 else "")
        if self.session is None and len(sessions) > 1:
            raise ConfigError(
                f"near: the database holds {len(sessions)} sessions, each with a map frame of its own",
                hint=f"--session NAME says whose frame is meant: {names}",
            )
        if self.session is not None and self.session not in sessions:
            raise ConfigError(
                f"near: no session {self.session!r} where it is looked for", hint=f"there is: {names}"
            )
        return replace(self, session=self.session or next(iter(sessions), None))

    def is_ahead(self, query: QueryMap) -> bool:
        """Return whether the query ends before the time that the prior is about."""
        return self.stamp_ns is not None and query.stamp_ns < self.stamp_ns

    def T_odom_prior(self, query: QueryMap) -> SE2 | None:
        """Return the base at the time that the prior is about; None before, and if the motion since is not
        known."""
        if self.stamp_ns is None:
            return query.T_odom_base
        return None if self.is_ahead(query) else query.T_odom_prior

    def squares(self, query: QueryMap, free_m: F64, side_m: float) -> F64:
        """Return those of the squares of `side_m` around (K, 2) that may hold the base now, whatever its
        heading was. The motion since the time of the prior must be known."""
        T_odom_prior = self.T_odom_prior(query)
        assert T_odom_prior is not None
        step = T_odom_prior.inverse() @ query.T_odom_base
        reach_m = self.radius_m + math.hypot(step.x, step.y) + PRIOR.drift * query.since_prior_m
        center = (self.T_map_base.x, self.T_map_base.y)
        return np.asarray(free_m[np.hypot(*(free_m - center).T) <= reach_m + side_m * math.sqrt(0.5)])


class MapIndex:
    """The maps of a database and their places, prepared to be searched again and again.

    Each map is prepared (in tens of milliseconds) when it first matters to a query, and kept.

    prior : what is known of the pose beforehand, see `within`. whole : the index without it.
    look : number of the look of a robot that is searched for, see `at_look`.
    surface_of : the points of the map of a session, by its index, which answers are refined and checked with;
        None if no map has any.
    grid_of, map_of : the map of a session, by its index, and the same prepared to be searched; `True` : for a
        query in a lower plane, to which its free space is unknown.
    """

    prior: Prior | None = None
    whole: MapIndex | None = None
    look: int | None = None
    surface_of: Callable[[int], MapSurface | None] | None = None

    def __init__(
        self,
        sessions: Iterable[str],
        grid: Callable[[str], OccupancyGrid],
        table: PlaceTable,
        made_with: Config,
        config: Config,
        labels: Mapping[str, Label] | None = None,
        areas_m2: Mapping[str, float] | None = None,
        stored: Callable[[str], SeenPlaces | None] = lambda session: None,
        frames: Mapping[str, BuildingFrame] | None = None,
        drawn: Collection[str] = (),
    ) -> None:
        """Prepare the places of some maps.

        sessions : in the order of `table.session_index`. grid : the map of a session.

        made_with : how the places were cut and described; queries are described in the same way.
        config : its relocalize section says how to search and when to be sure.
        labels : building and floor of sessions, where known.
        areas_m2 : free space of each map, for maps that are not to be read before they are needed.
        stored : what is seen from the places of a session; None: it is computed from the map when it is
            needed.
        frames : where the sessions that are joined lie in their buildings.
        drawn : the sessions whose maps somebody else made.
        """
        self.frames = dict(frames or {})
        self.made_with = made_with
        self.config = config.relocalize
        self.sessions = names = tuple(sessions)
        self.labels = tuple((labels or {}).get(name, Label()) for name in names)
        areas = [areas_m2[name] if areas_m2 else grid(name).free_m2 for name in names]
        # Of a large database, about as many grids are kept as are searched at once, and as many prepared
        # maps, which take ten times as much memory, as one look uses.
        most = most_prepared = None
        if sum(areas) > AT_ONCE_M2:
            most = math.ceil(len(names) * AT_ONCE_M2 / sum(areas))
            most_prepared = FIRST_PLACES + self.config.hypotheses

        @lru_cache(most)
        def grid_of(number: int) -> OccupancyGrid:
            return grid(names[number])

        @lru_cache(most_prepared)
        def map_of(number: int, from_below: bool = False) -> SearchMap:
            return SearchMap.of(grid_of(number), from_below=from_below, drawn=names[number] in drawn)

        self.grid_of: Callable[[int], OccupancyGrid] = grid_of
        self.map_of: Callable[..., SearchMap] = map_of
        self.places = Places(
            table, grid_of, made_with.partition.radius_m, areas, lambda number: stored(names[number])
        )

    @staticmethod
    @one_blas_thread
    def of(database: SubmapDatabase, config: Config, observer: Observer = Observer()) -> MapIndex:
        """Return the index of everything in a database.

        If that is more than `signature.places.places.AT_ONCE_M2` of free floor, maps are read when
        they first matter, and points always are, so the database must stay open as long as the index is used.

        observer : gets the progress where places have to be selected, and a warning if what is seen from them
            is damaged and has to be computed.
        """
        infos = {info.name: info for info in database.sessions()}
        areas_m2 = {name: info.area_m2 for name, info in infos.items()}
        labels = {name: info.provenance.label for name, info in infos.items()}
        lacking: list[str] = []

        def stored(name: str) -> SeenPlaces | None:
            # What is seen from a place follows from the map, so damage to it costs time and no answer.
            with contextlib.suppress(DatabaseCorrupt):
                return database.seen_places(name)
            lacking.append(name)
            return None

        places, made_with = database.signatures().places, database.config()
        frames: Mapping[str, BuildingFrame] = {}
        with contextlib.suppress(DatabaseCorrupt):  # without them a search takes longer, and finds the same
            frames = database.frames()
        drawn = {name for name, info in infos.items() if info.sensor == "map"}
        index = MapIndex(
            infos, database.grid, places, made_with, config, labels, areas_m2, stored, frames, drawn
        )
        if sum(areas_m2.values()) <= AT_ONCE_M2:
            for number in range(len(infos)):
                index.grid_of(number)
        if any(info.points for info in infos.values()):

            @lru_cache(index.config.hypotheses)  # as many as an answer may compare
            def surface_of(number: int) -> MapSurface | None:
                points = database.points(index.sessions[number])
                return None if points is None else MapSurface(points)

            index.surface_of = surface_of
        with observer.step("prepare places"):
            index.places.index(on_progress=observer.on_progress)
        if lacking:
            observer.on_warning(
                f"{database.location}: lacks what is seen from the places of {len(lacking)} of its"
                f" {len(infos)} sessions, so it was computed now; `pc2grid db copy --recover` makes it whole"
            )
        return index

    @staticmethod
    def of_session(database: SubmapDatabase, session: str) -> MapIndex:
        """Return the index of one session of a database by itself, without points."""
        table, config = database.signatures(session).places, database.config()
        table = replace(table, session_index=np.zeros(len(table), np.int32))
        return MapIndex([session], database.grid, table, config, config, stored=database.seen_places)

    def within(self, prior: Prior) -> MapIndex:
        """Return an index of which only places that the prior allows are answers; all that is prepared is
        shared.

        Raises ConfigError if the prior does not name its session where there are several, or an unknown one.
        """
        restricted = copy.copy(self)
        restricted.prior, restricted.whole = prior.of_one(self.sessions), self.whole or self
        return restricted

    def at_look(self, number: int) -> MapIndex:
        """Return an index whose searches end in time for a robot: beside the likeliest places they take one
        batch of the others, at each look the next one.

        number : of the look. All that is prepared is shared. If there is only one batch, it is this index.
        """
        if len(_batches(len(self.places.table))) <= 2:
            return self
        limited = copy.copy(self)
        limited.look = number
        return limited

    def prior_for(self, query: QueryMap) -> Prior | None:
        """Return the prior, if there is one and the motion of the query since its time is known."""
        lapsed = self.prior is None or self.prior.T_odom_prior(query) is None
        return None if lapsed else self.prior

    def allows(self, query: QueryMap, h: Fit) -> bool:
        """Return whether the prior allows the place of a hypothesis; true if there is none that applies."""
        prior = self.prior_for(query)
        T_odom_prior = None if prior is None else prior.T_odom_prior(query)
        if prior is None or T_odom_prior is None:
            return True
        here = self.sessions[h.session_index] == prior.session
        return here and prior.allows(h.T_map_query @ T_odom_prior, query.since_prior_m)

    def search(self, query: QueryMap, known: tuple[Fit, ...] = ()) -> Iterator[tuple[tuple[Fit, ...], float]]:
        """Yield hypotheses for the query, best first, again and again: the known ones, refined, and those
        found next to more and more places, the likeliest first; with a prior, anywhere in its region at once.
        Beside them the share 0..1 of the mass, by the signatures, that is not searched yet.

        What has less than the share `RelocalizeConfig.coarse_keep` of the best coarse score is left out.
        """
        rows, mass = self.places.order(query.views, query.center_m, self.config)
        batches = _batches(len(rows))
        if self.look is not None and len(batches) > 1:
            batches = [batches[0], batches[1 + self.look % (len(batches) - 1)]]
        areas = [self.places.areas(rows[batch]) for batch in batches]
        areas[0] = chain(areas[0], self._allowed(query))
        left = 1.0
        for batch, found in zip(batches, self._look_up(query, areas, known), strict=True):
            left -= float(mass[batch].sum())
            yield found, left

    def in_region(self, query: QueryMap, known: tuple[Fit, ...] = ()) -> tuple[Fit, ...]:
        """Return `known` and what fits anywhere in the region of the prior."""
        return next(self._look_up(query, [self._allowed(query)], known))

    def _look_up(
        self, query: QueryMap, areas: Iterable[Iterable[Area]], known: tuple[Fit, ...]
    ) -> Iterator[tuple[Fit, ...]]:
        map_of = self.maps_for(query)
        return look_up(query, areas, self.places, map_of, self.config, known, lambda h: self.allows(query, h))

    def _allowed(self, query: QueryMap) -> Iterator[Area]:
        """Yield the region of the prior, if there is one that applies."""
        prior = self.prior_for(query)
        if prior is not None and prior.session is not None:
            number = self.sessions.index(prior.session)
            yield Area(number, prior.squares(query, self.places.ground(number)[0], SQUARE_M))

    def maps_for(self, query: QueryMap) -> Callable[[int], SearchMap]:
        """Return what prepares the map of a session, by its index, as it is searched for a query."""

        def facing(number: int) -> SearchMap:
            prepared = self.map_of(number)
            below = query.walls.facing(prepared.walls).only_explain
            return self.map_of(number, True) if below else prepared

        return facing


def _batches(count: int) -> list[I64]:
    """Return the numbers of so many places, likeliest first, in the batches that are searched one after the
    other."""
    return np.split(np.arange(count), range(FIRST_PLACES, count, 10 * FIRST_PLACES))
