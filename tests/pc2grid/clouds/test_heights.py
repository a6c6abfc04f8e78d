"""A table before a wall, seen by a lidar at 0.9 m: its top is at 0.7 m, rays pass over it and under it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.ground import Ground
from pc2grid.clouds.planar_scan import PlanarScan, heights_seen, project_to_plane
from pc2grid.clouds.planar_scan import _compiled_heights as compiled
from pc2grid.geometry import F32, F64, U8
from pc2grid.model import SLICE_BORDERS_M, SLICES
from pc2grid.settings import ProjectionConfig

SENSOR_M = np.array([0.0, 0.0, 0.9])
FLOOR = np.array([0.0, 0.0, 1.0, 0.0])
BAND_M, DEPTHS = (0.1, 1.8), (0.05, 0.0)
ALL, TOP_ONLY = 0b000_111, 0b101_010


def wall(x_m: float) -> F32:
    """Returns every 2 cm of a wall across the x axis, from the floor to 1.8 m."""
    y, z = np.meshgrid(np.arange(-0.5, 0.5, 0.02), np.arange(0.0, 1.8, 0.02))
    return np.column_stack([np.full(y.size, x_m), y.ravel(), z.ravel()]).astype(np.float32)


def table(x_m: float) -> F32:
    """Returns of the edge of a table top."""
    y, z = np.meshgrid(np.arange(-0.3, 0.3, 0.02), (0.68, 0.7))
    return np.column_stack([np.full(y.size, x_m), y.ravel(), z.ravel()]).astype(np.float32)


def seen(at_m: list[tuple[float, float]], points_m: F32) -> list[int]:
    at = np.array(at_m, np.float32)
    return heights_seen(at, points_m, SENSOR_M, FLOOR, BAND_M, DEPTHS).tolist()


def test_of_a_table_the_top_is_seen_and_the_wall_behind_it_below_and_above() -> None:
    room = np.concatenate((table(2.0), wall(4.0)))
    assert seen([(2.0, 0.0), (4.0, 0.0)], room) == [TOP_ONLY, ALL]


def test_before_nothing_no_ray_is_known_to_pass() -> None:
    assert seen([(2.0, 0.0)], table(2.0)) == [TOP_ONLY & 0b000_111]


def test_where_the_scan_shows_nothing_no_height_is_known() -> None:
    assert seen([(-2.0, 0.0), (6.0, 0.0)], np.concatenate((table(2.0), wall(4.0)))) == [0, 0]


def test_rays_to_the_floor_and_to_the_ceiling_pass_too() -> None:
    # Through 2 m: to the floor at 4 m at 0.45 m, to a ceiling of 2.5 m at 4 m at 1.7 m.
    rays = np.array([(4.0, 0.0, 0.0), (4.0, 0.0, 2.5)], np.float32)
    assert seen([(2.0, 0.0)], np.concatenate((table(2.0), rays))) == [TOP_ONLY]


def heights_seen_plain(
    at_m: F32,
    points_m: F32,
    sensor_m: F64,
    plane: F64,
    band_m: tuple[float, float],
    depths: tuple[float, float],
    borders_m: F64,
) -> U8:
    """The definition of the compiled form, in plain numpy."""
    away_m = points_m[:, :2].astype(np.float64) - sensor_m[:2]
    ranges_m = np.hypot(away_m[:, 0], away_m[:, 1])
    height_m = points_m.astype(np.float64) @ plane[:3] + plane[3]
    sensor_height_m = float(sensor_m @ plane[:3] + plane[3])
    heights = np.zeros(len(at_m), np.uint8)
    for k, (x, y) in enumerate(at_m.astype(np.float64) - sensor_m[:2]):
        r = math.hypot(x, y)
        aside_m = np.abs(away_m @ (-y, x)) / np.maximum(ranges_m, 1e-9)
        ahead, deep_m = away_m @ (x, y) > 0.0, depths[0] + depths[1] * r * r
        returned = ahead & (aside_m <= 0.5 * depths[0]) & (np.abs(ranges_m - r) <= deep_m)
        passed = ahead & (aside_m <= 0.25 * depths[0]) & (ranges_m > r + deep_m)
        passing_m = sensor_height_m + (height_m - sensor_height_m) * r / np.maximum(ranges_m, 1e-9)
        filled, empty = (
            np.bitwise_or.reduce(1 << np.searchsorted(borders_m, inside, side="right"))
            for some in (height_m[returned], passing_m[passed])
            for inside in [some[(some >= band_m[0]) & (some <= band_m[1])]]
        )
        heights[k] = filled | (empty & ~filled) << SLICES
    return heights


def test_the_compiled_form_is_the_plain_one() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-4.0, -4.0, -0.2), (4.0, 4.0, 2.5), (2000, 3)).astype(np.float32)
    at = rng.uniform(-3.0, 3.0, (200, 2)).astype(np.float32)
    tilted = np.array([0.02, 0.0, 0.9998, 0.05])
    sensor_m, borders = np.array([0.1, 0.2, 0.6]), np.array(SLICE_BORDERS_M)
    expected = heights_seen_plain(at, points, sensor_m, tilted, BAND_M, (0.05, 0.01), borders)
    for bearings in (90, 720):  # how the points are sorted does not matter
        found: U8 = compiled(at, points, sensor_m, tilted, BAND_M, (0.05, 0.01), borders, bearings)
        assert np.array_equal(found, expected)
    assert len(np.unique(expected)) > 20


def projected(ground: Ground | None, points_m: NDArray[np.floating]) -> PlanarScan:
    return project_to_plane(points_m, stamp_ns=0, sensor_m=SENSOR_M, ground=ground, config=ProjectionConfig())


def test_hits_of_a_lidar_tell_heights_and_those_of_a_laser_its_own() -> None:
    room = np.concatenate((table(2.0), wall(4.0)))
    planar_scan = projected(Ground(FLOOR[:3], 0.0), room)
    is_table = planar_scan.hits_m[:, 0] < 3.0
    before_wall = is_table & (np.abs(planar_scan.hits_m[:, 1]) < 0.2)
    assert set(planar_scan.heights[before_wall].tolist()) == {TOP_ONLY}
    assert set(planar_scan.heights[~is_table].tolist()) == {ALL}
    nearest = planar_scan.only(is_table)
    assert len(nearest.hits_m) == len(nearest.heights) == np.count_nonzero(is_table)
    laser = projected(None, room)
    assert laser.height_m == SENSOR_M[2]
    assert not len(laser.heights)
