"""Where is the robot? Scans go in, a belief is held, an answer comes out whenever it is asked.

Hypotheses are carried along the query's travel: after every metre the old ones are refined on what has been
seen since, and the database is searched again, so that a wrong first hypothesis is replaced. What was seen
before the last metres is in the masses that the belief holds (`signature.localization.belief`).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import Health, RegisteredScan
from signature.config import Config
from signature.localization.answer import Answer, Moment
from signature.localization.answering import Clock, answer_query, locate_map, moment_of
from signature.localization.belief import Belief, State
from signature.localization.decision import PriorOf, judge
from signature.localization.hypotheses import HYPOTHESES, Hypothesis
from signature.localization.map_index import MapIndex
from signature.localization.posterior import POSTERIOR
from signature.localization.prior import Prior
from signature.localization.query import Query, QueryMap

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

__all__ = ["Answer", "Localizer", "Look", "MapIndex", "locate", "locate_in", "locate_map"]

Watch = Callable[[RegisteredScan, Moment | None], None]
"""Called with each scan of a query, and with the state of the answer if the database was searched after."""

_MOMENTS = 100
"""The latest moments that are told of a robot that is followed, so that memory is bounded; by hand."""
_LOST_SCANS = 20
"""A robot of which so many scans in a row cannot be registered is looked for by the last one; by hand."""
_STANDING_S = 2.0
"""A robot that has moved by less than hypotheses differ by is looked for once, after this time; by hand."""


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

    def __init__(self, index: MapIndex, *, query: Query | None = None, prior_ns: int | None = None) -> None:
        """index : where to look; `MapIndex.within` restricts it to what is known beforehand.

        prior_ns : time at which the pose of the query is wanted (`QueryMap.T_odom_prior`), if not that of the
            prior. query : scans that several localizers share; whoever shares them adds to it.
        """
        self._belief = Belief(index.config.accept)
        self._history: deque[Moment] = deque()
        self._begin(index, query, prior_ns)

    def _begin(self, index: MapIndex, query: Query | None = None, prior_ns: int | None = None) -> None:
        self.index = index
        prior_ns = prior_ns if index.prior is None else index.prior.stamp_ns
        in_space = index.points_of is not None
        self.query = query or Query(index.made_with, index.config, prior_ns=prior_ns, in_space=in_space)
        # Of the last look: part of the query, metres driven in it, and hypotheses.
        self._last: tuple[int, float, tuple[Hypothesis, ...]] = 0, 0.0, ()
        self._history.clear()
        self._clock = Clock()
        self._stood = False

    @property
    def uses_points(self) -> bool:
        """Whether scans must be given with their points."""
        return self.index.points_of is not None

    @property
    def located(self) -> bool:
        """Whether the looks of `follow` say where the robot is."""
        return self._belief.located

    @property
    def path_m(self) -> float:
        """Metres driven since the start, or since registration was lost."""
        return self.query.path_m

    @property
    def due(self) -> bool:
        """Whether the robot has travelled `relocalize.step_m` since the last look."""
        path_m, _ = self._last_look
        return self.path_m - path_m >= self.index.config.step_m

    @property
    def _last_look(self) -> tuple[float, tuple[Hypothesis, ...]]:
        """Metres driven at the last look since registration was lost, and the hypotheses then."""
        part, path_m, hypotheses = self._last
        return (path_m, hypotheses) if part == self.query.part else (0.0, ())

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan) -> Moment | None:
        """Take in the next scan. After every `relocalize.step_m` of travel the database is searched, and the
        present state of the answer is returned."""
        self._clock.lap("register")
        self.query.add(registered, planar_scan)
        return self.look() if self.due else None

    def look(self) -> Moment:
        """Search the database now. Raises NoScans if no scan could be used."""
        query, found = self._search(self.query)
        verdict = judge(self.index, query, found, partial(self._belief.prior, query))
        self._clock.lap("decide")
        self._belief.add(query, verdict)
        self._keep(query, verdict.hypotheses)
        self._history.append(moment_of(self.index, query, verdict))
        return self._history[-1]

    def looked(self) -> None:
        """The database was searched now without `look`: the next one is due a metre later."""
        self._keep(self.query.map(), self._last_look[1])

    def _keep(self, query: QueryMap, hypotheses: tuple[Hypothesis, ...]) -> None:
        self._last = query.part, query.path_m, hypotheses

    def answer(self, known: tuple[Hypothesis, ...] = (), prior_of: PriorOf | None = None) -> Answer:
        """Where the query is by all that it has seen; if it was likely carried away, by what it has seen
        since. The search goes on as if it had not been asked.

        known : hypotheses to be compared, too. prior_of : of each place; None: by the looks before the last
        metres. Raises NoScans if no scan could be used.
        """
        if prior_of is not None:
            return self._answer(self.query, known, prior_of)
        return self._since_slip(known)[1]

    def _since_slip(self, known: tuple[Hypothesis, ...] = ()) -> tuple[Query, Answer]:
        """The answer, and the query that it is about: the scans since the robot was carried away or tracking
        slipped, if that is more likely than not."""
        query, answer = self.query, self._answer(self.query, known)
        while answer.slipped >= POSTERIOR.likely:
            query = query.since(answer.evidence.scans_since)
            answer = self._answer(query, known)
        return query, answer

    def _answer(
        self, query: Query, known: tuple[Hypothesis, ...] = (), prior_of: PriorOf | None = None
    ) -> Answer:
        seen, found = self._search(query, known)
        return answer_query(
            self.index,
            query,
            seen,
            found,
            prior_of=prior_of or partial(self._belief.prior, seen),
            history=tuple(self._history),
            clock=self._clock,
        )

    def _search(
        self, query: Query, known: tuple[Hypothesis, ...] = ()
    ) -> tuple[QueryMap, tuple[Hypothesis, ...]]:
        """A query, and what retrieval proposes for it beside the hypotheses of the last look."""
        seen = query.map()
        self._clock.lap("describe")
        part, _, carried = self._last
        found = self.index.look_up(seen, (*(carried if part == seen.part else ()), *known))
        self._clock.lap("look_up")
        return seen, found

    def restart(self) -> None:
        """The scans do not go on from those before: what comes next is a search of its own, everywhere."""
        self._belief.restart()
        self._begin(self.index.whole or self.index)  # what was known beforehand was about the first search

    def take(self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_look: bool = True) -> bool:
        """Take in the next scan of a running robot; whether it is time to look: after every
        `relocalize.step_m`, and once after a while if it stands. may_look : if not, this is put off."""
        self._clock.lap("register")
        self.query.add(registered, planar_scan)
        first_ns = self.query.first_ns
        if not may_look or registered.health is Health.LOST or first_ns is None:
            return False
        waited = registered.scan.stamp_ns - first_ns > _STANDING_S * 1e9
        stands = waited and not self._stood and self.path_m < HYPOTHESES.same_m
        self._stood = self._stood or waited
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
        if not is_time and not (self.located and self.query.lost_scans == _LOST_SCANS):
            return None
        try:
            self.query, answer = self._since_slip()
        except NoScans:  # the scans since the start, or since registration was lost, show nothing
            return None
        query = self.query.map()
        self._keep(query, answer.hypotheses)
        self._history = deque((*self._history, answer.history[-1]), _MOMENTS)
        best = self._best(answer)
        state = self._belief.follow(self._belief.add(query, answer), best)
        if state == "lost":
            self.index = self.index.whole or self.index
        return Look(
            state=state,
            answer=answer,
            session=None if best is None else answer.sessions[best.session_index],
            T_map_base=None if best is None else best.fit.T_map_query @ answer.T_odom_base,
            registered=registered,
            elapsed_s=time.perf_counter() - begin,
        )

    def _best(self, answer: Answer) -> Hypothesis | None:
        """The hypothesis of a located answer, in the map in which the robot was located before if that shows
        the place, too."""
        if answer.status != "located":
            return None
        number = answer.places.count(answer.places[0])
        here = answer.hypotheses[:number]
        return next((h for h in here if h.session_index == self._belief.session_index), here[0])


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
