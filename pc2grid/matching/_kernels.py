"""Compiled twins of the coarse search and of the refinement. Lengths are in cells, poses are (x, y, yaw)."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, U8, BoolGrid

BLOCK_LEVELS = 7
"""So many of the sliding maxima have block maxima; a step of heading moves points by less than the last."""
LANES = 32
"""Width of a row of sums: a multiple of a vector register, so that rows are added without a remainder."""


@numba.njit(cache=True, nogil=True)
def box_bounds(levels: U8, level: I64, points: F64, boxes: F64) -> I64:
    """Twin of `window_search.plain_box_bounds`. The points are turned once for boxes of one heading that
    follow each other."""
    _, height, width = levels.shape
    out = np.empty(len(boxes), np.int64)
    turned_x, turned_y = np.empty(len(points)), np.empty(len(points))
    for b in range(len(boxes)):
        x, y, yaw = boxes[b, 0], boxes[b, 1], boxes[b, 2]
        if b == 0 or yaw != boxes[b - 1, 2]:
            c, s = math.cos(yaw), math.sin(yaw)
            for p in range(len(points)):
                turned_x[p] = c * points[p, 0] - s * points[p, 1]
                turned_y[p] = s * points[p, 0] + c * points[p, 1]
        total = 0
        for p in range(len(points)):
            j, i = np.int32(math.floor(turned_x[p] + x)), np.int32(math.floor(turned_y[p] + y))
            total += levels[level[p], min(max(i, 0), height - 1), min(max(j, 0), width - 1)]
        out[b] = total
    return out


@numba.njit(cache=True, nogil=True)
def _sum_windows(flat: U8, corners: I64, width: int, base: int, sums: NDArray[np.uint16]) -> int:
    """Set sums (side, LANES n) to `base` and the windows of images `width` cells wide whose first cells are
    `corners` in `flat`. Returns the flat index of the highest among the first `side` sums of each row."""
    side, wide = sums.shape
    top, at = -1, 0
    for r in range(side):
        row = sums[r]
        for k in range(wide):
            row[k] = base
        for p in range(len(corners)):
            first = corners[p] + r * width
            window = flat[first : first + wide]
            for k in range(wide):
                row[k] += window[k]
        for k in range(side):
            if row[k] > top:
                top, at = row[k], r * side + k
    return at


@numba.njit(cache=True, nogil=True)
def _best_in_block(flat: U8, at: I64, width: int, down: int, right: int, last: int) -> tuple[int, int, int]:
    """The highest sum over the cells `at` (N,) in `flat`, moved by `down` and `right` or one cell further,
    but by no more than `last`; and how far they are moved there."""
    s00, s01, s10, s11 = 0, 0, 0, 0
    move = down * width + right
    for p in range(len(at)):
        k = at[p] + move
        s00 += flat[k]
        s01 += flat[k + 1]
        s10 += flat[k + width]
        s11 += flat[k + width + 1]
    best, i, j = s00, down, right
    if right < last and s01 > best:
        best, j = s01, right + 1
    if down < last and s10 > best:
        best, i, j = s10, down + 1, right
    if right < last and down < last and s11 > best:
        best, i, j = s11, down + 1, right + 1
    return best, i, j


@numba.njit(cache=True, nogil=True)
def best_of_boxes(
    levels: U8,
    blocks: U8,
    shape: tuple[int, int],
    point_levels: I64,
    points: F64,
    boxes: F64,
    bounds: I64,
    half: int,
    turns: F64,
    floor: float,
    keep: float,
) -> F64:
    """Twin of `window_search.plain_best_of_boxes`.

    levels, blocks : those of a `SearchMap` of `shape` (H, W), flat. point_levels : (N, 2) for each point the
    sliding maximum that it is scored by, and the one in `blocks` that bounds it, or -1. half : even.
    """
    height, width = shape
    n, side, full = len(points), half + 1, 255.0 * len(points)
    across = width >> 1
    stride = (height >> 1) * across + LANES
    sums = np.empty((len(turns), side, -(-side // LANES) * LANES), np.uint16)
    cells, corners = np.empty((len(turns), n), np.int64), np.empty(n, np.int64)
    best = np.empty((len(boxes), 4))
    least = floor
    for b in range(len(boxes)):
        x, y, yaw = boxes[b, 0], boxes[b, 1], boxes[b, 2]
        best[b, 3] = -1.0
        if bounds[b] < full * least:
            continue
        top, top_t, top_at = -1, 0, 0
        for t in range(len(turns)):
            c, s = math.cos(yaw + turns[t]), math.sin(yaw + turns[t])
            count, base = 0, 0
            for p in range(n):
                j = math.floor(c * points[p, 0] - s * points[p, 1] + x)
                i = math.floor(s * points[p, 0] + c * points[p, 1] + y)
                i = min(max(i, half), height - half - 2)
                j = min(max(j, half), width - half - 2)
                cells[t, p] = (point_levels[p, 0] * height + i) * width + j
                image = point_levels[p, 1]
                if image >= 0:
                    corners[count] = image * stride + ((i - half) >> 1) * across + ((j - half) >> 1)
                    count += 1
                else:
                    base += 255
            at = _sum_windows(blocks, corners[:count], across, base, sums[t])
            if sums[t, at // side, at % side] > top:
                top, top_t, top_at = sums[t, at // side, at % side], t, at
        # The most promising block first: what it reaches excludes most of the others.
        down, right = 2 * (top_at // side) - half, 2 * (top_at % side) - half
        reached, down, right = _best_in_block(levels, cells[top_t], width, down, right, half)
        best_t, best_i, best_j = top_t, down, right
        for t in range(len(turns)):
            for i in range(side):
                for j in range(side):
                    if sums[t, i, j] <= reached or sums[t, i, j] < full * least:
                        continue
                    total, down, right = _best_in_block(
                        levels, cells[t], width, 2 * i - half, 2 * j - half, half
                    )
                    if total > reached:
                        reached, best_t, best_i, best_j = total, t, down, right
        best[b, 0], best[b, 1], best[b, 2] = x + best_j, y + best_i, yaw + turns[best_t]
        best[b, 3] = reached / full
        least = max(least, keep * best[b, 3])
    return best


@numba.njit(cache=True, nogil=True)
def known_sums(
    values: U8,
    known: BoolGrid,
    resolution_m: float,
    origin_m: tuple[float, float],
    points_m: F32,
    before_m: F32,
    weights: F32,
    pose: tuple[float, float, float],
    least: int,
) -> tuple[float, float, float]:
    """Twin of `two_way_score.plain_known_sums`."""
    height, width = values.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] - origin_m[0], pose[1] - origin_m[1]
    seen, likelihood, behind = 0.0, 0.0, 0.0
    for p in range(len(points_m)):
        j = math.floor((c * points_m[p, 0] - s * points_m[p, 1] + x) / resolution_m)
        i = math.floor((s * points_m[p, 0] + c * points_m[p, 1] + y) / resolution_m)
        if j < 0 or i < 0 or j >= width or i >= height or not known[i, j] or values[i, j] < least:
            continue
        seen += weights[p]
        likelihood += weights[p] * (values[i, j] / 255.0)
        j = math.floor((c * before_m[p, 0] - s * before_m[p, 1] + x) / resolution_m)
        i = math.floor((s * before_m[p, 0] + c * before_m[p, 1] + y) / resolution_m)
        if j < 0 or i < 0 or j >= width or i >= height or not known[i, j]:
            behind += weights[p]
    return seen, likelihood, behind


@numba.njit(cache=True, nogil=True, fastmath=True)
def normal_equations(
    field: U8, x: F64, y: F64, tx: float, ty: float, yaw: float
) -> tuple[F64, F64, float, float]:
    """Twin of `refinement.plain_normal_equations`."""
    height, width = field.shape
    c, s = math.cos(yaw), math.sin(yaw)
    right, top, unit = width - 1 - 1e-6, height - 1 - 1e-6, 1.0 / 255.0
    g0, g1, g2 = 0.0, 0.0, 0.0
    h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    misfit, count = 0.0, 0.0
    for p in range(len(x)):
        rx, ry = c * x[p] - s * y[p], s * x[p] + c * y[p]
        u, v = rx + tx - 0.5, ry + ty - 0.5
        inside_u, inside_v = min(max(u, 0.0), right), min(max(v, 0.0), top)
        j, i = int(inside_u), int(inside_v)
        a, b = inside_u - j, inside_v - i
        f00, f01 = field[i, j] * unit, field[i, j + 1] * unit
        f10, f11 = field[i + 1, j] * unit, field[i + 1, j + 1] * unit
        f = (1 - b) * ((1 - a) * f00 + a * f01) + b * ((1 - a) * f10 + a * f11)
        # Branchless: a point that does not count has weight 0.
        w = 1.0 if (inside_u == u) & (inside_v == v) & (f >= 0.05) else 0.0
        du = w * ((1 - b) * (f01 - f00) + b * (f11 - f10))
        dv = w * ((1 - a) * (f10 - f00) + a * (f11 - f01))
        r, dyaw = w * (1.0 - f), dv * rx - du * ry
        misfit += r * r
        count += w
        g0 += du * r
        g1 += dv * r
        g2 += dyaw * r
        h00 += du * du
        h01 += du * dv
        h02 += du * dyaw
        h11 += dv * dv
        h12 += dv * dyaw
        h22 += dyaw * dyaw
    H, g = np.empty((3, 3)), np.empty(3)
    H[0, 0], H[0, 1], H[0, 2] = h00, h01, h02
    H[1, 0], H[1, 1], H[1, 2] = h01, h11, h12
    H[2, 0], H[2, 1], H[2, 2] = h02, h12, h22
    g[0], g[1], g[2] = g0, g1, g2
    return H, g, misfit, count
