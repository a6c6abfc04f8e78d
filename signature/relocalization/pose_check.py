"""Is a pose that the robot believes in still right?

The last metres are asked twice, with the same calibrated probability as any query: near the pose (which is a
prior, so equal rooms elsewhere are no rivals), and everywhere. The pose is

- fine, if the best place, of all or near the pose, is certain, and the pose lies within the tolerance of it;
- lost, if another place is certain, or if the map around the pose contradicts what the robot has seen;
- unsure otherwise: the map knows too little there, or several places fit equally well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.matching.two_way_score import score_fit
from pc2grid.model import RegisteredScan
from signature.relocalization.answer import Answer
from signature.relocalization.confidence import LIMITS
from signature.relocalization.hypotheses import Hypothesis
from signature.relocalization.map_index import MapIndex
from signature.relocalization.prior import Prior
from signature.relocalization.query_map import QueryMap
from signature.relocalization.relocalizer import Query, Search

if TYPE_CHECKING:
    from signature.relocalization.relocalizer import Watch

CheckStatus = Literal["fine", "lost", "unsure"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckParameters:
    """When a pose counts as right, and where it is compared. All chosen by hand.

    tolerance_m, tolerance_rad : a pose this near to the right one is fine: three times the usual error of
        AMCL, and less than two hypotheses differ by.
    near_m, near_rad : poses so far around the checked one are compared with it.
    clearly : a place elsewhere speaks against a pose if its two-way score is higher by more than this:
        twice the spread of the score between two equal places.
    """

    tolerance_m: float = 0.3
    tolerance_rad: float = math.radians(8.0)
    near_m: float = 1.5
    near_rad: float = math.radians(45.0)
    clearly: float = 2.0 * LIMITS.equal_lead


CHECK = CheckParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseCheck:
    """The judgement on a pose.

    probability : that the pose is right; if it is not fine, an upper bound of that.
    T_map_base : the checked pose, moved to the query's last scan at `stamp_ns`. session : whose map frame.
    off_m, off_rad : what it differs by from the best place near it; None if nothing fits there.
    better : the answer that contradicts the pose, if it is lost and the right place is certain.
    lapsed : registration was lost after the time of the pose, so it could not be compared.
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


def check_pose(
    scans: Iterable[tuple[RegisteredScan, PlanarScan]],
    index: MapIndex,
    T_map_base: SE2,
    *,
    stamp_ns: int | None = None,
    session: str | None = None,
    watch: Watch | None = None,
) -> PoseCheck:
    """Whether a pose is right, by the last metres of a registered recording.

    scans : with their planar scans, from `pc2grid.pipeline.follow`, in any frame of their own.
    stamp_ns : time of the pose, of which the nearest scan is meant; None: the last scan.
    session : whose map frame the pose is in; may be None if there is only one.
    watch : called with each scan.

    Raises ConfigError for a missing or unknown session, NoScans for a query without a usable scan.

    >>> import pc2grid, signature
    >>> with signature.open_database("plan.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
    ...     config = database.config()
    ...     index = MapIndex.of(database, config)
    ...     found = signature.locate(pc2grid.follow(log.scans(), config), database, config)
    ...     checked = check_pose(pc2grid.follow(log.scans(), config), index, found.T_map_base)
    >>> checked.status, checked.off_m < 0.1
    ('fine', True)
    """
    about = replace(_around(T_map_base, session), stamp_ns=stamp_ns)
    query = Query(index.within(about))
    for registered, planar_scan in scans:
        query.add(registered, planar_scan)
        if watch is not None:
            watch(registered, None)
    seen = query.map()
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
    return judge_pose(seen, index, T_map_base, session=session, last_metres=tuple(query.last_metres()))


def judge_pose(
    query: QueryMap,
    index: MapIndex,
    T_map_base: SE2,
    *,
    session: str | None = None,
    last_metres: Sequence[QueryMap] = (),
) -> PoseCheck:
    """Whether a pose at the query's last scan is right.

    last_metres : the query again with less of its travel, longest first. Raises ConfigError as `check_pose`.
    """
    # All of this is one part: what is found near the pose is a hypothesis everywhere.
    query, last_metres = replace(query, part=0), [replace(part, part=0) for part in last_metres]
    restricted = index.within(_around(T_map_base, session))
    session = session or index.sessions[0]
    number = index.sessions.index(session)
    T_map_query = T_map_base @ query.T_odom_base.inverse()
    here = score_fit(index.maps[number].walls, query.walls, T_map_query, np.zeros((3, 3)))
    known = (Hypothesis(session_index=number, row=-1, fit=here),)
    near = Search(restricted, known).answer(query, last_metres, look_outside=False)
    everywhere = Search(index, near.hypotheses).answer(query, last_metres)
    best_near = _bases(near, number)[:1]
    off_m, off_rad = _apart(T_map_base, best_near[0]) if best_near else (None, None)
    is_there = any(_within_tolerance(T_map_base, base) for base in best_near)

    def judged(status: CheckStatus, probability: float, better: Answer | None = None) -> PoseCheck:
        return PoseCheck(
            status=status,
            probability=probability,
            T_map_base=T_map_base,
            session=session,
            stamp_ns=query.stamp_ns,
            path_m=query.path_m,
            off_m=off_m,
            off_rad=off_rad,
            better=better,
        )

    if everywhere.status == "located":
        # The place may have been seen by several sessions; that whose frame the pose is in counts.
        if any(_within_tolerance(T_map_base, base) for base in _bases(everywhere, number)):
            return judged("fine", everywhere.confidence)
        return judged("lost", 1.0 - everywhere.confidence, everywhere)
    elsewhere = _best_score(everywhere.hypotheses) - _best_score(near.hypotheses)
    if near.status == "located" and elsewhere <= CHECK.clearly:
        if is_there:
            return judged("fine", near.confidence)
        return judged("lost", 1.0 - near.confidence, near)
    # The pose fits no better than the best place near it, so it is no more probable; and if that one is
    # another place, they exclude each other.
    at_most = near.confidence if is_there else min(near.confidence, 1.0 - near.confidence)
    known_walls = here.overlap * query.walls.weight
    contradicted = near.status == "not_found" and known_walls >= LIMITS.few_walls
    contradicted = contradicted and at_most <= 1.0 - index.config.accept
    return judged("lost" if contradicted else "unsure", at_most)


def _around(T_map_base: SE2, session: str | None) -> Prior:
    return Prior.around(
        T_map_base.x,
        T_map_base.y,
        CHECK.near_m,
        yaw_rad=T_map_base.yaw,
        half_yaw_rad=CHECK.near_rad,
        session=session,
    )


def _bases(answer: Answer, session_index: int) -> list[SE2]:
    """The base at the best place of an answer, by the map of a session; none if that does not show it."""
    return [
        h.fit.T_map_query @ answer.T_odom_base
        for h, place in zip(answer.hypotheses, answer.places, strict=True)
        if place == answer.places[0] and h.session_index == session_index
    ]


def _best_score(hypotheses: Sequence[Hypothesis]) -> float:
    return hypotheses[0].fit.score if hypotheses else 0.0


def _apart(a: SE2, b: SE2) -> tuple[float, float]:
    return math.hypot(a.x - b.x, a.y - b.y), abs(wrap_angle(a.yaw - b.yaw))


def _within_tolerance(a: SE2, b: SE2) -> bool:
    off_m, off_rad = _apart(a, b)
    return off_m <= CHECK.tolerance_m and off_rad <= CHECK.tolerance_rad
