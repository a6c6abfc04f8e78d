"""Where is the robot? Scans go in, a belief is held, and after every metre an estimate comes out.

Hypotheses are carried along the query's travel: after every metre the old ones are refined on what has been
seen since, and the database is searched again, so that a wrong first hypothesis is replaced. What was seen
before the last metres is in the masses that the belief holds (`signature.localization.belief`).
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from functools import partial

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import Health, RegisteredScan
from pc2grid.threads import one_blas_thread
from signature.localization.answer import Answer, Moment
from signature.localization.answering import Clock, answer_query
from signature.localization.belief import Belief, State
from signature.localization.decision import PriorOf
from signature.localization.hypotheses import HYPOTHESES, Hypothesis
from signature.localization.map_index import MapIndex
from signature.localization.posterior import POSTERIOR
from signature.localization.query import Query

_MOMENTS = 10_000
"""The latest moments that `Answer.history` tells, some kilometres, so that memory is bounded; by hand."""
_LOST_SCANS = 20
"""A robot of which so many scans in a row cannot be registered is looked for by the last one; by hand."""
_STANDING_S = 2.0
"""A robot that has moved by less than hypotheses differ by is looked for once, after this time; by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Where the query is after one search of the database.

    state : what the answer says of a robot that was located before. registered : the last scan, which the
    answer is about. elapsed_s : time of the search.
    """

    state: State
    answer: Answer
    registered: RegisteredScan
    elapsed_s: float

    @property
    def is_told(self) -> bool:
        """Whether the place is sure enough to tell a robot that it is there."""
        return self.state in ("located", "recovered")

    @property
    def T_map_odom(self) -> SE2 | None:
        """The frame of the robot's own odometry in the map; None without an answer or without odometry."""
        T_map_base, T_odom_base = self.answer.T_map_base, self.registered.scan.T_odom_base
        if T_map_base is None or T_odom_base is None:
            return None
        return T_map_base @ SE2.from_matrix(T_odom_base).inverse()


class Localizer:
    """Takes in the scans of a recording or of a running robot, and says where it is.

    Memory does not grow with the travel.

    index : where to look; `MapIndex.within` restricts it to what is known beforehand: estimates from the time
    of the prior on, or, if it has none, `answer` alone.

    >>> import pc2grid, signature
    >>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     localizer = Localizer(MapIndex.of(database, config))
    ...     for registered, planar_scan in pc2grid.follow(log.scans(), config):
    ...         estimate = localizer.add(registered, planar_scan)
    >>> localizer.answer().status
    'located'
    """

    def __init__(self, index: MapIndex, *, prior_ns: int | None = None) -> None:
        """prior_ns : time at which the pose of the query is wanted (`QueryMap.T_odom_prior`), if not that of
        the prior."""
        self.index = index
        self._belief = Belief(index.config.accept)
        self._history: deque[Moment] = deque(maxlen=_MOMENTS)
        prior_ns = prior_ns if index.prior is None else index.prior.stamp_ns
        self._begin(Query(index.made_with, index.config, prior_ns=prior_ns, in_space=self.uses_points))

    def _begin(self, query: Query) -> None:
        self.query = query
        # Of the last search: part of the query, metres driven in it, and hypotheses.
        self._last: tuple[int, float, tuple[Hypothesis, ...]] = 0, 0.0, ()
        self._answer: Answer | None = None  # of the last scan
        self._history.clear()
        self._clock = Clock()
        self._stood = False

    @property
    def uses_points(self) -> bool:
        """Whether scans must be given with their points."""
        return self.index.surface_of is not None

    @one_blas_thread
    def add(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True
    ) -> Estimate | None:
        """Take in the next scan; returns an estimate if it was time for one.

        That is after every `relocalize.step_m` of travel, once after a while if the robot stands, and when a
        located robot has not been tracked for some scans. If the robot was likely carried away or tracking
        slipped, only the scans since are used from then on.

        may_search : if not, an estimate that is due is put off until it is true.
        """
        begin = time.perf_counter()
        if not self.take(registered, planar_scan, may_search=may_search):
            return None
        try:
            self.query, answer = self._since_slip(self._on_the_way)
        except NoScans:  # the scans since the start, or since registration was lost, show nothing
            return None
        query = self.query.map()
        self._answer = answer if self._on_the_way is self.index else None
        self._last = query.part, query.path_m, answer.hypotheses
        self._history.append(answer.history[-1])
        state = self._belief.follow(self._belief.add(query, answer), located=answer.status == "located")
        if state == "lost" and self._was_located_since_prior():
            self.query.forget_prior()
        elapsed_s = time.perf_counter() - begin
        return Estimate(state=state, answer=answer, registered=registered, elapsed_s=elapsed_s)

    def take(self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True) -> bool:
        """Take in the next scan without a search; whether it is time for one."""
        self._clock.lap("register")
        self.query.add(registered, planar_scan)
        self._answer = None
        if registered.health is Health.LOST:
            return self._belief.located and self.query.lost_scans == _LOST_SCANS
        if not may_search:
            return False
        path_m = self.query.path_m
        waited = registered.scan.stamp_ns - (self.query.first_ns or 0) > _STANDING_S * 1e9
        stands = waited and not self._stood and path_m < HYPOTHESES.same_m
        self._stood = self._stood or waited
        part, last_m, hypotheses = self._last
        if part != self.query.part:
            last_m, hypotheses = 0.0, ()
        is_time = stands or path_m - last_m >= self.index.config.step_m
        if is_time:
            self._last = self.query.part, path_m, hypotheses
        return is_time

    @one_blas_thread
    def answer(self) -> Answer:
        """Where the query is, by the scans so far; what comes later does not depend on whether it was asked.

        Raises NoScans if no scan could be used.
        """
        return self._answer or self._since_slip(self.index)[1]

    def restart(self) -> None:
        """The scans do not go on from those before: what comes next is a search of its own, and a prior of an
        earlier time says nothing of it."""
        self._belief.restart()
        self._begin(self.query.anew())

    @property
    def _on_the_way(self) -> MapIndex:
        """Where to look before the answer is asked: a prior without a time is about none of these scans."""
        timeless = self.index.prior is not None and self.index.prior.stamp_ns is None
        return self.index.whole or self.index if timeless else self.index

    def _was_located_since_prior(self) -> bool:
        """Whether the robot was located after the time of the prior, and not lost by the prior itself."""
        begin_ns = 0 if self.index.prior is None else self.index.prior.stamp_ns or 0
        return any(past.status == "located" and past.stamp_ns >= begin_ns for past in self._history)

    def _since_slip(self, index: MapIndex) -> tuple[Query, Answer]:
        """The answer, and the query that it is about: the scans since the robot was carried away or tracking
        slipped, if that is more likely than not."""
        query, answer = self.query, self.search(self.query, index=index)
        while answer.slipped >= POSTERIOR.likely:
            query = query.since(answer.evidence.scans_since)
            answer = self.search(query, index=index)
        return query, answer

    def search(
        self,
        query: Query,
        known: tuple[Hypothesis, ...] = (),
        prior_of: PriorOf | None = None,
        index: MapIndex | None = None,
    ) -> Answer:
        """Where a query is. Nothing of it is kept.

        known : hypotheses to be compared, too. prior_of : of each place; None: by the searches before the
        last metres. index : where to look, if not where the localizer does. Raises NoScans if no scan could
        be used.
        """
        seen, index = query.map(), index or self.index
        self._clock.lap("describe")
        part, _, carried = self._last
        off_map = self._belief.off_map(index, seen) if prior_of is None else ()
        return answer_query(
            index,
            query,
            seen,
            (*(carried if part == seen.part else ()), *known),
            prior_of=prior_of or partial(self._belief.prior, seen),
            off_map=off_map,
            session_index=self._belief.session_index,
            history=tuple(self._history),
            clock=self._clock,
        )
