"""What rises gently from the floor is floor: a ramp, but no wall, no table and no stairs."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from pc2grid.arrays import F32, F64
from pc2grid.clouds.ground import Ground
from pc2grid.clouds.slope import flatten_slopes
from pc2grid.simulate.scene import Mesh, Scene, prism, quads

GROUND = Ground(np.array([0.0, 0.0, 1.0]), 0.0)
SENSOR_M = np.array([0.2, 0.0, 0.6])
BAND_M = (0.2, 1.8)


def strip(profile_m: list[tuple[float, float]]) -> Mesh:
    """A floor 4 m wide along a profile of x and z."""
    faces = [
        [(x0, -2.0, z0), (x1, -2.0, z1), (x1, 2.0, z1), (x0, 2.0, z0)]
        for (x0, z0), (x1, z1) in itertools.pairwise(profile_m)
    ]
    return quads(np.array(faces))


def seen(*meshes: Mesh, noise: float = 0.0015) -> F32:
    """Points (N, 3) that a camera at `SENSOR_M` sees, with the noise of depths."""
    rng = np.random.default_rng(0)
    across, up = np.meshgrid(np.tan(np.radians(np.linspace(-40, 40, 80))), np.linspace(-0.55, 0.55, 120))
    rays = np.stack((np.ones_like(across), across, up), axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    depth = Scene(Mesh.join(list(meshes))).cast(
        np.column_stack((np.tile(SENSOR_M, (len(rays), 1)), rays)).astype(np.float32)
    )
    rays, depth = rays[depth < 6.0], depth[depth < 6.0]
    depth = depth + noise * depth**2 * rng.standard_normal(len(depth))
    points: F64 = SENSOR_M + rays * depth[:, None]
    return points.astype(np.float32)


def flattened(points: F32) -> F32:
    return flatten_slopes(points, SENSOR_M, GROUND, BAND_M)


@pytest.mark.parametrize("slope", [1 / 12, math.tan(math.radians(7.6))])
def test_a_ramp_ahead_becomes_floor(slope: float) -> None:
    points = seen(strip([(0.0, 0.0), (2.0, 0.0), (8.0, 6.0 * slope)]))
    raised = points[:, 2] > BAND_M[0]
    assert raised.sum() > 150
    flat = flattened(points)
    assert (flat[raised, 2] < BAND_M[0]).mean() > 0.98
    assert (flat[:, :2] == points[:, :2]).all() and (flat[~raised] == points[~raised]).all()


@pytest.mark.parametrize(
    "obstacle",
    [
        prism(np.array([(3.0, -2.0), (3.2, -2.0), (3.2, 2.0), (3.0, 2.0)]), 0.0, 2.5),  # a wall
        prism(np.array([(2.0, -0.6), (3.0, -0.6), (3.0, 0.6), (2.0, 0.6)]), 0.4, 0.45),  # a table
        prism(np.array([(2.0, -0.6), (3.0, -0.6), (3.0, 0.6), (2.0, 0.6)]), 0.0, 0.3),  # a box
        strip([(2.0 + 0.3 * (k // 2 + k % 2), 0.17 * (k // 2 + 1)) for k in range(10)]),  # treads of stairs
        strip([(2.0, 0.0), (5.0, 3.0 * math.tan(math.radians(25.0)))]),  # a steep slope
        prism(np.array([(3.0, -2.0), (3.2, -2.0), (3.2, 2.0), (3.0, 2.0)]), 0.35, 0.6),  # a rail, far away
    ],
    ids=["wall", "table", "box", "stairs", "steep", "rail"],
)
def test_obstacles_stay_obstacles(obstacle: Mesh) -> None:
    points = seen(strip([(0.0, 0.0), (8.0, 0.0)]), obstacle)
    raised = points[:, 2] > BAND_M[0] + 0.02
    assert raised.sum() > 100
    assert (flattened(points)[raised, 2] > BAND_M[0]).mean() > 0.97


def test_a_thing_behind_unseen_floor_is_no_ramp() -> None:
    points = seen(strip([(0.0, 0.0), (1.5, 0.0)]), strip([(3.2, 0.22), (4.0, 0.4)]))
    assert (points[:, 2] > BAND_M[0]).sum() > 100
    assert flattened(points) is points


def test_a_level_floor_is_left_as_it_is() -> None:
    points = seen(strip([(0.0, 0.0), (8.0, 0.0)]))
    assert flattened(points) is points
