"""The same office with ceilings of different height: twins in the plane, told apart by points in space."""

from collections.abc import Iterator
from itertools import islice

import numpy as np

from pc2grid.clouds.cloud import VoxelCloud
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.estimation.tracker import follow
from pc2grid.geometry import SE2
from pc2grid.io.building_file import sampled
from pc2grid.model import PointMap, RegisteredScan
from pc2grid.simulate import SimulationConfig, prepare_session
from pc2grid.simulate.scene import extrude
from signature.config import Config
from tests.helpers.simulated_drives import office

VOXEL_M = 0.1


def points(height_m: float) -> PointMap:
    """The surfaces of the office in space."""
    corners_m = extrude(office(), height_m).reshape(-1, 3).astype(np.float64)
    cloud = VoxelCloud(VOXEL_M)
    for block_m in sampled(corners_m, np.arange(len(corners_m)).reshape(-1, 3)):
        cloud.add(block_m)
    return PointMap.of(cloud.points_m(), VOXEL_M, cloud.corner_m)


def lidar_drive(
    height_m: float, *, seed: int = 0, scans: int = 25
) -> Iterator[tuple[RegisteredScan, PlanarScan, SE2]]:
    """A simulated lidar, registered as a user's is, with its true poses in the office."""
    simulation = SimulationConfig.model_validate(
        {
            "length_m": 0.15 * scans,
            "seed": seed,
            "clutter": 0,
            "wall_height_m": height_m,
            "lidar": {"rate_hz": 5.0, "columns": 360, "elevation_deg": 30.0},
        }
    )
    made = list(islice(prepare_session(sensor="lidar", grid=office(), config=simulation).scans(), scans))
    followed = follow((scan for scan, _ in made), Config())
    for (registered, planar_scan), (_, T_map_base) in zip(followed, made, strict=True):
        yield registered, planar_scan, T_map_base
