"""The floor in what several views have shown together."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.clouds.ground import LEVEL, FloorBelow, floor_height
from pc2grid.estimation.surface_map import SurfaceMap
from pc2grid.geometry import F64
from pc2grid.settings import RegistrationConfig

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
