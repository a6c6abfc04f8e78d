"""Where in the database was this recording made? Retrieve, verify, carry on, decide.

Hypotheses are carried along the query's travel: at every step the old ones are refined on what has been
seen since, and the database is asked anew, so a wrong first idea costs nothing and the right one gains
support. The answer is `located` only when one hypothesis stands clear of all others.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import Health, OccupancyGrid, RegisteredScan
from pc2grid.sweep import Sweep
from signature.answer import Answer, Moment, Verdict
from signature.building import Building
from signature.config import Config
from signature.query import QueryMap, Window, query_of
from signature.verify import Hypothesis

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

__all__ = ["Answer", "Building", "Relocalizer", "Search", "locate_map", "relocalize"]


class Search:
    """One query in one building: its hypotheses, carried from moment to moment."""

    def __init__(self, building: Building) -> None:
        self.building = building
        self._clock = _Clock()
        self._history: list[Moment] = []
        self.forget()

    @property
    def latest(self) -> Moment | None:
        """The answer as it stood when the database was last asked."""
        return self._history[-1] if self._history else None

    def forget(self) -> None:
        """Begin anew: what the query saw so far says nothing about where it is now."""
        self._hypotheses: tuple[Hypothesis, ...] = ()
        self._asked_m: float | None = None

    def look(self, query: QueryMap) -> None:
        """Ask the database with what the query has seen by now."""
        verdict = self._look_up(query, self.building.judge)
        self._history.append(_moment(self.building, query, verdict))

    def answer(self, query: QueryMap) -> Answer:
        """Where the query is by all that it has seen."""
        verdict = self._look_up(query, self.building.decide)
        return _answer(self.building, query, verdict, tuple(self._history), dict(self._clock.total_ms))

    def _look_up(
        self, query: QueryMap, judge: Callable[[QueryMap, tuple[Hypothesis, ...]], Verdict]
    ) -> Verdict:
        self._clock.start()
        driven_m = 0.0 if self._asked_m is None else query.path_m - self._asked_m
        self._asked_m = query.path_m
        found = self.building.look_up(query, self._hypotheses, driven_m=driven_m)
        self._clock.lap("look_up")
        verdict = judge(query, found)
        self._hypotheses = verdict.hypotheses
        self._clock.lap("decide")
        return verdict


class Relocalizer:
    """Takes in a query scan by scan and can say at any time where it is.

    Scans on which registration was lost are not used, and nothing seen before them is kept: what lies
    between the two parts is unknown.

    >>> import pc2grid, signature
    >>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     relocalizer = Relocalizer(Building.of(database, config))
    ...     for registered, sweep in pc2grid.follow(log.scans(), config):
    ...         relocalizer.add(registered, sweep)
    >>> relocalizer.answer().status
    'located'
    """

    def __init__(self, building: Building, *others: Building) -> None:
        """others : made with the same settings; the query is searched in each of them for itself."""
        self._made_with, self._config = building.made_with, building.config
        self.searches = tuple(Search(b) for b in (building, *others))
        self._clock = _Clock()
        self._forget()

    def _forget(self) -> None:
        self._window = Window(self._made_with.projection, self._config)
        self._asked_m = 0.0
        for search in self.searches:
            search.forget()

    @property
    def path_m(self) -> float:
        """Metres driven since the start, or since registration was lost."""
        return self._window.path_m

    def add(self, registered: RegisteredScan, sweep: Sweep) -> None:
        """The next scan. Every `relocalize.step_m` of travel the database is asked again."""
        self._clock.lap("register")
        if registered.health is Health.LOST:
            self._forget()
            return
        self._window.add(sweep, SE2.flatten(registered.T_map_base))
        if self.path_m - self._asked_m >= self._config.step_m:
            self._asked_m = self.path_m
            query = self.query()
            for search in self.searches:
                search.look(query)
            self._clock.start()

    def answer(self) -> Answer:
        """Where the query is by all that it has seen. Raises NoScans if no scan could be used."""
        self._clock.lap("register")
        answer = self.searches[0].answer(self.query())
        return replace(answer, timing_ms={**self._clock.total_ms, **answer.timing_ms})

    def query(self) -> QueryMap:
        """What the query has seen over its last metres, described as the database is.

        Raises NoScans if no scan could be used.
        """
        if not len(self._window):
            raise NoScans("no scan of the query could be registered", hint="look at it with `pc2grid info`")
        self._clock.start()
        query = self._window.query(self._made_with.partition, self._made_with.signature)
        self._clock.lap("describe")
        return query


def relocalize(
    query: Iterable[tuple[RegisteredScan, Sweep]],
    database: SubmapDatabase,
    config: Config,
    progress: Callable[[int, float], None] | None = None,
) -> Answer:
    """Find where a registered recording was made.

    query : scans with their sweeps, from `pc2grid.pipeline.follow`, in any frame of their own.
    progress : called with (scans so far, metres driven).

    Raises NoScans for a query without a usable scan.

    >>> import pc2grid, signature
    >>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     answer = relocalize(pc2grid.follow(log.scans(), config), database, config)
    >>> answer.status, answer.session, answer.covariance.shape
    ('located', 'monday', (3, 3))
    """
    relocalizer = Relocalizer(Building.of(database, config))
    for count, (registered, sweep) in enumerate(query, start=1):
        relocalizer.add(registered, sweep)
        if progress is not None:
            progress(count, relocalizer.path_m)
    return relocalizer.answer()


def locate_map(grid: OccupancyGrid, building: Building) -> Answer:
    """Find where a drawn map, say a nav2 map or a part of one, lies in the building.

    grid : the query, in any frame of its own; what it does not know is unknown, not empty.

    There is no robot in it, so the "base" of the answer is the map's own frame: `T_map_base` and
    `T_map_odom` both are T_map_query, and no way has been travelled.

    >>> import pc2grid, signature
    >>> with signature.open_database("plan.submaps") as database:
    ...     answer = locate_map(pc2grid.load_map("part.yaml"), Building.of(database, database.config()))
    >>> answer.status, round(answer.T_map_base.x, 1), round(answer.T_map_base.y, 1)
    ('located', 4.0, 3.0)
    """
    clock = _Clock()
    made_with = building.made_with
    query = query_of(
        grid,
        np.empty((0, 2)),
        partition=made_with.partition,
        signature=made_with.signature,
        config=building.config,
        T_odom_base=SE2(),
    )
    # A map's origin may lie anywhere, far outside its walls too. Poses turn about the best observed
    # point instead: it is free, and the walls around it are known.
    if query.views:
        center = query.views[0].center_m
        query = replace(query, T_odom_base=SE2(*center), aligned=replace(query.aligned, center_m=center))
    clock.lap("describe")
    found = building.look_up(query)
    clock.lap("look_up")
    verdict = building.decide(query, found)
    clock.lap("decide")
    at_origin = tuple(_at_origin(h, query.T_odom_base) for h in verdict.hypotheses)
    verdict = replace(verdict, hypotheses=at_origin)
    return _answer(building, replace(query, T_odom_base=SE2()), verdict, (), clock.total_ms)


def _at_origin(hypothesis: Hypothesis, at: SE2) -> Hypothesis:
    """Its covariance, known for the point `at` of the query, as that of the query's own frame."""
    fit = hypothesis.fit
    there = fit.T_map_query @ at
    J = np.eye(3)
    J[:2, 2] = there.y - fit.T_map_query.y, fit.T_map_query.x - there.x
    return replace(hypothesis, fit=replace(fit, covariance=J @ fit.covariance @ J.T))


def _moment(building: Building, query: QueryMap, verdict: Verdict) -> Moment:
    best = verdict.hypotheses[0] if verdict.hypotheses else None
    return Moment(
        stamp_ns=query.stamp_ns,
        path_m=query.path_m,
        status=verdict.status,
        session=building.sessions[best.session_index] if best else None,
        pose=best.fit.T_map_query @ query.T_odom_base if best else None,
        confidence=verdict.confidence,
    )


def _answer(
    building: Building,
    query: QueryMap,
    verdict: Verdict,
    history: tuple[Moment, ...],
    timing_ms: dict[str, float],
) -> Answer:
    located = verdict.hypotheses[0] if verdict.status == "located" else None
    table = building.places.table
    T_map_query = located.fit.T_map_query if located else None
    return Answer(
        status=verdict.status,
        session=building.sessions[located.session_index] if located else None,
        stamp_ns=query.stamp_ns,
        T_map_base=T_map_query @ query.T_odom_base if T_map_query else None,
        covariance=located.fit.covariance if located else None,
        T_map_odom=T_map_query,
        confidence=verdict.confidence,
        hypotheses=verdict.hypotheses,
        places=verdict.places,
        history=(*history, _moment(building, query, verdict)),
        T_odom_base=query.T_odom_base,
        path_m=query.path_m,
        sessions=building.sessions,
        labels=building.labels,
        submap_ids=tuple(int(table.submap_id[h.row]) if h.row >= 0 else -1 for h in verdict.hypotheses),
        evidence=verdict.evidence,
        timing_ms=timing_ms,
    )


class _Clock:
    """Where the time went, by name, milliseconds."""

    def __init__(self) -> None:
        self.total_ms: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Count from now on."""
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Add what has passed since the last lap to `name`."""
        now = time.perf_counter()
        self.total_ms[name] = self.total_ms.get(name, 0.0) + 1000.0 * (now - self._last)
        self._last = now
