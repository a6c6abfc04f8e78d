"""Refinement below the cell size, the compiled step against the plain one, and the covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import F64, SE2, U8
from pc2grid.matching.score import (
    LEAST_LIKELIHOOD,
    REFINEMENT,
    RefinementParameters,
    gauss_newton,
    normal_equations,
    refine,
)
from pc2grid.matching.search import SearchMap
from pc2grid.matching.walls import Walls
from pc2grid.model import OccupancyGrid
from tests.helpers.simulated_drives import office, office_part, plan

MAP = SearchMap.of(office())
FIELD = MAP.field
ONE_STEP = RefinementParameters(steps=1)


def plain_normal_equations(
    values: U8, x: F64, y: F64, tx: float, ty: float, yaw: float
) -> tuple[F64, F64, float, float]:
    """Hessian (3, 3), gradient (3,), sum of squared misfits and number of the points that count.

    A point counts if the interpolation has its four cells within the field and gives at least
    `LEAST_LIKELIHOOD`.
    """
    height, width = values.shape
    c, s = math.cos(yaw), math.sin(yaw)
    rx, ry = c * x - s * y, s * x + c * y
    u, v = rx + tx - 0.5, ry + ty - 0.5  # the value of a cell is that of its centre
    inside = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    rx, ry, u, v = (along[inside] for along in (rx, ry, u, v))
    j, i = u.astype(np.int64), v.astype(np.int64)
    a, b = u - j, v - i
    f00, f01 = values[i, j] / 255.0, values[i, j + 1] / 255.0
    f10, f11 = values[i + 1, j] / 255.0, values[i + 1, j + 1] / 255.0
    f = (1 - b) * ((1 - a) * f00 + a * f01) + b * ((1 - a) * f10 + a * f11)
    du = (1 - b) * (f01 - f00) + b * (f11 - f10)
    dv = (1 - a) * (f10 - f00) + a * (f11 - f01)
    jacobian = np.column_stack((du, dv, dv * rx - du * ry))[f >= LEAST_LIKELIHOOD]
    residual = 1.0 - f[f >= LEAST_LIKELIHOOD]
    return jacobian.T @ jacobian, jacobian.T @ residual, float(residual @ residual), float(len(residual))


@pytest.mark.parametrize("near", [(220.0, 160.0), (65.0, 65.0)])  # the other: walls hang over the map's edge
def test_the_compiled_normal_equations_are_the_plain_ones(near: tuple[float, float]) -> None:
    x, y = np.random.default_rng(0).uniform(-120, 120, (2, 400))
    fast = normal_equations(FIELD.values, x, y, *near, 0.3)
    plain = plain_normal_equations(FIELD.values, x, y, *near, 0.3)
    assert fast[3] == plain[3] >= REFINEMENT.least_points
    for a, b in zip(fast, plain, strict=True):
        assert np.allclose(a, b, rtol=1e-9, atol=1e-9)
    pose, _, _ = gauss_newton(FIELD.values, x, y, np.array([*near, 0.3]), ONE_STEP)
    H, g = plain[:2]
    step = np.linalg.solve(H + np.diag(0.05 * np.diag(H) + 1e-3), g)
    size = math.hypot(step[0], step[1])
    assert size > 0.01
    assert pose == pytest.approx(np.array([*near, 0.3]) + (step * 2.0 / size if size > 2.0 else step))


def test_the_pose_found_turns_with_the_query() -> None:
    walls = Walls.of(office_part((10.5, 7.0)))
    turned = SE2(1.0, -2.0, 2.1)
    guess = SE2(10.6, 7.1, 0.03) @ turned.inverse()
    pose, _ = refine(FIELD, turned.apply(walls.points_m).astype(np.float32), guess, (1.0, -2.0))
    there = pose @ turned
    assert math.dist((there.x, there.y), (10.5, 7.0)) < 0.03 and abs(there.yaw) < 0.01


def test_a_corridor_is_certain_across_and_uncertain_along() -> None:
    corridor = plan(30, 2, [])
    part = OccupancyGrid(cells=corridor.cells[:, 200:300], resolution_m=0.05, origin_m=(-2.5, -1.0))
    field, points_m = SearchMap.of(corridor).field, Walls.of(part).points_m
    _, covariance = refine(field, points_m, SE2(12.5, 1.0, 0.0), (0.0, 0.0))
    along, across = math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])
    assert across < 0.05 < 0.3 < along
