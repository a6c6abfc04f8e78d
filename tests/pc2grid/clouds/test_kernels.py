"""The compiled functions of the cloud stage: edge cases, and each against its plain twin."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.arrays import F32
from pc2grid.clouds._kernels import scan_bearings
from pc2grid.clouds.ground import Ground
from pc2grid.clouds.normals import planar_normals, planar_normals_plain
from pc2grid.clouds.planar_scan import PlanarScan, project_to_plane, scan_bearings_plain
from pc2grid.config import ProjectionConfig


@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_scan_of_one_short_wall_faces_the_sensor_squarely(count: int) -> None:
    """All beams lie within one neighbourhood: going round in the scan, no beam is beyond it."""
    hits = np.column_stack((np.full(count, 2.0), np.linspace(0.5, 0.54, count))).astype(np.float32)
    assert planar_normals(hits, np.zeros(2)) == pytest.approx(np.full(count, math.pi), abs=1e-4)


def test_above_its_band_a_sensor_says_nothing_of_what_is_above_it() -> None:
    config = ProjectionConfig()
    ground = Ground(np.array([0.0, 0.0, 1.0]), 0.0)
    high = config.band_max_m + 1.0
    points = np.array([[5.0, 0.0, high - 0.5], [0.0, 5.0, 0.0]])

    def seen(sensor_z_m: float) -> PlanarScan:
        sensor = np.array([0.0, 0.0, sensor_z_m])
        return project_to_plane(points, stamp_ns=0, sensor_m=sensor, ground=ground, config=config)

    above, below = seen(high), seen(0.5 * config.band_max_m)
    assert above.free_m[0] == 0.0 and 0.0 < below.free_m[0] < 5.0
    assert above.free_m[360] == pytest.approx(5.0) and not len(above.hits_m)


def room(rng: np.random.Generator, count: int) -> F32:
    """Hits (N, 2) on the walls of a room around the origin, with some that lie on no wall."""
    angles = rng.uniform(-math.pi, math.pi, count)
    ranges = 2.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles))) + rng.normal(0, 0.01, count)
    ranges[::17] *= rng.uniform(0.3, 1.0, len(ranges[::17]))
    return (ranges[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))).astype(np.float32)


@pytest.mark.parametrize("count", [0, 1, 2, 5, 60, 500])
def test_planar_normals_are_those_of_their_definition(count: int) -> None:
    hits, origin = room(np.random.default_rng(count), count), np.array([0.2, -0.1])
    found, expected = planar_normals(hits, origin), planar_normals_plain(hits, origin)
    assert found.shape == (count,)
    apart = np.abs(np.angle(np.exp(1j * (found - expected))))
    # The normal of a wall that points at the sensor edge-on may be turned to either side.
    assert (np.minimum(apart, math.pi - apart) < 1e-3).all() and (apart < 1e-3).sum() >= 0.99 * count


@pytest.mark.parametrize("ground", [True, False])
def test_bearings_are_sorted_as_by_their_definition(ground: bool) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform((-6, -6, -0.5), (6, 6, 3.0), (3000, 3)).astype(np.float32)
    sensor = np.array([0.1, 0.2, 0.7])
    plane = np.array([0.01, -0.02, 1.0, 0.05]) if ground else np.zeros(4)
    band = (0.2, 1.8) if ground else (-math.inf, math.inf)
    for depths in ((0.05, 0.0), (0.05, 0.006)):
        arguments = (points, sensor, plane, band, 5.0, depths, 360)
        for found, expected in zip(scan_bearings(*arguments), scan_bearings_plain(*arguments), strict=True):
            assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)
