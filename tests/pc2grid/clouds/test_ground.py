"""The ground plane: found below furniture and with a tilted sensor."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.clouds.ground import Ground, assumed_ground, find_ground
from pc2grid.geometry import F64, pose_from_rotation_vector, transform_points


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
    assert ground.ceiling_m == pytest.approx(2.5, abs=0.06)
    levelled = ground.leveling()[:3, :3] @ ground.normal
    assert levelled == pytest.approx((0, 0, 1), abs=1e-9)


def test_a_table_is_never_taken_for_the_expected_floor() -> None:
    rng = np.random.default_rng(1)
    table = rng.uniform((0.5, -1, -0.25), (2, 1, -0.25), (3000, 3)) + rng.normal(0, 0.01, (3000, 3))
    expected = Ground(np.array([0.0, 0.0, 1.0]), 1.0, 2.5)
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
