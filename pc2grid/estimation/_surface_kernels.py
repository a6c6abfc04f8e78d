"""Compiled parts of `surface_map`: a hash map of voxels with the moments of their points.

The voxels are rows of arrays; `slots` is a table with open addressing that gives the row of a voxel's
code, its three indices in one number (`code_of`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64

_BITS = 21
_HALF = 1 << (_BITS - 1)


@njit(cache=True, inline="always")
def code_of(i: int, j: int, k: int) -> int:
    """The three indices of a voxel, each within a million of zero, in one number."""
    return ((i + _HALF) << (2 * _BITS)) | ((j + _HALF) << _BITS) | (k + _HALF)


@njit(cache=True, inline="always")
def _slot(slots: NDArray[np.int32], codes: I64, code: int) -> int:
    """Where the row of a code is in `slots`, or where it belongs if it is not there."""
    mask = len(slots) - 1
    mixed = np.uint64(code) * np.uint64(0x9E3779B97F4A7C15)
    slot = int(np.int64(mixed >> np.uint64(20)) & mask)
    while slots[slot] >= 0 and codes[slots[slot]] != code:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True)
def rebuild(slots: NDArray[np.int32], codes: I64, used: int) -> None:
    """Enter the first `used` rows into `slots`, which is overwritten."""
    slots[:] = -1
    for row in range(used):
        slots[_slot(slots, codes, codes[row])] = row


@njit(cache=True)
def add(
    slots: NDArray[np.int32],
    codes: I64,
    moments: F64,
    used: int,
    points: F64,
    edge: float,
    most: float,
    touched: I64,
) -> int:
    """Add points (N, 3) to the moments (V, 10) of their voxels: number, sums and second moments.

    Coordinates are relative to the corner of the voxel. A voxel with more than `most` points forgets old ones
    in proportion. `touched` (N,) gets the row of each point. Returns the number of rows in use.
    """
    for n in range(len(points)):
        i = math.floor(points[n, 0] / edge)
        j = math.floor(points[n, 1] / edge)
        k = math.floor(points[n, 2] / edge)
        code = code_of(i, j, k)
        slot = _slot(slots, codes, code)
        row = slots[slot]
        if row < 0:
            row = used
            used += 1
            slots[slot] = row
            codes[row] = code
            moments[row] = 0.0
        if moments[row, 0] >= most:
            moments[row] *= (most - 1.0) / moments[row, 0]
        x, y, z = points[n, 0] - i * edge, points[n, 1] - j * edge, points[n, 2] - k * edge
        m = moments[row]
        m[0] += 1.0
        m[1] += x
        m[2] += y
        m[3] += z
        m[4] += x * x
        m[5] += x * y
        m[6] += x * z
        m[7] += y * y
        m[8] += y * z
        m[9] += z * z
        touched[n] = row
    return used


@njit(cache=True)
def fit_shapes(
    codes: I64, moments: F64, shapes: F64, rows: I64, edge: float, least: float, noise: float
) -> None:
    """Write mean and information (V, 9) of the voxels in `rows`; zero where there are too few points.

    The information says how well a point is held in each direction, 0..1: s^2 / (v + s^2) for a variance v of
    the points along it and a noise s, less what the widest direction has. So a plane holds along its
    normal, an edge across its line, and a ball not at all.
    """
    C = np.empty((3, 3))
    for row in rows:
        m, shape = moments[row], shapes[row]
        n, code = m[0], codes[row]
        x, y, z = m[1] / n, m[2] / n, m[3] / n
        shape[0] = x + (((code >> (2 * _BITS)) & (2 * _HALF - 1)) - _HALF) * edge
        shape[1] = y + (((code >> _BITS) & (2 * _HALF - 1)) - _HALF) * edge
        shape[2] = z + ((code & (2 * _HALF - 1)) - _HALF) * edge
        shape[3:] = 0.0
        if n < least:
            continue
        C[0, 0] = m[4] / n - x * x
        C[0, 1] = C[1, 0] = m[5] / n - x * y
        C[0, 2] = C[2, 0] = m[6] / n - x * z
        C[1, 1] = m[7] / n - y * y
        C[1, 2] = C[2, 1] = m[8] / n - y * z
        C[2, 2] = m[9] / n - z * z
        values, axes = np.linalg.eigh(C)
        widest = noise * noise / (max(values[2], 0.0) + noise * noise)
        for axis in range(2):
            held = noise * noise / (max(values[axis], 0.0) + noise * noise) - widest
            u, v, w = axes[0, axis], axes[1, axis], axes[2, axis]
            shape[3] += held * u * u
            shape[4] += held * u * v
            shape[5] += held * u * w
            shape[6] += held * v * v
            shape[7] += held * v * w
            shape[8] += held * w * w


@njit(cache=True)
def first_per_voxel(points: F32, edge: float) -> NDArray[np.int64]:
    """The indices of points (N, 3), the first in each voxel, in order."""
    size = 1 << 12
    while size < 3 * len(points):
        size *= 2
    slots = np.full(size, -1, np.int32)
    codes = np.empty(len(points), np.int64)
    kept = np.empty(len(points), np.int64)
    used = 0
    for n in range(len(points)):
        code = code_of(
            math.floor(points[n, 0] / edge), math.floor(points[n, 1] / edge), math.floor(points[n, 2] / edge)
        )
        slot = _slot(slots, codes, code)
        if slots[slot] < 0:
            slots[slot] = used
            codes[used] = code
            kept[used] = n
            used += 1
    return kept[:used]


@njit(cache=True)
def normal_equations(
    slots: NDArray[np.int32],
    codes: I64,
    shapes: F64,
    points: F64,
    weights: F64,
    pose: F64,
    edge: float,
    scale: float,
) -> tuple[F64, F64, float, float]:
    """Linearise the distances of points (N, 3) from the shapes (V, 9) of the voxels around them.

    pose : (4, 4). A point meets the shape whose mean is nearest, of its own voxel and the 26 around it.
    scale : of the Cauchy weight of a distance. weights : (N,) inverse variances of the points, relative.
    The unknowns are the shift and the rotation vector of the placed points about the origin of the base.

    Returns H (6, 6) and g (6,) of the step H d = -g, the number of points that found a shape, and the sum of
    their distances.
    """
    H, g = np.zeros((6, 6)), np.zeros(6)
    J = np.zeros((3, 6))
    J[0, 0] = J[1, 1] = J[2, 2] = 1.0
    W = np.empty((3, 3))
    d = np.empty(3)
    WJ = np.empty((3, 6))
    found, total = 0.0, 0.0
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        rx = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz
        ry = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz
        rz = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz
        x, y, z = rx + pose[0, 3], ry + pose[1, 3], rz + pose[2, 3]
        i, j, k = math.floor(x / edge), math.floor(y / edge), math.floor(z / edge)
        best, best_row = 2.25 * edge * edge, -1
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    row = slots[_slot(slots, codes, code_of(i + a, j + b, k + c))]
                    if row < 0 or shapes[row, 3] + shapes[row, 6] + shapes[row, 8] <= 0.0:
                        continue
                    dx, dy, dz = x - shapes[row, 0], y - shapes[row, 1], z - shapes[row, 2]
                    apart = dx * dx + dy * dy + dz * dz
                    if apart < best:
                        best, best_row = apart, row
        if best_row < 0:
            continue
        s = shapes[best_row]
        d[0], d[1], d[2] = x - s[0], y - s[1], z - s[2]
        W[0, 0], W[0, 1], W[0, 2] = s[3], s[4], s[5]
        W[1, 0], W[1, 1], W[1, 2] = s[4], s[6], s[7]
        W[2, 0], W[2, 1], W[2, 2] = s[5], s[7], s[8]
        wx = W[0, 0] * d[0] + W[0, 1] * d[1] + W[0, 2] * d[2]
        wy = W[1, 0] * d[0] + W[1, 1] * d[1] + W[1, 2] * d[2]
        wz = W[2, 0] * d[0] + W[2, 1] * d[1] + W[2, 2] * d[2]
        squared = d[0] * wx + d[1] * wy + d[2] * wz
        weight = weights[n] / (1.0 + squared / (scale * scale))
        J[0, 4], J[0, 5] = rz, -ry
        J[1, 3], J[1, 5] = -rz, rx
        J[2, 3], J[2, 4] = ry, -rx
        for a in range(3):
            for b in range(6):
                WJ[a, b] = weight * (W[a, 0] * J[0, b] + W[a, 1] * J[1, b] + W[a, 2] * J[2, b])
        wx, wy, wz = weight * wx, weight * wy, weight * wz
        for a in range(6):
            g[a] += J[0, a] * wx + J[1, a] * wy + J[2, a] * wz
            for b in range(a, 6):
                H[a, b] += J[0, a] * WJ[0, b] + J[1, a] * WJ[1, b] + J[2, a] * WJ[2, b]
        found += 1.0
        total += math.sqrt(squared)
    for a in range(6):
        for b in range(a):
            H[a, b] = H[b, a]
    return H, g, found, total
