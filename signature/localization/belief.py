"""Where a running robot is believed to be: a state machine over the answers of a `Localizer`.

Once the robot is located, its odometry says where the next answer must be. An answer elsewhere, or none for
several metres, means that the robot was carried away, or that the first answer was wrong: the search begins
again, and one answer is not enough then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pc2grid.geometry import SE2

State = Literal["searching", "located", "doubtful", "lost", "recovered"]
"""searching: not located yet. located: where the odometry says that it must be. doubtful: not confirmed by
this look. lost: not where it was. recovered: located again after that, by two looks that agree."""


@dataclass(frozen=True, slots=True)
class WatchParameters:
    """When a located robot counts as lost; chosen by hand.

    same_m, same_rad : answers agree if they differ by no more from what odometry says,
    same_share : and by this share of the way between them.
    doubtful_looks : so many looks in a row without an answer make a located robot lost.
    lost_scans : so do so many scans in a row that cannot be registered.
    standing_s : a robot that does not move is looked for once, after this time.
    standing_m : a robot that has moved less stands.
    """

    same_m: float = 0.5
    same_rad: float = math.radians(10.0)
    same_share: float = 0.05
    doubtful_looks: int = 5
    lost_scans: int = 20
    standing_s: float = 2.0
    standing_m: float = 0.3


WATCH = WatchParameters()


@dataclass(frozen=True, slots=True)
class Place:
    """A place in a map: the map, the base in it and in the frame of the registered scans, and metres driven
    when it was found."""

    session: str
    T_map_base: SE2
    T_session_base: SE2
    driven_m: float

    def agrees(self, later: Place, p: WatchParameters) -> bool:
        """Whether two places are one, by the motion between them."""
        expected = self.T_map_base @ self.T_session_base.inverse() @ later.T_session_base
        apart = expected.inverse() @ later.T_map_base
        limit_m = p.same_m + p.same_share * (later.driven_m - self.driven_m)
        near = math.hypot(apart.x, apart.y) <= limit_m and abs(apart.yaw) <= p.same_rad
        return self.session == later.session and near


class Belief:
    """The place of the robot, if it is located, and a place that one look has found elsewhere.

    place : None while the last looks do not agree on where the robot is. candidate : to be confirmed.
    """

    def __init__(self, parameters: WatchParameters = WATCH) -> None:
        self._parameters = parameters
        self._was_located = False
        self.restart()

    def restart(self) -> None:
        """The scans do not go on from those before. It is remembered that the robot was located once."""
        self.place: Place | None = None
        self.candidate: Place | None = None
        self._doubtful = 0

    def update(self, found: Place | None, gives_up: bool = False) -> State:
        """The state after a look. gives_up : an answer that does not confirm the place ends it."""
        if self.place is None:
            return self._search(found)
        if found is not None and self.place.agrees(found, self._parameters):
            return self._confirm(found, "located")
        if found is not None and self.candidate and self.candidate.agrees(found, self._parameters):
            return self._confirm(found, "recovered")
        self._doubtful += 1
        if gives_up or self._doubtful >= self._parameters.doubtful_looks:
            self.restart()
            return "lost"
        self.candidate = found
        return "doubtful"

    def _search(self, found: Place | None) -> State:
        """The state of a robot that is not located before this look."""
        before, self.candidate = self.candidate, found
        if found is None:
            return "lost" if self._was_located else "searching"
        if not self._was_located:
            return self._confirm(found, "located")
        # One answer was wrong, or the robot was moved: this time a second one must confirm it.
        if before is not None and before.agrees(found, self._parameters):
            return self._confirm(found, "recovered")
        return "doubtful"

    def _confirm(self, found: Place, state: State) -> State:
        self.place, self.candidate, self._doubtful, self._was_located = found, None, 0, True
        return state
