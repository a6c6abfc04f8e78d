"""Scans in, an answer after every metre: `Localizer`, and `Follower` beside the tracking.

Hypotheses are carried along the query's travel: after every metre the old ones are refined on what has been
seen since, and the database is searched again, so that a wrong first hypothesis is replaced. What was seen
before the last metres is in the masses of the belief. `Localizer.search` is the whole way of an answer; its
equations are in `signature.localization.posterior`.

A search takes up to seconds in a large building, and a robot sends 40 scans a second. So `Follower` searches
in a thread while tracking goes on; the most expensive parts are compiled and run beside Python.
`ResetPolicy` decides when a robot gets its pose.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.libraries import one_blas_thread
from pc2grid.matching.score import Fit
from pc2grid.model import Health, OccupancyGrid, RegisteredScan
from signature.localization.answer import LIKELY, Answer, State, fits_changed
from signature.localization.posterior import (
    Belief,
    PriorOf,
    decide,
    elsewhere,
    judge,
    settle_in_space,
    slip_of,
    weighed,
)
from signature.places.hypotheses import moved_to_origin
from signature.places.map_index import MapIndex
from signature.places.query import Query, QueryMap, ViewSpacing, map_as_query

MOST_KEPT = 5000
"""So many of the latest answers, scans that wait for a search to end, and poses of scans are kept, so that
memory is bounded: some kilometres, and 50 MB or two minutes of 40 scans a second. By hand."""
_LOST_SCANS = 20
"""A robot of which so many scans in a row cannot be registered is looked for by the last one; by hand."""
_STANDING_S = 2.0
"""A robot that has not driven half of a step is looked for once, after this time since the start, or since
registration was lost; by hand."""


class Localizer:
    """Takes in the scans of a recording or of a running robot, and says where it is.

    Memory does not grow with the travel. uses_points : whether scans must be given with their points.

    index : where to look; `MapIndex.within` restricts it to what is known beforehand: answers from the time
    of the prior on, or, if it has none, `answer` alone.

    >>> import pc2grid, signature
    >>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     localizer = Localizer(MapIndex.of(database, config))
    ...     for registered, planar_scan in pc2grid.follow(log.scans(), config):
    ...         found = localizer.add(registered, planar_scan)  # None but after every metre
    >>> localizer.answer().status
    'located'
    """

    def __init__(self, index: MapIndex, *, prior_ns: int | None = None) -> None:
        """Begin a query without any scan.

        prior_ns : time at which the pose of the query is wanted (`QueryMap.T_odom_prior`), if not that of
        the prior.
        """
        self.index = index
        self._belief = Belief(index.config.accept)
        self._history: deque[Answer] = deque(maxlen=MOST_KEPT)
        prior_ns = prior_ns if index.prior is None else index.prior.stamp_ns
        self.uses_points = index.surface_of is not None
        self.query = Query(index.made_with, index.config, prior_ns=prior_ns, in_space=self.uses_points)
        # Of the last search: part of the query, metres driven in it, and hypotheses.
        self._part, self._last_m, self._known = 0, 0.0, tuple[Fit, ...]()
        self._answer: Answer | None = None  # of the last scan
        self._clock = Clock()
        self._stood = False

    @one_blas_thread
    def add(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True
    ) -> Answer | None:
        """Take in the next scan; returns an answer, with its `state`, if it was time for one.

        That is after every `relocalize.step_m` of travel, once after a while if the robot stands, and when a
        located robot has not been tracked for some scans. If the robot was likely carried away or tracking
        slipped, only the scans since are used from then on.

        may_search : if not, an answer that is due is put off until it is true.
        """
        begin = time.perf_counter()
        if not self.take(registered, planar_scan, may_search=may_search):
            return None
        # A prior without a time is about none of these scans.
        timeless = self.index.prior is not None and self.index.prior.stamp_ns is None
        index = self.index.whole or self.index if timeless else self.index
        index = index.at_look(int(self.query.path_m / index.config.step_m))
        try:
            self.query, answer = self.search(self.query, index=index)
        except NoScans:  # the scans since the start, or since registration was lost, show nothing
            return None
        query, T_odometry_base = self.query.map(), registered.scan.T_odom_base
        self._last_m, self._known = query.path_m, answer.hypotheses
        self._history.append(answer.history[-1])
        answer = replace(
            answer,
            state=self._belief.update(query, answer),
            T_odometry_base=None if T_odometry_base is None else SE2.from_matrix(T_odometry_base),
            elapsed_s=time.perf_counter() - begin,
        )
        self._answer = answer if index is self.index else None
        return answer

    def take(self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True) -> bool:
        """Take in the next scan without a search; whether it is time for one."""
        self._clock.lap("register")
        self.query.add(registered, planar_scan)
        self._answer = None
        if self._part != self.query.part:
            self._part, self._last_m, self._known, self._stood = self.query.part, 0.0, (), False
        if registered.health is Health.LOST:
            return self._belief.located and self.query.lost_scans == _LOST_SCANS
        if not may_search:
            return False
        path_m = self.query.path_m
        waited = registered.scan.stamp_ns - (self.query.first_ns or 0) > _STANDING_S * 1e9
        step_m = self.index.config.step_m
        stands = waited and not self._stood and path_m < 0.5 * step_m
        self._stood = self._stood or waited
        is_time = stands or path_m - self._last_m >= step_m
        if is_time:
            self._last_m = path_m
        return is_time

    @one_blas_thread
    def answer(self) -> Answer:
        """Return where the query is, by the scans so far. Later answers do not depend on this call.

        Raises NoScans if no scan could be used.
        """
        return self._answer or self.search(self.query)[1]

    def restart(self) -> None:
        """Begin a new query: the next scans do not continue those before, and a prior of an earlier time does
        not apply to them."""
        self.query.restart()
        self._answer = None
        self._history.clear()

    def search(
        self,
        query: Query,
        known: tuple[Fit, ...] = (),
        prior_of: PriorOf | None = None,
        index: MapIndex | None = None,
    ) -> tuple[Query, Answer]:
        """Return the query that the answer is about, and the answer: where it is. That is the given query or,
        if the robot was more likely than not carried away or tracking slipped, its scans since. Nothing of it
        is kept.

        known : hypotheses to be compared, too. prior_of : of each place; None: by the searches before the
        last metres. index : where to look, if not where the localizer does. Raises NoScans if no scan could
        be used.
        """
        index, clock = index or self.index, self._clock
        # The local map, described as the database is.
        seen = query.map()
        clock.lap("describe")
        # Places selected by signatures, aligned by walls, and their masses; the prior is what was before.
        before, off_map = self._belief.before(index, seen)
        answer, found = decide(index, seen, (*self._known, *known), prior_of or before)
        answer = _with_prior(index, seen, answer, found)
        clock.lap("search")
        # What contradicts the likeliest place since some scan, and what these scans say alone.
        slipped, since = slip_of(index, seen, answer)
        later = self.search(query.since(since), index=index) if since and query is self.query else None
        if later is not None:
            slipped *= elsewhere(later[1], answer)
        answer, slipped = weighed(answer, off_map, slipped, index.config.accept)
        if later is not None and slipped >= LIKELY:
            return later
        answer = self._belief.in_its_map(answer)
        clock.lap("decide")
        # The points.
        if query.in_space is not None and index.surface_of is not None:
            answer = settle_in_space(answer, query.in_space, index.surface_of, index.config.accept)
            clock.lap("in_space")
        return query, _told(index, answer, self._history, clock)


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


def _with_prior(index: MapIndex, query: QueryMap, answer: Answer, found: tuple[Fit, ...]) -> Answer:
    """Return the answer with whether the prior was used, and, if no place that it allows is certain, the best
    place found that it excludes."""
    if index.whole is None or index.prior is None:
        return answer
    if index.prior_for(query) is None:
        return replace(answer, prior="ahead" if index.prior.is_ahead(query) else "lapsed")
    everywhere = judge(index.whole, query, () if answer.located else found)
    excluded = everywhere.best is not None and not index.allows(query, everywhere.best)
    return replace(answer, prior="used", excluded=everywhere.moment if excluded else None)


@one_blas_thread
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
    query = map_as_query(grid, index.made_with, index.config, drawn=True)
    clock.lap("describe")
    answer, _ = decide(index, query)
    clock.lap("search")

    def at_origin(fit: Fit) -> Fit:
        return replace(fit, covariance=moved_to_origin(fit.covariance, fit.T_map_query, query.T_odom_base))

    places = fits_changed(answer.places, at_origin)
    return _told(index, replace(answer, places=places, T_odom_base=SE2()), (), clock)


def _told(index: MapIndex, answer: Answer, history: Iterable[Answer], clock: Clock) -> Answer:
    """Return an answer, of which nothing is decided any more, with what shows it."""
    best = answer.best
    return replace(
        answer,
        map=None if best is None else index.grid_of(best.session_index),
        history=(*history, answer.moment),
        timing_ms=dict(clock.total_ms),
    )


ResultT = TypeVar("ResultT")
ResultT_co = TypeVar("ResultT_co", covariant=True)


class Follows(Protocol[ResultT_co]):
    """What follows a robot: a `Localizer` or a `PoseWatch`.

    uses_points : whether the scans that `ViewSpacing` takes are needed with their points.
    """

    uses_points: bool

    def add(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True
    ) -> ResultT_co | None:
        """Take in the next scan; returns an answer or a judgement if there is one after it."""
        ...

    def restart(self) -> None:
        """Begin anew: the next scans do not continue those before."""
        ...


class Follower(Generic[ResultT]):
    """Feeds a `Localizer` or a `PoseWatch` with scans, here or in a thread. Use as a context manager.

    lock : is held while the database is read; hold it to read the database in between.
    """

    def __init__(self, localizer: Follows[ResultT], *, beside: bool, step_m: float = 1.0) -> None:
        """Begin without any scan. beside : search in a thread; otherwise each search is made before `add`
        returns, always after the same scans.

        step_m : travel after which a search is due. It is left out if so much travel waits behind it.
        """
        self.lock = threading.Lock()
        self._localizer, self._step_m = localizer, step_m
        self._path_m = 0.0
        self._last: SE2 | None = None
        self._spacing = ViewSpacing()
        self._waiting: deque[tuple[RegisteredScan, PlanarScan, float] | None] = deque(maxlen=MOST_KEPT)
        self._results: deque[Future[ResultT | None]] = deque()
        self._thread = ThreadPoolExecutor(1, "searches") if beside else None

    def __enter__(self) -> Follower[ResultT]:
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread, when it has finished its search."""
        self._waiting.clear()
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan) -> None:
        """Hand over the next scan."""
        pose = SE2.from_matrix(registered.T_session_base)
        if self._last is not None:
            self._path_m += math.hypot(pose.x - self._last.x, pose.y - self._last.y)
        self._last = pose
        if self._thread is not None and not (self._localizer.uses_points and self._spacing.takes(registered)):
            # Of most scans only the pose is used, and a lidar's points would fill the memory.
            scan = replace(registered.scan, points_m=np.empty((0, 3), np.float32), offsets_s=None)
            registered = replace(registered, scan=scan)
        self._hand_over((registered, planar_scan, self._path_m))

    def restart(self) -> None:
        """Begin anew: the next scans do not continue those before."""
        self._last, self._spacing = None, ViewSpacing()
        self._hand_over(None)

    def take(self) -> list[ResultT]:
        """Return the results that are done. Raises what the thread raised."""
        taken = []
        while self._results and self._results[0].done():
            result = self._results.popleft().result()
            taken += [] if result is None else [result]
        return taken

    def finish(self) -> None:
        """Wait until the scans that were handed over are used."""
        wait(self._results)

    def _hand_over(self, item: tuple[RegisteredScan, PlanarScan, float] | None) -> None:
        self._waiting.append(item)
        if self._thread is not None:
            self._results.append(self._thread.submit(self._use_next))
            return
        done: Future[ResultT | None] = Future()
        done.set_result(self._use_next())
        self._results.append(done)

    def _use_next(self) -> ResultT | None:
        try:
            item = self._waiting.popleft()
        except IndexError:  # left out
            return None
        if item is None:
            self._localizer.restart()
            return None
        registered, planar_scan, path_m = item
        with self.lock:
            may_search = self._path_m - path_m < self._step_m
            return self._localizer.add(registered, planar_scan, may_search=may_search)


@dataclass(slots=True)
class ResetPolicy:
    """When `/initialpose` is sent: when the robot is located first, and when it was lost or carried away.

    pause_s : least time between two resets. More of them would keep navigation from continuing.
    """

    pause_s: float = 10.0
    clock: Callable[[], float] = time.monotonic
    _is_due: bool = True
    _last_s: float = -math.inf

    def allows(self, state: State | None) -> bool:
        """Return whether the pose of an answer is to be sent; it then counts as sent.

        state : of each answer in turn.
        """
        self._is_due = self._is_due or state in ("lost", "recovered")
        if state not in ("located", "recovered") or not self._is_due:
            return False
        now_s = self.clock()
        if now_s - self._last_s < self.pause_s:
            return False
        self._is_due, self._last_s = False, now_s
        return True
