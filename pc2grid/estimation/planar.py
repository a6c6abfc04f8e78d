"""Scan matching in the plane, for a base on wheels: KISS-ICP, then point-to-line matching with a local map.

KISS-ICP in space has a wide reach. A scan in the plane fixes the pose to millimetres, but only across the
walls that it shows. The information in each direction is measured, and the smoother fuses it with odometry.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

import numpy as np

from pc2grid.clouds.ground import Ground, assumed_ground, find_ground
from pc2grid.clouds.planar_scan import DepthLimit, PlanarScan, project_to_plane
from pc2grid.estimation.line_map import (
    CAMERA_MATCHING,
    MATCHING_PARAMETERS,
    TRACKING,
    LineMatch,
    MatchingParameters,
    PointGrid,
    best_placements,
    evenly,
)
from pc2grid.estimation.registration import KissRegistration
from pc2grid.estimation.smoother import KERNEL, PLANAR, Measurement, PoseWithCovariance, ScanMatch
from pc2grid.geometry import F32, F64, SE2, leveling
from pc2grid.model import SENSOR_MODELS, Scan
from pc2grid.settings import ProjectionConfig, RegistrationConfig


class PlanarMatcher:
    """Matches the scans of a sensor whose base stands on the floor.

    points_m : (N, 3) deskewed points of a scan in the base frame.
    """

    free = PLANAR

    def __init__(
        self,
        registration: RegistrationConfig,
        projection: ProjectionConfig,
    ) -> None:
        self._registration, self._projection = registration, projection
        self._depth_limit = DepthLimit()
        self._kiss = KissRegistration(registration)
        self._latest: deque[tuple[PlanarScan, SE2]] = deque(maxlen=TRACKING.followed)

    def start(self, scan: Scan, points_m: F32) -> F64:
        """Begin with the first scan; returns its pose (4, 4): the session frame is its base, levelled."""
        self._floor = GroundModel(points_m, scan)
        narrow = SENSOR_MODELS[scan.sensor].narrow  # the view is a part of the surroundings only
        self._matching = CAMERA_MATCHING if narrow else MATCHING_PARAMETERS
        self._maps = MatchingMaps(self._projection.max_range_m, self._matching)
        self.take(scan, points_m)
        return self.levelled(np.eye(4))

    def restart(self) -> None:
        """Forget the local maps: the next keyframe begins new ones."""
        self._maps = MatchingMaps(self._projection.max_range_m, self._matching)
        self._kiss = KissRegistration(self._registration)

    def levelled(self, pose: F64) -> F64:
        """Return a planar pose (4, 4) with tilt and height from the floor: by walls alone they drift."""
        return pose @ self._floor.T_level_base()

    def __bool__(self) -> bool:
        """Return True if there is a local map."""
        return bool(self._maps)

    def take(self, scan: Scan, points_m: F32) -> None:
        """Prepare a scan for the following calls."""
        self._points_m = self._floor.remove(points_m)
        T_level_base, sensor_m = self._floor.T_level_base(), scan.T_base_sensor[:3, 3]
        level_m, ground = points_m, self._floor.ground
        if ground is not None:
            R = T_level_base.copy()
            R[:3, 3] = 0.0  # a planar scan keeps the base's own origin; heights are relative to the ground
            level_m = points_m @ R[:3, :3].T.astype(np.float32)
            sensor_m, ground = R[:3, :3] @ sensor_m, ground.moved(R)
        self._planar_scan = project_to_plane(
            level_m,
            stamp_ns=scan.stamp_ns,
            sensor_m=sensor_m,
            ground=ground,
            config=self._projection,
            sensor=scan.sensor,
        )
        if SENSOR_MODELS[scan.sensor].noise_per_m2 > 0.0:
            self._depth_limit.observe(points_m, scan.T_base_sensor)
            T_level_sensor = T_level_base @ scan.T_base_sensor
            self._planar_scan = self._depth_limit.before(self._planar_scan, T_level_sensor)

    def match(self, belief: PoseWithCovariance) -> list[ScanMatch]:
        """Match from the expected pose and, if KISS-ICP brings half of the hits into other cells, from its
        pose, too: along a corridor KISS-ICP tends to stand still."""
        expected = SE2.from_matrix(belief.pose)
        registered = SE2.from_matrix(self._kiss.register(self._points_m, self.levelled(belief.pose)))
        hits_m = self._planar_scan.hits_m
        moved_m = np.linalg.norm((expected.inverse() @ registered).apply(hits_m) - hits_m, axis=1)
        elsewhere = len(hits_m) > 0 and np.median(moved_m) > self._matching.cell_m
        starts = (expected, registered) if elsewhere else (expected,)
        return [self._matched(self._maps, start, belief) for start in starts]

    def search(self, belief: PoseWithCovariance) -> Iterator[ScanMatch]:
        """Search the window of the belief, and match the best placements."""
        p, (sigma_m, sigma_rad), prior = TRACKING, belief.sigmas, SE2.from_matrix(belief.pose)
        window = min(KERNEL * sigma_m, p.search_most_m), min(KERNEL * sigma_rad, math.pi)
        for guess in self._maps.search(self._planar_scan, prior, *window):
            yield self._matched(self._maps, guess, belief)

    def observable(self, fit: ScanMatch) -> ScanMatch:
        """Return the match: points on a line provide the information that they seem to."""
        return fit

    def follow(self, belief: PoseWithCovariance) -> Measurement | None:
        """Match with a map of the last scans alone; returns the motion T_last_now, or None if the scan does
        not fit them.

        Half of the view of a turning camera may be new to the local map, but not to the scans before.
        """
        last = MatchingMaps(self._projection.max_range_m, self._matching)
        for before, pose in self._latest:
            last.extend(before, pose)
        fit = self._matched(last, SE2.from_matrix(belief.pose), belief)
        at, information = fit.alone
        motion = self._latest[-1][1].inverse() @ SE2.from_matrix(at)
        return (motion.lift(), _turned(information, -motion.yaw)) if fit.credible else None

    def _matched(self, maps: MatchingMaps, guess: SE2, belief: PoseWithCovariance) -> ScanMatch:
        """Match the planar scan with local maps from a guess, with a belief as prior.

        Unknown ground neither supports nor contradicts a match: points there count as if they fitted no
        better than a scan must. Otherwise a scan with much new ground, at a short range or after a long step,
        would fit best at the pose of the scan before.
        """
        p, prior = TRACKING, SE2.from_matrix(belief.pose)
        information = _turned(belief.information, -prior.yaw)  # in the axes of the session frame
        match = maps.match(self._planar_scan, guess, prior, information)
        unknown = 1.0 - match.overlap - match.contradicted
        hits = min(len(self._planar_scan.hits_m), p.matched)
        return ScanMatch(
            pose=match.pose.lift(),
            alone=(match.by_points.lift(), _turned(match.information, match.by_points.yaw)),
            overlap=match.overlap,
            measured=match.measured,
            evidence=p.hit_weight * hits * (match.overlap + p.sure_overlap * unknown),
            credible=match.overlap >= p.sure_overlap,
        )

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """Return the planar scan of the scan taken last."""
        del scan, points_m, lost
        self._latest.append((self._planar_scan, SE2.from_matrix(pose)))
        return self._planar_scan

    def extend(self, scan: Scan, points_m: F32, pose: F64) -> None:
        """Add the scan taken last, a keyframe, to the local maps and to the floor at its final pose (4,
        4).
        """
        self._floor.follow(points_m, scan)
        self._maps.extend(self._planar_scan, SE2.from_matrix(pose))
        self._kiss.add(self._points_m, pose)


def _turned(matrix: F64, yaw_rad: float) -> F64:
    """Rotate a covariance or information (3, 3) of x, y, yaw into other axes."""
    R = SE2(yaw=-yaw_rad).matrix()
    turned: F64 = R @ matrix @ R.T
    return turned


class MatchingMaps:
    """Two overlapping local maps: scans are matched with the older one, and the younger replaces it in time.

    reach_m : range of the hits of a scan. matching : parameters, which depend on the sensor.
    """

    def __init__(
        self,
        reach_m: float,
        matching: MatchingParameters = MATCHING_PARAMETERS,
    ) -> None:
        self._half_m = reach_m + 2.0 * TRACKING.map_travel_m
        self._matching = matching
        self._maps: list[tuple[PointGrid, float]] = []  # each with the travel at which it was begun
        self._last: SE2 | None = None  # where a scan was added last
        self._travel_m = 0.0

    def __bool__(self) -> bool:
        return bool(self._maps)

    def search(self, planar_scan: PlanarScan, guess: SE2, window_m: float, window_rad: float) -> list[SE2]:
        """Return the best placements of a planar scan around a guess T_session_base, to be refined."""
        p, grid = TRACKING, self._maps[0][0]
        hits = planar_scan.hits_m[evenly(len(planar_scan.hits_m), p.matched)].astype(np.float64)
        found = best_placements(grid.likelihood(), grid.low_m, grid.cell_m, hits, guess, window_m, window_rad)
        return [pose for _, pose in found]

    def match(self, planar_scan: PlanarScan, near: SE2, prior: SE2, information: F64) -> LineMatch:
        """Match a planar scan from a pose near the right one, T_session_base.

        prior, information : Gaussian prior of the pose, with its information (3, 3) of x, y, yaw.
        """
        grid = self._maps[0][0]
        chosen = evenly(len(planar_scan.hits_m), TRACKING.matched)
        hits, normals = planar_scan.hits_m[chosen], planar_scan.normal_rad[chosen]
        if near != prior:
            near = grid.weighed(hits, normals, near, prior, information)
        return grid.match(hits, normals, near, prior, information)

    def extend(self, planar_scan: PlanarScan, pose: SE2) -> None:
        """Add a planar scan at its final pose T_session_base."""
        if self._last is not None:
            step = self._last.inverse() @ pose
            self._travel_m += math.hypot(step.x, step.y)
        self._last = pose
        if not self._maps or self._travel_m - self._maps[-1][1] > TRACKING.map_travel_m:
            middle = np.array([pose.x, pose.y])
            low_m, high_m = middle - self._half_m, middle + self._half_m
            self._maps.append((PointGrid(low_m, high_m, parameters=self._matching), self._travel_m))
        if len(self._maps) > 2:
            del self._maps[0]
        hits_m, normal_rad = pose.apply(planar_scan.hits_m), planar_scan.normal_rad + pose.yaw
        outline_m = pose.apply(planar_scan.free_polygon())
        for grid, _ in self._maps:
            grid.add(hits_m, normal_rad)
            grid.clear(outline_m)


class GroundModel:
    """The floor in the base frame, averaged over the keyframes that show it.

    ground : the floor; None for a planar laser, which measures none.
    """

    def __init__(self, points_m: F32, scan: Scan) -> None:
        """Find the floor in the first scan.

        It is searched for at the height given by the mounting of the sensor, then as the lowest level plane;
        else it is assumed. points_m : (N, 3) points of the scan that are used, base frame.
        """
        self.ground: Ground | None = None
        if not SENSOR_MODELS[scan.sensor].planar:
            sensor_m, assumed = scan.T_base_sensor[:3, 3], assumed_ground(scan.T_base_sensor)
            found = find_ground(points_m, sensor_m, assumed) if assumed.offset_m == 0.0 else None
            self.ground = found or find_ground(points_m, sensor_m) or assumed
            self._observations = int(self.ground.seen)  # that have shown the floor

    def follow(self, points_m: F32, scan: Scan) -> None:
        """Update the floor by the points (N, 3) of a scan.

        Wheels do not tilt against the floor, and a ramp ahead soon passes.
        """
        if self.ground is None:
            return
        found = find_ground(points_m, scan.T_base_sensor[:3, 3], self.ground)
        if found is not None:
            self._observations += 1
            self.ground = self.ground.toward(found, 1.0 / self._observations)

    def remove(self, points_m: F32) -> F32:
        """Remove the floor from points (N, 3), for KISS-ICP."""
        if self.ground is None or not len(points_m):
            return points_m
        return points_m[self.ground.heights(points_m) > TRACKING.floor_slack_m]

    def T_level_base(self) -> F64:
        """Return tilt and height (4, 4) of the base over the floor. The heading of the base stays."""
        if self.ground is None:
            return np.eye(4)
        level = leveling(self.ground.normal)
        # Levelling is the smallest rotation, which may change the heading: turn it back.
        turn = SE2(0.0, 0.0, -SE2.from_matrix(level).yaw).lift()
        level[:3, :3] = turn[:3, :3] @ level[:3, :3]
        return level
