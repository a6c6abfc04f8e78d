"""Points against a local map in the plane: point-to-line Gauss-Newton with a prior.

The map is a grid of moments: each cell keeps number, sum and second moments of the points that fell into
it, apart for each way that their surface faces, so that the two faces of a wall stay two. The line at a
place is the principal axis of the cells around it, so that the accuracy is not bound by the cell size, and
adding a scan costs one pass over its points.

Point-to-line as in Censi, "An ICP variant using a point-to-line metric" (2008); the moments are those of
Biber and Strasser's normal distributions transform (2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pc2grid.geometry import F64, SE2, wrap_angle

CELL_M = 0.1
RESIDUAL_SCALE_M = 0.05  # beyond this a point is more likely something else (Cauchy)
# One point is worth its noise, but neighbours on one wall err together: count every point as a fraction.
_POINT_SIGMA_M = 0.1
_SECTORS = 8  # of the directions that surfaces face; a point sees its own and the two beside it
_PRIOR_SCALE = 2.0  # standard deviations


@dataclass(frozen=True, slots=True)
class Match:
    """Where a point set lies on a map.

    pose : T_map_points. information : (3, 3) of x, y, yaw in the map frame, from the points alone.
    overlap : share of the points that found a line. residual_m : mean distance of those from their lines.
    """

    pose: SE2
    information: F64
    overlap: float
    residual_m: float


class PointGrid:
    """A map of point moments over the rectangle from `low_m` to `high_m` (each x, y).

    Points outside are ignored, both when adding and when matching.
    """

    def __init__(self, low_m: ArrayLike, high_m: ArrayLike, cell_m: float = CELL_M) -> None:
        self.cell_m = cell_m
        self.low_m = np.asarray(low_m, dtype=np.float64)
        width, height = np.ceil((np.asarray(high_m) - self.low_m) / cell_m).astype(int)
        # Most cells are empty: moments are kept for those that are not, found by the index.
        self._index = np.full((height, width), -1, dtype=np.int32)
        self._moments = np.zeros((256, _SECTORS, 6), dtype=np.float64)
        self._used = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (y) and columns (x)."""
        return self._index.shape[0], self._index.shape[1]

    def add(self, points_m: NDArray[np.floating], facing_rad: NDArray[np.floating]) -> None:
        """Add points (N, 2), on surfaces that face (N,), given in the map frame."""
        points = np.asarray(points_m, dtype=np.float64)
        if self._used + len(points) > len(self._moments):
            room = np.zeros((max(len(self._moments), len(points)), _SECTORS, 6), dtype=np.float64)
            self._moments = np.concatenate((self._moments, room))
        facing = np.asarray(facing_rad, dtype=np.float64)
        self._used = _add_moments(
            self._index, self._moments, self._used, points, facing, self.low_m, self.cell_m
        )

    def match(
        self,
        points_m: NDArray[np.floating],
        facing_rad: NDArray[np.floating],
        guess: SE2,
        prior: SE2,
        prior_information: F64,
        *,
        radii: tuple[int, ...] = (3, 3, 2, 2, 1, 1, 1, 1, 1, 1),
    ) -> Match:
        """Align points (N, 2), on surfaces that face (N,) in the points' frame, to the map.

        Starts at `guess`, held to `prior` by `prior_information` (3, 3).

        `radii` are the half widths, in cells, of the neighbourhood that gives each point its line, one
        entry an iteration: wide first, to catch, then narrow, to be exact.
        """
        points = np.asarray(points_m, dtype=np.float64)
        start = np.array([guess.x, guess.y, guess.yaw])
        held = np.array([prior.x, prior.y, prior.yaw])
        pose, information, overlap, residual = _gauss_newton(
            self._index,
            self._moments,
            self.low_m,
            self.cell_m,
            points,
            np.asarray(facing_rad, dtype=np.float64),
            start,
            held,
            np.asarray(prior_information, dtype=np.float64),
            np.array(radii, dtype=np.int64),
        )
        return Match(
            SE2(float(pose[0]), float(pose[1]), wrap_angle(float(pose[2]))),
            information,
            float(overlap),
            float(residual),
        )


@njit(cache=True)
def _sector(angle: float) -> int:
    return round(angle * (_SECTORS / (2.0 * math.pi))) % _SECTORS


@njit(cache=True)
def _add_moments(
    index: NDArray[np.int32], moments: F64, used: int, points: F64, facing: F64, low: F64, cell_m: float
) -> int:
    height, width = index.shape
    for k in range(points.shape[0]):
        x, y = points[k, 0] - low[0], points[k, 1] - low[1]
        column, row = math.floor(x / cell_m), math.floor(y / cell_m)
        if 0 <= row < height and 0 <= column < width:
            if index[row, column] < 0:
                index[row, column] = used
                used += 1
            m = moments[index[row, column], _sector(facing[k])]
            m[0] += 1.0
            m[1] += x
            m[2] += y
            m[3] += x * x
            m[4] += x * y
            m[5] += y * y
    return used


@njit(cache=True)
def _line_at(
    index: NDArray[np.int32], moments: F64, row: int, column: int, radius: int, sector: int, line: F64
) -> bool:
    """Mean, normal and straightness (5 values) of the points within `radius` cells; False if too few."""
    n = sx = sy = sxx = sxy = syy = 0.0
    for r in range(row - radius, row + radius + 1):
        for c in range(column - radius, column + radius + 1):
            cell = index[r, c]
            if cell < 0:
                continue
            for beside in (-1, 0, 1):
                m = moments[cell, (sector + beside) % _SECTORS]
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


@njit(cache=True)
def _gauss_newton(
    index: NDArray[np.int32],
    moments: F64,
    low: F64,
    cell_m: float,
    points: F64,
    facing: F64,
    start: F64,
    prior: F64,
    prior_information: F64,
    radii: NDArray[np.int64],
) -> tuple[F64, F64, float, float]:
    pose = start.copy()
    height, width = index.shape
    line = np.empty(5)
    information = np.zeros((3, 3))
    overlap = residual = 0.0
    unit = 1.0 / (_POINT_SIGMA_M * _POINT_SIGMA_M)
    for step in range(len(radii)):
        radius = radii[step]
        scale = RESIDUAL_SCALE_M * radius
        H = np.zeros((3, 3))
        g = np.zeros(3)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        found = 0
        distance = 0.0
        for k in range(points.shape[0]):
            rx = c * points[k, 0] - s * points[k, 1]
            ry = s * points[k, 0] + c * points[k, 1]
            x, y = rx + pose[0] - low[0], ry + pose[1] - low[1]
            column, row = math.floor(x / cell_m), math.floor(y / cell_m)
            if row < radius or column < radius or row >= height - radius or column >= width - radius:
                continue
            if not _line_at(index, moments, row, column, radius, _sector(facing[k] + pose[2]), line):
                continue
            nx, ny = line[2], line[3]
            r = nx * (x - line[0]) + ny * (y - line[1])
            found += 1
            distance += abs(r)
            w = unit * line[4] * line[4] / (1.0 + (r / scale) ** 2)
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
        information = H
        overlap = found / max(points.shape[0], 1)
        residual = distance / max(found, 1)
        away = pose - prior
        away[2] = math.atan2(math.sin(away[2]), math.cos(away[2]))
        # Wheels slip and drivers lie: a prior that the points contradict loses its say (Cauchy, again).
        held = prior_information / (1.0 + (away @ prior_information @ away) / _PRIOR_SCALE**2)
        delta = np.linalg.solve(H + held + 1e-6 * np.eye(3), -(g + held @ away))
        pose += delta
        if radius == radii[-1] and abs(delta[0]) + abs(delta[1]) + abs(delta[2]) < 1e-4:
            break
    return pose, information, overlap, residual


def best_placements(
    field: NDArray[np.float32],
    low_m: F64,
    cell_m: float,
    points_m: F64,
    guess: SE2,
    window_m: float,
    window_rad: float,
    *,
    step_m: float = 0.2,
    step_rad: float = math.radians(2.0),
    count: int = 3,
) -> list[tuple[float, SE2]]:
    """Correlative matching (Olson 2009) by exhaustion: placements of points (N, 2) on a likelihood field.

    field : (H, W) in 0..1, cell (0, 0) at `low_m`. The window is searched around `guess` in equal steps;
    returned are the best `count` placements no two of which are neighbours, best first, with the mean
    likelihood of the points.
    """
    steps = math.ceil(window_m / step_m)
    across = step_m * np.arange(-steps, steps + 1, dtype=np.float64)
    steps = math.ceil(window_rad / step_rad)
    turns = step_rad * np.arange(-steps, steps + 1, dtype=np.float64)
    points = np.asarray(points_m, dtype=np.float64)
    scores = _scores(field, low_m, cell_m, points, guess.x, guess.y, guess.yaw + turns, across)
    found: list[tuple[float, SE2]] = []
    while len(found) < count:
        a, r, c = np.unravel_index(int(np.argmax(scores)), scores.shape)
        score = float(scores[a, r, c])
        if score <= 0.0:
            break
        found.append(
            (score, SE2(guess.x + across[c], guess.y + across[r], wrap_angle(guess.yaw + float(turns[a]))))
        )
        scores[max(a - 2, 0) : a + 3, max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3] = 0.0
    return found


@njit(cache=True)
def _scores(
    field: NDArray[np.float32],
    low: F64,
    cell_m: float,
    points: F64,
    x: float,
    y: float,
    yaws: F64,
    across: F64,
) -> NDArray[np.float32]:
    height, width = field.shape
    n = len(across)
    scores = np.zeros((len(yaws), n, n), dtype=np.float32)
    step = max(round((across[1] - across[0]) / cell_m), 1) if n > 1 else 1
    first = round(across[0] / cell_m)
    for a in range(len(yaws)):
        cos, sin = math.cos(yaws[a]), math.sin(yaws[a])
        for k in range(points.shape[0]):
            column = math.floor((cos * points[k, 0] - sin * points[k, 1] + x - low[0]) / cell_m) + first
            row = math.floor((sin * points[k, 0] + cos * points[k, 1] + y - low[1]) / cell_m) + first
            for r in range(n):
                at_row = row + r * step
                if at_row < 0 or at_row >= height:
                    continue
                for c in range(n):
                    at_column = column + c * step
                    if 0 <= at_column < width:
                        scores[a, r, c] += field[at_row, at_column]
    return scores / np.float32(max(points.shape[0], 1))


def evenly(length: int, count: int) -> NDArray[np.intp]:
    """At most `count` of the indices below `length`, evenly spread."""
    return np.arange(length) if length <= count else np.linspace(0, length - 1, count).astype(np.intp)
