"""The ground plane: found below furniture and with a tilted sensor."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from pc2grid.clouds.ground import (
    LEVEL,
    FloorBelow,
    Ground,
    assumed_ground,
    find_ground,
    floor_height,
    vertical_held,
    vertical_of,
)
from pc2grid.estimation.surface_map import SurfaceMap
from pc2grid.geometry import F64, leveling, pose_from_rotation_vector, transform_points
from pc2grid.settings import RegistrationConfig


def room(rng: np.random.Generator, *, table: bool = True, ceiling_m: float = 2.5) -> F64:
    """Points of a 6 x 5 m room around the origin, floor at z = -1: floor, ceiling, walls and a table."""

    def slab(low: tuple[float, ...], high: tuple[float, ...], count: int) -> F64:
        return rng.uniform(low, high, (count, 3))

    parts = [
        slab((-3, -2.5, -1), (3, 2.5, -1), 2000),
        slab((-3, -2.5, ceiling_m - 1), (3, 2.5, ceiling_m - 1), 1500),
        slab((-3, -2.5, -1), (-3, 2.5, ceiling_m - 1), 1500),
        slab((3, -2.5, -1), (3, 2.5, ceiling_m - 1), 1500),
        slab((-3, 2.5, -1), (3, 2.5, ceiling_m - 1), 1500),
    ]
    if table:
        parts.append(slab((0.5, -1, -0.25), (2.0, 1, -0.25), 2500))
    points = np.concatenate(parts)
    return points + rng.normal(0, 0.01, points.shape)


@pytest.mark.parametrize("tilt_deg", [(0, 0), (15, -10), (-25, 8)])
def test_floor_found_under_a_table_and_a_tilted_sensor(tilt_deg: tuple[float, float]) -> None:
    T = pose_from_rotation_vector(np.radians((*tilt_deg, 0)))
    points = transform_points(T, room(np.random.default_rng(0)))
    ground = find_ground(points, np.zeros(3))
    assert ground is not None and ground.seen
    assert np.degrees(np.arccos(ground.normal @ T[:3, 2])) < 0.5
    assert ground.offset_m == pytest.approx(1.0, abs=0.01)
    levelled = leveling(ground.normal)[:3, :3] @ ground.normal
    assert levelled == pytest.approx((0, 0, 1), abs=1e-9)


def test_a_table_is_never_taken_for_the_expected_floor() -> None:
    rng = np.random.default_rng(1)
    table = rng.uniform((0.5, -1, -0.25), (2, 1, -0.25), (3000, 3)) + rng.normal(0, 0.01, (3000, 3))
    expected = Ground(np.array([0.0, 0.0, 1.0]), 1.0)
    assert find_ground(table, np.zeros(3), expected) is None


def test_walls_alone_have_no_floor() -> None:
    rng = np.random.default_rng(2)
    walls = np.concatenate(
        [rng.uniform((-3, -2, -0.2), (-3, 2, 1), (800, 3)), rng.uniform((3, -2, -0.2), (3, 2, 1), (800, 3))]
    )
    assert find_ground(walls, np.zeros(3)) is None


def test_the_mounting_gives_the_expected_floor() -> None:
    T = np.eye(4)
    assert assumed_ground(T).offset_m == 1.0 and not assumed_ground(T).seen
    T[2, 3] = 0.7
    assert assumed_ground(T).offset_m == 0.0


# --- The floor in what several views have shown together ---


EDGE_M = 0.15
SENSOR = np.array((0.0, 0.0, 1.5))


def slab(low: tuple[float, float], high: tuple[float, float], z: float, seed: int = 0) -> F64:
    """Points (N, 3) of a level surface, 4,000 a square metre, 5 mm of noise."""
    rng = np.random.default_rng(seed)
    count = int(4000 * (high[0] - low[0]) * (high[1] - low[1]))
    points = np.column_stack((rng.uniform(low, high, (count, 2)), np.full(count, z)))
    return points + 0.005 * rng.standard_normal(points.shape)


def wall(x: float, seed: int = 1) -> F64:
    """Points (N, 3) of a wall across x, 4 m long and 2 m high."""
    upright = slab((0.0, -2.0), (2.0, 2.0), x, seed)
    return upright[:, [2, 1, 0]]


def shapes_of(*points_m: F64) -> F64:
    surfaces = SurfaceMap(EDGE_M, 20.0, RegistrationConfig())
    surfaces.add(np.concatenate(points_m), np.eye(4))
    return surfaces.fine.shapes


TABLE = slab((0.5, -0.5), (2.0, 0.5), 0.72)
FLOOR = slab((-1.0, -1.0), (1.0, 1.0), 0.0)
REFLECTION = slab((1.0, 0.0), (1.3, 0.3), -0.8)


@pytest.mark.parametrize(
    ("surfaces", "height_m"),
    [
        ((FLOOR, wall(2.0)), 0.0),
        ((FLOOR, TABLE), 0.0),  # the table is as large as the floor that is seen, but higher
        ((FLOOR, TABLE, REFLECTION), 0.0),  # below a glossy floor, and small
        ((TABLE,), 0.72),  # of a table alone nobody can tell
        ((wall(2.0),), None),
        ((slab((-1.0, -1.0), (1.0, 1.0), 1.4),), None),  # a shelf at the height of the eyes
    ],
)
def test_the_floor_is_the_lowest_large_level(surfaces: tuple[F64, ...], height_m: float | None) -> None:
    found = floor_height(shapes_of(*surfaces), EDGE_M, SENSOR)
    assert found == (None if height_m is None else pytest.approx(height_m, abs=0.02))


def test_a_floor_that_is_seen_in_rows_is_a_floor() -> None:
    """The rows of an image lie far apart on the floor: the points of a voxel fix their height, and also where
    the row is. So do those of a post, which is no floor."""
    rows = FLOOR[np.abs(FLOOR[:, 0] % EDGE_M - 0.5 * EDGE_M) < 0.01]
    upright = wall(2.0)
    posts = upright[np.abs(upright[:, 1] % EDGE_M - 0.5 * EDGE_M) < 0.01]
    assert floor_height(shapes_of(rows, wall(2.0)), EDGE_M, SENSOR) == pytest.approx(0.0, abs=0.02)
    assert floor_height(shapes_of(posts), EDGE_M, SENSOR) is None


def followed(*views: tuple[F64, ...]) -> tuple[FloorBelow, list[float | None]]:
    """The floor after views of some surfaces each, a metre of travel between them, and what each showed."""
    surfaces, floor, seen = SurfaceMap(EDGE_M, 20.0, RegistrationConfig()), FloorBelow(), []
    for view in views:
        surfaces.add(np.concatenate(view), np.eye(4))
        seen.append(floor.follow(1.0, shapes_of(*view), surfaces.fine.shapes, EDGE_M, SENSOR))
    return floor, seen


def test_a_floor_that_rises_is_followed_and_in_between_it_is_in_doubt() -> None:
    """By 2 cm a metre, over the floor of the views before; at last nothing but a table and a wall is seen."""
    rising = [(slab((-1.0, -1.0), (1.0, 1.0), 0.02 * k, k), wall(2.0, k)) for k in range(12)]
    floor, seen = followed(*rising)
    assert floor.z_m == pytest.approx(0.22, abs=0.03)
    assert floor.risen_m == pytest.approx(0.22, abs=0.03)
    assert seen == pytest.approx([0.02 * k for k in range(12)], abs=0.01)
    assert floor.sigma_m < LEVEL.seen_m
    doubtful, unseen = followed(rising[0], *[(TABLE, wall(2.0, k)) for k in range(9)])
    assert unseen[1:] == [None] * 9 and doubtful.z_m == pytest.approx(0.0, abs=0.02)
    assert doubtful.sigma_m == pytest.approx(0.06, abs=0.01)  # 9 m of travel


def test_what_was_a_table_is_no_floor_when_the_floor_is_seen() -> None:
    floor, seen = followed((TABLE,), (TABLE, FLOOR), (FLOOR,))
    assert seen == pytest.approx([0.72, 0.0, 0.0], abs=0.02)
    assert floor.z_m == pytest.approx(0.0, abs=0.02)
    assert floor.risen_m == pytest.approx(0.0, abs=0.02)  # it is the floor that was wrong, not the poses


# --- Walls show which way is up ---


UP = np.array([0.0, 0.0, 1.0])


def bare_room(tilt_rad: float, *, rng: np.random.Generator) -> np.ndarray:
    """What a lidar sees in a room of 6 x 4 m, in the frame of a base that is pitched up."""
    bearing, up = np.meshgrid(np.radians(np.arange(-180, 180, 1.0)), np.radians(np.linspace(-15, 15, 16)))
    beams = np.stack((np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)), axis=-1)
    beams = beams.reshape(-1, 3)
    c, s = math.cos(tilt_rad), math.sin(tilt_rad)
    level = beams @ np.array([(c, 0, -s), (0, 1, 0), (s, 0, c)]).T
    with np.errstate(divide="ignore"):
        away_m = np.minimum(3.0 / np.abs(level[:, 0]), 2.0 / np.abs(level[:, 1]))
    return beams * (away_m + rng.normal(0.0, 0.02, len(beams)))[:, None]


@pytest.mark.parametrize("tilt_deg", [-20.0, -4.8, 0.0, 4.8, 30.0])
def test_walls_show_the_tilt_of_the_base(tilt_deg: float) -> None:
    points = bare_room(math.radians(tilt_deg), rng=np.random.default_rng(1))
    vertical = vertical_of(points, UP, narrow=False)
    assert vertical is not None
    assert math.degrees(math.asin(vertical[0])) == pytest.approx(tilt_deg, abs=0.7)
    assert abs(math.degrees(math.asin(vertical[1]))) < 0.7


def test_a_single_wall_does_not_show_it() -> None:
    y, z = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(0, 2, 20))
    wall = np.column_stack((np.full(y.size, 2.0), y.ravel(), z.ravel()))
    assert vertical_of(wall, UP, narrow=False) is None


def test_a_camera_sees_the_pitch_by_a_single_wall_ahead() -> None:
    rng = np.random.default_rng(1)
    pitch = math.radians(20.0)
    y, z = np.meshgrid(np.linspace(-1.5, 1.5, 80), np.linspace(-0.5, 1.5, 60))
    wall = np.column_stack((np.full(y.size, 2.0), y.ravel(), z.ravel())) + rng.normal(0, 0.005, (y.size, 3))
    c, s = math.cos(pitch), math.sin(pitch)
    points = wall @ np.array([(c, 0, -s), (0, 1, 0), (s, 0, c)])
    assert vertical_of(points, UP, narrow=False) is None
    vertical = vertical_of(points, UP, narrow=True)
    assert vertical is not None
    assert math.degrees(math.asin(vertical[0])) == pytest.approx(20.0, abs=0.5)
    beside = points[:, [1, 0, 2]] * (1.0, -1.0, 1.0)  # a wall along the way shows no pitch
    assert vertical_of(beside, UP, narrow=True) is None


def of_walls(points: F64) -> F64:
    return points[(points[:, 2] > -0.9) & (points[:, 2] < 1.4)]


def of_floor(points: F64) -> F64:
    return points[points[:, 2] < -0.9]


@pytest.mark.parametrize("seen", [of_walls, of_floor])
@pytest.mark.parametrize("tilt_deg", [-4.0, 0.0, 6.0])
def test_floors_and_walls_of_one_view_hold_its_vertical(seen: Callable[[F64], F64], tilt_deg: float) -> None:
    rng = np.random.default_rng(1)
    points = seen(np.concatenate([room(rng, table=False) for _ in range(5)]))
    tilted = transform_points(pose_from_rotation_vector((math.radians(tilt_deg), 0.0, 0.0)), points)
    view = SurfaceMap(0.25, 20.0, RegistrationConfig()).alone(tilted)
    information, pull = vertical_held(view, UP)
    turn_deg = np.degrees(np.linalg.lstsq(information, pull, rcond=1e-6)[0])
    assert turn_deg == pytest.approx((-tilt_deg, 0.0, 0.0), abs=0.8)
    none, tiny, large = np.linalg.eigvalsh(information)
    assert abs(none) < 1e-6 * large and tiny > math.radians(1.0) ** -2


def test_of_a_single_wall_or_a_slanting_plane_no_vertical_follows() -> None:
    y, z = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(0, 2, 40))
    wall = np.column_stack((np.full(y.size, 2.0), y.ravel(), z.ravel()))
    wall += np.random.default_rng(1).normal(0, 0.003, wall.shape)
    for turn_deg, held in ((0.0, 1), (40.0, 0)):
        slanting = transform_points(pose_from_rotation_vector((0.0, math.radians(turn_deg), 0.0)), wall)
        view = SurfaceMap(0.25, 20.0, RegistrationConfig()).alone(slanting)
        information, _ = vertical_held(view, UP)
        assert (np.linalg.eigvalsh(information) > math.radians(2.0) ** -2).sum() == held
