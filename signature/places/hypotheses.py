"""Hypotheses: where the query may lie, each verified by aligning its walls on the map: a `Fit`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from scipy.special import chdtri

from pc2grid.geometry import F32, F64, SE2, hand_over, lever_arm, wrap_angle
from pc2grid.matching.evidence import EVIDENCE
from pc2grid.matching.score import Fit, refine, score_fit
from pc2grid.matching.search import (
    MOST_POINTS,
    SearchMap,
    SearchParameters,
    search_windows,
)
from pc2grid.matching.walls import thin_evenly
from signature.config import RelocalizeConfig
from signature.places.places import SQUARE_M, Area, Places
from signature.places.query import QueryMap


@dataclass(frozen=True, slots=True, kw_only=True)
class HypothesisParameters:
    """How places are verified. All chosen by hand, checked on fr079 and intel.

    few_points : near wall points in the coarse search, and as many far ones: together all that it can add up.
    few_spacing_m : they are at least about so far apart.
    near_m : near are walls up to so far from the centre of rotation. A small error of yaw moves those beyond
        by more than a wall's width, so that they must not outweigh the near ones.
    far_m : walls beyond are left out. What is near may be people and carts only: of a real hall, 4 s of a
        lidar were found with the walls between 8 and 20 m and not without them.
    refined : so many times `RelocalizeConfig.hypotheses` are refined; some of these will merge.
    around_m, around_rad : each place that may be the answer is searched so far around itself: by a square of
        the coarse search to each side, which may have found the shoulder of a peak. Two poses that are nearer
        are one place: a search around one has seen the other. By their covariances they are not: of 21
        windows of a laser in a lidar's map, two were ambiguous with their own shoulder, .12 and .16 m off,
        which is six standard deviations.
    map_m, map_rad : standard deviations of where a map shows what is around a place: half a cell, and over
        the range of a laser as an angle. They are added to those of the alignment, in the plane and in space,
        which are of some millimetres: without them the errors of 148 right answers to real recordings in the
        plane are 2.2 times what is stated (median), with them 1.0; those of 32 in space, by cameras and by
        lidars, 2.4 and 5.9 times, with them 0.6 and 0.9.
    """

    few_points: int = MOST_POINTS // 2
    few_spacing_m: float = 0.25
    near_m: float = 8.0
    far_m: float = 20.0
    refined: int = 2
    around_m: float = SQUARE_M
    around_rad: float = math.radians(5.0)
    map_m: float = 0.025
    map_rad: float = 0.002


HYPOTHESES = HypothesisParameters()

MAP_COVARIANCE = hand_over(np.diag(np.square((HYPOTHESES.map_m, HYPOTHESES.map_m, HYPOTHESES.map_rad))))
"""(3, 3) of x, y, yaw of what a map shows, added to that of an alignment."""

SAME = hand_over(np.diag(np.square((HYPOTHESES.around_m, HYPOTHESES.around_m, HYPOTHESES.around_rad))))
"""(3, 3) region of x, y, yaw around a pose: poses in it are one place."""

_ONE_POSE = float(chdtri(3, 1.0 - 0.999))
"""Squared Mahalanobis distance of x, y, yaw within which 99.9 % of all poses of one place lie."""

SIGMAS = math.sqrt(chdtri(2, 1.0 - 0.99))
"""Mahalanobis distance within which 99 % of positions in the plane lie."""


def look_up(
    query: QueryMap,
    batches: Iterable[Iterable[Area]],
    places: Places,
    map_of: Callable[[int], SearchMap],
    config: RelocalizeConfig,
    known: Iterable[Fit] = (),
    allows: Callable[[Fit], bool] = lambda h: True,
) -> Iterator[tuple[Fit, ...]]:
    """Look the walls of a local map up: the same call for an answer, a recognised loop and
    a join.

    Yields, after each batch of areas, the hypotheses so far that are worth keeping, best first: the `known`
    ones, refined, and what fits there with any heading.

    batches : likeliest first; what is clearly less than the best so far is not looked for in the next.
    map_of : prepared map of a session, by its session_index.
    allows : those that it excludes are kept beside the others, and do not compete with them.
    """

    def kept(new: Iterable[Fit], before: Sequence[Fit] = ()) -> tuple[Fit, ...]:
        found: list[Fit] = []
        for inside in (True, False):
            of_new, of_before = ([h for h in some if allows(h) is inside] for some in (new, before))
            found += _worth_keeping(query, of_new, map_of, config.hypotheses, of_before)
        return tuple(sorted(found, key=lambda h: -h.score))

    refined = [
        fitted(query, h.session_index, h.submap_id, map_of(h.session_index), h.T_map_query) for h in known
    ]
    found = kept(refined)
    for fits in _align(query, batches, places, map_of, config):
        found = kept(fits, found)
        yield found


def _align(
    query: QueryMap,
    batches: Iterable[Iterable[Area]],
    places: Places,
    map_of: Callable[[int], SearchMap],
    config: RelocalizeConfig,
) -> Iterator[tuple[Fit, ...]]:
    """Align the query with any heading wherever the robot may stand; yields what fits in each batch of
    areas."""
    most = HYPOTHESES.refined * config.hypotheses
    submap_ids = np.append(places.table.submap_id, -1)  # row -1: there is no place
    scores, enough = [0.0], 0.0  # the best so far, and what is worth refining
    for areas in batches:
        coarse: list[tuple[float, int, int, SE2]] = []
        for session, squares_m in areas:
            target = map_of(session)
            poses = search_windows(
                target,
                coarse_points(query.walls.facing(target.walls).points_m, query.center_m),
                np.insert(squares_m, 2, 0.0, axis=1),
                half_t_m=0.5 * SQUARE_M,
                half_a_rad=math.pi,
                parameters=SearchParameters(
                    floor=max(config.coarse_floor, enough),
                    keep=config.coarse_keep,
                    most=config.hypotheses,
                ),
            )
            _, rows = places.nearest(session, poses[:, :2])
            for (x, y, yaw, score), number in zip(poses.tolist(), submap_ids[rows].tolist(), strict=True):
                coarse.append((score, session, number, _about(query.center_m, SE2(x, y, yaw))))
            scores = sorted((*scores, *poses[:, 3].tolist()), reverse=True)[:most]
            enough = max(config.coarse_keep * scores[0], scores[-1])
        yield tuple(
            fitted(query, session, number, map_of(session), T_map_query)
            for score, session, number, T_map_query in coarse
            if score >= enough
        )


def best_around(query: QueryMap, h: Fit, target: SearchMap) -> Fit:
    """Return the best hypothesis within `HypothesisParameters.around_m` and `around_rad` of a given one."""
    p, center_m = HYPOTHESES, query.center_m
    at = _at(query, h)
    poses = search_windows(
        target,
        coarse_points(query.walls.facing(target.walls).points_m, center_m),
        np.array([[at.x, at.y, at.yaw]]),
        half_t_m=p.around_m,
        half_a_rad=p.around_rad,
    )
    found = (
        fitted(query, h.session_index, h.submap_id, target, _about(center_m, SE2(x, y, yaw)))
        for x, y, yaw, _ in poses.tolist()
    )
    return max((h, *found), key=lambda one: one.score)


def _worth_keeping(
    query: QueryMap,
    new: Iterable[Fit],
    map_of: Callable[[int], SearchMap],
    most: int,
    kept: Sequence[Fit] = (),
) -> tuple[Fit, ...]:
    """Return the new and the earlier hypotheses that score enough beside the best one to be reported
    (`EvidenceParameters.longest_lead`), best first, each the best around itself; at most so many."""
    share, found = 1.0 - EVIDENCE.longest_lead, list(kept)
    best = max((h.score for h in found), default=0.0)
    for h in sorted(new, key=lambda h: -h.score):
        if h.score >= share * best:
            found.append(best_around(query, h, map_of(h.session_index)))
            best = max(best, found[-1].score)
    enough = (h for h in distinct(query, found) if h.score >= share * best)
    return tuple(islice(enough, most))


def fitted(query: QueryMap, session_index: int, submap_id: int, target: SearchMap, T_map_query: SE2) -> Fit:
    """Return the hypothesis that the query lies at a pose, which is refined first."""
    pose, covariance = _refined(query, target, T_map_query)
    fit = score_fit(target.walls, query.walls, pose, covariance + MAP_COVARIANCE)
    return replace(fit, session_index=session_index, submap_id=submap_id)


def _refined(query: QueryMap, target: SearchMap, T_map_query: SE2) -> tuple[SE2, F64]:
    """Return the refined pose of the query, and its covariance (3, 3) at `QueryMap.center_m`, map frame.

    The walls of the query are brought onto those of the map. Of two planes at different heights it is the
    walls of the higher one, since things near a wall in the lower one would be drawn onto it.
    """
    walls = query.walls.facing(target.walls)
    if not walls.only_explain:
        return refine(target.field, walls.points_m, T_map_query, query.center_m)
    center_m = T_map_query.apply(np.array([query.center_m]))[0]
    back, covariance = refine(
        walls.field, target.walls.points_m, T_map_query.inverse(), (center_m[0], center_m[1])
    )
    pose = back.inverse()
    turn = np.eye(3)
    turn[:2, :2] = pose.lift()[:2, :2]
    return pose, turn @ covariance @ turn.T


def distinct(query: QueryMap, hypotheses: Iterable[Fit]) -> tuple[Fit, ...]:
    """Return the hypotheses best first, without those that are one peak with a better one.

    The best one takes over the `submap_id` of the others if it has none.
    """
    kept: list[Fit] = []
    for candidate in sorted(hypotheses, key=lambda h: -h.score):
        better = next(
            (
                i
                for i, other in enumerate(kept)
                if other.session_index == candidate.session_index
                and one_place(_at(query, candidate), _at(query, other))
            ),
            None,
        )
        if better is None:
            kept.append(candidate)
        elif kept[better].submap_id < 0:
            kept[better] = replace(kept[better], submap_id=candidate.submap_id)
    return tuple(kept)


def _at(query: QueryMap, h: Fit) -> SE2:
    """Return where a hypothesis puts `QueryMap.center_m`, to which its covariance refers."""
    return h.T_map_query @ SE2(*query.center_m, 0.0)


def is_inside(a: SE2, b: SE2, shape: F64) -> bool:
    """Return whether a pose lies in the region around another one.

    shape : (3, 3) of x, y, yaw. The position is inside if it is off by d and d' shape^-1 d <= 1; the heading
    by itself.
    """
    off = np.array((a.x - b.x, a.y - b.y))
    near = float(off @ np.linalg.solve(shape[:2, :2], off)) <= 1.0
    return near and wrap_angle(a.yaw - b.yaw) ** 2 <= float(shape[2, 2])


def one_place(a: SE2, b: SE2) -> bool:
    """Return whether two poses are one place, because a search around one has seen the other."""
    return is_inside(a, b, SAME)


def agree(T_odom_base: SE2, a: Fit, b: Fit) -> bool:
    """Return whether two fits put the base at one pose, by the covariances of both: over time odometry says
    where a place is now, which is more exact than what a search sees."""
    one, other = (h.T_map_query @ T_odom_base for h in (a, b))
    off = np.array([one.x - other.x, one.y - other.y, wrap_angle(one.yaw - other.yaw)])
    squared = float(off @ np.linalg.solve(a.covariance + b.covariance, off))
    return a.session_index == b.session_index and squared <= _ONE_POSE


def more_exact(a: Fit, b: Fit) -> bool:
    """Return whether one hypothesis has the smaller covariance of the base than another."""
    return bool(np.trace(a.covariance[:2, :2]) < np.trace(b.covariance[:2, :2]))


def moved_to_origin(covariance: F64, T_map_query: SE2, at: SE2) -> F64:
    """Return the covariance (3, 3) of a pose in the map at the query's origin, given that at its point
    `at`."""
    J = lever_arm(T_map_query @ at, T_map_query)
    return np.asarray(J @ covariance @ J.T)


def coarse_points(points_m: F32, center_m: tuple[float, float]) -> F32:
    """Return a few of the wall points (N, 2), near and far, spread evenly around `center_m` and relative to
    it: (M, 2) float32."""
    p = HYPOTHESES
    local = points_m - np.asarray(center_m, np.float32)
    away_m = np.hypot(local[:, 0], local[:, 1])
    near, far = local[away_m < p.near_m], local[(away_m >= p.near_m) & (away_m < p.far_m)]
    return np.concatenate((_few(near), _few(far)))


def _few(points_m: F32) -> F32:
    points_m = points_m[thin_evenly(points_m, HYPOTHESES.few_spacing_m)]
    if len(points_m) > HYPOTHESES.few_points:
        points_m = points_m[np.linspace(0, len(points_m) - 1, HYPOTHESES.few_points).astype(int)]
    return points_m


def _about(center_m: tuple[float, float], pose: SE2) -> SE2:
    """Return T_map_query that puts `center_m` of the query's frame at the position of `pose`, turned by its
    yaw."""
    return pose @ SE2(-center_m[0], -center_m[1], 0.0)
