"""SURF (Bay et al. 2008): the detector of mahotas with a descriptor of our own.

OpenCV's wheels do not contain SURF. The detector of mahotas finds 96 % of its points again after half a
turn of the image, but its descriptors do not turn with the points: only 27 % of the points match
themselves. So orientations and descriptors are computed here, from Haar wavelets on the integral image as
published.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64
from pc2grid_lab.paper.rivals import _kernels

_SECTORS = 36
"""Directions in which the sector of 60 degrees is tried for the orientation; chosen by hand."""


def surf_descriptors(image: NDArray[np.uint8], max_points: int) -> F32:
    """Up to `max_points` SURF descriptors (K, 64) of length 1, of the points with the strongest response."""
    return describe_points(image, interest_points(image, max_points))


def interest_points(image: NDArray[np.uint8], max_points: int) -> F64:
    """Points (K, 3) as y, x, scale in pixels; the strongest of mahotas's Fast-Hessian detector."""
    from mahotas.features import surf

    if min(image.shape) < 16:  # smaller than the smallest filter
        return np.empty((0, 3))
    points = np.asarray(surf.interest_points(image, max_points=max_points), np.float64)
    if points.size == 0:
        return np.empty((0, 3))
    return np.ascontiguousarray(points.reshape(len(points), -1)[:, :3])


def describe_points(image: NDArray[np.uint8], points: F64) -> F32:
    """SURF descriptors (K, 64) of points (K, 3) as y, x, scale.

    For each of 4 x 4 fields of a square of 20 scales, turned with the point: the sums of dx, dy, |dx|, |dy|
    of 5 x 5 wavelets. A descriptor has length 1, or 0 where the image does not change.
    """
    integral = np.zeros((image.shape[0] + 1, image.shape[1] + 1))
    integral[1:, 1:] = image.astype(np.float64).cumsum(axis=0).cumsum(axis=1)
    y, x, scale = points.T[:, :, None]
    turn = orientations(integral, points)[:, None]
    c, s = np.cos(turn), np.sin(turn)
    v, u = (axis.ravel() + 0.5 for axis in np.mgrid[-10:10, -10:10])
    half = np.maximum(1, np.floor(scale + 0.5)).astype(np.int64)
    dx, dy = _kernels.haar(integral, y + scale * (s * u + c * v), x + scale * (c * u - s * v), half)
    weights = np.exp(-(u**2 + v**2) / (2 * 3.3**2))
    along, across = weights * (c * dx + s * dy), weights * (c * dy - s * dx)
    responses = np.stack((along, across, np.abs(along), np.abs(across)), axis=-1)
    fields = responses.reshape(len(points), 4, 5, 4, 5, 4).sum(axis=(2, 4))
    descriptors = fields.reshape(len(points), 64)
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.asarray(descriptors / np.where(lengths > 0, lengths, 1.0), np.float32)


def orientations(integral: F64, points: F64) -> F64:
    """Directions (K,), radians, in which the wavelets within 6 scales have the largest 60 degree sum."""
    y, x, scale = points.T
    i, j = (axis.reshape(-1, 1) for axis in np.mgrid[-6:7, -6:7])
    near = (i**2 + j**2 < 36)[:, 0]
    i, j = i[near], j[near]
    half = np.maximum(1, np.floor(2 * scale + 0.5)).astype(np.int64)[None]
    dx, dy = _kernels.haar(integral, y + i * scale, x + j * scale, half)
    weights = np.exp(-(i**2 + j**2) / (2 * 2.5 * 2.5))
    dx, dy = weights * dx, weights * dy
    sums = _kernels.sector_sums(np.arctan2(dy, dx), dx, dy, _SECTORS)
    best = (sums**2).sum(axis=1).argmax(axis=0)
    sum_x, sum_y = sums[best, :, np.arange(len(points))].T
    return np.asarray(np.arctan2(sum_y, sum_x))
