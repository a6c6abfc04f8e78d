"""The compiled steps of SDF and SURF give what plain forms in numpy give, bit for bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64, I64
from pc2grid_lab.paper import rivals

SEEDS = pytest.mark.parametrize("seed", range(4))


def field(rng: np.random.Generator) -> tuple[F32, F64]:
    """Strength and direction, in turns, of a gradient; some of it without strength."""
    gx, gy = (rng.normal(size=(40, 50)).astype(np.float32) for _ in range(2))
    gx[:20:3], gy[::4] = 0.0, 0.0
    return np.hypot(gx, gy), rivals._turns(gx, gy)


@SEEDS
def test_votes_on_a_keypoints_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    strength, turns = field(rng)
    keypoints, offsets = rng.integers(0, (40, 50), (30, 2)), rng.integers(-9, 10, (200, 2))
    falloff = rng.random(200)
    rows, columns = (keypoints[:, None] + offsets).transpose(2, 0, 1)
    inside = (rows >= 0) & (columns >= 0) & (rows < 40) & (columns < 50)
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    weights, turn = strength[rows, columns] * falloff * inside, (turns * 36)[rows, columns]
    low = np.floor(turn).astype(np.int64)
    owner, votes = np.arange(30)[:, None] * 36, np.zeros(30 * 36)
    for at, share in ((low, 1 - (turn - low)), (low + 1, turn - low)):
        votes += np.bincount((owner + at % 36).ravel(), (weights * share).ravel(), len(votes))
    found = rivals.ring_votes(keypoints, offsets, falloff, strength, turns, 36)
    assert not inside.all() and np.array_equal(found, votes.reshape(30, 36))


@SEEDS
def test_shares_of_the_directions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    strength, turns = field(rng)
    rows, columns = rng.integers(0, 40, (30, 90)), rng.integers(0, 50, (30, 90))
    inside = rng.random((30, 90)) < 0.9
    own, falloff = rng.uniform(-0.1, 1.1, 30), rng.random(90)
    own[:8] = np.arange(8) / 8
    turn = (turns[rows, columns] - own[:, None]) % 1.0 * 8
    weights = strength[rows, columns] * falloff * inside
    plain = [weights * np.maximum(0.0, 1.0 - np.abs((turn - k + 8 / 2) % 8 - 8 / 2)) for k in range(8)]
    found = rivals.direction_shares(rows, columns, inside, own, falloff, strength, turns, 8)
    assert np.array_equal(found, plain)


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
    found = rivals._consensus(a, b, nearest, 0.25, 400)
    assert found.tolist() == [*(consensus(a, b[row], 0.25, 400) for row in nearest[:4]), 0]
    assert matches < 37 or found[1] > 2 * found[0]


def haar(integral: F64, y: F64, x: F64, half: I64) -> tuple[F64, F64]:
    """Wavelets from the integral image at nine corners, all gathered at once."""
    rows, columns = np.floor(y + 0.5).astype(np.int64), np.floor(x + 0.5).astype(np.int64)
    height, width = integral.shape
    inside = (rows >= half) & (columns >= half) & (rows + half < height) & (columns + half < width)
    r = [np.where(inside, rows + step * half, 0) for step in (-1, 0, 1)]
    c = [np.where(inside, columns + step * half, 0) for step in (-1, 0, 1)]
    at = [[integral[r[a], c[b]] for b in range(3)] for a in range(3)]
    left = at[2][1] - at[0][1] - at[2][0] + at[0][0]
    right = at[2][2] - at[0][2] - at[2][1] + at[0][1]
    upper = at[1][2] - at[0][2] - at[1][0] + at[0][0]
    lower = at[2][2] - at[1][2] - at[2][0] + at[1][0]
    return right - left, lower - upper


@SEEDS
@pytest.mark.parametrize("shape", [(1, 30), (70, 1)])
def test_wavelets(seed: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    integral = rng.integers(0, 256, (61, 81)).cumsum(axis=0).cumsum(axis=1).astype(np.float64)
    y, x = rng.uniform(-3, 64, (70, 30)), rng.uniform(-3, 84, (70, 30))
    half = rng.integers(1, 9, shape)
    found, plain = rivals.haar(integral, y, x, half), haar(integral, y, x, half)
    assert np.array_equal(found, plain) and 0.2 < (found[0] == 0).mean() < 0.9


def sector_sums(angles: F64, dx: F64, dy: F64) -> NDArray[np.float64]:
    sums = np.empty((36, 2, angles.shape[1]))
    for k in range(36):
        ahead = angles - (k * math.pi / (36 / 2) - math.pi)
        inside = ((ahead >= 0) & (ahead < math.pi / 3)) | (ahead + 2 * math.pi < math.pi / 3)
        sums[k] = (dx * inside).sum(axis=0), (dy * inside).sum(axis=0)
    return sums


@SEEDS
def test_sums_over_sectors(seed: int) -> None:
    """Among them the directions of the axes and diagonals, on the borders of sectors."""
    rng = np.random.default_rng(seed)
    dx, dy = rng.integers(-2, 3, (2, 109, 40)) * rng.random((109, 1))
    dx[:50], dy[:50] = rng.normal(size=(2, 50, 40))
    angles = np.arctan2(dy, dx)
    assert np.array_equal(rivals.sector_sums(angles, dx, dy, 36), sector_sums(angles, dx, dy))
