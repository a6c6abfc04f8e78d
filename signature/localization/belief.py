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

Fox, Burgard and Thrun 1999, "Markov localization for mobile robots in dynamic environments"; Thrun, Burgard
and Fox, "Probabilistic Robotics", chapter 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pc2grid.geometry import SE2
from signature.localization.answer import Answer, Verdict
from signature.localization.hypotheses import Hypothesis, same_pose
from signature.localization.posterior import POSTERIOR
from signature.localization.query import QueryMap

State = Literal["searching", "located", "doubtful", "lost", "recovered"]
"""searching: not located yet. located: one place has at least the mass `RelocalizeConfig.accept`. doubtful:
none has, nor has all else together than where the robot was. lost: this has, or the robot was carried away.
recovered: located elsewhere, or again after it was lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Masses:
    """The masses of places at one moment.

    part : of the query, see `QueryMap.part`. place : of each hypothesis, number of its mass.
    """

    part: int
    path_m: float
    T_odom_base: SE2
    hypotheses: tuple[Hypothesis, ...] = ()
    places: tuple[int, ...] = ()
    masses: tuple[float, ...] = ()

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
        )

    def mass(self, place: Sequence[Hypothesis]) -> float:
        """Mass of the places that put the robot, at this moment, where one of these hypotheses does."""
        at = [(h.session_index, h.fit.T_map_query @ self.T_odom_base) for h in place]
        found = {
            number
            for h, number in zip(self.hypotheses, self.places, strict=True)
            for session, base in at
            if h.session_index == session and same_pose(h.fit.T_map_query @ self.T_odom_base, base)
        }
        return sum(self.masses[number] for number in found)

    def prior(self, query: QueryMap, place: Sequence[Hypothesis]) -> float:
        """Prior of a place, relative to that of "nowhere", for a query of later scans."""
        share = kept(query)
        return 1.0 + share * self.mass(place) / (1.0 - share * sum(self.masses))


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
        self._place = None

    def prior(self, query: QueryMap, place: Sequence[Hypothesis]) -> float:
        """Prior of a place, relative to that of "nowhere", by the searches before the scans of a query."""
        before = self._before(query)
        return before[-1].prior(query, place) if before else 1.0

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
        if located:
            goes_on = not self._was_located or here >= POSTERIOR.likely
            self._was_located = True
            self._place = now.part, now.hypotheses[: now.places.count(0)]
            return "located" if goes_on else "recovered"
        if here > 1.0 - self._accept:
            return "doubtful"
        self._place = None
        return "lost" if self._was_located else "searching"
