"""The compiled functions of the cloud stage: edge cases, and each against its plain twin."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.clouds.ground import CLOUD_PARAMETERS, CloudParameters, Ground
from pc2grid.clouds.planar_scan import PlanarScan, planar_normals, project_to_plane, scan_bearings
from pc2grid.geometry import F32, F64
from pc2grid.settings import ProjectionConfig


def planar_normals_plain(hits_m: F32, origin_m: F64, parameters: CloudParameters = CLOUD_PARAMETERS) -> F32:
    """`planar_normals` in plain numpy."""
    p = parameters
    away = hits_m.astype(np.float64) - origin_m
    ranges = np.hypot(away[:, 0], away[:, 1])
    bearings = np.arctan2(away[:, 1], away[:, 0])
    turns = np.abs(bearings[:, None] - bearings)
    turns = np.minimum(turns, 2.0 * np.pi - turns)
    distances = np.linalg.norm(away[:, None] - away, axis=2)
    angles = np.arctan2(-away[:, 1], -away[:, 0])
    for k in range(len(angles)):
        for factor in (1.0, p.sparse_factor):
            reach = factor * (p.reach_m + p.reach_per_m * ranges[k])
            near = (distances[k] < reach) & (turns[k] <= reach / max(ranges[k], reach))
            near[k] = True
            if near.sum() < 3:
                continue
            variances, axes = np.linalg.eigh(np.cov(away[near].T, bias=True))
            if variances[0] < p.max_flatness * variances[1]:
                normal = axes[:, 0] * (1.0 if axes[:, 0] @ away[k] <= 0.0 else -1.0)
                angles[k] = np.arctan2(normal[1], normal[0])
            break
    return angles.astype(np.float32)


def scan_bearings_plain(
    points: F32,
    sensor: F64,
    plane: F64,
    band: tuple[float, float],
    limit: float,
    depths: tuple[float, float],
    bearings: int,
) -> tuple[F64, F64, F64]:
    """Sort points (N, 3) by bearing, in plain numpy.

    sensor : (3,). plane : (4,) with height = plane[:3] . p + plane[3]. band : lowest and highest height of
    an obstacle. limit : farthest range of an obstacle point. depths : (d, q), obstacle points of one
    bearing belong to one surface up to a range difference of d + q * range**2.

    Returns for each bearing the range of the nearest obstacle (inf: none) and how far floor and ceiling
    show it to be free (0: not at all), and for each surface (S, 3) the sums of x and y of its points and
    their number, by increasing bearing and range.
    """
    away = points[:, :2].astype(np.float64) - sensor[:2]
    ranges = np.hypot(away[:, 0], away[:, 1])
    bearing = np.rint(np.arctan2(away[:, 1], away[:, 0]) * (bearings / (2.0 * np.pi))).astype(int) % bearings
    height = points.astype(np.float64) @ plane[:3] + plane[3]
    sensor_height = float(sensor @ plane[:3] + plane[3])
    low, high = height < band[0], height > band[1]
    nearest, reach = np.full(bearings, np.inf), np.zeros(bearings)
    np.maximum.at(reach, bearing[low], ranges[low])
    if sensor_height < band[1]:
        part = (band[1] - sensor_height) / (height[high] - sensor_height)
        np.maximum.at(reach, bearing[high], ranges[high] * part)
    obstacle = ~(low | high)
    np.minimum.at(nearest, bearing[obstacle], ranges[obstacle])
    kept = np.flatnonzero(obstacle & (ranges <= limit))
    kept = kept[np.lexsort((ranges[kept], bearing[kept]))]
    surfaces: list[F64] = []
    last, first_m = -1, 0.0
    for k in kept:
        if bearing[k] != last or ranges[k] - first_m > depths[0] + depths[1] * ranges[k] ** 2:
            last, first_m = bearing[k], ranges[k]
            surfaces.append(np.zeros(3))
        surfaces[-1] += points[k, 0], points[k, 1], 1.0
    return nearest, reach, np.array(surfaces).reshape(-1, 3)


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
