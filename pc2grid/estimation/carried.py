"""A carried sensor: followed in space, and reduced to the plane by the map of its last metres.

A narrow, tilted, noisy view shows neither where the floor is nor what is a wall. So each scan is registered
to the surfaces seen before, with the odometry of the device, where there is one, as what it is: six degrees
of freedom that drift. The planar scan is cut out of the map (`SpaceMap`). A scan that does not fit is
searched for in all headings, and what then agrees with the surfaces and the free space of the map is
believed, else it is lost.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.clouds.ground import find_ground
from pc2grid.clouds.level import LEVEL
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.config import ProjectionConfig
from pc2grid.estimation.belief import SPATIAL, Belief
from pc2grid.estimation.manifold import moved, steps
from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.estimation.placed import Placed
from pc2grid.estimation.space_map import SpaceMap, ThinnedScan
from pc2grid.estimation.surface_map import SURFACES, Placement
from pc2grid.geometry import SE2, leveling
from pc2grid.model import Scan


@dataclass(frozen=True, slots=True, kw_only=True)
class CarriedParameters:
    """Numbers of carried sensors. Chosen by hand, unless noted.

    sure_agreement : a scan long after the one before that agrees less with the map is searched for. In a
        hall, right poses have 0.89 and more, wrong ones 0.66 to 0.88 (lidar/hall).
    least_agreement : with less at the best place that is found, the scan is lost.
    starts : placements that a search refines in space. turned_rad : by how much these may be turned, a
        standard deviation: more than a step of the search.
    """

    sure_agreement: float = 0.9
    least_agreement: float = 0.85
    starts: int = 10
    turned_rad: float = 0.1


CARRIED = CarriedParameters()


@dataclass(frozen=True, slots=True, order=True)
class _Candidate:
    """A placement, and its score: the logarithm of its posterior density but for a constant.

    agreement : with what is known where its points lie, -1..1. sure : it fits so well that it need not be
    searched for.
    """

    score: float
    placement: Placement = field(compare=False)
    agreement: float = field(compare=False)
    sure: bool = field(compare=False)


class CarriedSensor:
    """Places the scans of a sensor in the hand, one after another, in the session frame: z up."""

    free = SPATIAL

    def __init__(
        self,
        projection: ProjectionConfig,
        parameters: CarriedParameters = CARRIED,
        tracking: TrackingParameters = TRACKING_PARAMETERS,
    ) -> None:
        self._projection, self._parameters, self._tracking = projection, parameters, tracking
        self._map: SpaceMap | None = None
        self._found: F64 = np.eye(4)  # pose of the last scan that was
        self._thinned = ThinnedScan(np.empty((0, 3)), np.empty(0))  # the scan placed last

    @property
    def ground(self) -> None:
        """The floor in the base frame changes with every step."""
        return None

    @property
    def map(self) -> SpaceMap | None:
        """The local map in space; None before the first scan and after `restart`."""
        return self._map

    def restart(self) -> None:
        """Forget the map: the next scan begins a new one."""
        self._map = None

    def start(self, scan: Scan, points_m: F32, at: SE2) -> F64:
        """Begin with a scan whose base is at a place of the session frame; returns its pose (4, 4),
        levelled."""
        self._map = SpaceMap(scan, points_m, self._projection)
        self._thinned = self._map.thin(scan, points_m)
        self._found = at.lift() @ first_pose(scan, points_m)
        return self._found

    def levelled(self, pose: F64) -> F64:
        """A pose (4, 4) in space has its tilt and its height already."""
        return pose

    def place(self, scan: Scan, points_m: F32, seconds: float, expected: Sequence[Belief]) -> Placed:
        """See `PlacingSensor`."""
        del seconds
        belief = expected[0]
        if self._map is None:
            self._map = SpaceMap(scan, points_m, self._projection)
        self._thinned = thinned = self._map.thin(scan, points_m)
        if not self._map or not len(thinned.points_m):
            self._found = belief.pose
            return Placed(belief.pose, first=not self._map)
        candidates = self._candidates(belief, self._map)
        best = max(candidates)
        found = best.placement
        if not self._is_believed(best, belief):
            return Placed(belief.pose)
        self._found = found.pose
        # Where the motion is expected to centimetres, points that only seem to hold the scan do no harm.
        held = not self._is_vague(belief) or self._map.is_held(thinned, found)
        return Placed(
            found.pose,
            _alone(found, belief, _spread(candidates, best)),
            found.overlap,
            found.residual_m,
            found.measured and held,
        )

    def _candidates(self, belief: Belief, space: SpaceMap) -> list[_Candidate]:
        """Where the scan placed last may lie.

        The coarse map brings it near from where the base is expected. Where more is possible than a match
        reaches, or it does not fit, it is also matched without the coarse map, which slides along surfaces
        that it smooths; and it is searched for where it still does not fit, or does not agree.
        """
        p = self._parameters
        vague = self._is_vague(belief)

        def matched(*, wide: bool) -> _Candidate:
            return self._candidate(space.match(self._thinned, belief.pose, belief, wide=wide), belief, space)

        found = [matched(wide=True)]
        if vague or not found[0].sure:
            found.append(matched(wide=False))
        best = max(found)
        if not best.sure or (vague and best.agreement < p.sure_agreement):
            found += self._searched(belief, space)
        return found

    def _searched(self, belief: Belief, space: SpaceMap) -> Iterator[_Candidate]:
        """Placements in all headings around the last pose that was found, with its height and tilt.

        A hand turns fast; then the predicted direction of the step says nothing.
        """
        p, t = self._parameters, self._tracking
        step_m = float(np.linalg.norm(belief.pose[:3, 3] - self._found[:3, 3]))
        window_m = min(step_m + t.search_sigmas * belief.sigmas[0], t.search_most_m)
        covariance = np.diag([window_m**2] * 3 + [p.turned_rad**2] * 3)
        for guess in space.search(self._thinned, self._found, window_m, p.starts):
            loose = Belief(guess, covariance, belief.free)
            placement = space.match(self._thinned, guess, loose, wide=True)
            yield self._candidate(placement, belief, space)

    def _candidate(self, placement: Placement, belief: Belief, space: SpaceMap) -> _Candidate:
        """A placement of the scan placed last, with its score."""
        t = self._tracking
        of_known, of_all = space.agreement(self._thinned, placement.pose)
        quality = of_all - t.residual_weight_per_m * placement.residual_m
        of_scan = SURFACES.independent(len(self._thinned.points_m)) * quality
        score = of_scan + belief.log_density(belief.chi2(placement.pose))
        sure = placement.overlap >= t.sure_overlap and placement.residual_m <= t.max_residual_m
        return _Candidate(score, placement, of_known, sure)

    def _is_vague(self, belief: Belief) -> bool:
        """Whether a match alone does not reach all that a belief holds possible."""
        t, (sigma_m, sigma_rad) = self._tracking, belief.sigmas
        return t.search_sigmas * max(sigma_m / t.search_above_m, sigma_rad / t.search_above_rad) > 1.0

    def _is_believed(self, best: _Candidate, belief: Belief) -> bool:
        """Whether a scan lies where it fits best: it fits well near where it is expected, or nothing that is
        known there speaks against it."""
        if best.sure and not self._is_vague(belief):
            return True
        overlaps = best.placement.overlap >= self._tracking.min_overlap
        return overlaps and best.agreement >= self._parameters.least_agreement

    def extend(self, pose: F64) -> None:
        """Nothing: scans join the map in space oftener than keyframes begin, see `cut`."""

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """Add the scan placed last to the map at its final pose (4, 4), and cut its planar scan out of it.

        The planar scan is in the levelled base frame.
        """
        if self._map is None:
            raise ValueError("no scan has been placed")
        if not lost:
            self._map.extend(scan, points_m, self._thinned, pose)
        return self._map.cut(scan, pose)


def _spread(candidates: Sequence[_Candidate], best: _Candidate) -> F64:
    """The covariance (6, 6) of all candidates about the best one, in the axes of the base there."""
    mass = np.exp([candidate.score - best.score for candidate in candidates])
    poses = np.array([candidate.placement.pose for candidate in candidates])
    away = steps(np.tile(best.placement.pose, (len(poses), 1, 1)), poses).step
    spread: F64 = np.einsum("n,na,nb->ab", mass / mass.sum(), away, away)
    return spread


def _alone(found: Placement, belief: Belief, spread: F64) -> tuple[F64, F64]:
    """The pose (4, 4) by the points alone, with its information (6, 6).

    spread : covariance (6, 6) of where else the scan may lie.
    """
    away, _, J = (of_belief[0] for of_belief in steps(belief.pose[None], found.pose[None]))
    information = found.information + 1e-3 * np.eye(6)
    change = np.linalg.solve(information, J.T @ belief.information @ away)
    wider = np.linalg.inv(np.linalg.inv(information) + spread)
    return moved(found.pose[None], change[None])[0], np.asarray(wider, np.float64)


def first_pose(scan: Scan, points_m: F32) -> F64:
    """T_session_base (4, 4) of the first scan of a carried sensor: the session frame is the base, levelled.

    The vertical is that of the odometry, which has six degrees of freedom; else that of the floor in the
    points (N, 3), unless an IMU contradicts it, which measures it less exactly; else that of the IMU, else
    the z axis of the base.
    """
    if scan.T_odom_base is not None:
        return leveling(scan.T_odom_base[2, :3])
    ground = find_ground(points_m, scan.T_base_sensor[:3, 3])
    if scan.T_level_base is not None:
        up = scan.T_level_base[2, :3]
        if ground is None or ground.normal @ up < LEVEL.level:
            return leveling(up)
    return np.eye(4) if ground is None else ground.leveling()
