"""A sensor on wheels: KISS-ICP brings a scan near, point-to-line matching in the plane places it.

KISS-ICP in space has a wide reach. A scan in the plane knows the pose to millimetres, but only across the
walls that it shows; how far it knows each direction is measured, and the smoother does the rest.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.clouds.depth_limit import DepthLimit
from pc2grid.clouds.ground import Ground
from pc2grid.clouds.planar_scan import PlanarScan, project_to_plane
from pc2grid.config import ProjectionConfig, RegistrationConfig
from pc2grid.estimation.belief import PLANAR, Belief
from pc2grid.estimation.ground_model import GroundModel
from pc2grid.estimation.matching_maps import MatchingMaps
from pc2grid.estimation.parameters import (
    CAMERA_MATCHING,
    MATCHING_PARAMETERS,
    TRACKING_PARAMETERS,
    TrackingParameters,
)
from pc2grid.estimation.placed import Placed
from pc2grid.estimation.point_to_line import Match
from pc2grid.estimation.registration import KissRegistration
from pc2grid.geometry import SE2
from pc2grid.model import Scan
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True, order=True)
class _Candidate:
    """A match, and its score: the logarithm of its posterior density but for a constant.

    sure : the scan fits well. near : it lies where it is expected.
    """

    score: float
    match: Match = field(compare=False)
    sure: bool = field(compare=False)
    near: bool = field(compare=False)

    @property
    def settles(self) -> bool:
        """Whether nothing else needs to be tried."""
        return self.sure and self.near


class SensorOnWheels:
    """Places the scans of a sensor whose base stands on the floor.

    ground : the floor in the base frame; None for a planar laser.
    """

    free = PLANAR

    def __init__(
        self,
        registration: RegistrationConfig,
        projection: ProjectionConfig,
        parameters: TrackingParameters = TRACKING_PARAMETERS,
    ) -> None:
        self._registration, self._projection, self._parameters = registration, projection, parameters
        self._narrow = False  # the sensor sees a part of its surroundings only
        self._depth_limit = DepthLimit()
        self._floor = GroundModel(None, parameters)
        self._matching = MATCHING_PARAMETERS
        self._maps = MatchingMaps(projection.max_range_m, parameters)
        self.kiss = KissRegistration(registration, parameters)
        self._planar_scan: PlanarScan | None = None  # of the scan placed last
        self._last = SE2()  # its final pose
        self._latest: deque[tuple[PlanarScan, SE2]] = deque(maxlen=parameters.followed)

    @property
    def ground(self) -> Ground | None:
        """The floor in the base frame."""
        return self._floor.ground

    def start(self, scan: Scan, points_m: F32, at: SE2) -> F64:
        """Begin with a scan whose base is at a place of the session frame; returns its pose (4, 4),
        levelled."""
        self._floor = GroundModel.start(points_m, scan, self._parameters)
        self._narrow = SENSOR_MODELS[scan.sensor].narrow
        self._matching = CAMERA_MATCHING if self._narrow else MATCHING_PARAMETERS
        self._maps = MatchingMaps(self._projection.max_range_m, self._parameters, self._matching)
        pose = self.levelled(at.lift())
        self.kiss.register(self._floor.remove(points_m), pose, 0.0)
        self._planar_scan = self._project(scan, points_m)
        return pose

    def restart(self) -> None:
        """Forget the local maps: the next keyframe begins new ones."""
        self._maps.restart()
        self.kiss = KissRegistration(self._registration, self._parameters)

    def levelled(self, pose: F64) -> F64:
        """A pose (4, 4) in the plane with tilt and height from the floor: walls alone let them drift."""
        return pose @ self._floor.T_level_base()

    def place(self, scan: Scan, points_m: F32, seconds: float, expected: Sequence[Belief]) -> Placed:
        """See `PlacingSensor`."""
        p = self._parameters
        self._floor.follow(points_m, scan)
        near = self.kiss.register(self._floor.remove(points_m), self.levelled(expected[0].pose), seconds)
        registered = SE2.from_matrix(near)
        self._planar_scan = planar_scan = self._project(scan, points_m)
        motion = None
        if scan.T_odom_base is None and self.kiss.registered and not self._narrow:
            sigmas = np.array([p.steady_sigma_m, p.steady_sigma_m, p.steady_sigma_rad])
            motion = (self._last.inverse() @ registered).lift(), np.diag(sigmas**-2)
        if not self._maps:
            return Placed(expected[0].pose, first=True)
        best = self._match(planar_scan, registered, expected)
        match = best.match
        # Half of what a camera sees while it turns may be new to the map, but not to the scans before.
        if match.overlap < p.min_overlap or not (best.sure or best.near):
            followed = None if scan.T_odom_base is not None else self._followed(planar_scan, expected[0])
            return Placed(expected[0].pose, motion=followed or motion, followed=followed is not None)
        alone = match.by_points.lift(), _turned(match.information, match.by_points.yaw)
        return Placed(
            match.pose.lift(), alone, match.overlap, match.residual_m, match.measured, motion=motion
        )

    def _followed(self, planar_scan: PlanarScan, belief: Belief) -> tuple[F64, F64] | None:
        """The motion (4, 4) from the scan before by the last scans alone, with its information (3, 3); None
        if it does not fit them."""
        last = MatchingMaps(self._projection.max_range_m, self._parameters, self._matching)
        for before, pose in self._latest:
            last.extend(before, pose)
        prior = SE2.from_matrix(belief.pose)
        match = last.match(planar_scan, prior, prior, _in_map_axes(belief))
        motion = self._last.inverse() @ match.by_points
        information = _turned(match.information, self._last.yaw)
        return (motion.lift(), information) if self._is_sure(match) else None

    def _match(self, planar_scan: PlanarScan, registered: SE2, expected: Sequence[Belief]) -> _Candidate:
        """The most probable match of a planar scan with the local map.

        A scan that fits nowhere near what is expected is searched for.
        """
        p, first, unseen = self._parameters, expected[0], -math.inf
        found = self._candidates(planar_scan, registered, expected)
        if self._is_vague(first) and not max(found).sure:
            found += self._searched(planar_scan, first)
            # A wide scan shows known ground behind it, too.
            if self._narrow and not max(found).near:
                unseen = self._weight(planar_scan) * p.sure_overlap + first.log_density(0.0)
        return self._believed(found, unseen)

    def _candidates(
        self, planar_scan: PlanarScan, registered: SE2, expected: Sequence[Belief]
    ) -> list[_Candidate]:
        """Matches of a planar scan with the local map.

        They begin where the base is expected and where KISS-ICP puts it. If the scan fits nowhere there, they
        begin where else the base may be. KISS-ICP slides along walls, so it does not count where the scan
        fits as well without it.
        """
        p = self._parameters
        found: list[_Candidate] = []
        for belief in expected:
            prior = SE2.from_matrix(belief.pose)
            starts = [prior, registered]
            if _is_near(registered, prior, p.disagree_m, p.disagree_rad):
                starts = [registered]
            found += (self._candidate(planar_scan, start, belief) for start in starts)
            if not max(found).settles:
                found.append(self._candidate(planar_scan, prior, belief, wide=False))
            if max(found).settles and not self._is_vague(belief):
                return [max(found)]
        return found

    def _searched(self, planar_scan: PlanarScan, belief: Belief) -> Iterator[_Candidate]:
        """Matches of a planar scan anywhere within a belief."""
        p, (sigma_m, sigma_rad) = self._parameters, belief.sigmas
        window = min(p.search_sigmas * sigma_m, p.search_most_m), min(p.search_sigmas * sigma_rad, math.pi)
        for guess in self._maps.search(planar_scan, SE2.from_matrix(belief.pose), *window):
            yield replace(self._candidate(planar_scan, guess, belief), near=False)

    def _believed(self, found: list[_Candidate], unseen: float) -> _Candidate:
        """The best of several matches; it says nothing where another explanation is nearly as probable:
        another place, or, with the score `unseen`, that the scan shows ground that the map does not know."""
        p, best = self._parameters, max(found)
        rivals = [
            math.exp(other.score - best.score)
            for other in found
            if not _is_near(other.match.pose, best.match.pose, p.search_above_m, p.search_above_rad)
        ]
        rivals.append(math.exp(min(unseen - best.score, 700.0)))
        alone = 1.0 / (1.0 + sum(rivals)) >= p.least_mass
        return best if alone else replace(best, sure=False, near=False)

    def _candidate(
        self, planar_scan: PlanarScan, guess: SE2, belief: Belief, *, wide: bool = True
    ) -> _Candidate:
        """A match of a planar scan that begins at a guess and is held to a belief.

        wide : lines far from the guess count at first; this reaches further, but may leave a good guess.
        """
        information = _in_map_axes(belief)
        match = self._maps.match(planar_scan, guess, SE2.from_matrix(belief.pose), information, wide=wide)
        of_scan = self._weight(planar_scan) * self._maps.quality(match)
        chi2 = belief.chi2(match.pose.lift())
        near = chi2 < self._parameters.search_sigmas**2
        return _Candidate(of_scan + belief.log_density(chi2), match, self._is_sure(match), near)

    def _weight(self, planar_scan: PlanarScan) -> float:
        """What a scan tells if it fits without any error."""
        p = self._parameters
        return p.hit_weight * min(len(planar_scan.hits_m), p.matched_hits)

    def _is_vague(self, belief: Belief) -> bool:
        """Whether a refinement alone does not reach all that a belief holds possible."""
        p, (sigma_m, sigma_rad) = self._parameters, belief.sigmas
        return p.search_sigmas * max(sigma_m / p.search_above_m, sigma_rad / p.search_above_rad) > 1.0

    def _is_sure(self, match: Match) -> bool:
        """Whether a scan fits so well that nothing else needs to be tried."""
        p = self._parameters
        return match.overlap >= p.sure_overlap and match.residual_m <= p.max_residual_m

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """The planar scan of the scan placed last."""
        del scan, points_m, lost
        self._last = SE2.from_matrix(pose)
        assert self._planar_scan is not None
        self._latest.append((self._planar_scan, self._last))
        return self._planar_scan

    def extend(self, pose: F64) -> None:
        """Add the scan placed last to the local maps at its final pose (4, 4)."""
        assert self._planar_scan is not None
        self._maps.extend(self._planar_scan, SE2.from_matrix(pose))
        self.kiss.update_map(pose)

    def _project(self, scan: Scan, points_m: F32) -> PlanarScan:
        """Reduce points (N, 3) of the base frame to the plane."""
        T_level_base = self._floor.T_level_base()
        noisy = SENSOR_MODELS[scan.sensor].noise_per_m2 > 0.0
        if noisy:
            self._depth_limit.observe(points_m, scan.T_base_sensor)
        sensor_m, ground = scan.T_base_sensor[:3, 3], self._floor.ground
        if ground is not None:
            R = T_level_base.copy()
            R[:3, 3] = 0.0  # a planar scan keeps the base's own origin; heights are relative to the ground
            points_m = points_m @ R[:3, :3].T.astype(np.float32)
            sensor_m, ground = R[:3, :3] @ sensor_m, ground.moved(R)
        planar_scan = project_to_plane(
            points_m,
            stamp_ns=scan.stamp_ns,
            sensor_m=sensor_m,
            ground=ground,
            config=self._projection,
            sensor=scan.sensor,
        )
        if not noisy:
            return planar_scan
        return self._depth_limit.before(planar_scan, T_level_base @ scan.T_base_sensor)


def _is_near(a: SE2, b: SE2, limit_m: float, limit_rad: float) -> bool:
    apart = a.inverse() @ b
    return math.hypot(apart.x, apart.y) <= limit_m and abs(apart.yaw) <= limit_rad


def _turned(matrix: F64, yaw_rad: float) -> F64:
    """A covariance or information (3, 3) of x, y, yaw in axes that are turned."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned: F64 = R @ matrix @ R.T
    return turned


def _in_map_axes(belief: Belief) -> F64:
    """The information (3, 3) of a belief, in the axes of the session frame."""
    return _turned(belief.information, -SE2.from_matrix(belief.pose).yaw)
