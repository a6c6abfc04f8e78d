"""The compiled step of SDF gives what a plain form in numpy gives, bit for bit."""

import math

import numpy as np
import pytest

from pc2grid.geometry import F32
from pc2grid_lab.paper import methods

SEEDS = pytest.mark.parametrize("seed", range(4))


def consensus(a: F32, b: F32, inlier_m: float, iterations: int) -> int:
    """RANSAC of one submap, every motion on all matches."""
    if len(a) < 2:
        return 0
    i, j = np.random.default_rng(0).integers(0, len(a), (2, iterations))
    along_a, along_b = a[j] - a[i], b[j] - b[i]
    length_a, length_b = np.hypot(*along_a.T), np.hypot(*along_b.T)
    usable = np.minimum(length_a, length_b) >= 1.0
    usable &= np.abs(length_a - length_b) <= 2 * inlier_m
    if not usable.any():
        return 0
    i, j = i[usable], j[usable]
    za, zb = a[:, 0] + 1j * a[:, 1], b[:, 0] + 1j * b[:, 1]
    rotation = (zb[j] - zb[i]) * np.conj(za[j] - za[i])
    rotation /= np.abs(rotation)
    shift = (zb[i] + zb[j]) / 2 - rotation * (za[i] + za[j]) / 2
    errors = rotation[:, None] * za + shift[:, None] - zb
    agreeing = errors.real**2 + errors.imag**2 <= inlier_m**2
    return int(agreeing.sum(axis=1).max())


@SEEDS
@pytest.mark.parametrize("matches", [1, 2, 37, 180])
def test_the_most_that_one_motion_explains(seed: int, matches: int) -> None:
    """Of five submaps: other places, the same ones turned and moved, half of these, some, and none."""
    rng = np.random.default_rng(seed)
    a = rng.uniform(0, 16, (matches, 2)).astype(np.float32)
    turn = rng.uniform(-math.pi, math.pi)
    to_b = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    moved = (a @ to_b + rng.normal(0, 0.12, a.shape) + 3.0).astype(np.float32)
    b = np.concatenate((rng.uniform(0, 16, (60, 2)).astype(np.float32), moved))
    nearest = rng.integers(0, 60, (5, matches))
    nearest[1] = 60 + np.arange(matches)
    nearest[2, ::2], nearest[3, ::5] = nearest[1, ::2], nearest[1, ::5]
    nearest[4] = -1
    found = methods._consensus(a, b, nearest, 0.25, 400)
    assert found.tolist() == [*(consensus(a, b[row], 0.25, 400) for row in nearest[:4]), 0]
    assert matches < 37 or found[1] > 2 * found[0]
