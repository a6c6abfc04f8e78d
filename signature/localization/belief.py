"""The posterior filtered over time, with a rate of kidnapping.

    prior_t(h)  =  1 + (1 - k) mass_s(h) / (1 - (1 - k) sum_g mass_s(g)),    k = 1 - (1 - slip)^n
    mass_t(h)   =  prior_t(h) exp(z_h) / N        (`signature.localization.posterior`)

The scans of a search are those of the last metres, so the searches overlap. The prior of search t follows
from the latest search s that lies before all scans of t. Then each scan counts once, however far the robot
has driven, and a search costs the same after 80 m as after 15 m. The odometry carries the places on: the pose
of a query in the map is that of its odometry frame, which does not move.

At each of the n scans of t, odometry may fail or the robot may be carried away, at the rate `slip`. This
share of the mass joins "anywhere", of which each place has the mass of "nowhere" again, as at the beginning.
So the past makes a place at most 1 / k times as likely, and a place that the robot was never believed to be
at has the prior 1.

Off the map: where a map shows too little of what is seen (`PosteriorParameters.shown`), it tells nothing of
a place, neither for it nor against it. So a place of search s stays as likely beside "nowhere" as it was, at
the pose to which odometry carries it, whose covariance grows:

    mass_t(h)   =  (prior_t(h) - 1) / N,        which N contains, too

When the robot comes back, the place that the map shows there has this mass before it.

Fox, Burgard and Thrun 1999, "Markov localization for mobile robots in dynamic environments"; Thrun, Burgard
and Fox, "Probabilistic Robotics", chapter 8.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pc2grid.geometry import F64, SE2
from pc2grid.matching.score import score_fit
from signature.localization.answer import Answer, OffMap, Verdict
from signature.localization.hypotheses import Hypothesis, same_pose
from signature.localization.map_index import MapIndex
from signature.localization.posterior import POSTERIOR, PRIOR, Prior
from signature.localization.query import QueryMap

State = Literal["searching", "located", "off_map", "doubtful", "lost", "recovered"]
"""searching: not located yet. located: one place has at least the mass `RelocalizeConfig.accept`; and the
robot was located there before, or the searches in a row that found it there leave no more doubt, multiplied,
than `PosteriorParameters.certain`. off_map: most likely it is where the map shows too little of what it sees.
doubtful: none of these, nor has all else together than where it was at least the mass `accept`. lost: this
has, or the robot was carried away. recovered: located elsewhere, or again after it was lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Masses:
    """The masses of places at one moment.

    part : of the query, see `QueryMap.part`. place : of each hypothesis, number of its mass.
    off_map : places that the map does not show.
    """

    part: int
    path_m: float
    T_odom_base: SE2
    hypotheses: tuple[Hypothesis, ...] = ()
    places: tuple[int, ...] = ()
    masses: tuple[float, ...] = ()
    off_map: tuple[OffMap, ...] = ()

    @staticmethod
    def of(query: QueryMap, found: Verdict | Answer) -> Masses:
        """The masses that a query gives."""
        return Masses(
            part=query.part,
            path_m=query.path_m,
            T_odom_base=query.T_odom_base,
            hypotheses=found.hypotheses,
            places=found.places,
            masses=found.masses,
            off_map=found.off_map,
        )

    @property
    def first(self) -> tuple[Hypothesis, ...]:
        """The first place."""
        return self.hypotheses[: self.places.count(0)]

    def mass(self, place: Sequence[Hypothesis]) -> float:
        """Mass of the places that put the robot, at this moment, where one of these hypotheses does."""
        at = [(h.session_index, h.fit.T_map_query @ self.T_odom_base) for h in place]
        found = {
            number
            for h, number in zip(self.hypotheses, self.places, strict=True)
            for session, base in at
            if h.session_index == session and same_pose(h.fit.T_map_query @ self.T_odom_base, base)
        }
        beside = [
            away.mass
            for away in self.off_map
            if any(
                away.hypothesis.session_index == session and region_of(away, self.T_odom_base).allows(base)
                for session, base in at
            )
        ]
        return sum(self.masses[number] for number in found) + sum(beside)

    def prior(self, query: QueryMap, place: Sequence[Hypothesis]) -> float:
        """Prior of a place, relative to that of "nowhere", for a query of later scans. What was beside the
        map stays there until the map shows enough of the place."""
        shown = place[0].fit.overlap >= POSTERIOR.shown
        before = self if shown else replace(self, off_map=())
        return 1.0 + self.odds(query, before.mass(place))

    def odds(self, query: QueryMap, mass: float) -> float:
        """A mass of this moment, relative to that of "nowhere", before a query of later scans."""
        share = kept(query)
        total = sum(self.masses) + sum(away.mass for away in self.off_map)
        return share * mass / (1.0 - share * total)

    def carried(self, query: QueryMap) -> Iterator[OffMap]:
        """The places of this moment, where odometry has carried them; `mass`: `odds`."""
        beside = list(self.off_map)
        for number, mass in enumerate(self.masses):
            h = self.hypotheses[self.places.index(number)]
            k = self._beside(h)
            if k is not None:
                beside[k] = replace(beside[k], mass=beside[k].mass + mass)
                continue
            yield OffMap(
                hypothesis=h,
                mass=self.odds(query, mass),
                seen_m=self.path_m,
                T_odom_seen=self.T_odom_base,
                seen=h.fit.covariance,
            )
        for away in beside:
            yield replace(away, mass=self.odds(query, away.mass))

    def _beside(self, h: Hypothesis) -> int | None:
        """The place beside the map that a hypothesis is at, if the map shows too little to align it."""
        if h.fit.overlap >= POSTERIOR.shown:
            return None
        base = h.fit.T_map_query @ self.T_odom_base
        for k, away in enumerate(self.off_map):
            same = away.hypothesis.session_index == h.session_index
            if same and region_of(away, self.T_odom_base).allows(base):
                return k
        return None


def region_of(away: OffMap, T_odom_base: SE2) -> Prior:
    """Where the robot may be if it is beside the map."""
    fit = away.hypothesis.fit
    return Prior.of_pose(fit.T_map_query @ T_odom_base, fit.covariance)


def grown(away: OffMap, query: QueryMap) -> F64:
    """The covariance (3, 3) of the base now, by the odometry since the map showed the place."""
    T_map_query = away.hypothesis.fit.T_map_query
    begin, now = T_map_query @ away.T_odom_seen, T_map_query @ query.T_odom_base
    J = np.eye(3)
    J[:2, 2] = begin.y - now.y, now.x - begin.x
    way_m = (query.path_m - away.seen_m) / PRIOR.sigmas
    drift = np.array([PRIOR.drift, PRIOR.drift, PRIOR.drift_rad_m]) * way_m
    return np.asarray(J @ away.seen @ J.T + np.diag(drift**2))


def kept(query: QueryMap) -> float:
    """1 - k, the share of the masses before a query that stays where it was."""
    return float((1.0 - POSTERIOR.slip) ** max(len(query.keyframes), 1))


class Belief:
    """The masses of the searches since the start of the last window, and what they say of a running robot."""

    def __init__(self, accept: float) -> None:
        """accept : least mass to say where the robot is, and to say that it is not where it was."""
        self._accept = accept
        self._searches: list[Masses] = []
        self._place: tuple[int, tuple[Hypothesis, ...]] | None = None  # part and place of the last "located"
        self._found: tuple[Masses, float] | None = None  # the last search, if it located the robot; doubt
        self._was_located = False

    @property
    def located(self) -> bool:
        """Whether the robot is held to be where it was located last."""
        return self._place is not None

    @property
    def session_index(self) -> int | None:
        """Of the map in which it was located last."""
        return self._place[1][0].session_index if self._place else None

    def restart(self) -> None:
        """The scans do not go on from those before. It is remembered that the robot was located once."""
        self._searches.clear()
        self._place = self._found = None

    def prior(self, query: QueryMap, place: Sequence[Hypothesis]) -> float:
        """Prior of a place, relative to that of "nowhere", by the searches before the scans of a query."""
        before = self._before(query)
        return before[-1].prior(query, place) if before else 1.0

    def off_map(self, index: MapIndex, query: QueryMap) -> tuple[OffMap, ...]:
        """Where the robot may be beside the map: the places of before of which it shows too little.

        mass : relative to that of "nowhere".
        """
        before = self._before(query)
        found: list[OffMap] = []
        for away in before[-1].carried(query) if before else ():
            h = away.hypothesis
            walls = index.maps_for(query)[h.session_index].walls
            fit = score_fit(walls, query.walls, h.fit.T_map_query, grown(away, query))
            if away.mass >= POSTERIOR.forgotten and fit.overlap < POSTERIOR.shown:
                found.append(replace(away, hypothesis=replace(h, fit=fit)))
        return tuple(found)

    def add(self, query: QueryMap, found: Verdict | Answer) -> Masses:
        """Keep the masses of a search; those that no later query follows from are forgotten."""
        now = Masses.of(query, found)
        forgotten = max(len(self._before(query)) - 1, 0)
        here = [known for known in self._searches if known.part == query.part]
        self._searches = [*here[forgotten:], now]
        return now

    def _before(self, query: QueryMap) -> list[Masses]:
        """The searches that lie before all scans of a query."""
        first_m = query.keyframes[0].path_m if query.keyframes else 0.0
        return [past for past in self._searches if past.part == query.part and past.path_m < first_m]

    def follow(self, now: Masses, *, located: bool) -> State:
        """The state of a running robot after a search. located : at the first place."""
        here = 0.0
        if self._place is not None and self._place[0] == now.part:
            here = now.mass(self._place[1])
        doubt, before = 1.0, self._found
        if located:
            doubt -= now.masses[0]
            if (
                before is not None
                and before[0].part == now.part
                and now.mass(before[0].first) >= self._accept
            ):
                doubt *= before[1]
        self._found = (now, doubt) if located else None
        if located:
            goes_on = here >= POSTERIOR.likely
            if goes_on or doubt <= 1.0 - POSTERIOR.certain:
                state: State = "located" if goes_on or not self._was_located else "recovered"
                self._was_located, self._place = True, (now.part, now.first)
                return state
            return "doubtful" if self._place is not None else self._nowhere
        if any(away.mass >= POSTERIOR.likely for away in now.off_map):
            return "off_map"
        if here > 1.0 - self._accept:
            return "doubtful"
        self._place = None
        return self._nowhere

    @property
    def _nowhere(self) -> State:
        """The state of a robot that no place is told of."""
        return "lost" if self._was_located else "searching"
