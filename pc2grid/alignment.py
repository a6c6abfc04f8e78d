"""Where does one grid fit on another? Best-first branch and bound over planar poses.

The query is a set of occupied points; the map is a likelihood field (how near is the closest occupied
cell), stored with its sliding maxima. A box of poses (dx, dy, dyaw) moves a point at distance d from the
query's centre by no more than `half_t + d * half_a`, so the maximum of the field within that reach bounds
what any pose in the box can score: boxes that cannot beat what has been found are never opened (Olson
2015, "M3RSM: many-to-many multi-resolution scan matching", and Hess et al. 2016 for translations; here the
bound is per point, so rotation is searched by the same tree).

The winners are refined below the cell size by Gauss-Newton on the interpolated field and scored both
ways: the query's walls against the map's free space, and the map's walls against the query's. What stands
alone and is small may have been moved since; a wall speaks by the size of what it belongs to.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, SE2, wrap_angle
from pc2grid.model import F32, I64, OccupancyGrid
from pc2grid.skeleton import cells_of

U8 = NDArray[np.uint8]

SIGMA_M = 0.10
"""Width of the likelihood around a wall: cell size, registration and sensor noise together."""
NEUTRAL = 0.35
"""What a point on unknown cells scores: about what a random point of a building scores, so that ground
one side has not seen speaks neither for nor against a pose."""
FIXED_M = 2.0
"""What is at least that long is taken to stay where it is."""
_ENOUGH_POINTS = 300
_CORRELATED = 5.0  # so many neighbouring points say what one says
_STILL_CELLS, _STILL_RAD = 0.02, 2e-4  # a millimetre at the end of a room
_BLOCK = 64  # cells at a time
REACHES_M = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0, 1.3, 1.6)
"""Radii of the sliding maxima; the first is the field itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LikelihoodField:
    """A map prepared for alignment.

    levels : (L, H, W) uint8, sliding maxima of the field over `reaches_m`; 255 = on a wall.
    halves : (L, H // 2, W // 2) uint8, every second cell of it, the second first.
    known : (H, W) cells that are occupied or free.
    walls_m : (K, 2) float32 occupied cell centres, map frame, one per 0.1 m square.
    weights : (K,) float32, 0..1, how surely each of them stays where it is, see `steadiness`.
    """

    levels: U8
    halves: U8
    reaches_m: tuple[float, ...]
    known: NDArray[np.bool_]
    walls_m: F32
    weights: F32
    resolution_m: float
    origin_m: tuple[float, float]


def likelihood(
    grid: OccupancyGrid, sigma_m: float = SIGMA_M, neutral: float = NEUTRAL
) -> tuple[U8, NDArray[np.bool_]]:
    """Field (H, W) uint8 of exp(-d^2 / 2 sigma^2) to the nearest wall, unknown cells at least neutral.

    Also returns which cells are known (H, W).
    """
    occupied = grid.occupied
    known = occupied | grid.free
    # Beyond this many cells the likelihood is below 1 / 255.
    reach = math.ceil(sigma_m / grid.resolution_m * math.sqrt(2.0 * math.log(255.0)))
    distance = np.sqrt(np.arange(reach**2 + 1, dtype=np.float32))
    values = (np.exp(-0.5 * (distance * (grid.resolution_m / sigma_m)) ** 2) * 255.0).astype(np.uint8)
    values[-1] = 0
    return _field(occupied, known, values, reach, int(neutral * 255.0)), known


@numba.njit(cache=True, nogil=True)
def _field(occupied: NDArray[np.bool_], known: NDArray[np.bool_], values: U8, reach: int, neutral: int) -> U8:
    """`values[d^2]` for the distance d in cells to the nearest occupied cell; at most `reach` count."""
    height, width = occupied.shape
    far, limit, one = np.uint16(reach * reach), np.uint16(reach), np.uint16(1)
    # Distance within the column, then its square. Whole rows at a time, which the processor does in parallel.
    squared = np.full((height, width + 2 * reach), far, np.uint16)
    steps = np.full(width, limit, np.uint16)
    for i in range(height):
        row, out = occupied[i], squared[i, reach : reach + width]
        for j in range(width):
            steps[j] = np.uint16(0) if row[j] else min(np.uint16(steps[j] + one), limit)
            out[j] = steps[j]
    steps[:] = limit
    for i in range(height - 1, -1, -1):
        row, out = occupied[i], squared[i, reach : reach + width]
        for j in range(width):
            steps[j] = np.uint16(0) if row[j] else min(np.uint16(steps[j] + one), limit)
            nearer = min(steps[j], out[j])
            out[j] = np.uint16(nearer * nearer)
    field = np.empty((height, width), np.uint8)
    nearest = np.empty(_BLOCK, np.uint16)
    for i in range(height):
        for first in range(0, width, _BLOCK):
            size = min(_BLOCK, width - first)
            row_known, out = known[i, first : first + size], field[i, first : first + size]
            around = squared[i, first : first + size + 2 * reach]
            lowest = far
            for j in range(len(around)):
                lowest = min(lowest, around[j])
            if lowest == far:  # as most of a map is: no wall near
                for j in range(size):
                    out[j] = np.uint8(0) if row_known[j] else np.uint8(neutral)
                continue
            nearest[:] = far
            for k in range(1, 2 * reach):
                beside, more = around[k : k + size], np.uint16((k - reach) ** 2)
                for j in range(size):
                    nearest[j] = min(nearest[j], np.uint16(beside[j] + more))
            for j in range(size):
                value = values[nearest[j]]
                out[j] = value if row_known[j] else max(value, np.uint8(neutral))
    return field


def prepare(grid: OccupancyGrid) -> LikelihoodField:
    """Build the likelihood field of a map and its sliding maxima, padded so that queries may hang over.

    Everything outside the map counts as unknown.
    """
    import cv2

    pad = round(2.0 / grid.resolution_m)
    cells = np.full((grid.cells.shape[0] + 2 * pad, grid.cells.shape[1] + 2 * pad), -1, dtype=np.int8)
    cells[pad:-pad, pad:-pad] = grid.cells
    padded = OccupancyGrid(
        cells=cells,
        resolution_m=grid.resolution_m,
        origin_m=(grid.origin_m[0] - pad * grid.resolution_m, grid.origin_m[1] - pad * grid.resolution_m),
    )
    field, known = likelihood(padded)
    levels = [field]
    for reach_m in REACHES_M[1:]:
        n = math.ceil(reach_m / grid.resolution_m)
        kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * n + 1, 2 * n + 1))
        levels.append(np.asarray(cv2.dilate(field, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8))
    cells = cells_of(padded.occupied)
    cells = cells[thin_evenly(padded.to_point(cells), 0.1)]
    stacked = np.stack(levels)
    return LikelihoodField(
        levels=stacked,
        halves=np.ascontiguousarray(stacked[:, 1::2, 1::2]),
        reaches_m=REACHES_M,
        known=known,
        walls_m=padded.to_point(cells).astype(np.float32),
        weights=steadiness(padded.occupied, cells, padded.resolution_m),
        resolution_m=padded.resolution_m,
        origin_m=padded.origin_m,
    )


@numba.njit(cache=True, nogil=True, fastmath=True)
def _bound(
    levels: U8,
    point_level: NDArray[np.int64],
    x: F32,
    y: F32,
    tx: float,
    ty: float,
    yaw: float,
    outside: int,
    least: float,
) -> float:
    """Sum of the field at the transformed points (all lengths in cells); stops once below `least`."""
    _, height, width = levels.shape
    c, s = math.cos(yaw), math.sin(yaw)
    n = len(x)
    total = 0.0
    for p in range(n):
        j = math.floor(c * x[p] - s * y[p] + tx)
        i = math.floor(s * x[p] + c * y[p] + ty)
        total += levels[point_level[p], i, j] if (0 <= i < height and 0 <= j < width) else outside
        if (p & 31) == 31 and total + 255.0 * (n - 1 - p) < least:
            return -1.0
    return total


@numba.njit(cache=True, nogil=True)
def levels_for(d: F32, half_t: float, half_a: float, reaches: F64) -> NDArray[np.int64]:
    """The smallest sliding maximum that covers what a box does to a point at distance d (cells).

    Half a cell is neglected: it is less than `SIGMA_M`, and covering it would blur the smallest boxes."""
    out = np.empty(len(d), dtype=np.int64)
    for p in range(len(d)):
        reach = half_t + d[p] * half_a
        level = 0
        while level < len(reaches) - 1 and reaches[level] < reach - 0.5:
            level += 1
        out[p] = level
    return out


@numba.njit(cache=True, nogil=True)
def _search(
    levels: U8,
    reaches: F64,
    x: F32,
    y: F32,
    starts: F64,
    half_t0: float,
    half_a0: float,
    depth: int,
    floor: float,
    keep: float,
    most: int,
    apart_t: float,
    apart_a: float,
    budget: int,
    outside: int,
) -> tuple[F64, int]:
    """Best-first search; see `search`. Poses are (tx, ty, yaw, score) in cells, score in 0..1."""
    n = len(x)
    d = np.sqrt(x * x + y * y)
    point_levels = np.empty((depth + 1, n), dtype=np.int64)
    for k in range(depth + 1):
        point_levels[k] = levels_for(d, half_t0 * 0.5**k, half_a0 * 0.5**k, reaches)
    scale = 1.0 / (255.0 * n)
    heap = [(0.0, 0, 0.0, 0.0, 0.0)]
    heap.pop()
    for b in range(len(starts)):
        score = _bound(
            levels, point_levels[0], x, y, starts[b, 0], starts[b, 1], starts[b, 2], outside, floor / scale
        )
        if score * scale >= floor:
            heap.append((-score * scale, 0, starts[b, 0], starts[b, 1], starts[b, 2]))
    heapq.heapify(heap)
    found = np.empty((most, 4), dtype=np.float64)
    count, opened = 0, 0
    while len(heap) > 0 and count < most and opened < budget:
        negative, k, tx, ty, yaw = heapq.heappop(heap)
        if count > 0 and -negative < max(floor, keep * found[0, 3]):
            break
        near = False
        for h in range(count):
            dyaw = abs(yaw - found[h, 2]) % (2 * math.pi)
            dyaw = min(dyaw, 2 * math.pi - dyaw)
            if max(abs(tx - found[h, 0]), abs(ty - found[h, 1])) < apart_t and dyaw < apart_a:
                near = True
                break
        if near:
            continue
        if k == depth:
            found[count] = tx, ty, yaw, -negative
            count += 1
            continue
        opened += 1
        half_t, half_a = half_t0 * 0.5 ** (k + 1), half_a0 * 0.5 ** (k + 1)
        least = floor if count == 0 else max(floor, keep * found[0, 3])
        for sx in (-1, 1):
            for sy in (-1, 1):
                for sa in (-1, 1):
                    bx, by, ba = tx + sx * half_t, ty + sy * half_t, yaw + sa * half_a
                    score = _bound(levels, point_levels[k + 1], x, y, bx, by, ba, outside, least / scale)
                    if score * scale >= least:
                        heapq.heappush(heap, (max(-score * scale, negative), k + 1, bx, by, ba))
    return found[:count], opened


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """How a query lies on a map at one pose. Means and shares are of walls weighted by `steadiness`.

    T_map_query : pose of the query's frame in the map.
    forward : 0..1, mean likelihood of the query's walls, neutral where the map is unknown.
    backward : 0..1, mean likelihood of the map's walls where the query has looked.
    overlap : 0..1, share of the query's walls that fall on known ground of the map.
    score : 0..1, what hypotheses are ranked by.
    covariance : (3, 3) of x, y, yaw from the score surface: wide along a corridor, narrow across it.
    """

    T_map_query: SE2
    forward: float
    backward: float
    overlap: float
    score: float
    covariance: F64


@dataclass(frozen=True, slots=True, kw_only=True)
class Query:
    """A query's grid prepared for alignment.

    walls_m : (M, 2) float32 occupied cell centres, query frame, thinned evenly to `spacing_m`.
    weights : (M,) float32, 0..1, how surely each of them stays where it is, see `steadiness`.
    field, known : likelihood (H, W) uint8 and known cells of the query's grid, for the way back.
    """

    walls_m: F32
    weights: F32
    field: U8
    known: NDArray[np.bool_]
    resolution_m: float
    origin_m: tuple[float, float]
    center_m: tuple[float, float]

    @property
    def walls(self) -> float:
        """How many wall points there are, by weight."""
        return float(self.weights.sum(dtype=np.float64))


def steadiness(occupied: NDArray[np.bool_], cells: I64, resolution_m: float) -> F32:
    """How surely what fills `cells` (K, 2) stays where it is: (K,) 0..1.

    The longer side of what a cell belongs to, as a share of `FIXED_M`, at most 1; gaps of one cell do not
    part things. Chairs, boxes and people are somewhere else the next time; walls are not.
    """
    extent = _extents(cells_of(occupied), occupied.shape)
    share = extent[cells[:, 0], cells[:, 1]] * resolution_m / FIXED_M
    return np.asarray(np.minimum(share, 1.0), np.float32)


@numba.njit(cache=True, nogil=True)
def _extents(cells: I64, shape: tuple[int, int]) -> NDArray[np.int32]:
    """(H, W) the longer side, in cells, of what each of `cells` (N, 2), row by row, belongs to, with a rim of
    one cell; elsewhere 0. Those whose rims touch, three rows and columns apart at most, belong together."""
    height, width = shape
    number = np.zeros((height + 3, width + 6), np.int32)  # from 1 on; with a margin, not to ask for the edge
    leader = np.arange(len(cells) + 1)
    for k in range(len(cells)):
        i, j = cells[k, 0] + 3, cells[k, 1] + 3
        number[i, j] = k + 1
        for row in range(i - 3, i + 1):
            for column in range(j - 3, j + 4 if row < i else j):
                other = number[row, column]
                if other:
                    _join(leader, k + 1, other)
    boxes = np.empty((len(leader), 4), np.int64)
    boxes[:, :2], boxes[:, 2:] = max(height, width), -1
    for k in range(len(cells)):
        box = boxes[_leader(leader, k + 1)]
        for axis in range(2):
            box[axis] = min(box[axis], max(cells[k, axis] - 1, 0))
            box[2 + axis] = max(box[2 + axis], min(cells[k, axis] + 1, shape[axis] - 1))
    extent = number[3:, 3:-3]
    for k in range(len(cells)):
        box = boxes[_leader(leader, k + 1)]
        extent[cells[k, 0], cells[k, 1]] = max(box[2] - box[0], box[3] - box[1]) + 1
    return extent


@numba.njit(cache=True, nogil=True)
def _leader(leader: I64, k: int) -> int:
    """Who speaks for k; those on the way there come nearer to him."""
    while leader[k] != k:
        leader[k] = leader[leader[k]]
        k = leader[k]
    return k


@numba.njit(cache=True, nogil=True)
def _join(leader: I64, a: int, b: int) -> None:
    a, b = _leader(leader, a), _leader(leader, b)
    leader[max(a, b)] = min(a, b)


def thin_evenly(points_m: NDArray[np.floating], spacing_m: float) -> NDArray[np.intp]:
    """Indices (K,) of one point per square of `spacing_m`; deterministic, keeps the order of the points."""
    return _first_of_each(np.floor(np.asarray(points_m) / spacing_m).astype(np.int64))


@numba.njit(cache=True, nogil=True)
def _first_of_each(squares: I64) -> NDArray[np.intp]:
    """Indices (K,) of the squares (N, 2) that were not there before; a hash table remembers which were."""
    mask = 1
    while mask < 2 * len(squares):
        mask *= 2
    slots = np.full(mask, -1, np.int32)
    mask -= 1
    first = np.empty(len(squares), np.intp)
    count = 0
    for k in range(len(squares)):
        i, j = squares[k]
        slot = ((i * 73856093) ^ (j * 19349663)) & mask
        while slots[slot] >= 0 and (squares[slots[slot], 0] != i or squares[slots[slot], 1] != j):
            slot = (slot + 1) & mask
        if slots[slot] < 0:
            slots[slot] = k
            first[count] = k
            count += 1
    return first[:count].copy()


def prepare_query(
    grid: OccupancyGrid, *, spacing_m: float = 0.1, center_m: tuple[float, float] | None = None
) -> Query:
    """Prepare a query grid; poses rotate about `center_m` (query frame), by default the mean of the walls."""
    field, known = likelihood(grid)
    cells = cells_of(grid.occupied)
    cells = cells[thin_evenly(grid.to_point(cells), spacing_m)]
    walls = grid.to_point(cells)
    if center_m is None:
        mean = walls.mean(axis=0) if len(walls) else np.zeros(2)
        center_m = (float(mean[0]), float(mean[1]))
    return Query(
        walls_m=walls.astype(np.float32),
        weights=steadiness(grid.occupied, cells, grid.resolution_m),
        field=field,
        known=known,
        resolution_m=grid.resolution_m,
        origin_m=grid.origin_m,
        center_m=center_m,
    )


def search(
    target: LikelihoodField,
    walls_m: F32,
    starts: F64,
    *,
    half_t_m: float = 0.4,
    half_a_rad: float = math.radians(8.0),
    finest_m: float = 0.06,
    floor: float = 0.45,
    keep: float = 0.8,
    most: int = 10,
    apart_m: float = 0.5,
    apart_rad: float = math.radians(10.0),
    budget: int = 50_000,
) -> F64:
    """The best distinct poses of a point set on a map, best first.

    Parameters
    ----------
    walls_m : (M, 2) points, already centred on what they should rotate about.
    starts : (B, 3) x, y, yaw: boxes of poses with half widths `half_t_m` and `half_a_rad` to search.
    finest_m : boxes are split until their half width is at most this.
    floor, keep : poses scoring below `floor`, or below `keep` times the best, are not reported.
    apart_m, apart_rad : two reported poses differ by more than one of these.
    budget : boxes opened at most.

    Returns (H, 4): x, y, yaw of the centres of the smallest boxes, and the most (mean likelihood over the
    points, 0..1) that any pose in the box can score, but for half a cell, see `levels_for`.
    """
    if not len(walls_m) or not len(starts):
        return np.empty((0, 4))
    res = target.resolution_m
    depth = max(0, math.ceil(math.log2(half_t_m / finest_m)))
    cells = (starts - np.array([target.origin_m[0], target.origin_m[1], 0.0])) / np.array([res, res, 1.0])
    found, _ = _search(
        target.levels,
        np.asarray(target.reaches_m) / res,
        np.ascontiguousarray(walls_m[:, 0] / res, dtype=np.float32),
        np.ascontiguousarray(walls_m[:, 1] / res, dtype=np.float32),
        cells,
        half_t_m / res,
        half_a_rad,
        depth,
        floor,
        keep,
        most,
        apart_m / res,
        apart_rad,
        budget,
        int(255 * NEUTRAL),
    )
    found[:, :2] = found[:, :2] * res + np.asarray(target.origin_m)
    return found


@numba.njit(cache=True, nogil=True)
def _solve(
    a: float, b: float, c: float, d: float, e: float, f: float, g0: float, g1: float, g2: float, x: F64
) -> None:
    """x (3,) of [[a, b, c], [b, d, e], [c, e, f]] x = g, positive definite, by Cholesky's way."""
    l10, l20 = b / a, c / a
    d1 = d - l10 * b
    l21 = (e - l20 * b) / d1
    d2 = f - l20 * c - l21 * l21 * d1
    y1 = g1 - l10 * g0
    x[2] = (g2 - l20 * g0 - l21 * y1) / d2
    x[1] = y1 / d1 - l21 * x[2]
    x[0] = g0 / a - l10 * x[1] - l20 * x[2]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _gauss_newton(
    field: U8,
    x: NDArray[np.floating],
    y: NDArray[np.floating],
    tx: float,
    ty: float,
    yaw: float,
    steps: int,
) -> tuple[float, float, float, F64, float]:
    """Climb the interpolated field; lengths in cells. Returns pose, Hessian (3, 3), mean squared misfit.

    Where hardly anything fits, it wanders about by parts of a cell: `steps` ends that.
    """
    height, width = field.shape
    flat, down, one = field.reshape(-1), np.uint64(width), np.uint64(1)
    right, top = width - 1 - 1e-6, height - 1 - 1e-6
    H, step = np.zeros((3, 3)), np.zeros(3)
    misfit, unit = 1.0, 1.0 / 255.0
    for _ in range(steps):
        c, s = math.cos(yaw), math.sin(yaw)
        g0, g1, g2 = 0.0, 0.0, 0.0
        h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        total, count = 0.0, 0.0
        for p in range(len(x)):
            rx, ry = c * x[p] - s * y[p], s * x[p] + c * y[p]
            u, v = rx + tx - 0.5, ry + ty - 0.5
            inside_u, inside_v = min(max(u, 0.0), right), min(max(v, 0.0), top)
            j, i = int(inside_u), int(inside_v)
            a, b = inside_u - j, inside_v - i
            at = np.uint64(i * width + j)
            f00, f01 = flat[at] * unit, flat[at + one] * unit
            f10, f11 = flat[at + down] * unit, flat[at + down + one] * unit
            f = (1 - b) * ((1 - a) * f00 + a * f01) + b * ((1 - a) * f10 + a * f11)
            # What is outside counts nothing, nor clutter, too far from any wall to pull. By weight, because
            # which points those are is as good as random, and a branch taken wrongly costs more.
            w = 1.0 if (inside_u == u) & (inside_v == v) & (f >= 0.05) else 0.0
            du = w * ((1 - b) * (f01 - f00) + b * (f11 - f10))
            dv = w * ((1 - a) * (f10 - f00) + a * (f11 - f01))
            r, dyaw = w * (1.0 - f), dv * rx - du * ry
            total += r * r
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
        H[0, 0], H[0, 1], H[0, 2] = h00, h01, h02
        H[1, 0], H[1, 1], H[1, 2] = h01, h11, h12
        H[2, 0], H[2, 1], H[2, 2] = h02, h12, h22
        if count < 10:
            break
        misfit = total / count
        d00, d11, d22 = 1.05 * h00 + 1e-3, 1.05 * h11 + 1e-3, 1.05 * h22 + 1e-3
        _solve(d00, h01, h02, d11, h12, d22, g0, g1, g2, step)
        size = math.sqrt(step[0] ** 2 + step[1] ** 2)
        if size > 2.0:
            step *= 2.0 / size
        tx += step[0]
        ty += step[1]
        yaw += step[2]
        if size < _STILL_CELLS and abs(step[2]) < _STILL_RAD:
            break
    return tx, ty, yaw, H, misfit


def refine(target: LikelihoodField, query: Query, T_map_query: SE2, *, steps: int = 8) -> tuple[SE2, F64]:
    """Improve a pose below the cell size; returns it with its covariance (3, 3) of x, y, yaw in the map.

    The covariance is the inverse of the Gauss-Newton Hessian, scaled for the correlation of neighbouring
    points, with the neighbourhood that the field can see (0.5 m, 0.1 rad) as its prior, so that a direction
    the walls do not constrain is answered with that width and not with infinity.
    """
    pose, covariance = _refined(
        target.levels[0],
        query.walls_m,
        *query.center_m,
        *(T_map_query.x, T_map_query.y, T_map_query.yaw),
        target.resolution_m,
        *target.origin_m,
        steps,
    )
    return SE2(pose[0], pose[1], wrap_angle(pose[2])), np.asarray(covariance, np.float64)


@numba.njit(cache=True, nogil=True)
def _refined(
    field: U8,
    walls: F32,
    cx: float,
    cy: float,
    x: float,
    y: float,
    yaw: float,
    resolution: float,
    origin_x: float,
    origin_y: float,
    steps: int,
) -> tuple[tuple[float, float, float], NDArray[np.floating]]:
    """`refine` for walls (M, 2) that turn about (cx, cy), from the pose (x, y, yaw) on; lengths in metres."""
    c, s = math.cos(yaw), math.sin(yaw)
    tx = (c * cx - s * cy + x - origin_x) / resolution
    ty = (s * cx + c * cy + y - origin_y) / resolution
    u, v = (walls[:, 0] - cx) / resolution, (walls[:, 1] - cy) / resolution
    if len(walls) >= 4 * _ENOUGH_POINTS:  # a few of many bring it near, in a fraction of the time
        every = len(walls) // _ENOUGH_POINTS
        tx, ty, yaw, _, _ = _gauss_newton(field, u[::every].copy(), v[::every].copy(), tx, ty, yaw, steps)
    tx, ty, yaw, H, misfit = _gauss_newton(field, u, v, tx, ty, yaw, steps)
    information = H / (_CORRELATED * max(misfit, 0.02))
    information[:2, :2] /= resolution * resolution
    information[:2, 2] /= resolution
    information[2, :2] /= resolution
    information += np.diag(np.array([1 / 0.5**2, 1 / 0.5**2, 1 / 0.1**2]))
    c, s = math.cos(yaw), math.sin(yaw)
    at_x, at_y = tx * resolution + origin_x, ty * resolution + origin_y
    return (at_x - c * cx + s * cy, at_y - s * cx - c * cy, yaw), np.linalg.inv(information)


@numba.njit(cache=True, nogil=True)
def _agreement(
    walls: F32,
    weights: F32,
    x: float,
    y: float,
    yaw: float,
    field: U8,
    known: NDArray[np.bool_],
    resolution: float,
    origin: tuple[float, float],
) -> tuple[float, float]:
    """Of walls (K, 2) moved by a pose: the weight of those that land on known ground, and the weighted sum
    of their likelihood 0..1 there."""
    height, width = field.shape
    known_cells, values = known.reshape(-1), field.reshape(-1)
    c, s = math.cos(yaw) / resolution, math.sin(yaw) / resolution
    tx, ty = (x - origin[0]) / resolution, (y - origin[1]) / resolution
    weight, total = 0.0, 0.0
    for p in range(len(walls)):
        u, v = c * walls[p, 0] - s * walls[p, 1] + tx, s * walls[p, 0] + c * walls[p, 1] + ty
        if (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height):
            at = np.uint64(int(v) * width + int(u))
            # By weight: which cells are known is as good as random, and a wrong guess costs more.
            w = weights[p] * known_cells[at]
            weight += w
            total += w * values[at]
    return weight, total / 255.0


def assess(target: LikelihoodField, query: Query, T_map_query: SE2, covariance: F64) -> Fit:
    """Score a pose both ways: query walls on the map, and map walls on what the query has looked at."""
    there, back = T_map_query, T_map_query.inverse()
    seen, total = _agreement(
        query.walls_m,
        query.weights,
        *(there.x, there.y, there.yaw),
        target.levels[0],
        target.known,
        target.resolution_m,
        target.origin_m,
    )
    looked, echoed = _agreement(
        target.walls_m,
        target.weights,
        *(back.x, back.y, back.yaw),
        query.field,
        query.known,
        query.resolution_m,
        query.origin_m,
    )
    walls = query.walls
    forward = (total + NEUTRAL * (walls - seen)) / walls if walls else 0.0
    backward = echoed / looked if looked else 0.0
    return Fit(
        T_map_query=T_map_query,
        forward=forward,
        backward=backward,
        overlap=seen / walls if walls else 0.0,
        score=math.sqrt(forward * backward),
        covariance=covariance,
    )
