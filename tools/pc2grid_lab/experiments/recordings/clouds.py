"""How two recordings of one room lie to each other, by their clouds: a truth that no answer has a part in.

Each recording is one cloud along its own trajectory. The clouds are level, and stand on one floor, so that
only a heading and a shift in the plane are searched for; the best few are refined in space by Open3D's
point-to-plane ICP. The best is the truth if no other place has nearly as many points on surfaces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from pc2grid.arrays import F64
from pc2grid.clouds.sampling import random_subset
from pc2grid.clouds.voxel_cloud import VoxelCloud
from pc2grid.geometry import SE2, invert_pose, transform_points
from pc2grid.io import Log
from pc2grid.model import Trajectory
from pc2grid.open3d_core import o3d
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredCloudsParameters:
    """How two clouds are registered. Chosen by hand for single rooms.

    voxel_m : points are thinned to one a voxel. every : scan of a recording that is used. noise_m : points
        whose deviation is larger are left out.
    step_m, step_rad, near_m : grid of the search, and how near to a surface a point counts. points : of the
        search. starts : that are refined.
    rounds_m : reach of ICP, one after the other.
    Places nearer than a step are one. rival : another place has less than this share of the
        points on surfaces of the best one.
    """

    voxel_m: float = 0.05
    every: int = 6
    noise_m: float = 0.02
    step_m: float = 0.5
    step_rad: float = math.radians(10.0)
    near_m: float = 0.3
    points: int = 250
    starts: int = 12
    rounds_m: tuple[float, ...] = (0.4, 0.2, 0.1)
    rival: float = 0.9


REGISTERED_CLOUDS = RegisteredCloudsParameters()


def cloud_along(log: Log, trajectory: Trajectory, p: RegisteredCloudsParameters = REGISTERED_CLOUDS) -> F64:
    """The points (N, 3) of a recording, thinned, in the frame of its trajectory."""
    cloud = VoxelCloud(p.voxel_m)
    for number, scan in enumerate(log.scans()):
        k = int(np.searchsorted(trajectory.stamps_ns, scan.stamp_ns))
        if number % p.every or k == len(trajectory) or trajectory.stamps_ns[k] != scan.stamp_ns:
            continue
        away_m = np.linalg.norm(scan.points_m - scan.T_base_sensor[:3, 3], axis=1)
        near = away_m < SENSOR_MODELS[scan.sensor].range_of_noise_m(p.noise_m)
        cloud.add(transform_points(trajectory.T_session_base[k], scan.points_m[near]))
    return cloud.points_m()


def registered_clouds(
    source: F64, target: F64, p: RegisteredCloudsParameters = REGISTERED_CLOUDS
) -> SE2 | None:
    """T_target_source of two clouds (N, 3) and (M, 3) of one room, z up; None if it is not clear.

    Neither cloud is preferred: each is registered to the other one, as one of the two ways may end beside the
    place, and a place counts by the points on surfaces of both (geometric mean).
    """
    placed = [*_refined(source, target, p), *map(invert_pose, _refined(target, source, p))]
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
    found: list[tuple[float, SE2]] = []
    for T in placed:
        there, back = (
            o3d.pipelines.registration.evaluate_registration(*pair, p.rounds_m[-1], pose).fitness
            for pair, pose in ((clouds, T), (clouds[::-1], invert_pose(T)))
        )
        found.append((math.sqrt(there * back), SE2.from_matrix(T)))
    share, best = max(found, key=lambda one: one[0])
    rivals = [other for other, pose in found if not _same(pose, best, p)]
    return best if max(rivals, default=0.0) < p.rival * share else None


def _refined(source: F64, target: F64, p: RegisteredCloudsParameters) -> list[F64]:
    """The poses (4, 4) at which a search ends, refined."""
    steps = o3d.pipelines.registration
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
    clouds[1].estimate_normals()
    poses = []
    for T in _starts(source, target, p):
        for reach_m in p.rounds_m:
            loss = steps.TransformationEstimationPointToPlane(steps.TukeyLoss(k=0.5 * reach_m))
            T = steps.registration_icp(*clouds, reach_m, T, loss).transformation
        poses.append(np.asarray(T, np.float64))
    return poses


def _starts(source: F64, target: F64, p: RegisteredCloudsParameters) -> list[F64]:
    """The poses (4, 4) of a grid at which most points of the source are near the target, best first."""
    tree = cKDTree(target)
    few = source[random_subset(len(source), p.points)]
    (x0, y0), (x1, y1) = (_middle(points) for points in (source, target))
    floors_m = [float(np.percentile(points[:, 2], 2.0)) for points in (source, target)]
    half_m = 0.5 * np.ptp(target[:, :2], axis=0)
    shifts = [np.arange(-half, half + p.step_m, p.step_m) for half in half_m.tolist()]
    tried: list[tuple[float, SE2]] = []
    for yaw, x, y in product(np.arange(-math.pi, math.pi, p.step_rad).tolist(), *shifts):
        pose = SE2(x1 + x, y1 + y, yaw) @ SE2(-x0, -y0, 0.0)
        placed = transform_points(_lifted(pose, floors_m), few)
        away_m, _ = tree.query(placed, distance_upper_bound=p.near_m)
        tried.append((float(np.mean(away_m < p.near_m)), pose))
    kept: list[SE2] = []
    for _, pose in sorted(tried, key=lambda one: -one[0]):
        if len(kept) < p.starts and not any(_same(pose, other, p) for other in kept):
            kept.append(pose)
    return [_lifted(pose, floors_m) for pose in kept]


def _middle(points: F64) -> tuple[float, float]:
    """The middle of the ground that points (N, 3) lie on."""
    x, y = (0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0))).tolist()
    return x, y


def _lifted(pose: SE2, floors_m: list[float]) -> F64:
    """A planar pose in space, that brings one floor onto the other."""
    T = pose.lift()
    T[2, 3] = floors_m[1] - floors_m[0]
    return T


def _same(a: SE2, b: SE2, p: RegisteredCloudsParameters) -> bool:
    between = a.inverse() @ b
    return math.hypot(between.x, between.y) < p.step_m and abs(between.yaw) < p.step_rad
