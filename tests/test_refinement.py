"""Refinement below the cell size, thinning and steadiness against their plain counterparts."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pc2grid.alignment import FIXED_M, _gauss_newton, prepare, steadiness, thin_evenly
from tests.drives import office

FIELD = prepare(office())


def plain_step(points: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The next pose in cells by Gauss-Newton on the interpolated field, and the Hessian it rests on."""
    field = FIELD.levels[0] / 255.0
    height, width = field.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    H, g = np.zeros((3, 3)), np.zeros(3)
    for x, y in points:
        rx, ry = c * x - s * y, s * x + c * y
        u, v = rx + pose[0] - 0.5, ry + pose[1] - 0.5
        i, j = math.floor(v), math.floor(u)
        if not (0 <= i < height - 1 and 0 <= j < width - 1):
            continue
        a, b = u - j, v - i
        (f00, f01), (f10, f11) = field[i : i + 2, j : j + 2]
        f = (1 - b) * ((1 - a) * f00 + a * f01) + b * ((1 - a) * f10 + a * f11)
        if f < 0.05:
            continue
        slope = np.array(
            [(1 - b) * (f01 - f00) + b * (f11 - f10), (1 - a) * (f10 - f00) + a * (f11 - f01), 0]
        )
        slope[2] = slope[1] * rx - slope[0] * ry
        H += np.outer(slope, slope)
        g += slope * (1 - f)
    step = np.linalg.solve(H + np.diag(0.05 * np.diag(H) + 1e-3), g)
    size = math.hypot(step[0], step[1])
    return pose + (step * 2.0 / size if size > 2.0 else step), H


@pytest.mark.parametrize("near", [(200.0, 140.0), (45.0, 45.0)])  # the other: walls hang over the map's edge
def test_a_step_of_the_refinement_is_the_plain_one(near: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-120, 120, (400, 2))
    pose = np.array([*near, 0.3])
    expected, H = plain_step(points, pose)
    x, y = np.ascontiguousarray(points.T)
    *found, hessian, _ = _gauss_newton(FIELD.levels[0], x, y, *pose, 1)
    assert np.allclose(found, expected, atol=1e-9) and np.allclose(hessian, H, rtol=1e-9)
    assert math.dist(found[:2], near) > 0.01


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 300), far_m=st.sampled_from([0.0, 1e6]))
def test_thinning_keeps_the_first_point_of_each_square(seed: int, count: int, far_m: float) -> None:
    points = np.random.default_rng(seed).normal(far_m, 2.0, (count, 2))
    squares = np.floor(points / 0.4).astype(np.int64)
    first = np.unique(squares, axis=0, return_index=True)[1]
    assert np.array_equal(thin_evenly(points, 0.4), np.sort(first))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 1.0])
def test_what_things_belong_to_is_what_opencv_s_components_say(share: float) -> None:
    occupied = np.random.default_rng(0).random((60, 90)) < share
    cells = np.argwhere(occupied)[::2]
    joined = cv2.dilate(occupied.astype(np.uint8), np.ones((3, 3), np.uint8))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    longer = boxes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)[labels[cells[:, 0], cells[:, 1]]]
    assert np.allclose(steadiness(occupied, cells, 0.05), np.minimum(longer * 0.05 / FIXED_M, 1.0))
