"""A planar pose refined and checked in space, by the points of the query and of the map.

1. The two floors give the height and the tilt of the query in the map.
2. ICP, point to plane (Open3D), brings the points of the query on those of the map, in all six degrees of
   freedom, with ever smaller distances and Tukey's loss, so that what has changed does not pull.
3. Each ray of the query is compared with the map: it ends on a surface of the map, or passes through one, or
   ends before it. This does not use the occupancy grids, so it finds what a planar answer cannot: a shelf in
   place of a wall, or a higher room.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.cloud import VoxelCloud, random_subset
from pc2grid.clouds.ground import find_ground
from pc2grid.geometry import (
    F64,
    SE2,
    BoolGrid,
    frozen_arrays,
    invert_pose,
    pose_from_rotation_vector,
    rotation_vector,
    skew,
    transform_points,
)
from pc2grid.model import PointMap


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationParameters:
    """How points are registered and compared. All chosen by hand, tried in simulation.

    voxel_m : edge of the voxels that the query, and the map for it, are reduced to. points : so many of the
        query are registered. least_points : so many of these must meet the map.
    margin_m : of the part of the map that is used, around the query.
    floor_m : the floors are compared so far around the sensor.
    rounds_m : largest distance of corresponding points, round by round. Further than the first, ICP must not
        move the planar pose; nearer than the last, a point lies on the map.
    converged : a round ends when the share of points that meet the map, and their distance as a share of it,
        change by less.
    tukey : constant of Tukey's loss, as a share of the distance of the round.
    farthest_rad, tilt_rad : ICP must not turn or tilt the planar pose more than this.
    patch_m : errors of points nearer than this to each other are taken to be the same, in the covariance. In
        simulation the normalised squared errors are then about 6, as they should for 6 numbers.
    noise_m : least standard deviation of a distance; of voxels and of maps.

    Rays:

    views, rays : at most so many scans are compared, evenly spread, and of each so many rays.
    bin_rad : size of the bins of directions in which surfaces hide each other.
    gap_m : a surface is passed, or not reached, if it is at least so far off along the ray.
    object_m : rays that end within a cell of this size hit one object.
    object_rays : an object counts for a place if so many more of its rays end on surfaces of this place than
        of the other.
    above_m : surfaces higher above the floor belong to the building: they are seldom moved.
    """

    voxel_m: float = 0.1
    points: int = 2000
    least_points: int = 100
    margin_m: float = 1.0
    floor_m: float = 8.0
    rounds_m: tuple[float, ...] = (0.6, 0.3, 0.15)
    converged: tuple[float, ...] = (1e-3, 1e-4, 1e-5)
    tukey: float = 0.5
    farthest_rad: float = math.radians(10.0)
    tilt_rad: float = math.radians(8.0)
    patch_m: float = 2.0
    noise_m: float = 0.01

    views: int = 5
    rays: int = 4000
    bin_rad: float = math.radians(1.5)
    gap_m: float = 0.4
    object_m: float = 0.5
    object_rays: int = 3
    above_m: float = 2.0


REGISTRATION = RegistrationParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(sensor_m=(np.float64, 3), points_m=(np.float64, "N", 3))
class SpatialView:
    """A scan of the query. sensor_m : (3,), points_m : (N, 3), both in the query's odom frame."""

    sensor_m: F64
    points_m: F64


@dataclass(frozen=True, slots=True)
@frozen_arrays(
    end_m=(np.float64, "R", 3),
    height_m=(np.float64, "R"),
    on=(np.bool_, "R"),
    through=(np.bool_, "R"),
    before=(np.bool_, "R"),
)
class Rays:
    """The rays of a query compared with a map; the same rays in the same order at each place.

    end_m : (R, 3) where they end, in the query. height_m : (R,) of the end above the floor, NaN if no floor
    was found. on, through, before : (R,) True if a ray ends on a surface of the map, behind one that should
    have stopped it, or before one where the map shows no other; none of them for a ray to the floor, or where
    the map is empty.
    """

    end_m: F64
    height_m: F64
    on: NDArray[np.bool_]
    through: NDArray[np.bool_]
    before: NDArray[np.bool_]

    def patches_over(self, other: Rays) -> int:
        """Return the number of patches that only this place explains, minus those that only the other place
        explains.

        Only patches of the building count: of two similar rooms, the one that is furnished like the query
        need not be the right one. Patches that one of the maps has not observed count for neither.
        """
        contradicted = self.through | self.before, other.through | other.before
        balance = (self.on & contradicted[1]).astype(np.int64) - (other.on & contradicted[0])
        high = np.minimum(self.height_m, other.height_m) > REGISTRATION.above_m
        balance, end_m = balance[high], self.end_m[high]
        cells = np.floor(end_m / REGISTRATION.object_m).astype(np.int64)
        _, patch = np.unique(cells, axis=0, return_inverse=True)
        lead = np.bincount(patch.ravel(), balance)
        over, under = lead >= REGISTRATION.object_rays, lead <= -REGISTRATION.object_rays
        return int(np.count_nonzero(over)) - int(np.count_nonzero(under))


Unfit = Literal["unknown", "left"]
"""Why there is no fit: the map shows too little of the points, or of the floor, there; or ICP leaves the
planar pose, which nothing there constrains."""


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(T_map_query=(np.float64, 4, 4), information=(np.float64, 6, 6), center_m=(np.float64, 3))
class SpatialFit:
    """A query in space on a map.

    T_map_query : (4, 4). information : (6, 6) inverse covariance of a small motion at `center_m` (3,), map
        frame: along x, y, z, then about x, y, z.
    rmse_m : of the distances of corresponding points from the surfaces of the map.
    compared : all rays. rays : number of those that are on, through or before. on, through, before : shares
        of these; their sum is 1.
    """

    T_map_query: F64
    information: F64
    center_m: F64
    rmse_m: float
    compared: Rays
    rays: int
    on: float
    through: float
    before: float

    @property
    def held(self) -> float:
        """Return the observability, 0..1, of the position: three times the share of information along the
        least known axis.

        Surfaces that all face one way fit onto any wall.
        """
        position = self.information[:3, :3]
        return 3.0 * float(np.linalg.eigvalsh(position)[0] / np.trace(position))

    def covariance_at(self, T_query_base: F64) -> F64:
        """Return the covariance (6, 6) of the pose of a base (4, 4) in the query.

        It is of x, y, z of the origin of the base in the map frame, then of the rotation about the axes of
        the map, as in geometry_msgs/PoseWithCovariance.
        """
        away = (self.T_map_query @ T_query_base)[:3, 3] - self.center_m
        motion = np.eye(6)
        motion[:3, 3:] = -skew(away[None])[0]
        values, axes = np.linalg.eigh(self.information)
        covariance = axes @ np.diag(1.0 / np.maximum(values, 1e-6)) @ axes.T
        moved: F64 = motion @ covariance @ motion.T
        return moved


class MapSurface:
    """The points of a map in space, (V, 3) `points_m`, and the surfaces that they show."""

    def __init__(self, points: PointMap) -> None:
        self.points_m: F64 = points.points_m()

    @cached_property
    def surfaces(self) -> tuple[F64, F64]:
        """Return points (M, 3), one a voxel, and the normals (M, 3) of the surfaces there."""
        from pc2grid.open3d_core import o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self.points_m))
        cloud = cloud.voxel_down_sample(REGISTRATION.voxel_m)
        cloud.estimate_normals()
        return np.asarray(cloud.points), np.asarray(cloud.normals)


def register_in_space(
    views: Sequence[SpatialView], surface: MapSurface, T_map_query: SE2
) -> SpatialFit | Unfit:
    """Register the scans of a query with the points of a map, from a planar pose of its odom frame.

    "unknown" if the map has no points there, or the floors are not found on both sides; "left" if ICP leaves
    the neighbourhood of the planar pose.
    """
    cloud = VoxelCloud(REGISTRATION.voxel_m)
    for view in views:
        cloud.add(view.points_m)
    query = cloud.points_m()
    if not len(query):
        return "unknown"
    lifted = T_map_query.lift()
    target = surface.points_m[_around(surface.points_m, transform_points(lifted, query))]
    start = _on_floor(target, query, lifted, views[-1].sensor_m)
    if start is None:
        return "unknown"
    points_m, normals = surface.surfaces
    near = _around(points_m, transform_points(start, query))
    found = _icp(query, points_m[near], normals[near], start)
    if isinstance(found, str):
        return found
    T, information, center_m, rmse_m = found
    compared = compare_rays(views, target, T)
    on, through, before = (int(k.sum()) for k in (compared.on, compared.through, compared.before))
    count = on + through + before
    return SpatialFit(
        T_map_query=T,
        information=information,
        center_m=center_m,
        rmse_m=rmse_m,
        compared=compared,
        rays=count,
        on=on / max(count, 1),
        through=through / max(count, 1),
        before=before / max(count, 1),
    )


def _around(points: F64, query: F64) -> BoolGrid:
    """Return a mask (V,) of the points of a map (V, 3) within the horizontal extent of a query (N, 3) in the
    map.
    """
    margin_m = REGISTRATION.margin_m
    low, high = query[:, :2].min(axis=0) - margin_m, query[:, :2].max(axis=0) + margin_m
    inside: BoolGrid = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    return inside


def _on_floor(target: F64, query: F64, lifted: F64, sensor_m: F64) -> F64 | None:
    """Tilt and raise `lifted`, the pose (4, 4) of a query in the map, so that the two floors are one.

    The odom frame of a query without tf is only as level as the floor in its first scan. None if the floor
    near the sensor (3,), odom frame, is not visible on both sides.
    """
    at_m = transform_points(lifted, sensor_m[None])[0]
    normals, heights_m = [], []
    for points in (target, transform_points(lifted, query)):
        near = points[np.linalg.norm(points[:, :2] - at_m[:2], axis=1) < REGISTRATION.floor_m]
        if not len(near):
            return None
        # Half of all points and more may be of the floor, which is searched for below the middle height.
        middle = np.array([at_m[0], at_m[1], 0.5 * float(near[:, 2].min() + near[:, 2].max())])
        ground = find_ground(near - middle, np.zeros(3))
        if ground is None:
            return None
        normals.append(ground.normal)
        heights_m.append(middle[2] - ground.offset_m / ground.normal[2])
    axis = np.cross(normals[1], normals[0])
    sine = float(np.linalg.norm(axis))
    turn = pose_from_rotation_vector(axis / max(sine, 1e-12) * math.asin(min(sine, 1.0)))
    foot_m = np.array([at_m[0], at_m[1], heights_m[1]])
    turn[:3, 3] = foot_m - turn[:3, :3] @ foot_m
    turn[2, 3] += heights_m[0] - heights_m[1]
    start: F64 = turn @ lifted
    return start


def _icp(query: F64, target_m: F64, normals: F64, start: F64) -> tuple[F64, F64, F64, float] | Unfit:
    """Register a query; returns the pose (4, 4), its information (6, 6) at a point (3,), and the rmse, m.

    target_m, normals : (M, 3) of the surfaces of the map.
    """
    from pc2grid.open3d_core import o3d

    p = REGISTRATION
    source, target = (
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        for points in (query[random_subset(len(query), p.points)], target_m)
    )
    target.normals = o3d.utility.Vector3dVector(normals)
    share = min(1.0, p.points / len(query))
    steps = o3d.pipelines.registration
    T = start
    for distance_m, converged in zip(p.rounds_m, p.converged, strict=True):
        estimate = steps.TransformationEstimationPointToPlane(steps.TukeyLoss(k=p.tukey * distance_m))
        criteria = steps.ICPConvergenceCriteria(converged, converged)
        result = steps.registration_icp(source, target, distance_m, T, estimate, criteria)
        T = np.array(result.transformation)
        if len(result.correspondence_set) < p.least_points:
            return "unknown"
    # Only the last round counts: the first one may turn too far, and the next ones back.
    turn_rad, middle = rotation_vector(invert_pose(start) @ T), query.mean(axis=0)[None]
    moved_m = (transform_points(T, middle) - transform_points(start, middle))[0]
    tilt_rad = math.hypot(turn_rad[0], turn_rad[1])
    if math.hypot(*moved_m[:2]) > p.rounds_m[0] or abs(turn_rad[2]) > p.farthest_rad or tilt_rad > p.tilt_rad:
        return "left"
    pairs = np.asarray(result.correspondence_set)
    placed = transform_points(T, np.asarray(source.points))[pairs[:, 0]]
    normals = normals[pairs[:, 1]]
    away_m = np.einsum("ij,ij->i", placed - target_m[pairs[:, 1]], normals)
    near = np.abs(away_m) < p.tukey * p.rounds_m[-1]
    placed, normals, away_m = placed[near], normals[near], away_m[near]
    center_m = placed.mean(axis=0)
    J = np.column_stack((normals, np.cross(placed - center_m, normals)))
    rmse_m = float(np.sqrt(np.mean(away_m**2)))
    # Neighbouring points share the error of their voxels and of the map: as many count as there are patches.
    independent = min(1.0, (p.voxel_m / p.patch_m) ** 2) / share
    information = J.T @ J * (independent / max(rmse_m, p.noise_m) ** 2)
    return T, information, center_m, rmse_m


def compare_rays(views: Sequence[SpatialView], target: F64, T_map_query: F64) -> Rays:
    """Compare rays of the views with the surfaces of a map (V, 3).

    Rays to the floor are no evidence: it is the same everywhere.
    """
    from scipy.spatial import cKDTree

    p, near_m = REGISTRATION, REGISTRATION.rounds_m[-1]
    tree = cKDTree(target)
    every = max(1, math.ceil(len(views) / p.views))
    none = np.empty(0, np.bool_)
    found: list[tuple[NDArray[Any], ...]] = [(np.empty((0, 3)), np.empty(0), none, none, none)]
    for view in views[::-1][::every]:
        chosen = random_subset(len(view.points_m), p.rays)
        placed = transform_points(T_map_query, view.points_m[chosen])
        origin = transform_points(T_map_query, view.sensor_m[None])[0]
        if not len(placed):
            continue
        height_m = np.full(len(placed), np.nan)
        ground = find_ground(placed - origin, np.zeros(3))
        if ground is not None:
            height_m = ground.heights(placed - origin)
        stands = ~(np.abs(height_m) <= near_m)
        on = tree.query(placed, distance_upper_bound=near_m)[0] < near_m
        ray_bin, range_m = _directions(placed - origin, p.bin_rad)
        map_bin, map_m = _directions(target - origin, p.bin_rad)
        size = int(max(ray_bin.max(), map_bin.max())) + 1
        first, last = np.full(size, np.inf), np.full(size, -np.inf)
        np.minimum.at(first, map_bin, map_m)
        np.maximum.at(last, map_bin, map_m)
        through = ~on & (first[ray_bin] < range_m - p.gap_m)
        before = ~on & ~through & (last[ray_bin] > range_m + p.gap_m)
        found.append((view.points_m[chosen], height_m, stands & on, stands & through, stands & before))
    return Rays(*map(np.concatenate, zip(*found, strict=True)))


def _directions(away: F64, bin_rad: float) -> tuple[NDArray[np.int64], F64]:
    """Return the bin of directions (N,) and the range (N,) of points (N, 3) around the origin."""
    range_m: F64 = np.linalg.norm(away, axis=1)
    azimuth = np.arctan2(away[:, 1], away[:, 0]) + math.pi
    elevation = np.arcsin(np.clip(away[:, 2] / np.maximum(range_m, 1e-9), -1.0, 1.0)) + math.pi / 2
    width = math.ceil(2 * math.pi / bin_rad) + 1
    bins = (elevation / bin_rad).astype(np.int64) * width + (azimuth / bin_rad).astype(np.int64)
    return bins, range_m
