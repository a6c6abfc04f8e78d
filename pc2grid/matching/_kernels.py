"""Compiled steps of the coarse search and of the refinement. Lengths are in cells, poses are (x, y, yaw). The
tests compare them with plain forms in numpy."""

from __future__ import annotations

import math

import numba
import numpy as np

from pc2grid.arrays import F32, F64, I64, U8, U16, BoolGrid
from pc2grid.matching.lattice import BLOCK, SQUARE, TILE
from pc2grid.matching.likelihood_field import LIKELIHOOD

_ROWS, _COLUMNS = TILE
_NEUTRAL = LIKELIHOOD.neutral_value


@numba.njit(cache=True, nogil=True)
def _turn(points: F64, yaw: float, turned: F64) -> None:
    """Set `turned` (2, N), rows y and x, to the points turned by `yaw`."""
    c, s = math.cos(yaw), math.sin(yaw)
    for p in range(len(points)):
        turned[0, p] = s * points[p, 0] + c * points[p, 1]
        turned[1, p] = c * points[p, 0] - s * points[p, 1]


@numba.njit(cache=True, nogil=True)
def _place(
    turned: F64,
    level: I64,
    down: float,
    right: float,
    shape: tuple[int, int],
    corner: I64,
    at: I64,
    counted: I64,
) -> None:
    """Where the points are looked up if the pose lies `down` and `right` of the corner of its square.

    Sets the first of `at` to the places for the first square of the tile at `corner`, in all images flat, and
    `counted` (2,) to their number, and to the sum of the others: they lie beyond the map for all squares of
    the tile, or have no level.
    """
    height, width = shape
    count, rest = 0, 0
    for p in range(turned.shape[1]):
        if level[p] < 0:
            rest += 255
            continue
        i, j = math.floor(turned[0, p] + down), math.floor(turned[1, p] + right)
        row, column = corner[0] + i // SQUARE + _ROWS, corner[1] + j // SQUARE + _COLUMNS
        if row < 0 or column < 0 or row > height - _ROWS or column > width - _COLUMNS:
            rest += _NEUTRAL
            continue
        image = (level[p] * SQUARE + i % SQUARE) * SQUARE + j % SQUARE
        at[count] = (image * height + row) * width + column
        count += 1
    counted[0], counted[1] = count, rest


@numba.njit(cache=True, nogil=True)
def _sum_tile(flat: U8, at: I64, rest: int, width: int, inside: U16, sums: U16) -> int:
    """Set `sums` (TILE) to those of a tile, 0 where nothing is `inside`; returns the highest."""
    top = 0
    for r in range(_ROWS):
        for k in range(_COLUMNS):
            sums[r, k] = rest
    for p in range(len(at)):
        for r in range(_ROWS):
            first = at[p] + r * width
            window, row = flat[first : first + _COLUMNS], sums[r]
            for k in range(_COLUMNS):
                row[k] += window[k]
    for r in range(_ROWS):
        for k in range(_COLUMNS):
            sums[r, k] &= inside[r, k]
            top = max(top, sums[r, k])
    return top


@numba.njit(cache=True, nogil=True)
def _sum(flat: U8, at: I64, rest: int, move: int) -> int:
    """The sum for one square of a tile, `move` behind the first in all images flat."""
    total = rest
    for p in range(len(at)):
        total += flat[at[p] + move]
    return total


_HALF = SQUARE // 2
_PARTS = 1 + 4 + SQUARE * SQUARE
"""Parts of a square: all of it, its quarters, and the cells, those of one quarter after the other."""


@numba.njit(cache=True, nogil=True)
def _place_parts(
    turned: F64, levels: I64, shape: tuple[int, int], corner: I64, at: I64, counted: I64
) -> None:
    """Set `at` (_PARTS, N) and `counted` (_PARTS, 2) to what `_place` says of each part of a square."""
    _place(turned, levels[1], _HALF, _HALF, shape, corner, at[0], counted[0])
    for q in range(4):
        down, right = q // 2 * _HALF, q % 2 * _HALF
        middle = 0.5 * _HALF
        _place(turned, levels[2], down + middle, right + middle, shape, corner, at[1 + q], counted[1 + q])
        for c in range(_HALF**2):
            part = 5 + q * _HALF**2 + c
            i, j = down + c // _HALF, right + c % _HALF
            _place(turned, levels[3], i + 0.5, j + 0.5, shape, corner, at[part], counted[part])


@numba.njit(cache=True, nogil=True)
def _best_cell(flat: U8, at: I64, counted: I64, move: int, least: float) -> tuple[int, int]:
    """The highest sum of a cell of a square, and its part; -1 where it is below `least`."""
    best, part = -1, 0
    if _sum(flat, at[0, : counted[0, 0]], counted[0, 1], move) < least:
        return best, part
    for q in range(4):
        if _sum(flat, at[1 + q, : counted[1 + q, 0]], counted[1 + q, 1], move) < least:
            continue
        for c in range(5 + q * _HALF**2, 5 + (q + 1) * _HALF**2):
            total = _sum(flat, at[c, : counted[c, 0]], counted[c, 1], move)
            if total >= least and total > best:
                best, part = total, c
    return best, part


@numba.njit(cache=True, nogil=True)
def _best_in_block(
    flat: U8, width: int, at: I64, counted: I64, sums: U16, down: int, right: int, least: float
) -> tuple[int, int, int, int]:
    """The highest sum in the block of squares at `down`, `right` of a tile, -1 where it is below `least`; and
    where it is: square, half of the heading, part. at, counted : of both halves of the heading."""
    best, best_square, best_side, best_part = -1, 0, 0, 0
    # The most promising square first: what it reaches excludes most of the others.
    first = int(sums[down : down + BLOCK, right : right + BLOCK].argmax())
    for visit in range(BLOCK**2):
        square = (first + visit) % BLOCK**2
        r, c = down + square // BLOCK, right + square % BLOCK
        for side in range(2):
            needed = max(least, best + 1.0)
            if sums[r, c] >= needed:
                total, part = _best_cell(flat, at[side], counted[side], r * width + c, needed)
                if total > best:
                    best, best_square, best_side, best_part = total, r * _COLUMNS + c, side, part
    return best, best_square, best_side, best_part


@numba.njit(cache=True, nogil=True)
def tile_bounds(
    flat: U8,
    shape: tuple[int, int],
    level: I64,
    points: F64,
    corner: I64,
    yaw_rad: F64,
    inside: U16,
    turns: F64,
) -> I64:
    """(T, K) the highest sum over the points at the centres of the squares of each tile, at each heading.

    flat, shape : images, and the size of one. level : (N,) the image that each point is looked up in, -1: it
    counts as on a wall. points : (N, 2). corner, yaw_rad, inside : as of `Tiles`. turns : (K,).
    """
    bounds = np.empty((len(corner), len(turns)), np.int64)
    turned, at = np.empty((2, len(points))), np.empty(len(points), np.int64)
    counted, sums = np.empty(2, np.int64), np.empty((_ROWS, _COLUMNS), np.uint16)
    middle = 0.5 * SQUARE
    for t in range(len(corner)):
        for k in range(len(turns)):
            _turn(points, yaw_rad[t] + turns[k], turned)
            _place(turned, level, middle, middle, shape, corner[t], at, counted)
            bounds[t, k] = _sum_tile(flat, at[: counted[0]], counted[1], shape[1], inside[t], sums)
    return bounds


@numba.njit(cache=True, nogil=True)
def best_in_tiles(
    flat: U8,
    shape: tuple[int, int],
    levels: I64,
    points: F64,
    corners: I64,
    yaws: F64,
    inside: U16,
    tile: I64,
    bounds: I64,
    half_a_rad: float,
    floor: float,
    keep: float,
) -> F64:
    """(N, 4) the best pose of each block of squares at each heading, and its score, without blocks that do
    not reach `floor` or the share `keep` of the best so far.

    All cells of the squares count, at half a step of heading, `half_a_rad` / 2, to both sides.

    corners, yaws, tile, bounds : (B,) each tile at each heading, the highest bound first. tile : its number
    in `inside`.
    """
    n, full, width = len(points), 255.0 * len(points), shape[1]
    turned, sums = np.empty((2, n)), np.empty((_ROWS, _COLUMNS), np.uint16)
    at, counted = np.empty((2, _PARTS, n), np.int64), np.empty((2, _PARTS, 2), np.int64)
    found, number = np.empty((64, 4)), 0
    least = max(floor, 1.0 / full)
    for b in range(len(bounds)):
        if bounds[b] < full * least:
            break
        here, yaw = corners[b], yaws[b]
        _turn(points, yaw, turned)
        _place(turned, levels[0], _HALF, _HALF, shape, here, at[0, 0], counted[0, 0])
        _sum_tile(flat, at[0, 0, : counted[0, 0, 0]], counted[0, 0, 1], width, inside[tile[b]], sums)
        for side in range(2):
            _turn(points, yaw + (side - 0.5) * half_a_rad, turned)
            _place_parts(turned, levels, shape, here, at[side], counted[side])
        for block in range(_ROWS * _COLUMNS // BLOCK**2):
            down, right = block // (_COLUMNS // BLOCK) * BLOCK, block % (_COLUMNS // BLOCK) * BLOCK
            best, square, side, part = _best_in_block(
                flat, width, at, counted, sums, down, right, full * least
            )
            if best < 0:
                continue
            if number == len(found):
                found = np.concatenate((found, np.empty_like(found)))
            quarter, cell = (part - 5) // _HALF**2, (part - 5) % _HALF**2
            i, j = quarter // 2 * _HALF + cell // _HALF, quarter % 2 * _HALF + cell % _HALF
            found[number, 0] = (here[1] + square % _COLUMNS) * SQUARE + j + 0.5
            found[number, 1] = (here[0] + square // _COLUMNS) * SQUARE + i + 0.5
            found[number, 2] = yaw + (side - 0.5) * half_a_rad
            found[number, 3] = best / full
            number += 1
            least = max(least, keep * best / full)
    return found[:number]


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
    """Of the wall points on known ground: their weight, the weighted sum of their likelihoods, 0..1, and the
    weight of those seen from unknown ground. Points with a likelihood below `least` do not count."""
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
    """Hessian (3, 3), gradient (3,), sum of squared misfits and number of the points that count.

    A point counts if the interpolation has its four cells within the field and gives at least
    `LEAST_LIKELIHOOD`; the value of a cell is that of its centre.
    """
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
