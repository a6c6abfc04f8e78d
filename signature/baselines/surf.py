"""SURF (Bay et al. 2008): mahotas's detector with a descriptor of our own.

OpenCV's wheels refuse SURF. mahotas finds the same points again after a turn (96 % of them after half a
turn), but its descriptors do not turn with them: only 27 % of the points find themselves. So orientation
and descriptor are computed here, from Haar wavelets on the integral image as published.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.model import F32


def surf_descriptors(image: NDArray[np.uint8], max_points: int) -> F32:
    """Up to `max_points` SURF descriptors (K, 64) of length 1, of the strongest points."""
    return describe_points(image, interest_points(image, max_points))


def interest_points(image: NDArray[np.uint8], max_points: int) -> NDArray[np.float64]:
    """Points (K, 3) as y, x, scale, pixels; the strongest of mahotas's Fast-Hessian detector."""
    from mahotas.features import surf

    if min(image.shape) < 16:  # smaller than the smallest filter
        return np.empty((0, 3))
    points = np.asarray(surf.interest_points(image, max_points=max_points), np.float64)
    if points.size == 0:
        return np.empty((0, 3))
    return np.ascontiguousarray(points.reshape(len(points), -1)[:, :3])


def describe_points(image: NDArray[np.uint8], points: NDArray[np.float64]) -> F32:
    """SURF descriptors (K, 64) of points (K, 3) as y, x, scale."""
    integral = np.zeros((image.shape[0] + 1, image.shape[1] + 1))
    integral[1:, 1:] = image.astype(np.float64).cumsum(axis=0).cumsum(axis=1)
    descriptors: F32 = _describe(integral, points)
    return descriptors


@numba.njit(cache=True)
def _box(integral: NDArray[np.float64], r0: int, c0: int, r1: int, c1: int) -> float:
    """Sum of the image over rows r0 .. r1 - 1 and columns c0 .. c1 - 1, as far as they are inside."""
    height, width = integral.shape
    r0, r1 = min(max(r0, 0), height - 1), min(max(r1, 0), height - 1)
    c0, c1 = min(max(c0, 0), width - 1), min(max(c1, 0), width - 1)
    return float(integral[r1, c1] - integral[r0, c1] - integral[r1, c0] + integral[r0, c0])


@numba.njit(cache=True)
def _haar(integral: NDArray[np.float64], y: float, x: float, half: int) -> tuple[float, float]:
    """Haar wavelets in x and y of 2 * half pixels around a place; 0 where they would leave the image."""
    r, c = math.floor(y + 0.5), math.floor(x + 0.5)
    if r < half or c < half or r + half >= integral.shape[0] or c + half >= integral.shape[1]:
        return 0.0, 0.0
    left = _box(integral, r - half, c - half, r + half, c)
    right = _box(integral, r - half, c, r + half, c + half)
    upper = _box(integral, r - half, c - half, r, c + half)
    lower = _box(integral, r, c - half, r + half, c + half)
    return right - left, lower - upper


@numba.njit(cache=True)
def _orientation(integral: NDArray[np.float64], y: float, x: float, s: float) -> float:
    """Direction in which the wavelets within 6 s sum up the most over a sector of 60 degrees."""
    half = max(1, math.floor(2 * s + 0.5))
    angles = np.empty(169)
    dxs, dys = np.empty(169), np.empty(169)
    count = 0
    for i in range(-6, 7):
        for j in range(-6, 7):
            if i * i + j * j < 36:
                weight = math.exp(-(i * i + j * j) / (2 * 2.5 * 2.5))
                dx, dy = _haar(integral, y + i * s, x + j * s, half)
                dxs[count], dys[count] = weight * dx, weight * dy
                angles[count] = math.atan2(dy, dx)
                count += 1
    best, direction = -1.0, 0.0
    for k in range(36):
        start = k * math.pi / 18 - math.pi
        sx = sy = 0.0
        for n in range(count):
            ahead = angles[n] - start
            if 0 <= ahead < math.pi / 3 or ahead + 2 * math.pi < math.pi / 3:
                sx += dxs[n]
                sy += dys[n]
        if sx * sx + sy * sy > best:
            best, direction = sx * sx + sy * sy, math.atan2(sy, sx)
    return direction


@numba.njit(cache=True)
def _describe(integral: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Sums of dx, dy, |dx|, |dy| over 4 x 4 fields of a square of 20 s, turned with the point."""
    out = np.zeros((len(points), 64), np.float32)
    for n in range(len(points)):
        y, x, s = points[n]
        turn = _orientation(integral, y, x, s)
        c, d = math.cos(turn), math.sin(turn)
        half = max(1, math.floor(s + 0.5))
        for i in range(-10, 10):
            for j in range(-10, 10):
                v, u = (i + 0.5) * s, (j + 0.5) * s
                dx, dy = _haar(integral, y + d * u + c * v, x + c * u - d * v, half)
                weight = math.exp(-((i + 0.5) ** 2 + (j + 0.5) ** 2) / (2 * 3.3 * 3.3))
                along, across = weight * (c * dx + d * dy), weight * (c * dy - d * dx)
                field = (((i + 10) // 5) * 4 + (j + 10) // 5) * 4
                out[n, field] += along
                out[n, field + 1] += across
                out[n, field + 2] += abs(along)
                out[n, field + 3] += abs(across)
        length = math.sqrt(np.sum(out[n] ** 2))
        if length > 0:
            out[n] /= length
    return out
