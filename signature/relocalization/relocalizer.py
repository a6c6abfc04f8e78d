"""Where in the database was this recording made?

Hypotheses are carried along the query's travel: after every metre the old ones are refined on what has been
seen since, and the database is asked again, so that a wrong first hypothesis is replaced. The answer is
`located` only when one hypothesis stands clear of all others.

`localize` asks this question for a recording; the command line, the API and the evaluation all use it. A
robot that wants to know its place while it drives uses a `Relocalizer`.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import Health, OccupancyGrid, RegisteredScan
from signature.config import Config
from signature.relocalization.answer import Answer, Moment, Verdict
from signature.relocalization.hypotheses import Hypothesis
from signature.relocalization.in_space import QueryInSpace, settle_in_space
from signature.relocalization.map_index import MapIndex
from signature.relocalization.prior import Prior
from signature.relocalization.query_map import QUERY, QueryMap, QueryWindow, query_of

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

__all__ = ["Answer", "Asked", "MapIndex", "Relocalizer", "Search", "localize", "locate_map", "relocalize"]

Watch = Callable[[RegisteredScan, Moment | None], None]
"""Called with each scan of a query, and with the state of the answer if the database was asked after it."""


class Search:
    """One query in one index: its hypotheses, carried from moment to moment."""

    def __init__(
        self,
        index: MapIndex,
        hypotheses: tuple[Hypothesis, ...] = (),
        *,
        most_moments: int | None = None,
    ) -> None:
        """hypotheses : known beforehand, for the first part of the query. most_moments : how many of the
        latest moments are kept; None: all."""
        self.index = index
        self._clock = _Clock()
        self._history: deque[Moment] = deque(maxlen=most_moments)
        self._hypotheses = hypotheses
        self._part = 0

    def look(self, query: QueryMap) -> Moment:
        """Ask the database with what the query has seen so far."""
        verdict = self._verdict(query, self.index.judge)
        self._hypotheses = verdict.hypotheses
        self._history.append(_moment(self.index, query, verdict))
        return self._history[-1]

    def answer(
        self,
        query: QueryMap,
        last_metres: Iterable[QueryMap] = (),
        in_space: QueryInSpace | None = None,
        *,
        look_outside: bool = True,
    ) -> Answer:
        """Where the query is by all that it has seen or, if that does not settle it, by the last metres;
        refined and checked in space where both sides have points.

        The search goes on as if it had not been asked.

        last_metres : the query again, each time with less of its travel; made only when they are needed.
        in_space : the scans of the query in space; None: the answer is of the plane.
        look_outside : find the best place that a prior excludes, if none that it allows is certain.
        """
        index = self.index
        verdict = self._verdict(query, index.decide)
        if verdict.status != "located":
            query, verdict = self._by_last_metres(query, verdict, last_metres)
        answer = self._answer(query, verdict)
        if index.whole is not None:
            answer = self._with_prior(answer, query, look_outside)
        if in_space is not None and index.points_of is not None:
            self._clock.start()
            answer = settle_in_space(answer, in_space, index.points_of, index.config.accept)
            self._clock.lap("in_space")
        return replace(answer, timing_ms=dict(self._clock.total_ms))

    def _answer(self, query: QueryMap, verdict: Verdict) -> Answer:
        return _answer(self.index, query, verdict, tuple(self._history))

    def _with_prior(self, answer: Answer, query: QueryMap, look_outside: bool) -> Answer:
        """The answer with what became of the prior.

        Where nothing that it allows is certain, all places are asked. What is certain without the prior is
        not taken away by it, although a search of the whole region finds more rivals than signatures
        propose; and a query that certainly is elsewhere is not in the region.
        """
        index, whole = self.index, self.index.whole
        assert whole is not None
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
                answer = replace(self._answer(query, verdict), prior="used")
            return answer
        excluded = _moment(whole, query, verdict)
        if excluded.status == "located":
            last = replace(answer.history[-1], status="not_found")
            answer = replace(answer, status="not_found", history=(*answer.history[:-1], last))
        return replace(answer, excluded=excluded)

    def _by_last_metres(
        self, query: QueryMap, verdict: Verdict, last_metres: Iterable[QueryMap]
    ) -> tuple[QueryMap, Verdict]:
        """The first of the shorter queries that is located, with its verdict; the query itself if none is.

        A stretch through rooms that the map lacks or shows otherwise spoils the whole query, even after the
        robot is back. Each further attempt may be wrong, so with the n-th one the probability of an error
        counts n times (Bonferroni's correction).
        """
        self._clock.start()
        for attempts, shorter in enumerate(last_metres, start=2):
            found = self.index.look_up(shorter, verdict.hypotheses)
            for judge in (self.index.judge, self.index.judge_everywhere):
                by_last = judge(shorter, found)
                confidence = 1.0 - attempts * (1.0 - by_last.confidence)
                if confidence < self.index.config.accept:
                    break
            else:
                self._clock.lap("last_metres")
                return shorter, replace(by_last, confidence=confidence)
        self._clock.lap("last_metres")
        return query, verdict

    def _verdict(
        self, query: QueryMap, judge: Callable[[QueryMap, tuple[Hypothesis, ...]], Verdict]
    ) -> Verdict:
        self._clock.start()
        if query.part != self._part:  # hypotheses of an earlier part are in another odom frame
            self._hypotheses, self._part = (), query.part
        found = self.index.look_up(query, self._hypotheses)
        self._clock.lap("look_up")
        verdict = judge(query, found)
        self._clock.lap("decide")
        return verdict


class Query:
    """A recording, scan by scan, as what is asked for: its last metres, in the plane and, if the index has
    points, in space; and when to ask again.

    Scans on which registration was lost are not used, and nothing seen before them is kept, because the
    motion between the two parts is unknown. If registration was lost on
    the last scan, this scan alone is the query.
    """

    def __init__(self, index: MapIndex) -> None:
        """index : the query is drawn and described with the settings of its database; if it has a prior, the
        pose at the time of that is remembered."""
        self._made_with, self._config = index.made_with, index.config
        self._prior_ns = None if index.prior is None else index.prior.stamp_ns
        self._prior_gap_ns: int | None = None  # from that time to the nearest scan so far
        self._prior_at: tuple[SE2, float] | None = None  # the base and the path there
        self._clock = _Clock()
        self._part = -1
        self._lost: tuple[PlanarScan, SE2] | None = None  # the last scan, if registration was lost on it
        self._in_space = None if index.points_of is None else QueryInSpace()
        self._restart()

    def _restart(self) -> None:
        self._window = QueryWindow(self._made_with.projection, self._config)
        self._asked_m = 0.0
        self._prior_at = None  # the motion from there to here is not known
        self._part += 1

    @property
    def path_m(self) -> float:
        """Metres driven since the start, or since registration was lost."""
        return self._window.path_m

    @property
    def timing_ms(self) -> dict[str, float]:
        """Where the time went: registration, before each `add`, and the description of query maps."""
        return dict(self._clock.total_ms)

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan) -> bool:
        """Take in the next scan. Returns whether the database is to be asked again: after every
        `relocalize.step_m` of travel."""
        self._clock.lap("register")
        if self._in_space is not None:
            self._in_space.add(registered)
        pose = SE2.from_matrix(registered.T_session_base)
        if registered.health is Health.LOST:
            self._restart()
            self._lost = (planar_scan, pose) if len(planar_scan.hits_m) else None
            return False
        self._window.add(planar_scan, pose)
        self._remember_prior(planar_scan.stamp_ns, pose)
        due = self.path_m - self._asked_m >= self._config.step_m
        if due:
            self._asked_m = self.path_m
        return due

    def _remember_prior(self, stamp_ns: int, pose: SE2) -> None:
        if self._prior_ns is None:
            return
        gap_ns = abs(stamp_ns - self._prior_ns)
        if self._prior_gap_ns is None or gap_ns < self._prior_gap_ns:
            self._prior_gap_ns, self._prior_at = gap_ns, (pose, self.path_m)

    def _placed(self, query: QueryMap) -> QueryMap:
        """The query with what the window does not know: its odom frame, and where the prior lies in it."""
        query = replace(query, part=self._part)
        if self._prior_at is None:
            return query
        T_odom_prior, path_m = self._prior_at
        return replace(query, T_odom_prior=T_odom_prior, since_prior_m=query.path_m - path_m)

    def map(self) -> QueryMap:
        """What has been seen over the last metres, described as the database is.

        Raises NoScans if no scan could be used.
        """
        window = self._window
        if not len(window):
            if self._lost is None:
                raise NoScans("no scan of the query shows anything", hint="look at it with `pc2grid info`")
            window = QueryWindow(self._made_with.projection, self._config)
            window.add(*self._lost)
        self._clock.start()
        query = window.query(self._made_with.partition, self._made_with.signature)
        self._clock.lap("describe")
        return self._placed(query)

    def last_metres(self) -> Iterator[QueryMap]:
        """The query map again, with the last metres only, as long as these are less than the whole."""
        made_with = self._made_with
        for last_m in QUERY.last_m:
            if last_m < min(self.path_m, self._config.window_m):
                shorter = self._window.query(made_with.partition, made_with.signature, last_m)
                yield self._placed(shorter)

    def answer(self, search: Search) -> Answer:
        """What a search says now. Raises NoScans if no scan could be used."""
        answer = search.answer(self.map(), self.last_metres(), self._in_space)
        return replace(answer, timing_ms={**self.timing_ms, **answer.timing_ms})

    def resume(self) -> None:
        """The work on the query map is done; from now on, time counts as registration."""
        self._clock.start()


class Relocalizer:
    """Takes in a query scan by scan, and answers at any time where it is.

    >>> import pc2grid, signature
    >>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     relocalizer = Relocalizer(MapIndex.of(database, config))
    ...     for registered, planar_scan in pc2grid.follow(log.scans(), config):
    ...         moment = relocalizer.add(registered, planar_scan)
    >>> relocalizer.answer().status
    'located'
    """

    def __init__(self, index: MapIndex, most_moments: int | None = None) -> None:
        """index : where to look; `MapIndex.within` restricts it to what is known beforehand.

        most_moments : how many of the latest moments an answer tells, for a robot that runs for hours.
        """
        self._query, self._search = Query(index), Search(index, most_moments=most_moments)

    @property
    def path_m(self) -> float:
        """Metres driven since the start, or since registration was lost."""
        return self._query.path_m

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan) -> Moment | None:
        """Take in the next scan. After every `relocalize.step_m` of travel the database is asked, and the
        present state of the answer is returned."""
        return self.look() if self.take(registered, planar_scan) else None

    def take(self, registered: RegisteredScan, planar_scan: PlanarScan) -> bool:
        """Take in the next scan, and leave it to the caller to `look`; returns whether it is time to."""
        return self._query.add(registered, planar_scan)

    def look(self) -> Moment:
        """Ask the database now. Raises NoScans if no scan could be used."""
        moment = self._search.look(self._query.map())
        self._query.resume()
        return moment

    def answer(self) -> Answer:
        """Where the query is by all that it has seen. Raises NoScans if no scan could be used."""
        answer = self._query.answer(self._search)
        self._query.resume()
        return answer


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """The answers to a query after `scans` of its scans, one for each index. elapsed_ms : time of each."""

    scans: int
    query: QueryMap
    answers: tuple[Answer, ...]
    elapsed_ms: tuple[float, ...]


def localize(
    scans: Iterable[tuple[RegisteredScan, PlanarScan]],
    indexes: Sequence[MapIndex],
    *,
    after: Collection[int] | None = None,
    until_located: bool = False,
    watch: Watch | None = None,
    ask: Callable[[RegisteredScan], bool] | None = None,
) -> Iterator[Asked]:
    """Ask where a registered recording was made, in each of several indexes separately.

    scans : with their planar scans, from `pc2grid.pipeline.follow`, in any frame of their own.
    indexes : at least one, of databases made with the same settings; of priors for a time, that of the first.
    after : numbers of scans after which the answers are wanted; by default after the last scan.
    until_located : ask after every metre of travel, and end with the first answers that are `located`.
    watch : called after each scan, with the state of the answer in the first index.
    ask : whether, at a scan after which the database is asked, the answer itself is wanted, which takes
        longer than the looks of `Answer.history`; `watch` then gets what the answer would be, and no other
        state.

    Raises NoScans if an answer is due and no scan could be used.
    """
    query, searches = Query(indexes[0]), [Search(index) for index in indexes]

    def asked(count: int) -> Asked:
        begin = time.perf_counter()
        seen = query.map()
        describe_ms = 1000.0 * (time.perf_counter() - begin)
        answers, elapsed_ms = [], []
        for search in searches:
            begin = time.perf_counter()
            answers.append(query.answer(search))
            elapsed_ms.append(describe_ms + 1000.0 * (time.perf_counter() - begin))
        query.resume()
        return Asked(scans=count, query=seen, answers=tuple(answers), elapsed_ms=tuple(elapsed_ms))

    count = 0
    for count, (registered, planar_scan) in enumerate(scans, start=1):
        moment: Moment | None = None
        due = query.add(registered, planar_scan)
        if due:
            moment, *_ = [search.look(query.map()) for search in searches]
            if ask is not None:
                moment = query.answer(searches[0]).history[-1] if ask(registered) else None
            query.resume()
        if watch is not None:
            watch(registered, moment)
        if after is not None and count in after:
            yield asked(count)
        if until_located and due:
            so_far = asked(count)
            if all(answer.status == "located" for answer in so_far.answers):
                yield so_far
                return
    if after is None:
        yield asked(count)


def relocalize(
    query: Iterable[tuple[RegisteredScan, PlanarScan]],
    database: SubmapDatabase,
    config: Config,
    watch: Watch | None = None,
    *,
    prior: Prior | None = None,
    ask: Callable[[RegisteredScan], bool] | None = None,
) -> Answer:
    """Find where a registered recording was made.

    query : scans with their planar scans, from `pc2grid.pipeline.follow`, in any frame of their own.
    watch : called with each scan, and with the state of the answer if the database was asked after it.
    prior : what is known of the pose beforehand; other places are no answers.
    ask : see `localize`.

    Where the database keeps points (`convert --points`) and the query is of a lidar or depth camera, the pose
    is refined and checked in space (`Answer.in_space`).

    Raises NoScans for a query without a usable scan.

    >>> import pc2grid, signature
    >>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     answer = relocalize(pc2grid.follow(log.scans(), config), database, config)
    >>> answer.status, answer.session, answer.covariance.shape
    ('located', 'monday', (3, 3))
    """
    index = MapIndex.of(database, config)
    (asked,) = localize(query, [index if prior is None else index.within(prior)], watch=watch, ask=ask)
    return asked.answers[0]


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
    clock = _Clock()
    made_with = index.made_with
    query = query_of(
        grid,
        np.empty((0, 2)),
        partition=made_with.partition,
        signature=made_with.signature,
        config=index.config,
        T_odom_base=SE2(),
    )
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


class _Clock:
    """Adds up elapsed times by name, milliseconds."""

    def __init__(self) -> None:
        self.total_ms: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Begin a lap."""
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Add the time since the last lap to `name`."""
        now = time.perf_counter()
        self.total_ms[name] = self.total_ms.get(name, 0.0) + 1000.0 * (now - self._last)
        self._last = now
