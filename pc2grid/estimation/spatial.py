"""Scan matching in space, for a sensor in the hand: registered to surfaces, reduced to the plane by its map.

A narrow, tilted, noisy view shows neither the floor nor which of its obstacles are walls. So each scan is
registered to the local map, by KISS-ICP and then by the shapes of the surfaces. Odometry of the device, if
there is any, has six degrees of freedom that drift. A scan that does not fit is searched for in all headings;
a match that agrees with the surfaces and the free space of the map is accepted, else the scan is lost.

The local map (`SpaceMap`) fuses the registered clouds of the last metres in two ways: as shapes to which
scans are registered (`SurfaceMap`), and as columns of occupied and free cells out of which planar scans are
cut (`ColumnMap`). Memory is that of the surroundings, however long the recording is.

`begin` decides from the first scans whether a sensor is in the hand.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from pc2grid.clouds.columns import ColumnMap
from pc2grid.clouds.ground import LEVEL, FloorBelow, level_floor, vertical_held
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.estimation.line_map import (
    MATCHING_PARAMETERS,
    TRACKING,
    best_placements,
    evenly,
    likelihood_field,
    moved,
    steps,
)
from pc2grid.estimation.smoother import KERNEL, SPATIAL, PoseWithCovariance, ScanMatch
from pc2grid.estimation.surface_map import LEAST_INFORMATION, SURFACES, SurfaceMap
from pc2grid.geometry import F32, F64, SE2, BoolGrid, invert_pose, leveling, motion_size, transform_points
from pc2grid.model import SENSOR_MODELS, Scan
from pc2grid.settings import ProjectionConfig, RegistrationConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class SpatialParameters:
    """Parameters of `SpatialMatcher` and `begin`. Chosen by hand.

    least_agreement : least agreement, -1..1, of a credible pose with the known cells at its points. In a
        hall, right poses have 0.89 and more, wrong ones 0.66 to 0.88 (lidar/hall).
    most_waiting : scans kept, at most, until one shows the floor, or all that the sensor is on wheels: some
        50 MB.

    The local map:

    noise_m : points whose deviation is larger are not used. good_m : points whose deviation is smaller count
        fully when a scan is registered.
    step_rad : a scan joins the map after this turn, or when it has moved by a cell of the grid.
    assumed_m : height of the sensor above the floor as long as no floor is visible.
    """

    least_agreement: float = 0.85
    most_waiting: int = 100

    noise_m: float = 0.025
    good_m: float = 0.01
    step_rad: float = math.radians(3.0)
    assumed_m: float = 1.4


SPATIAL_MATCHING = SpatialParameters()


class SpatialMatcher:
    """Matches the scans of a sensor in the hand, in the session frame (z up).

    points_m : (N, 3) deskewed points of a scan in the base frame.
    """

    free = SPATIAL

    def __init__(
        self,
        registration: RegistrationConfig,
        projection: ProjectionConfig,
    ) -> None:
        self._registration, self._projection = registration, projection
        self._space: SpaceMap
        self._begins = True  # a scan that is taken begins a map
        self._last: F64 = np.eye(4)  # pose of the last scan that was not lost
        self._thinned: ThinnedScan  # of the scan taken last

    def restart(self) -> None:
        """Forget the map: the next scan begins a new one."""
        self._begins = True

    def start(self, scan: Scan, points_m: F32) -> F64:
        """Begin with the first scan; returns its pose (4, 4): the session frame is its base, levelled."""
        self.take(scan, points_m)
        return first_pose(scan, points_m)

    def levelled(self, pose: F64) -> F64:
        """Return the pose (4, 4): in space it includes tilt and height."""
        return pose

    def __bool__(self) -> bool:
        """Return True if there is a local map."""
        return bool(self._space.surfaces)

    def take(self, scan: Scan, points_m: F32) -> None:
        """Prepare a scan for the following calls."""
        if self._begins:
            self._space = SpaceMap(scan, points_m, self._registration, self._projection)
            self._begins = False
        self._thinned = self._space.thin(scan, points_m, self._last[:3, :3])

    def match(self, belief: PoseWithCovariance) -> list[ScanMatch]:
        """Match from the expected pose."""
        return [self._matched(belief.pose, belief)]

    def search(self, belief: PoseWithCovariance) -> Iterator[ScanMatch]:
        """Search in all headings around the last pose, with its height and tilt, and match there.

        A hand turns fast; then the direction of the predicted step is unreliable.
        """
        step_m = float(np.linalg.norm(belief.pose[:3, 3] - self._last[:3, 3]))
        window_m = min(step_m + KERNEL * belief.sigmas[0], TRACKING.search_most_m)
        for guess in self._space.search(self._thinned, self._last, window_m):
            yield self._matched(guess, PoseWithCovariance(guess, window_m**2 * np.eye(6), belief.free))

    def _matched(self, guess: F64, held: PoseWithCovariance) -> ScanMatch:
        """Match the scan taken last with the map from a guess (4, 4), with a belief as prior."""
        space = self._space
        surfaces, points_m, weights = space.surfaces, self._thinned.points_m, self._thinned.weights
        near = surfaces.near(points_m, weights, guess, held)
        pose, of_points, overlap, measured = surfaces.match(points_m, weights, near, held)
        of_known, of_all = space.agreement(self._thinned, pose)
        # So many points of a scan are worth this number of points with independent errors.
        count = min(len(points_m), SURFACES.points)
        independent = (SURFACES.noise_m / MATCHING_PARAMETERS.cell_m) ** 2 * count
        # The pose by the points alone: the prior is removed.
        away, _, J = (of_belief[0] for of_belief in steps(held.pose[None], pose[None]))
        information = of_points + LEAST_INFORMATION
        change = np.linalg.solve(information, J.T @ held.information @ away)
        return ScanMatch(
            pose=pose,
            alone=(moved(pose[None], change[None])[0], information),
            overlap=overlap,
            measured=measured,
            evidence=independent * of_all,
            credible=of_known >= SPATIAL_MATCHING.least_agreement,
        )

    def observable(self, fit: ScanMatch) -> ScanMatch:
        """Return the match with only the information that the surfaces really provide
        (`SurfaceMap.observable`).

        Without odometry, the vertical that the scan shows by itself is added, also where the map holds
        nothing: the map leans as far as the scans that made it. A slide is then known only as far as it would
        tilt the scan. Not of a camera, whose narrow view shows too little for that.
        """
        thinned, (alone, information) = self._thinned, fit.alone
        kept = self._space.surfaces.observable(thinned.points_m, thinned.weights, fit.pose)
        information, pull, turn = kept.T @ information @ kept, np.zeros(6), self._last[:3, :3]
        if len(thinned.shapes):
            of_turns, pull[3:] = vertical_held(thinned.shapes, turn @ alone[2, :3])
            pull[3:] = turn.T @ pull[3:]
            information[3:, 3:] += turn.T @ of_turns @ turn
            step = np.asarray(np.linalg.solve(information + LEAST_INFORMATION, pull), np.float64)
            alone = moved(alone[None], step[None])[0]
        measured = fit.measured and np.array_equal(kept, np.eye(6))
        return replace(fit, alone=(alone, information), measured=measured)

    def follow(self, belief: PoseWithCovariance) -> None:
        """Return None: the surfaces of the last scans are in the map."""

    def extend(self, scan: Scan, points_m: F32, pose: F64) -> None:
        """Do nothing: `cut` adds scans to the map, more of them than there are keyframes."""

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """Add the scan taken last to the map at its final pose (4, 4), and cut its planar scan out of it.

        The planar scan is in the levelled base frame.
        """
        if not lost:
            self._space.extend(scan, points_m, self._thinned, pose)
            self._last = pose
        return self._space.cut(scan, pose)


# --- the beginning of a session -----------------------------------------------------------------------


_UPRIGHT_HEIGHT_M, _UPRIGHT_TILT_RAD = 0.05, math.radians(0.5)
"""A base on wheels keeps its height and its tilt within these, as its odometry reports them: an EKF in three
dimensions reports some tenths of a degree; a phone in the hand (depth/room) 0.8 to 6.5 degrees in a second.
Without odometry, a sensor that is mounted lower than this above its base is in the hand."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """The first scans of a session, all but those `left_out`.

    in_hand : True for a sensor in the hand, False on wheels; given to all stages.
    warning : a sentence for the user about scans that were left out, or about an assumption; None: nothing.
    """

    scans: Sequence[Scan]
    in_hand: bool = False
    left_out: int = 0
    warning: str | None = None


def begin(scans: Iterator[Scan]) -> Beginning:
    """Look ahead until the first scans decide between hand and wheels and, in the hand, which way is up.

    A hand is level for a moment only. What tilts and rises later is on a ramp. A session in the hand begins
    with the first scan that shows which way is up. If none does, all scans are kept, and the sensor is
    assumed to be held level.
    """
    ahead = islice(scans, SPATIAL_MATCHING.most_waiting)
    waiting: list[Scan] = []
    in_hand = False
    for scan in ahead:
        waiting.append(scan)
        in_hand = not is_rolling(scan, waiting[0])
        upright_s = (scan.stamp_ns - waiting[0].stamp_ns) * 1e-9
        if in_hand or SENSOR_MODELS[scan.sensor].planar or upright_s > TRACKING.standing_s:
            break
    if not in_hand:
        return Beginning(waiting)
    unknown = "no floor, and neither odometry nor an IMU says which way is up"
    seen: list[Scan] = []
    for scan in chain(waiting, ahead):
        by_others = scan.T_odom_base is not None or scan.T_level_base is not None
        if by_others or level_floor(scan, scan.points_m) is not None:
            said = f"{len(seen)} scans show {unknown}: they are left out; begin with the floor in view"
            rest = [scan, *waiting[len(seen) + 1 :]]
            return Beginning(rest, True, len(seen), said if seen else None)
        seen.append(scan)
    said = f"the scans show {unknown}: the sensor is taken to be held level; begin with the floor in view"
    return Beginning(seen, True, warning=said)


def is_rolling(scan: Scan, first: Scan | None = None) -> bool:
    """Return True if the base stays upright: by its odometry, or without odometry by the mounting.

    first : the first scan, whose height is that of a base on wheels. A planar laser is taken to be on wheels.
    """
    T = scan.T_odom_base
    if SENSOR_MODELS[scan.sensor].planar:
        return True
    if T is None:
        return float(scan.T_base_sensor[2, 3]) > _UPRIGHT_HEIGHT_M
    before = T if first is None or first.T_odom_base is None else first.T_odom_base
    level = float(T[2, 2]) > math.cos(_UPRIGHT_TILT_RAD)
    return level and abs(float(T[2, 3] - before[2, 3])) < _UPRIGHT_HEIGHT_M


def first_pose(scan: Scan, points_m: F32) -> F64:
    """Return T_session_base (4, 4) of the first scan of a sensor in the hand: the session frame is the base,
    levelled.

    The vertical is that of the odometry, which has six degrees of freedom; else that of the floor in the
    points (N, 3), unless an IMU, which is less exact, contradicts it; else that of the IMU, else the z axis
    of the base.
    """
    if scan.T_odom_base is not None:
        return leveling(scan.T_odom_base[2, :3])
    ground = level_floor(scan, points_m)
    if scan.T_level_base is not None:
        up = scan.T_level_base[2, :3]
        if ground is None or ground.normal @ up < LEVEL.level:
            return leveling(up)
    return np.eye(4) if ground is None else leveling(ground.normal)


# --- the local map ------------------------------------------------------------------------------------


_DOWN = np.array([(0.05 * i, 0.05 * j, -1.0) for i, j in np.ndindex(9, 9)]) - (0.2, 0.2, 0.0)
"""Rays from a sensor to the floor, in its height above that: who carries it walks on ground 0.4 m wide.
So it is free, unless measurements there contradict it."""


@dataclass(frozen=True, slots=True)
class ThinnedScan:
    """The downsampled points of a scan that are registered.

    points_m : (N, 3) about one for each half voxel, base frame. weights : (N,) 0..1, by their noise.
    shapes : (V, 9) of the surfaces in all its points, turned as the last scan was; none with odometry, which
    knows the vertical, and of a camera. Voxels bend the normals of surfaces that they cut at a slant, so
    floors must be nearly level.
    """

    points_m: F64
    weights: F64
    shapes: F64


class SpaceMap:
    """The local map of a sensor in the hand, in the session frame (z up).

    Its columns stand on their own floor: each scan is entered at its height above the floor around it, so
    that the passes of a pose whose height drifts lie over each other.
    """

    def __init__(
        self,
        scan: Scan,
        points_m: F32,
        registration: RegistrationConfig,
        projection: ProjectionConfig,
    ) -> None:
        """Make an empty map, with voxels that suit the points (N, 3) of a scan, base frame."""
        self._projection = projection
        self._noise_per_m2 = SENSOR_MODELS[scan.sensor].noise_per_m2
        noise_range_m = SENSOR_MODELS[scan.sensor].range_of_noise_m(SPATIAL_MATCHING.noise_m)
        self._reach_m = min(projection.max_range_m, noise_range_m)
        ranges_m = np.linalg.norm(points_m - scan.T_base_sensor[:3, 3], axis=1)
        middle_m = float(np.percentile(ranges_m, 75)) if len(ranges_m) else 0.0
        edge_m = float(np.clip(SURFACES.edge_per_range * middle_m, *SURFACES.edge_m))
        self.surfaces = SurfaceMap(edge_m, 2.0 * projection.max_range_m, registration)
        self._columns = ColumnMap(self._reach_m, scan.sensor, projection)
        self._added_at: F64 | None = None  # pose of the last scan that joined
        self._floor = FloorBelow()
        self._above_floor_m: float | None = None  # the base, by the last scan

    def thin(self, scan: Scan, points_m: F32, turn: F64) -> ThinnedScan:
        """Downsample the points (N, 3) of a deskewed scan, base frame. turn : (3, 3) of the last scan."""
        near_m = points_m[self._near(scan, points_m)]
        thinned = self.surfaces.thinned(near_m)
        shown = near_m if scan.T_odom_base is None and not SENSOR_MODELS[scan.sensor].narrow else near_m[:0]
        away = thinned - scan.T_base_sensor[:3, 3]
        sigma_m = self._noise_per_m2 * np.einsum("ij,ij->i", away, away)
        return ThinnedScan(
            thinned,
            1.0 / (1.0 + (sigma_m / SPATIAL_MATCHING.good_m) ** 2),
            self.surfaces.alone(shown @ turn.T),
        )

    def agreement(self, thinned: ThinnedScan, pose: F64) -> tuple[float, float]:
        """Return the agreement of a scan at a pose (4, 4) with surfaces and free space, see
        `ColumnMap.agreement`.
        """
        return self._columns.agreement(self._lowered(transform_points(pose, thinned.points_m)))

    def search(self, thinned: ThinnedScan, guess: F64, window_m: float) -> list[F64]:
        """Search the best few poses (4, 4) in all headings, with the height and the tilt of a guess (4, 4).

        The points at the height of walls are searched for in the plane, within `window_m` along x and y.
        """
        planar = SE2.from_matrix(guess)
        T_level_base = planar.inverse().lift() @ guess
        level = transform_points(T_level_base, thinned.points_m)
        heights = level[:, 2] - self._floor_m(guess[:3, 3])
        band = level[(heights > self._projection.band_min_m) & (heights < self._projection.band_max_m), :2]
        if not len(band):
            return []
        obstacles, corner_m = self._columns.obstacles()
        chosen, cell_m = band[evenly(len(band), TRACKING.matched)], self._projection.resolution_m
        field = likelihood_field(obstacles, cell_m)
        found = best_placements(field, corner_m, cell_m, chosen, planar, window_m, math.pi)
        return [pose.lift() @ T_level_base for _, pose in found]

    def extend(self, scan: Scan, points_m: F32, thinned: ThinnedScan, pose: F64) -> None:
        """Add a scan at its final pose (4, 4), if the sensor has moved enough since the last one."""
        step_m = self._projection.resolution_m
        self._above_floor_m, travel_m = None, 0.0
        if self._added_at is not None:
            travel_m, turned_rad = motion_size(invert_pose(self._added_at) @ pose)
            if travel_m < step_m and turned_rad < SPATIAL_MATCHING.step_rad:
                return
        self._added_at = pose
        self.surfaces.add(thinned.points_m, pose)
        sensor_m, rays_m = (pose @ scan.T_base_sensor)[:3, 3], transform_points(pose, thinned.points_m)
        near_m = transform_points(pose, points_m[self._near(scan, points_m)])
        fine = self.surfaces.fine
        seen_m = self._floor.follow(travel_m, self.surfaces.alone(near_m), fine.shapes, fine.edge_m, sensor_m)
        if seen_m is not None:
            self._above_floor_m = float(pose[2, 3]) - seen_m
        if travel_m >= step_m:  # who turns on the spot may hold the sensor over a table
            down_m = sensor_m + _DOWN * (1.0, 1.0, sensor_m[2] - self._floor_m(sensor_m))
            rays_m = np.concatenate((rays_m, down_m))
        self._columns.add(
            self._lowered(near_m),
            self._lowered(rays_m),
            self._lowered(sensor_m),
            self._floor_m(sensor_m) - self._floor.risen_m,
            2.0 * self._floor.sigma_m,
        )

    def cut(self, scan: Scan, pose: F64) -> PlanarScan:
        """Return the planar scan of a scan at its pose (4, 4), in the levelled base frame."""
        planar = self._columns.cut(SE2.from_matrix(pose), (pose @ scan.T_base_sensor)[:3, 3], scan.stamp_ns)
        # Without a floor, heights above it are not known.
        heights = planar.heights[:0] if self._floor.z_m is None else planar.heights
        return replace(planar, heights=heights, above_floor_m=self._above_floor_m)

    def _floor_m(self, sensor_m: F64) -> float:
        """Return z of the floor below a sensor at (3,)."""
        assumed_m = float(sensor_m[2]) - SPATIAL_MATCHING.assumed_m
        return assumed_m if self._floor.z_m is None else self._floor.z_m

    def _lowered(self, points_m: F64) -> F64:
        """Lower points (..., 3), session frame, by the drift of the height of the poses."""
        return points_m - (0.0, 0.0, self._floor.risen_m)

    def _near(self, scan: Scan, points_m: F32) -> BoolGrid:
        """Return a mask (N,) of the points that are near enough to be exact."""
        away = points_m - scan.T_base_sensor[:3, 3].astype(np.float32)
        return np.asarray(np.einsum("ij,ij->i", away, away) < self._reach_m**2)
