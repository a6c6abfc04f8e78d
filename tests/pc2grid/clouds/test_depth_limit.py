"""Hits near the far limit of a depth camera are too short; hits of a scene that ends before are kept."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.clouds.ground import Ground
from pc2grid.clouds.planar_scan import DepthLimit, PlanarScan, project_to_plane
from pc2grid.estimation.tracker import Tracker
from pc2grid.model import Scan, SensorKind
from pc2grid.settings import ProjectionConfig, RegistrationConfig

LIMIT_M = 6.0
NOISE_PER_M2 = 0.0015
CAMERA = np.eye(4)  # 0.6 m above the floor, looking along x, optical axes
CAMERA[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
CAMERA[2, 3] = 0.6
FLOOR = Ground(np.array([0.0, 0.0, 1.0]), 0.0, None)


def image_of_wall(wall_m: float, limit_m: float = LIMIT_M, seed: int = 0) -> np.ndarray:
    """Points (N, 3), base frame, of a wall across the view at depth `wall_m` and of the floor before it."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 120), np.linspace(-0.5, 0.5, 90))
    rays = np.column_stack((x.ravel(), y.ravel(), np.ones(x.size)))
    with np.errstate(divide="ignore"):
        floor_m = np.where(rays[:, 1] > 0.0, 0.6 / rays[:, 1], np.inf)
    depth = np.minimum(wall_m, floor_m)
    depth += rng.normal(size=len(depth)) * NOISE_PER_M2 * depth**2
    points = (rays * depth[:, None])[depth < limit_m]
    return np.asarray(points @ CAMERA[:3, :3].T + CAMERA[:3, 3], np.float32)


def planar(points: np.ndarray) -> PlanarScan:
    return project_to_plane(
        points, stamp_ns=0, sensor_m=CAMERA[:3, 3], ground=FLOOR, config=ProjectionConfig(), sensor="depth"
    )


def too_short_m(scan: PlanarScan, wall_m: float) -> float:
    return wall_m - float(scan.hits_m[:, 0].mean())


@pytest.mark.parametrize("behind_m", [0.02, 0.05])
def test_a_wall_behind_the_limit_is_left_out(behind_m: float) -> None:
    wall_m = LIMIT_M + behind_m
    points = image_of_wall(wall_m)
    limit = DepthLimit()
    limit.observe(points, CAMERA)
    scan = planar(points)
    assert too_short_m(scan, wall_m) > 0.03  # what is left out is wrong indeed
    kept = limit.before(scan, CAMERA)
    assert len(kept.hits_m) < 0.1 * len(scan.hits_m)
    assert len(kept.normal_rad) == len(kept.hits_m)
    np.testing.assert_array_equal(kept.free_m, scan.free_m)


@pytest.mark.parametrize("wall_m", [1.5, 4.0, 8.0])
def test_a_scene_that_ends_before_the_limit_loses_nothing(wall_m: float) -> None:
    limit = DepthLimit()
    points = image_of_wall(wall_m, limit_m=np.inf)
    limit.observe(points, CAMERA)
    scan = planar(points)
    kept = limit.before(scan, CAMERA)
    assert len(scan.hits_m) > 20
    assert len(kept.hits_m) > 0.97 * len(scan.hits_m)


@pytest.mark.parametrize(
    ("sensor", "odometry", "left"), [("depth", True, False), ("depth", False, False), ("lidar", True, True)]
)
def test_the_tracker_asks_it_for_cameras_only(sensor: SensorKind, odometry: bool, left: bool) -> None:
    scan = Scan(
        stamp_ns=0,
        points_m=image_of_wall(LIMIT_M + 0.02),
        T_base_sensor=CAMERA,
        sensor=sensor,
        T_odom_base=np.eye(4) if odometry else None,
    )
    hits_m = Tracker(RegistrationConfig(), in_hand=False).track(scan).planar_scan.hits_m
    assert bool((hits_m[:, 0] > LIMIT_M - 0.08).any()) is left
