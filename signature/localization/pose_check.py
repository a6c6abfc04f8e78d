"""Is a pose that the robot believes in still right?

The same posterior as that of any query, with the robot's belief as the prior: before what it has seen lately,
the mass was near where the robot believes to be (`signature.localization.posterior`). The pose is

- fine, if the place within its tolerance has the mass that is needed to be located;
- lost, if another place has it, or if the map at the pose contradicts what the robot has seen: its likelihood
  is less than that of a wrong place;
- unsure otherwise: the map knows too little there, or several places fit equally well.

`check_pose` asks this of a recording; a `PoseWatch` asks it of a running robot again and again: after every
metre, when the robot has stood for a while, and when its belief jumps.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.io.map_pose import MapPose
from pc2grid.libraries import one_blas_thread
from pc2grid.matching.evidence import evidence_of
from pc2grid.matching.score import score_fit
from pc2grid.model import Health, RegisteredScan
from signature.localization.answer import Answer
from signature.localization.localizer import MOST_KEPT, Localizer
from signature.localization.posterior import stayed
from signature.places.map_index import MapIndex, Prior

CheckStatus = Literal["fine", "lost", "unsure"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckParameters:
    """When a pose counts as right, and where it is compared. All chosen by hand.

    tolerance_m, tolerance_rad : a pose this near to the right one is fine: three times the usual error of
        AMCL, and less than two hypotheses differ by.
    near_m, near_rad : poses so far around the checked one are compared with it.
    """

    tolerance_m: float = 0.3
    tolerance_rad: float = math.radians(8.0)
    near_m: float = 1.5
    near_rad: float = math.radians(45.0)


CHECK = CheckParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseCheck:
    """The judgement on a pose.

    probability : that the pose is right; if it is not fine, an upper bound of that.
    T_map_base : the checked pose, moved to the query's last scan at `stamp_ns`. session : whose map frame.
    off_m, off_rad : what it differs by from the best place near it; None if nothing fits there.
    better : the answer that contradicts the pose, if it is lost and the right place is certain.
    lapsed : registration was lost after the time of the pose, so it could not be compared.
    elapsed_s : time that a check of a running robot took.
    """

    status: CheckStatus
    probability: float
    T_map_base: SE2
    session: str
    stamp_ns: int
    path_m: float
    off_m: float | None = None
    off_rad: float | None = None
    better: Answer | None = None
    lapsed: bool = False
    elapsed_s: float = 0.0


def check_pose(
    scans: Iterable[tuple[RegisteredScan, PlanarScan]],
    index: MapIndex,
    T_map_base: SE2,
    *,
    stamp_ns: int | None = None,
    session: str | None = None,
) -> PoseCheck:
    """Return whether a pose is right, by the last metres of a registered recording.

    scans : with their planar scans, from `pc2grid.estimation.tracker.follow`, in any frame of their own.
    stamp_ns : time of the pose, of which the nearest scan is meant; None: the last scan.
    session : whose map frame the pose is in; may be None if there is only one.

    Raises ConfigError for a missing or unknown session, NoScans for a query without a usable scan.

    >>> import pc2grid, signature
    >>> with signature.open_database("plan.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     index = MapIndex.of(database, config)
    ...     found = signature.relocalize("tuesday.mcap", "plan.submaps")
    ...     checked = check_pose(pc2grid.follow(log.scans(), config), index, found.T_map_base)
    >>> checked.status, checked.off_m < 0.1
    ('fine', True)
    """
    index.within(_around(T_map_base, session))  # raises what is wrong with the session before any work
    localizer = Localizer(index, prior_ns=stamp_ns)
    for registered, planar_scan in scans:
        localizer.take(registered, planar_scan)
    seen = localizer.query.map()
    if stamp_ns is not None:
        if seen.T_odom_prior is None:
            return PoseCheck(
                status="unsure",
                probability=0.5,
                T_map_base=T_map_base,
                session=session or index.sessions[0],
                stamp_ns=stamp_ns,
                path_m=seen.path_m,
                lapsed=True,
            )
        T_map_base = T_map_base @ seen.T_odom_prior.inverse() @ seen.T_odom_base
    return judge_pose(localizer, T_map_base, session)


@one_blas_thread
def judge_pose(localizer: Localizer, T_map_base: SE2, session: str | None = None) -> PoseCheck:
    """Return whether a pose at the query's last scan is right. Raises the errors of `check_pose`."""
    index, seen = localizer.index, localizer.query.map()
    near = index.within(_around(T_map_base, session))
    assert near.prior is not None and near.prior.session is not None
    session = near.prior.session
    number = index.sessions.index(session)
    T_map_query = T_map_base @ seen.T_odom_base.inverse()
    walls = index.maps_for(seen)(number).walls
    believed = replace(score_fit(walls, seen.walls, T_map_query, np.zeros((3, 3))), session_index=number)
    # All mass was near the pose before what was seen lately. So of two equal rooms it is in the nearer one.
    _, answer = localizer.search(
        localizer.query,
        near.in_region(seen, (believed,)),
        lambda place: 1.0 / (1.0 - stayed(seen)) if any(near.allows(seen, h) for h in place) else 1.0,
    )
    apart = [
        (number, *_apart(T_map_base, fit.T_map_query @ answer.T_odom_base))
        for number, fit in answer.numbered
        if near.allows(seen, fit)
    ]
    here = {number for number, *off in apart if _within_tolerance(*off)}
    mass_here = sum(answer.places[number].mass for number in here)
    # Where the map knows too little to contradict the pose, "at no place of this map" does not exclude it.
    (alone,) = evidence_of([believed])
    at_most = mass_here if alone.log_likelihood < 0.0 else 1.0 - answer.mass + mass_here
    status = _status(mass_here, at_most, index.config.accept)
    _, off_m, off_rad = apart[0] if apart else (None, None, None)
    return PoseCheck(
        status=status,
        probability=mass_here if status == "fine" else at_most,
        T_map_base=T_map_base,
        session=session,
        stamp_ns=seen.stamp_ns,
        path_m=seen.path_m,
        off_m=off_m,
        off_rad=off_rad,
        better=answer if status == "lost" and answer.status == "located" else None,
    )


def _status(mass_here: float, at_most: float, accept: float) -> CheckStatus:
    """Return the status of a pose. at_most : upper bound of the probability that the pose is right. accept :
    least mass to be certain."""
    if mass_here >= accept:
        return "fine"
    return "lost" if at_most <= 1.0 - accept else "unsure"


def _around(T_map_base: SE2, session: str | None) -> Prior:
    return Prior.around(
        T_map_base.x,
        T_map_base.y,
        CHECK.near_m,
        yaw_rad=T_map_base.yaw,
        half_yaw_rad=CHECK.near_rad,
        session=session,
    )


def _apart(a: SE2, b: SE2) -> tuple[float, float]:
    return math.hypot(a.x - b.x, a.y - b.y), abs(wrap_angle(a.yaw - b.yaw))


def _within_tolerance(off_m: float, off_rad: float) -> bool:
    return off_m <= CHECK.tolerance_m and off_rad <= CHECK.tolerance_rad


class PoseWatch:
    """Takes in scans for as long as the robot runs, and judges what it believes. Its memory does not grow.

    uses_points : whether scans must be given with their points.

    index : where to look. believed : the newest pose in the map that the robot believes in, None before the
    first. session : whose map frame that is; may be None if there is only one.
    """

    def __init__(
        self, index: MapIndex, believed: Callable[[], MapPose | None], session: str | None = None
    ) -> None:
        self._index, self._believed, self._session = index, believed, session
        self.uses_points = index.surface_of is not None
        self._received: MapPose | None = None
        self.restart()

    def restart(self) -> None:
        """Begin anew: the next scans do not continue those before."""
        self._localizer = Localizer(self._index)
        self._driven: deque[tuple[int, SE2]] = deque(maxlen=MOST_KEPT)
        self._waiting: MapPose | None = None
        self._T_map_session: SE2 | None = None
        self._judged: SE2 | None = None

    def add(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True
    ) -> PoseCheck | None:
        """Take in the next scan; returns the judgement if there was one after it.

        may_search : if not, a judgement that is due is put off until it is true. Raises ConfigError for a
        missing or unknown session.
        """
        begin = time.perf_counter()
        T_session_base = SE2.from_matrix(registered.T_session_base)
        if registered.health is Health.LOST:  # the motion from before to what comes next is not known
            self.restart()
            return None
        self._driven.append((registered.scan.stamp_ns, T_session_base))
        self._update()
        T_map_session = self._T_map_session
        may_search = may_search and T_map_session is not None
        is_time = self._localizer.take(registered, planar_scan, may_search=may_search)
        if T_map_session is None or not may_search:
            return None
        T_map_base = T_map_session @ T_session_base
        judged = T_map_session if self._judged is None else self._judged
        jumped = not _within_tolerance(*_apart(T_map_base, judged @ T_session_base))
        if not is_time and not jumped:
            return None
        try:
            checked = judge_pose(self._localizer, T_map_base, self._session)
        except NoScans:  # the scans since registration was lost show nothing
            return None
        self._judged = T_map_session
        return replace(checked, elapsed_s=time.perf_counter() - begin)

    def _update(self) -> None:
        """Find out where the frame of the registered scans lies in the map, as the robot believes.

        A belief that is older than the scans since registration was lost says nothing of now; one that is
        ahead of the scans waits for them.
        """
        newest = self._believed()
        if self._waiting is None and newest is not self._received:
            self._waiting = self._received = newest
        (newest_ns, _) = self._driven[-1]
        if self._waiting is None or self._waiting.stamp_ns > newest_ns:
            return
        pose, self._waiting = self._waiting, None
        if self._driven[0][0] <= pose.stamp_ns:
            nearest = min(self._driven, key=lambda scan: abs(scan[0] - pose.stamp_ns))
            self._T_map_session = pose.T_map_base @ nearest[1].inverse()
