"""Scans of any kind, reduced to the plane."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from pc2grid.clouds import planar_scan
from pc2grid.clouds.ground import CLOUD_PARAMETERS, CloudParameters, Ground
from pc2grid.clouds.planar_scan import (
    BEARINGS,
    DepthLimit,
    PlanarScan,
    heights_seen,
    planar_normals,
    project_to_plane,
    scan_bearings,
)
from pc2grid.estimation.tracker import Tracker
from pc2grid.geometry import F32, F64, U8
from pc2grid.model import SLICE_BORDERS_M, SLICES, Scan, SensorKind
from pc2grid.settings import ProjectionConfig, RegistrationConfig

CONFIG = ProjectionConfig()
GROUND = Ground(np.array([0.0, 0.0, 1.0]), 0.0, 2.5)


def bearing(degrees: float) -> int:
    return round(degrees / 360 * BEARINGS) % BEARINGS


def planar_scan_of(
    points: Sequence[tuple[float, ...]] | F64,
    ground: Ground | None = GROUND,
    sensor: tuple[float, ...] = (0.0, 0.0, 0.7),
) -> PlanarScan:
    return project_to_plane(
        np.array(points, float), stamp_ns=5, sensor_m=np.array(sensor), ground=ground, config=CONFIG
    )


RING = [(3 * math.cos(math.radians(a)), 3 * math.sin(math.radians(a)), 0.0) for a in (10.0, 11.0, 20.0)]


@pytest.mark.parametrize(
    ("points", "ground", "hits", "free_m"),
    [
        # A beam of a laser is a hit and the free space before it.
        ([(3.0, 0.0, 0.0), (0.0, 2.0, 0.0)], None, [(3.0, 0.0), (0.0, 2.0)], {0: 3.0, 90: 2.0, 180: 0.0}),
        # The floor is no obstacle. Towards the ceiling the ray leaves the band (1.8 m)
        # after 1.1 of its 1.8 m climb.
        ([(2.0, 0.0, 0.0), (0.0, 2.0, 1.0), (-2.0, 0.0, 2.5)], GROUND, [(0.0, 2.0)],
         {0: 2.0, 90: 2.0, 180: pytest.approx(2.0 * 1.1 / 1.8, rel=1e-5)}),
        # An obstacle ends the free space, also if the floor is seen behind it.
        ([(1.0, 0.0, 0.3), (4.0, 0.0, 0.0)], GROUND, [(1.0, 0.0)], {0: 1.0}),
        # Gaps between beams are closed, but not those of missing returns.
        (RING, None, [point[:2] for point in RING], {10.5: pytest.approx(3.0), 15: 0.0}),
        ([(50.0, 0.0, 0.0)], None, [], {0: CONFIG.max_range_m}),  # far returns give free space but no hits
    ],
)  # fmt: skip
def test_what_is_a_hit_and_what_is_free(
    points: list[tuple[float, ...]],
    ground: Ground | None,
    hits: list[tuple[float, float]],
    free_m: dict[float, object],
) -> None:
    planar_scan = planar_scan_of(points, ground)
    found = sorted(map(tuple, planar_scan.hits_m.tolist()))
    assert len(found) == len(hits) and np.allclose(found, sorted(hits), atol=1e-6)
    assert {degrees: planar_scan.free_m[bearing(degrees)] for degrees in free_m} == free_m


# --- A table before a wall, seen by a lidar at 0.9 m: its top is at 0.7 m, rays pass over it and under it ---


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


def test_the_compiled_form_is_the_plain_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-4.0, -4.0, -0.2), (4.0, 4.0, 2.5), (2000, 3)).astype(np.float32)
    at = rng.uniform(-3.0, 3.0, (200, 2)).astype(np.float32)
    tilted = np.array([0.02, 0.0, 0.9998, 0.05])
    sensor_m, borders = np.array([0.1, 0.2, 0.6]), np.array(SLICE_BORDERS_M)
    expected = heights_seen_plain(at, points, sensor_m, tilted, BAND_M, (0.05, 0.01), borders)
    for bearings in (90, 720):  # how the points are sorted does not matter
        monkeypatch.setattr(planar_scan, "BEARINGS", bearings)
        found = heights_seen(at, points, sensor_m, tilted, BAND_M, (0.05, 0.01))
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
    laser = projected(None, room)
    assert laser.height_m == SENSOR_M[2]
    assert not len(laser.heights)


# --- Hits near the far limit of a depth camera are too short; hits of a scene that ends before are kept ---


LIMIT_M = 6.0
NOISE_PER_M2 = 0.0015
CAMERA = np.eye(4)  # 0.6 m above the floor, looking along x, optical axes
CAMERA[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
CAMERA[2, 3] = 0.6
LEVEL = Ground(np.array([0.0, 0.0, 1.0]), 0.0, None)


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
        points, stamp_ns=0, sensor_m=CAMERA[:3, 3], ground=LEVEL, config=ProjectionConfig(), sensor="depth"
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
    assert len(kept.normal_rad) == len(kept.heights) == len(kept.hits_m)
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


# --- The compiled functions of the cloud stage: edge cases, and each against its plain twin ---


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
    most_between: int,
) -> tuple[F64, F64]:
    """Sort points (N, 3) by bearing, in plain numpy.

    sensor : (3,). plane : (4,) with height = plane[:3] . p + plane[3]. band : lowest and highest height of
    an obstacle. limit : farthest range of an obstacle point. depths : (d, q), obstacle points of one
    bearing belong to one surface up to a range difference of d + q * range**2. most_between : as many
    bearings of which nothing is known take the shorter range of the two beside them.

    Returns for each bearing how far it is free (0: not at all), and for each surface (S, 3) the sums of x
    and y of its points and their number, by increasing bearing and range.
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
    free = np.where(np.isfinite(nearest), nearest, reach)
    return fill_gaps(free, most_between), np.array(surfaces).reshape(-1, 3)


def fill_gaps(free_m: F64, most_between: int) -> F64:
    """Return free ranges (B,) in which narrow gaps, zeros between two ranges, take the shorter of the two."""
    filled = free_m.copy()
    right = np.flatnonzero(free_m > 0.0)
    left = np.roll(right, 1)
    gap = (right - left - 1) % len(free_m)
    shorter = np.minimum(free_m[left], free_m[right])
    for step in range(1, most_between + 1):
        inside = (gap >= step) & (gap <= most_between)
        filled[(left[inside] + step) % len(free_m)] = shorter[inside]
    return filled


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
    for depths, count in (((0.05, 0.0), 3000), ((0.05, 0.006), 3000), ((0.05, 0.0), 150), ((0.05, 0.0), 1)):
        arguments = (points[:count], sensor, plane, band, 5.0, depths, 360, 3)
        for found, expected in zip(scan_bearings(*arguments), scan_bearings_plain(*arguments), strict=True):
            assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)
