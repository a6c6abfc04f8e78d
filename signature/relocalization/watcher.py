"""Where is the robot, and is it still there? A `Relocalizer` that goes on after it is located.

The database is asked after every metre; where it has points, a located answer is refined and checked in
space. Once the robot is located, its odometry says where the next answer
must be. An answer elsewhere, or none for several metres, means that the robot was carried away, or that the
first answer was wrong: the search starts again, and one answer is not enough then.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import Health, RegisteredScan
from signature.relocalization.answer import Answer
from signature.relocalization.map_index import MapIndex
from signature.relocalization.relocalizer import Relocalizer

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
_MOMENTS = 100
"""How many moments an answer tells; chosen by hand. Memory must not grow while a robot runs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What one look at the database said.

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


@dataclass(frozen=True, slots=True)
class _Place:
    """A place in a map: the map, the base in it and in the frame of the registered scans, and metres driven
    when it was found."""

    session: str
    T_map_base: SE2
    T_session_base: SE2
    driven_m: float


class Watcher:
    """Takes in scans for as long as the robot runs. Its memory does not grow.

    index : where to look. A prior (`MapIndex.within`) is about the first scan, unless it has a stamp, and
    counts until the robot is lost or the scans do not go on.
    located : whether the last looks agree on where the robot is.
    """

    def __init__(
        self,
        index: MapIndex,
        parameters: WatchParameters = WATCH,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._index, self._parameters, self._clock = index, parameters, clock
        self._relocalizer = Relocalizer(index, _MOMENTS)
        self._place: _Place | None = None
        self._candidate: _Place | None = None
        self._was_located = False
        self._doubtful = self._lost_scans = 0
        self._driven_m = self._path_m = 0.0
        self._first_ns: int | None = None
        self._stood = self._due = False

    @property
    def uses_points(self) -> bool:
        """Whether scans must be given with their points."""
        return self._index.points_of is not None

    @property
    def located(self) -> bool:
        """See above."""
        return self._place is not None

    def restart(self) -> None:
        """The scans do not go on from those before: what comes next is a search of its own, everywhere."""
        self._index = self._index.whole or self._index  # what was known beforehand was about the first search
        self._relocalizer = Relocalizer(self._index, _MOMENTS)
        self._place = self._candidate = None
        self._doubtful = self._lost_scans = 0
        self._path_m = 0.0
        self._first_ns, self._stood, self._due = None, False, False

    def add(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_look: bool = True
    ) -> Look | None:
        """Take in the next scan; returns what a look said if there was one after it.

        may_look : if not, a look that is due is put off until it is true.
        """
        p = self._parameters
        if self._first_ns is None:
            self._begin(registered.scan.stamp_ns)
        lost = registered.health is Health.LOST
        self._lost_scans = self._lost_scans + 1 if lost else 0
        begin = self._clock()
        self._due = self._relocalizer.take(registered, planar_scan) or (self._due and not lost)
        path_m = self._relocalizer.path_m
        self._driven_m += max(path_m - self._path_m, 0.0)
        self._path_m = path_m
        stamp_ns = registered.scan.stamp_ns
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        gives_up = self._place is not None and self._lost_scans == p.lost_scans
        stands = not self._stood and not lost and stamp_ns - self._first_ns > p.standing_s * 1e9
        if stands and may_look:
            self._stood = True
            stands = path_m < p.standing_m
        if not gives_up and not (may_look and (self._due or stands)):
            return None
        try:
            if self._due:
                self._relocalizer.look()
            answer = self._relocalizer.answer()
        except NoScans:  # the scans since the start, or since registration was lost, show nothing
            return None
        self._due = False
        found = self._place_of(answer, registered)
        state = self._state(found, gives_up)
        return Look(
            state=state,
            answer=answer,
            session=None if found is None else found.session,
            T_map_base=None if found is None else found.T_map_base,
            registered=registered,
            elapsed_s=self._clock() - begin,
        )

    def _begin(self, stamp_ns: int) -> None:
        """Take the prior, if there is one without a stamp, for one of the first scan."""
        prior = self._index.prior
        if prior is not None and prior.stamp_ns is None:
            self._index = self._index.within(replace(prior, stamp_ns=stamp_ns))
            self._relocalizer = Relocalizer(self._index, _MOMENTS)

    def _state(self, found: _Place | None, gives_up: bool) -> State:
        if self._place is None:
            return self._search(found)
        if found is not None and self._agree(self._place, found):
            self._place, self._candidate, self._doubtful = found, None, 0
            return "located"
        self._doubtful += 1
        elsewhere = found is not None and self._candidate is not None and self._agree(self._candidate, found)
        if elsewhere:
            self._place, self._candidate, self._doubtful = found, None, 0
            return "recovered"
        if gives_up or self._doubtful >= self._parameters.doubtful_looks:
            self.restart()
            return "lost"
        self._candidate = found
        return "doubtful"

    def _search(self, found: _Place | None) -> State:
        """The state of a robot that is not located before this look."""
        before, self._candidate = self._candidate, found
        if found is None:
            return "lost" if self._was_located else "searching"
        if not self._was_located:
            self._place, self._was_located = found, True
            return "located"
        # One answer was wrong, or the robot was moved: this time a second one must confirm it.
        if before is not None and self._agree(before, found):
            self._place = found
            return "recovered"
        return "doubtful"

    def _place_of(self, answer: Answer, registered: RegisteredScan) -> _Place | None:
        """The place of a located answer, in the map of the place before if that shows it, too."""
        if answer.status != "located":
            return None
        known = self._place or self._candidate
        best = answer.hypotheses[0]
        if known is not None:
            same = zip(answer.hypotheses, answer.places, strict=True)
            here = [h for h, place in same if place == answer.places[0]]
            best = next((h for h in here if answer.sessions[h.session_index] == known.session), best)
        T_session_base = SE2.from_matrix(registered.T_session_base)
        T_map_base = best.fit.T_map_query @ answer.T_odom_base
        return _Place(answer.sessions[best.session_index], T_map_base, T_session_base, self._driven_m)

    def _agree(self, before: _Place, now: _Place) -> bool:
        """Whether two places are one, by the motion between them."""
        if before.session != now.session:
            return False
        p = self._parameters
        expected = before.T_map_base @ before.T_session_base.inverse() @ now.T_session_base
        apart = expected.inverse() @ now.T_map_base
        limit_m = p.same_m + p.same_share * (now.driven_m - before.driven_m)
        return math.hypot(apart.x, apart.y) <= limit_m and abs(apart.yaw) <= p.same_rad


@dataclass(slots=True)
class ResetPolicy:
    """When the robot may be told a new place: not too often, and not for ever.

    A program that resets a robot again and again keeps it from ever coming to rest.

    pause_s : least time between two resets. most : resets until the robot has been located for `calm_s`.
    """

    pause_s: float = 10.0
    most: int = 5
    calm_s: float = 60.0
    clock: Callable[[], float] = time.monotonic
    _last_s: float | None = None
    _count: int = 0

    def allows(self) -> bool:
        """Whether a reset may be made now; it then counts as made."""
        now_s = self.clock()
        if self._last_s is not None:
            if now_s - self._last_s > self.calm_s:
                self._count = 0
            if now_s - self._last_s < self.pause_s or self._count >= self.most:
                return False
        self._last_s = now_s
        self._count += 1
        return True
