"""Where is the robot? Scans go in, a belief is held, an answer comes out whenever it is asked.

Hypotheses are carried along the query's travel: after every metre the old ones are refined on what has been
seen since, and the database is searched again, so that a wrong first hypothesis is replaced. The answer is
`located` only when one hypothesis stands clear of all others.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import Health, OccupancyGrid, RegisteredScan
from signature.config import Config
from signature.localization.answer import Answer, Moment, Verdict
from signature.localization.belief import WATCH, Belief, Place, State, WatchParameters
from signature.localization.hypotheses import Hypothesis
from signature.localization.in_space import settle_in_space
from signature.localization.map_index import MapIndex
from signature.localization.prior import Prior
from signature.localization.query import Query, QueryMap, query_of

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

__all__ = ["Answer", "Localizer", "Look", "MapIndex", "locate", "locate_in", "locate_map"]

Watch = Callable[[RegisteredScan, Moment | None], None]
"""Called with each scan of a query, and with the state of the answer if the database was searched after."""

_MOMENTS = 100
"""The latest moments that are told of a robot that is followed, so that memory is bounded; by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What one look at the database said of a running robot.

    session, T_map_base : where the robot is, None unless the answer is `located`. Of several maps that show
    the place, the one in which the robot was located before. registered : the scan of the look; its pose and
    odometry belong to the answer. elapsed_s : time of the look.
    """

    state: State
    answer: Answer
    session: str | None
    T_map_base: SE2 | None
    registered: RegisteredScan
    elapsed_s: float

    @property
    def T_map_odom(self) -> SE2 | None:
        """The frame of the robot's own odometry in the map; None without an answer or without odometry."""
        T_odom_base = self.registered.scan.T_odom_base
        if self.T_map_base is None or T_odom_base is None:
            return None
        return self.T_map_base @ SE2.from_matrix(T_odom_base).inverse()


class Clock:
    """Adds up elapsed times by name, milliseconds. All time since the last lap belongs to the next one."""

    def __init__(self) -> None:
        self.total_ms: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Add the time since the last lap to `name`."""
        now = time.perf_counter()
        self.total_ms[name] = self.total_ms.get(name, 0.0) + 1000.0 * (now - self._last)
        self._last = now


@dataclass(frozen=True, slots=True)
class _Carried:
    """From the last look: the part of the query, the path then, and the hypotheses in that odometry frame."""

    part: int
    path_m: float = 0.0
    hypotheses: tuple[Hypothesis, ...] = ()


class Localizer:
    """Takes in the scans of a recording or of a running robot, and answers at any time where it is.

    For a recording, `add` scans and ask for the `answer`. A robot that runs is followed by `follow`, which
    says after each look whether it is located, lost or recovered. Memory does not grow, but for the moments
    that `add` has told.

    >>> import pc2grid, signature
    >>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     localizer = Localizer(MapIndex.of(database, config))
    ...     for registered, planar_scan in pc2grid.follow(log.scans(), config):
    ...         moment = localizer.add(registered, planar_scan)
    >>> localizer.answer().status
    'located'
    """

    def __init__(
        self,
        index: MapIndex,
        *,
        query: Query | None = None,
        prior_ns: int | None = None,
        parameters: WatchParameters = WATCH,
    ) -> None:
        """index : where to look; `MapIndex.within` restricts it to what is known beforehand.

        prior_ns : time at which the pose of the query is wanted (`QueryMap.T_odom_prior`), if not that of the
            prior. query : scans that several localizers share; whoever shares them adds to it.
        """
        self._parameters = parameters
        self._belief = Belief(parameters)
        self._history: deque[Moment] = deque()
        self._begin(index, query, prior_ns)

    def _begin(self, index: MapIndex, query: Query | None = None, prior_ns: int | None = None) -> None:
        self.index = index
        prior_ns = prior_ns if index.prior is None else index.prior.stamp_ns
        in_space = index.points_of is not None
        if query is None:
            query = Query(index.made_with, index.config, prior_ns=prior_ns, in_space=in_space)
        self.query = query
        self._carried = _Carried(self.query.part)
        self._history.clear()
        self._clock = Clock()
        self._stood = False

    @property
    def uses_points(self) -> bool:
        """Whether scans must be given with their points."""
        return self.index.points_of is not None

    @property
    def located(self) -> bool:
        """Whether the last looks of `follow` agree on where the robot is."""
        return self._belief.place is not None

    @property
    def path_m(self) -> float:
        """Metres driven since the start, or since registration was lost."""
        return self.query.path_m

    @property
    def due(self) -> bool:
        """Whether the robot has travelled `relocalize.step_m` since the last look."""
        return self.path_m - self._last_look.path_m >= self.index.config.step_m

    @property
    def _last_look(self) -> _Carried:
        """What the last look said, if it was of this part of the query."""
        return self._carried if self._carried.part == self.query.part else _Carried(self.query.part)

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan) -> Moment | None:
        """Take in the next scan. After every `relocalize.step_m` of travel the database is searched, and the
        present state of the answer is returned."""
        self._clock.lap("register")
        self.query.add(registered, planar_scan)
        return self.look() if self.due else None

    def look(self) -> Moment:
        """Search the database now. Raises NoScans if no scan could be used."""
        query, found = self._search()
        verdict = self.index.judge(query, found)
        self._clock.lap("decide")
        self._carried = _Carried(query.part, query.path_m, verdict.hypotheses)
        self._history.append(_moment(self.index, query, verdict))
        return self._history[-1]

    def looked(self) -> None:
        """The database was searched now without `look`: the next one is due a metre later."""
        self._carried = replace(self._last_look, path_m=self.path_m)

    def answer(self, known: tuple[Hypothesis, ...] = ()) -> Answer:
        """Where the query is by all that it has seen. The search goes on as if it had not been asked.

        known : hypotheses to be compared, too. Raises NoScans if no scan could be used.
        """
        query, found = self._search(known)
        return answer_query(
            self.index, self.query, query, found, history=tuple(self._history), clock=self._clock
        )

    def _search(self, known: tuple[Hypothesis, ...] = ()) -> tuple[QueryMap, tuple[Hypothesis, ...]]:
        """The query, and what retrieval proposes for it beside the hypotheses of the last look."""
        query = self.query.map()
        self._clock.lap("describe")
        found = self.index.look_up(query, (*self._last_look.hypotheses, *known))
        self._clock.lap("look_up")
        return query, found

    def restart(self) -> None:
        """The scans do not go on from those before: what comes next is a search of its own, everywhere."""
        self._belief.restart()
        self._begin(self.index.whole or self.index)  # what was known beforehand was about the first search

    def take(self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_look: bool = True) -> bool:
        """Take in the next scan of a running robot; whether it is time to look: after every
        `relocalize.step_m`, and once after a while if it stands. may_look : if not, this is put off."""
        self._clock.lap("register")
        self.query.add(registered, planar_scan)
        stamp_ns, first_ns = registered.scan.stamp_ns, self.query.first_ns
        if not may_look or registered.health is Health.LOST or first_ns is None:
            return False
        stands = False
        if not self._stood and stamp_ns - first_ns > self._parameters.standing_s * 1e9:
            self._stood, stands = True, self.path_m < self._parameters.standing_m
        return self.due or stands

    def follow(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_look: bool = True
    ) -> Look | None:
        """Take in the next scan of a running robot; returns what a look said if there was one after it.

        A prior without a stamp is about the first scan. Any prior counts until the robot is lost or the scans
        do not go on.

        may_look : if not, a look that is due is put off until it is true.
        """
        begin = time.perf_counter()
        prior = self.index.prior
        if prior is not None and prior.stamp_ns is None:
            self._begin(self.index.within(replace(prior, stamp_ns=registered.scan.stamp_ns)))
        is_time = self.take(registered, planar_scan, may_look=may_look)
        gives_up = self.located and self.query.lost_scans == self._parameters.lost_scans
        if not (is_time or gives_up):
            return None
        try:
            if self.due:
                self.look()
                self._history = deque(self._history, _MOMENTS)
            answer = self.answer()
        except NoScans:  # the scans since the start, or since registration was lost, show nothing
            return None
        found = self._place_of(answer, SE2.from_matrix(registered.T_session_base))
        was_located = self.located
        state = self._belief.update(found, gives_up)
        if was_located and not self.located:
            self.restart()
        return Look(
            state=state,
            answer=answer,
            session=None if found is None else found.session,
            T_map_base=None if found is None else found.T_map_base,
            registered=registered,
            elapsed_s=time.perf_counter() - begin,
        )

    def _place_of(self, answer: Answer, T_session_base: SE2) -> Place | None:
        """The place of a located answer, in the map of the place before if that shows it, too."""
        if answer.status != "located":
            return None
        known = self._belief.place or self._belief.candidate
        here = [
            h for h, place in zip(answer.hypotheses, answer.places, strict=True) if place == answer.places[0]
        ]
        same = [h for h in here if known and answer.sessions[h.session_index] == known.session]
        best = (same or here)[0]
        T_map_base = best.fit.T_map_query @ answer.T_odom_base
        return Place(answer.sessions[best.session_index], T_map_base, T_session_base, self.query.driven_m)


def answer_query(
    index: MapIndex,
    query: Query,
    seen: QueryMap,
    found: tuple[Hypothesis, ...],
    *,
    history: tuple[Moment, ...] = (),
    look_outside: bool = True,
    clock: Clock | None = None,
) -> Answer:
    """Where a query is by all that it has seen or, if that does not settle it, by the last metres; refined
    and checked in space where both sides have points.

    seen : `query` drawn. found : hypotheses for it.
    look_outside : find the best place that a prior excludes, if none that it allows is certain.
    """
    clock = clock or Clock()
    verdict = index.decide(seen, found)
    clock.lap("decide")
    if verdict.status != "located":
        seen, verdict = _by_last_metres(index, seen, verdict, query.last_metres())
        clock.lap("last_metres")
    answer = _answer(index, seen, verdict, history)
    if index.whole is not None:
        answer = _with_prior(index, index.whole, answer, seen, look_outside)
        clock.lap("decide")
    if query.in_space is not None and index.points_of is not None:
        answer = settle_in_space(answer, query.in_space, index.points_of, index.config.accept)
        clock.lap("in_space")
    return replace(answer, timing_ms=dict(clock.total_ms))


def _by_last_metres(
    index: MapIndex, query: QueryMap, verdict: Verdict, last_metres: Iterable[QueryMap]
) -> tuple[QueryMap, Verdict]:
    """The first of the shorter queries that is located, with its verdict; the query itself if none is.

    A stretch through rooms that the map lacks or shows otherwise spoils the whole query, even after the robot
    is back. The odds of the n-th attempt are 1 / n^2 beforehand: 1 / n, because each further attempt may be
    wrong, and 1 / n again, because a query of which only the last metres lie in this map is rarer.
    """
    for attempts, shorter in enumerate(last_metres, start=2):
        found, odds = index.look_up(shorter, verdict.hypotheses), attempts**-2
        if index.judge(shorter, found, odds).status == "located":
            by_last = index.decide(shorter, found, odds)
            if by_last.status == "located":
                return shorter, by_last
    return query, verdict


def _with_prior(
    index: MapIndex, whole: MapIndex, answer: Answer, query: QueryMap, look_outside: bool
) -> Answer:
    """The answer with what became of the prior.

    Where nothing that it allows is certain, all places are searched. What is certain without the prior is
    not taken away by it, although a search of the whole region finds more rivals than signatures
    propose; and a query that certainly is elsewhere is not in the region.
    """
    if not index.prior_applies(query):
        return replace(answer, prior="lapsed")
    answer = replace(answer, prior="used")
    if answer.status == "located" or not look_outside:
        return answer
    verdict = whole.decide(query, whole.look_up(query))
    if not verdict.hypotheses:
        return answer
    if index.allowed(verdict.hypotheses[:1], query):
        if verdict.status == "located":
            answer = replace(_answer(index, query, verdict, answer.history[:-1]), prior="used")
        return answer
    excluded = _moment(whole, query, verdict)
    if excluded.status == "located":
        last = replace(answer.history[-1], status="not_found")
        answer = replace(answer, status="not_found", history=(*answer.history[:-1], last))
    return replace(answer, excluded=excluded)


def locate_in(
    scans: Iterable[tuple[RegisteredScan, PlanarScan]],
    index: MapIndex,
    *,
    until_located: bool = False,
    watch: Watch | None = None,
    answer_at: Callable[[RegisteredScan], bool] | None = None,
) -> Answer:
    """Find where a registered recording was made.

    scans : with their planar scans, from `pc2grid.pipeline.follow`, in any frame of their own.
    until_located : answer after every metre of travel, and end with the first answer that is `located`.
    watch : called after each scan, with the state of the answer.
    answer_at : whether, at a scan after which the database is searched, the answer itself is wanted, which
        takes longer than the looks of `Answer.history`; `watch` then gets what the answer would be, and no
        other state.

    Raises NoScans if an answer is due and no scan could be used.
    """
    localizer = Localizer(index)
    for registered, planar_scan in scans:
        moment = localizer.add(registered, planar_scan)
        due = moment is not None
        if due and answer_at is not None:
            moment = localizer.answer().history[-1] if answer_at(registered) else None
        if watch is not None:
            watch(registered, moment)
        if until_located and due and (answer := localizer.answer()).status == "located":
            return answer
    return localizer.answer()


def locate(
    query: Iterable[tuple[RegisteredScan, PlanarScan]],
    database: SubmapDatabase,
    config: Config,
    watch: Watch | None = None,
    *,
    prior: Prior | None = None,
    answer_at: Callable[[RegisteredScan], bool] | None = None,
) -> Answer:
    """Find where a registered recording was made.

    query : scans with their planar scans, from `pc2grid.pipeline.follow`, in any frame of their own.
    watch : called with each scan, and with the state of the answer if the database was searched after it.
    prior : what is known of the pose beforehand; other places are no answers.
    answer_at : see `locate_in`.

    Where the database keeps points (`convert --points`) and the query is of a lidar or depth camera, the pose
    is refined and checked in space (`Answer.in_space`).

    Raises NoScans for a query without a usable scan.

    >>> import pc2grid, signature
    >>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     answer = locate(pc2grid.follow(log.scans(), config), database, config)
    >>> answer.status, answer.session, answer.covariance.shape
    ('located', 'monday', (3, 3))
    """
    index = MapIndex.of(database, config)
    index = index if prior is None else index.within(prior)
    return locate_in(query, index, watch=watch, answer_at=answer_at)


def locate_map(grid: OccupancyGrid, index: MapIndex) -> Answer:
    """Find where a drawn map, for example a nav2 map or a part of one, lies in the building.

    grid : the query, in any frame of its own; cells that it does not know must be unknown, not free.

    There is no robot in it, so the "base" of the answer is the map's own frame: `T_map_base` and
    `T_map_odom` both are T_map_query, and the travelled path is 0 m long.

    >>> import pc2grid, signature
    >>> with signature.open_database("plan.submaps") as database:
    ...     answer = locate_map(pc2grid.load_map("part.yaml"), MapIndex.of(database, database.config()))
    >>> answer.status, round(answer.T_map_base.x, 1), round(answer.T_map_base.y, 1)
    ('located', 4.0, 3.0)
    """
    clock = Clock()
    query = query_of(grid, np.empty((0, 2)), index.made_with, index.config)
    # The origin of a map may lie anywhere, even far outside its walls. Poses turn about the best observed
    # point instead: it is free, and the walls around it are known.
    if query.views:
        center = query.views[0].center_m
        query = replace(query, T_odom_base=SE2(*center), center_m=center)
    clock.lap("describe")
    found = index.look_up(query)
    clock.lap("look_up")
    verdict = index.decide(query, found)
    clock.lap("decide")
    at_origin = tuple(_at_origin(h, query.T_odom_base) for h in verdict.hypotheses)
    verdict = replace(verdict, hypotheses=at_origin)
    answer = _answer(index, replace(query, T_odom_base=SE2()), verdict, ())
    return replace(answer, timing_ms=clock.total_ms)


def _at_origin(hypothesis: Hypothesis, at: SE2) -> Hypothesis:
    """The hypothesis with its covariance, known for the point `at` of the query, moved to the query's
    origin."""
    fit = hypothesis.fit
    there = fit.T_map_query @ at
    J = np.eye(3)
    J[:2, 2] = there.y - fit.T_map_query.y, fit.T_map_query.x - there.x
    return replace(hypothesis, fit=replace(fit, covariance=J @ fit.covariance @ J.T))


def _moment(index: MapIndex, query: QueryMap, verdict: Verdict) -> Moment:
    best = verdict.hypotheses[0] if verdict.hypotheses else None
    return Moment(
        stamp_ns=query.stamp_ns,
        path_m=query.path_m,
        status=verdict.status,
        session=index.sessions[best.session_index] if best else None,
        pose=best.fit.T_map_query @ query.T_odom_base if best else None,
        confidence=verdict.confidence,
    )


def _answer(index: MapIndex, query: QueryMap, verdict: Verdict, history: tuple[Moment, ...]) -> Answer:
    located = verdict.hypotheses[0] if verdict.status == "located" else None
    table = index.places.table
    T_map_query = located.fit.T_map_query if located else None
    return Answer(
        status=verdict.status,
        session=index.sessions[located.session_index] if located else None,
        stamp_ns=query.stamp_ns,
        T_map_base=T_map_query @ query.T_odom_base if T_map_query else None,
        covariance=located.fit.covariance if located else None,
        T_map_odom=T_map_query,
        confidence=verdict.confidence,
        hypotheses=verdict.hypotheses,
        places=verdict.places,
        history=(*history, _moment(index, query, verdict)),
        T_odom_base=query.T_odom_base,
        path_m=query.path_m,
        sessions=index.sessions,
        labels=index.labels,
        submap_ids=tuple(int(table.submap_id[h.row]) if h.row >= 0 else -1 for h in verdict.hypotheses),
        evidence=verdict.evidence,
        local_map=query.grid,
    )
