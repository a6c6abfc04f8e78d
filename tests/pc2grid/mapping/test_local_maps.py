"""Local maps that loops are closed on."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.mapping.keyframes import Keyframe
from pc2grid.mapping.local_maps import CAMERA_LOCAL_MAPS, LOCAL_MAPS, LocalMap, LocalMapParameters


def uneven_walls(seed: int) -> PlanarScan:
    """Two walls that meet in a corner, with ledges 5 cm deep and 15 cm apart; noise 3 mm."""
    rng = np.random.default_rng(seed)
    along = np.arange(-1.5, 1.5, 0.02)
    deep = 2.0 + 0.05 * (np.floor(along / 0.15) % 2)
    hits = np.concatenate((np.column_stack((along, deep)), np.column_stack((deep, along))))
    hits = (hits + rng.normal(size=hits.shape) * 0.003).astype(np.float32)
    return PlanarScan.of_hits(
        stamp_ns=0, hits_m=hits, origin_m=np.zeros(2), free_m=np.full(360, 1.5, np.float32)
    )


def rms_error_m(parameters: LocalMapParameters) -> float:
    """Of matches of a part of each wall, seen again, with the local map of both."""
    rng = np.random.default_rng(1)
    local_map = LocalMap([Keyframe(0, uneven_walls(0), SE2())], [SE2()], parameters)
    errors = []
    for seed in range(1, 21):
        again = uneven_walls(seed)
        x, y, yaw = rng.uniform(-1.0, 1.0, 3) * (0.05, 0.05, math.radians(2.0))
        first, second = rng.integers(0, 100, 2)
        part = np.r_[first : first + 50, 150 + second : 200 + second]
        guess = SE2(x, y, yaw)
        match = local_map.match(again.hits_m[part].astype(np.float64), again.normal_rad[part], guess)
        errors.append(math.hypot(match.pose.x, match.pose.y))
    return float(np.sqrt(np.mean(np.square(errors))))


def test_smaller_cells_place_uneven_walls_more_exactly() -> None:
    coarse_m, fine_m = rms_error_m(LOCAL_MAPS), rms_error_m(CAMERA_LOCAL_MAPS)
    assert fine_m < 0.01
    assert fine_m < 0.75 * coarse_m
