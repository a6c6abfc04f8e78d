"""Compiled steps of this folder. The tests compare them with plain forms in numpy."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64

_DAMPING = 1e-6  # so that directions that no point measures can be solved for


@njit(cache=True, error_model="numpy")
def _line_at(
    index: NDArray[np.int32], moments: F64, row: int, column: int, radius: int, sector: int, line: F64
) -> bool:
    """Write mean, normal and straightness of the points around a cell; False if they make no line.

    The inner part of `normal_equations`.
    """
    sectors = moments.shape[1]
    n = sx = sy = sxx = sxy = syy = 0.0
    for r in range(row - radius, row + radius + 1):
        for c in range(column - radius, column + radius + 1):
            cell = index[r, c]
            if cell < 0:
                continue
            for beside in (-1, 0, 1):
                m = moments[cell, (sector + beside) % sectors]
                n += m[0]
                sx += m[1]
                sy += m[2]
                sxx += m[3]
                sxy += m[4]
                syy += m[5]
    if n < 3.0:
        return False
    mx, my = sx / n, sy / n
    a, b, d = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
    middle = 0.5 * (a + d)
    spread = math.sqrt(max(0.25 * (a - d) * (a - d) + b * b, 0.0))
    large, small = middle + spread, max(middle - spread, 0.0)
    if large < 1e-4:
        return False
    angle = 0.5 * math.atan2(2.0 * b, a - d)  # of the line; its normal is a quarter turn on
    line[0], line[1] = mx, my
    line[2], line[3] = -math.sin(angle), math.cos(angle)
    line[4] = 1.0 - small / large
    return True


@njit(cache=True, error_model="numpy")
def normal_equations(
    index: NDArray[np.int32],
    moments: F64,
    points: F64,
    normal_rad: F64,
    pose: F64,
    cell_m: float,
    radius: int,
    scale_m: float,
) -> tuple[F64, F64, int]:
    """Linearise the point-to-line distances at a pose.

    index : (H, W) row of `moments` (K, sectors, 6) for each cell, or -1. points : (N, 2) and normal_rad :
    (N,) in their frame. pose : (3,) x, y, yaw of that frame from the corner of cell (0, 0).
    radius : half width in cells of the neighbourhood. scale_m : scale of the Cauchy weight.

    Returns H (3, 3) and g (3,) of the Gauss-Newton step H d = -g for points of unit variance, and the
    number of points that found a line.

    Measured: 0.03 ms instead of 7 ms for 290 points of a planar laser.
    """
    height, width = index.shape
    sectors = moments.shape[1]
    H, g, line = np.zeros((3, 3)), np.zeros(3), np.empty(5)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    found, last, is_line = 0, (-1, -1, -1), False
    for k in range(points.shape[0]):
        rx = c * points[k, 0] - s * points[k, 1]
        ry = s * points[k, 0] + c * points[k, 1]
        x, y = rx + pose[0], ry + pose[1]
        column, row = math.floor(x / cell_m), math.floor(y / cell_m)
        if row < radius or column < radius or row >= height - radius or column >= width - radius:
            continue
        at = row, column, round((normal_rad[k] + pose[2]) * (sectors / (2.0 * math.pi))) % sectors
        if at != last:  # neighbours on a wall share it
            last, is_line = at, _line_at(index, moments, row, column, radius, at[2], line)
        if not is_line:
            continue
        nx, ny = line[2], line[3]
        r = nx * (x - line[0]) + ny * (y - line[1])
        found += 1
        w = line[4] * line[4] / (1.0 + (r / scale_m) ** 2)
        j2 = ny * rx - nx * ry
        H[0, 0] += w * nx * nx
        H[0, 1] += w * nx * ny
        H[0, 2] += w * nx * j2
        H[1, 1] += w * ny * ny
        H[1, 2] += w * ny * j2
        H[2, 2] += w * j2 * j2
        g[0] += w * nx * r
        g[1] += w * ny * r
        g[2] += w * j2 * r
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    return H, g, found


@njit(cache=True, error_model="numpy")
def _solve(A: F64, b: F64, x: F64) -> None:
    """Write the solution of A x = b, with a positive definite matrix A (3, 3), by its factors L D L^T."""
    l10, l20 = A[1, 0] / A[0, 0], A[2, 0] / A[0, 0]
    d1 = A[1, 1] - l10 * A[1, 0]
    l21 = (A[2, 1] - l20 * A[1, 0]) / d1
    d2 = A[2, 2] - l20 * A[2, 0] - l21 * l21 * d1
    y1 = b[1] - l10 * b[0]
    x[2] = (b[2] - l20 * b[0] - l21 * y1) / d2
    x[1] = y1 / d1 - l21 * x[2]
    x[0] = b[0] / A[0, 0] - l10 * x[1] - l20 * x[2]


@njit(cache=True, error_model="numpy")
def aligned(
    index: NDArray[np.int32],
    moments: F64,
    points: F64,
    normal_rad: F64,
    guess: F64,
    prior: F64,
    prior_information: F64,
    cell_m: float,
    radii: NDArray[np.int64],
    residual_scale_m: float,
    prior_scale: float,
    converged: float,
) -> tuple[F64, F64, F64, int]:
    """Gauss-Newton of the point-to-line distances, held to a prior, one radius of `radii` an iteration.

    index, moments, points, normal_rad, cell_m : as of `normal_equations`. guess, prior : (3,) poses from the
    corner of cell (0, 0). prior_information : (3, 3). residual_scale_m, prior_scale, converged : see
    `MatchingParameters`.

    Returns the pose (3,); that by the points alone (3,), linearised where the last iteration began, with its
    information (3, 3); and the number of points that found a line there.
    """
    unit, pose, alone = cell_m**-2.0, guess.copy(), guess.copy()
    information, A, b, step, away = np.zeros((3, 3)), np.empty((3, 3)), np.empty(3), np.zeros(3), np.empty(3)
    found = 0
    for radius in radii:
        H, g, found = normal_equations(
            index, moments, points, normal_rad, pose, cell_m, radius, residual_scale_m * radius
        )
        for i in range(3):
            alone[i], away[i] = pose[i], pose[i] - prior[i]
            for j in range(3):
                information[i, j] = unit * H[i, j]
        away[2] -= 2.0 * math.pi * math.floor(away[2] / (2.0 * math.pi) + 0.5)
        chi2 = 0.0
        for i in range(3):
            for j in range(3):
                chi2 += away[i] * prior_information[i, j] * away[j]
        # Cauchy weight: wheels slip, so a prior that disagrees with the points counts less.
        weight = 1.0 / (1.0 + chi2 / prior_scale**2)
        for i in range(3):
            b[i] = -unit * g[i]
            for j in range(3):
                A[i, j] = information[i, j] + weight * prior_information[i, j]
                b[i] -= weight * prior_information[i, j] * away[j]
            A[i, i] += _DAMPING
        _solve(A, b, step)
        for i in range(3):
            pose[i] += step[i]
        if radius == radii[-1] and abs(step[0]) + abs(step[1]) + abs(step[2]) < converged:
            break
    for i in range(3):
        b[i] = -unit * g[i]
        for j in range(3):
            A[i, j] = information[i, j]
        A[i, i] += unit * _DAMPING
    _solve(A, b, step)
    for i in range(3):
        alone[i] += step[i]
    return pose, alone, information, found


@njit(cache=True)
def placement_scores(
    field: F32, points: F64, origin: F64, yaws: F64, first: int, step: int, count: int
) -> F32:
    """Score all placements of a window. All in cells.

    points : (N, 2) x, y. origin : (2,) middle of the window. yaws : (A,) radians. Shifts are
    `first` + `step` * k for k below `count`, in x and in y. Returns the means (A, count (y), count (x)) of
    the field at the points, 0 outside.

    Measured: 6 ms instead of 290 ms for 400 points and 20 000 placements.
    """
    height, width = field.shape
    scores = np.zeros((len(yaws), count, count), dtype=np.float32)
    for a in range(len(yaws)):
        cos, sin = math.cos(yaws[a]), math.sin(yaws[a])
        for k in range(points.shape[0]):
            column = math.floor(cos * points[k, 0] - sin * points[k, 1] + origin[0]) + first
            row = math.floor(sin * points[k, 0] + cos * points[k, 1] + origin[1]) + first
            for r in range(count):
                at_row = row + r * step
                if at_row < 0 or at_row >= height:
                    continue
                for c in range(count):
                    at_column = column + c * step
                    if 0 <= at_column < width:
                        scores[a, r, c] += field[at_row, at_column]
    return scores / np.float32(max(points.shape[0], 1))


@njit(cache=True)
def steps(first: F64, second: F64) -> tuple[F64, F64, F64]:
    """The steps between poses (N, 4, 4) and their Jacobians, see `manifold.Steps`."""
    count = first.shape[0]
    step, by_first, by_second = np.zeros((count, 6)), np.zeros((count, 6, 6)), np.zeros((count, 6, 6))
    turn, right = np.empty((3, 3)), np.empty((3, 3))
    for n in range(count):
        A, B = first[n], second[n]
        for i in range(3):
            for k in range(3):
                step[n, i] += A[k, i] * (B[k, 3] - A[k, 3])
                turn[i, k] = A[0, i] * B[0, k] + A[1, i] * B[1, k] + A[2, i] * B[2, k]
        x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
        twice_sine = math.sqrt(x * x + y * y + z * z)
        angle = math.atan2(twice_sine, turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)
        ratio = 0.5 if twice_sine < 1e-9 else angle / twice_sine
        rx, ry, rz = ratio * x, ratio * y, ratio * z
        step[n, 3], step[n, 4], step[n, 5] = rx, ry, rz
        right[0, 0] = right[1, 1] = right[2, 2] = 1.0
        right[1, 0], right[2, 0], right[2, 1] = 0.5 * rz, -0.5 * ry, 0.5 * rx
        right[0, 1], right[0, 2], right[1, 2] = -0.5 * rz, 0.5 * ry, -0.5 * rx
        tx, ty, tz = step[n, 0], step[n, 1], step[n, 2]
        J = by_first[n]
        J[0, 0] = J[1, 1] = J[2, 2] = -1.0
        J[0, 4], J[0, 5], J[1, 5] = -tz, ty, -tx
        J[1, 3], J[2, 3], J[2, 4] = tz, -ty, tx
        for i in range(3):
            for k in range(3):
                by_second[n, i, k] = turn[i, k]
                by_second[n, 3 + i, 3 + k] = right[i, k]
                J[3 + i, 3 + k] = -(
                    right[i, 0] * turn[k, 0] + right[i, 1] * turn[k, 1] + right[i, 2] * turn[k, 2]
                )
    return step, by_first, by_second


@njit(cache=True)
def moved(poses: F64, changes: F64) -> F64:
    """Poses (N, 4, 4) after changes (N, 6) in their own axes, see `manifold.moved`."""
    result, turn = poses.copy(), np.empty((3, 3))
    for n in range(len(poses)):
        x, y, z = changes[n, 3], changes[n, 4], changes[n, 5]
        square = x * x + y * y + z * z
        angle = math.sqrt(square)
        # Rodrigues' formula, by its series near no turn.
        s = math.sin(angle) / angle if angle > 1e-9 else 1.0
        c = (1.0 - math.cos(angle)) / square if angle > 1e-4 else 0.5
        turn[0, 0], turn[1, 1] = 1.0 - c * (y * y + z * z), 1.0 - c * (x * x + z * z)
        turn[2, 2] = 1.0 - c * (x * x + y * y)
        turn[0, 1], turn[1, 0] = c * x * y - s * z, c * x * y + s * z
        turn[0, 2], turn[2, 0] = c * x * z + s * y, c * x * z - s * y
        turn[1, 2], turn[2, 1] = c * y * z - s * x, c * y * z + s * x
        for i in range(3):
            for k in range(3):
                result[n, i, 3] += poses[n, i, k] * changes[n, k]
                result[n, i, k] = 0.0
                for j in range(3):
                    result[n, i, k] += poses[n, i, j] * turn[j, k]
    return result
