"""The floor and the vertical: in one scan, and from scan to scan for a sensor in the hand.

`find_ground` takes the lowest large, roughly level plane of a scan for the floor (planes by Open3D's RANSAC),
whether tf gives the height of the sensor or not. `vertical_of` checks it: a slanting plane, such as the back
of a chair, may be taken for a floor, but walls are upright, so the vertical is perpendicular to their
normals.

A single view of a tilted camera may show a table only. `FloorBelow` therefore takes the lowest large level in
the fused surfaces of several views and follows it. One recording is one floor, and a floor is level, so a
floor that rises is drift of the pose. `vertical_held` is the same for roll and pitch: level and upright
surfaces of one view say how far its pose leans.

Where no other origin is given, a number was chosen by hand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.cloud import random_subset
from pc2grid.geometry import F64, BoolGrid, skew
from pc2grid.model import SENSOR_MODELS, Scan


@dataclass(frozen=True, slots=True)
class Ground:
    """The floor plane of a scan, in the scan's frame.

    normal : (3,) unit vector that points up from the floor.
    offset_m : height of the frame's origin above the floor, so that height = normal . p + offset_m.
    seen : True if the floor was measured, False if it is assumed from the mounting.
    """

    normal: F64
    offset_m: float
    seen: bool = True

    def heights(self, points_m: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the heights (N,) of points (N, 3) above the floor, in metres and in the points' type."""
        normal = self.normal.astype(points_m.dtype)
        heights: NDArray[np.floating] = points_m @ normal + points_m.dtype.type(self.offset_m)
        return heights

    def toward(self, other: Ground, gain: float) -> Ground:
        """Return the mean of this ground and another one, weighted 1 - `gain` and `gain` (0..1)."""
        normal = (1.0 - gain) * self.normal + gain * other.normal
        offset = (1.0 - gain) * self.offset_m + gain * other.offset_m
        return Ground(normal / np.linalg.norm(normal), offset, self.seen or other.seen)

    def moved(self, T_new_old: F64) -> Ground:
        """Return the same ground in another frame; T_new_old (4, 4) is the old frame's pose in it."""
        normal = T_new_old[:3, :3] @ self.normal
        return Ground(normal, self.offset_m - float(normal @ T_new_old[:3, 3]), self.seen)


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudParameters:
    """How one cloud is processed.

    Ground plane:

    sample, voxel_m : floor and vertical are searched for in a random sample of a scan, of which Open3D keeps
        one point a voxel, so that near surfaces count no more.
    max_tilt_rad : largest angle between a floor's normal and the z axis of the base.
    plane_tolerance_m : half thickness of a floor, three to four times the range noise of a lidar. What is
        twice as far from a plane does not belong to it.
    search_iterations : of RANSAC for each plane. 300 draws of three points contain three floor points with a
        probability of 99 % where a quarter of the points lies on the floor.
    min_plane_points : with fewer points no plane is searched for.
    max_beneath_share : a floor has at most this share of the points beneath it. This separates a floor from a
        table.
    step_tilt_rad : largest change of the floor against what was expected.

    Normals:

    reach_m, reach_per_m : radius of the neighbourhood of a hit, and its growth with the range, since the
        distance between beams grows with it.
    sparse_factor : the neighbourhood is this many times as wide where it contains fewer than three hits.
    max_flatness : largest ratio of the variances across and along a surface.

    Planar scan:

    limit_sigmas : hits so many standard deviations before the farthest depth of a camera, or beyond, are left
        out; see `pc2grid.clouds.planar_scan`.
    max_gap_bins : bearings without a return between two with one count as free up to this many.
    """

    sample: int = 10_000
    voxel_m: float = 0.1
    max_tilt_rad: float = math.radians(35.0)
    plane_tolerance_m: float = 0.04
    search_iterations: int = 300
    min_plane_points: int = 30
    max_beneath_share: float = 0.05
    step_tilt_rad: float = math.radians(3.0)

    reach_m: float = 0.08
    reach_per_m: float = 0.02
    sparse_factor: float = 4.0
    max_flatness: float = 0.3

    limit_sigmas: float = 2.0
    max_gap_bins: int = 5


CLOUD_PARAMETERS = CloudParameters()


def find_ground(
    points_m: NDArray[np.floating],
    sensor_m: F64,
    expected: Ground | None = None,
    parameters: CloudParameters = CLOUD_PARAMETERS,
) -> Ground | None:
    """Find the floor in one scan; None if the scan shows none.

    points_m : (N, 3) returns. sensor_m : (3,) position of the sensor, same frame.
    expected : the floor as known so far. Only a plane within a few centimetres and degrees of it is
        accepted, so that a box or a table is not taken for the floor.

    Without `expected`, Open3D's RANSAC takes planes out of the points below the sensor, the largest first,
    until one is tilted by at most 35 degrees and has next to no points below it. The last condition
    separates a floor from a table. The seed is fixed.
    """
    p = parameters
    points = _downsample(points_m, p)
    if expected is None:
        return _lowest_plane(points, sensor_m, p)
    far_m = 2.0 * p.plane_tolerance_m
    found = _largest_plane(points[np.abs(expected.heights(points)) < far_m], p)
    ground = None if found is None else _as_floor(points, found[0], p)
    if (
        ground is None
        or ground.normal @ expected.normal < np.cos(p.step_tilt_rad)
        or abs(ground.offset_m - expected.offset_m) > far_m
    ):
        return None
    return ground


def assumed_ground(T_base_sensor: F64) -> Ground:
    """Return the floor that is assumed where none is visible.

    It is z = 0 of the base if the sensor is mounted above that, else 1 m below the base's origin.
    """
    mounted = float(T_base_sensor[2, 3]) > 0.05
    return Ground(np.array([0.0, 0.0, 1.0]), 0.0 if mounted else 1.0, seen=False)


def _downsample(points_m: NDArray[np.floating], p: CloudParameters) -> F64:
    """Return one point a voxel (N, 3) of a random sample."""
    from pc2grid.open3d_core import o3d

    sample = points_m[random_subset(len(points_m), p.sample)].astype(np.float64)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(sample))
    return np.array(cloud.voxel_down_sample(p.voxel_m).points)


def _lowest_plane(points: F64, sensor_m: F64, p: CloudParameters) -> Ground | None:
    """Return the first of the largest planes below the sensor that can be a floor."""
    below = points[points[:, 2] < sensor_m[2] - 0.05]
    while (found := _largest_plane(below, p)) is not None:
        plane, inliers = found
        floor = _as_floor(points, plane, p)
        if floor is not None:
            # A level cut through walls holds no more points than the cut above it.
            tolerances = floor.heights(points) / p.plane_tolerance_m
            above = ((tolerances > 2.0) & (tolerances < 4.0)).sum()
            if (np.abs(tolerances) < 1.0).sum() > 1.5 * above:
                return floor
        below = np.delete(below, inliers, axis=0)
    return None


def _largest_plane(points: F64, p: CloudParameters) -> tuple[Ground, NDArray[np.intp]] | None:
    """Return the plane that holds the most points, least squares of these, and their indices."""
    from pc2grid.open3d_core import o3d

    if len(points) < p.min_plane_points:
        return None
    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    # With probability 1 every iteration is run, so that the result does not depend on the threads.
    model, inliers = cloud.segment_plane(p.plane_tolerance_m, 3, p.search_iterations, probability=1.0)
    if len(inliers) < p.min_plane_points:
        return None
    model = np.copysign(1.0, model[2]) / np.linalg.norm(model[:3]) * model
    return Ground(model[:3], float(model[3])), np.asarray(inliers)


def _as_floor(points: F64, plane: Ground, p: CloudParameters) -> Ground | None:
    """Return the plane fitted to all points near it, or None if that cannot be a floor."""
    near = points[np.abs(plane.heights(points)) < p.plane_tolerance_m]
    if len(near) < p.min_plane_points:
        return None
    center = near.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov((near - center).T))
    # Within its thickness a narrow strip, such as the foot of a wall, may slant as much as no level surface.
    narrow = variances[1] * (1.0 - LEVEL.level**2) < p.plane_tolerance_m**2
    if narrow or abs(axes[2, 0]) < np.cos(p.max_tilt_rad):
        return None
    normal = axes[:, 0] * np.sign(axes[2, 0])
    floor = Ground(normal, -float(normal @ center))
    beneath = (floor.heights(points) < -2.0 * p.plane_tolerance_m).mean()
    return floor if beneath <= p.max_beneath_share else None


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelParameters:
    """Parameters of `floor_height`, `FloorBelow` and `vertical_of`. Chosen by hand.

    flat : least information along the vertical of a voxel of a level surface.
    level : a surface is level if the cosine between its normal and the vertical is higher.
    least_m2 : smallest floor; smaller levels below it are reflections.
    thick_m : heights within this are of one level. A floor lies farther below the sensor, and a seat higher
        above the floor, beside three standard deviations of its height.
    seen_m : standard deviation of the height measured in one view.
    drift_per_m : variance that the height of a pose gains on a metre of travel, m2: 2 cm on the first, 10 cm
        on 25 m, where the odometry of a phone drifts by half a percent.

    The vertical by the walls; chosen on simulated scans of a 16-beam lidar. In two rooms by a phone
    (`depth/room`) all 14 planes of 269 that are tilted by 14 to 28 degrees are distinguished from the floor
    by it.

    neighbours : points for the estimate of a normal.
    flatness : largest ratio of the variances across a surface and along its shorter side.
    steepest_rad : normals nearer to the vertical than 90 degrees minus this are not of walls.
    scale : of the robust weight of a normal, sine of its angle with the horizontal.
    rounds : of reweighting.
    least_share : with less weight on the second direction of walls, the vertical is not determined.
    side_share : weight, as a share of that of all normals, of the vertical being perpendicular to the y axis
        of the base, about which a hand turns a camera most. So one wall ahead, which shows the pitch, is
        enough. Of cameras only.
    """

    flat: float = 0.3
    level: float = 0.97
    least_m2: float = 0.4
    thick_m: float = 0.2
    seen_m: float = 0.03
    drift_per_m: float = 0.02**2

    neighbours: int = 40
    flatness: float = 0.05
    steepest_rad: float = math.radians(37.0)
    scale: float = 0.05
    rounds: int = 8
    least_share: float = 0.05
    side_share: float = 0.1


LEVEL = LevelParameters()


def level_floor(scan: Scan, points_m: NDArray[np.floating]) -> Ground | None:
    """Find the floor in the points (N, 3) of a scan, base frame; None if it shows none.

    A plane that is not perpendicular to the walls of the scan is no floor, but for example the back of a
    chair.
    """
    ground = find_ground(points_m, scan.T_base_sensor[:3, 3])
    if ground is None:
        return None
    vertical = vertical_of(points_m, ground.normal, narrow=SENSOR_MODELS[scan.sensor].narrow)
    return ground if vertical is None or float(vertical @ ground.normal) > LEVEL.level else None


def vertical_of(points_m: NDArray[np.floating], guess: F64, *, narrow: bool) -> F64 | None:
    """Estimate the vertical (3,), a unit vector that points up, from the walls in a scan; None if they do not
    fix it.

    points_m : (N, 3) in the base frame, deskewed. guess : (3,) initial direction. The result is the direction
    near it that is perpendicular to most normals. narrow : True for a camera.
    """
    from pc2grid.open3d_core import o3d

    p, thinned = LEVEL, _downsample(points_m, CLOUD_PARAMETERS)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(thinned))
    cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamKNN(p.neighbours))
    variances, axes = np.linalg.eigh(np.asarray(cloud.covariances))
    normals = axes[variances[:, 0] < p.flatness * variances[:, 1], :, 0]
    walls = normals[np.abs(normals @ guess) < math.sin(p.steepest_rad)]
    vertical, spread, weight = guess, np.zeros(3), np.zeros(1)
    for _ in range(p.rounds):
        weight = (1.0 + ((walls @ vertical) / p.scale) ** 2) ** -2
        scatter = (walls * weight[:, None]).T @ walls
        scatter[1, 1] += narrow * p.side_share * weight.sum()
        spread, axes = np.linalg.eigh(scatter)
        vertical = axes[:, 0] if axes[:, 0] @ guess > 0.0 else -axes[:, 0]
    return vertical if spread[1] > p.least_share * float(weight.sum()) else None


SYMMETRIC = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
"""Places in the upper triangle of a symmetric matrix (3, 3) of its elements, row by row."""


def vertical_held(shapes: F64, up: F64) -> tuple[F64, F64]:
    """Return the information (3, 3) of a view on turns of its base, and its pull (3,) on the turn that makes
    floors level and walls upright.

    shapes : (V, 9) of the surfaces of the view, and up : (3,) expected vertical, both in the axes of the
    result. A surface that is neither nearly level nor nearly upright counts nothing.
    """
    held, axes = np.linalg.eigh(shapes[:, 3:][:, SYMMETRIC].reshape(-1, 3, 3))
    plane = held[:, 2] > LEVEL.flat
    # Of an edge two directions are held, and none is its normal.
    normals, flatness = axes[plane, :, 2], held[plane, 2] - held[plane, 1]
    vertical, scatter = up, np.eye(3)
    for _ in range(LEVEL.rounds):
        along = (normals @ vertical) ** 2
        level, upright = along > LEVEL.level**2, along < 1.0 - LEVEL.level**2
        off = np.where(level, 1.0 - along, along) / LEVEL.scale**2
        weight = flatness * (level | upright) / (1.0 + off) ** 2
        scatter = (normals * np.where(level, -weight, weight)[:, None]).T @ normals
        scatter += weight[level].sum() * np.eye(3)
        axis = np.linalg.eigh(scatter)[1][:, 0]
        vertical = axis * np.sign(axis @ up)
    turn = skew(vertical[None])[0] / LEVEL.scale
    information = turn @ scatter @ turn.T
    return information, information @ np.cross(vertical, up)


def floor_height(shapes: F64, edge_m: float, sensor_m: F64) -> float | None:
    """Return z of the floor below a sensor at (3,), in a map whose z axis is up; None if none is visible.

    The floor is the lowest large level: tables lie above it, reflections below are small.
    """
    heights = shapes[_lying_below(shapes, sensor_m), 2]
    if not len(heights):
        return None
    slab = np.floor((heights - heights.min()) / (0.5 * LEVEL.thick_m)).astype(np.int64)
    counts = np.bincount(slab, minlength=2)
    # A floor on the border of two slabs is in both.
    pairs = np.append(counts[:-1] + counts[1:], counts[-1]) * edge_m**2
    large = np.flatnonzero(pairs > LEVEL.least_m2)
    if not len(large):
        return None
    lowest = int(large[0])
    if lowest + 1 < len(pairs) and pairs[lowest + 1] > pairs[lowest]:
        lowest += 1
    return float(np.median(heights[(slab == lowest) | (slab == lowest + 1)]))


def _lying_below(shapes: F64, sensor_m: F64) -> BoolGrid:
    """Select the shapes (V, 9) of level surfaces below a sensor at (3,); returns a mask (V,)."""
    # Of a plane, each column of the information points along the normal.
    _, _, xz, _, yz, zz = shapes[:, 3:].T
    lying = (zz > LEVEL.flat) & (zz > LEVEL.level * np.sqrt(xz**2 + yz**2 + zz**2))
    return np.asarray(lying & (shapes[:, 2] < sensor_m[2] - LEVEL.thick_m))


class FloorBelow:
    """Estimates z of the floor below a sensor in the hand, while the height of its poses drifts.

    z_m : None until a floor was found. sigma_m : its standard deviation.
    risen_m : drift of the height of the poses since then.
    """

    def __init__(self) -> None:
        self.z_m: float | None = None
        self.sigma_m = self.risen_m = 0.0

    def follow(self, travel_m: float, view: F64, surfaces: F64, edge_m: float, sensor_m: F64) -> float | None:
        """Update the floor after some travel; returns z of the floor in this view alone, or None if it shows
        none.

        view : (V, 9) shapes of this view. surfaces : (W, 9) shapes of all views.
        """
        p = LEVEL
        variance = self.sigma_m**2 + p.drift_per_m * travel_m
        self.sigma_m = math.sqrt(variance)
        near_m = p.thick_m + 3.0 * self.sigma_m
        # A view may show a reflection, and all views the floor of another pass; a lower floor is in both.
        if self.z_m is None or self._lower(view, near_m, edge_m, sensor_m) is not None:
            lowest_m = self._lower(surfaces, near_m, edge_m, sensor_m)
            if lowest_m is not None:
                self.z_m, self.sigma_m = lowest_m, p.seen_m
        if self.z_m is None:
            return None
        heights_m = view[_lying_below(view, sensor_m), 2]
        heights_m = heights_m[np.abs(heights_m - self.z_m) < near_m]
        if len(heights_m) * edge_m**2 < p.least_m2:
            return None
        seen_m = float(np.median(heights_m))
        gain = variance / (variance + p.seen_m**2)
        rise_m = gain * (seen_m - self.z_m)
        self.z_m, self.risen_m = self.z_m + rise_m, self.risen_m + rise_m
        self.sigma_m = math.sqrt((1.0 - gain) * variance)
        return seen_m

    def _lower(self, surfaces: F64, near_m: float, edge_m: float, sensor_m: F64) -> float | None:
        """Return z of the floor in surfaces (V, 9), or None.

        A known floor is replaced only by one that lies far below it: what was taken for the floor may be a
        table.
        """
        lowest_m = floor_height(surfaces, edge_m, sensor_m)
        if lowest_m is not None and self.z_m is not None and lowest_m > self.z_m - near_m:
            return None
        return lowest_m
