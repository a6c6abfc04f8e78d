"""Scan matching in the plane: point-to-line Gauss-Newton against a local map, with a prior.

The map is a grid of moments: each cell keeps number, sum and second moments of the points that fell into
it, separately for each direction of the surface normal, so that the two faces of a wall stay two. The line
at a place is the principal axis of the cells around it. The accuracy is therefore not bound by the cell
size, and adding a scan costs one pass over its points.

Point-to-line as in Censi, "An ICP variant using a point-to-line metric" (2008); the moments are those of
Biber and Strasser's normal distributions transform (2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pc2grid.arrays import F32, F64, SUBPIXEL_BITS, BoolGrid, polygon_corners
from pc2grid.estimation._kernels import aligned, normal_equations, placement_scores
from pc2grid.estimation.manifold import weakest
from pc2grid.estimation.parameters import MATCHING_PARAMETERS, MatchingParameters
from pc2grid.geometry import SE2, wrap_angle

_BORDER_CELLS = 5
"""Width of the border of free ground that may be a wall: a neighbourhood of the matching on either side."""


@dataclass(frozen=True, slots=True)
class Match:
    """Placement of a point set on a map.

    pose : T_map_points. by_points : the same by the points alone, without the prior; where they measure
    nothing that is anywhere. information : (3, 3) of x, y, yaw in the map frame, from the points alone.
    overlap : share of the points that found a line. contradicted : share that found none where the map is
    free; the others lie where it knows nothing.
    measured : whether the points fix every direction of the position.
    """

    pose: SE2
    by_points: SE2
    information: F64
    overlap: float
    contradicted: float
    measured: bool


class PointGrid:
    """A map of point moments over the rectangle from `low_m` to `high_m` (each x, y).

    Points outside are ignored, both when adding and when matching.
    """

    def __init__(
        self,
        low_m: ArrayLike,
        high_m: ArrayLike,
        cell_m: float | None = None,
        parameters: MatchingParameters = MATCHING_PARAMETERS,
    ) -> None:
        self._parameters = parameters
        self.cell_m = cell_m or parameters.cell_m
        self.low_m = np.asarray(low_m, dtype=np.float64)
        width, height = np.ceil((np.asarray(high_m) - self.low_m) / self.cell_m).astype(int)
        # Most cells are empty: `_index` gives the row of `_moments` of those that are not, -1 of the others.
        self._index = np.full((height, width), -1, dtype=np.int32)
        self._moments = np.zeros((256, parameters.sectors, 6), dtype=np.float64)
        self._used = 0
        self._free = np.zeros((height, width), dtype=np.uint8)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (y) and columns (x)."""
        return self._index.shape[0], self._index.shape[1]

    def add(self, points_m: NDArray[np.floating], normal_rad: NDArray[np.floating]) -> None:
        """Add points (N, 2) with the directions (N,) of their surface normals, in the map frame."""
        points = np.asarray(points_m, dtype=np.float64)
        row, column, inside = self._cells(points)
        x, y = (points[inside] - self.low_m).T
        cell = row[inside] * self.shape[1] + column[inside]
        cells = self._index.reshape(-1)
        fresh = np.unique(cell[cells[cell] < 0])
        cells[fresh] = self._used + np.arange(len(fresh), dtype=np.int32)
        self._used += len(fresh)
        if self._used > len(self._moments):
            room = np.zeros((max(len(self._moments), len(fresh)), *self._moments.shape[1:]))
            self._moments = np.concatenate((self._moments, room))
        sector = sector_of(np.asarray(normal_rad, np.float64)[inside], self._parameters.sectors)
        slot = cells[cell] * self._parameters.sectors + sector
        changed, group = np.unique(slot, return_inverse=True)
        flat = self._moments.reshape(-1, 6)
        for moment, weights in enumerate((np.ones_like(x), x, y, x * x, x * y, y * y)):
            flat[changed, moment] += np.bincount(group, weights, len(changed))

    def clear(self, outline_m: F64) -> None:
        """Mark the ground within an outline (B, 2) as free, but for its border, which may be a wall."""
        corners = [polygon_corners((outline_m - self.low_m) / self.cell_m)]
        inside = np.zeros_like(self._free)
        cv2.fillPoly(inside, corners, 1, shift=SUBPIXEL_BITS)
        cv2.polylines(inside, corners, True, 0, thickness=_BORDER_CELLS, shift=SUBPIXEL_BITS)
        self._free |= inside

    def free(self, points_m: F64) -> float:
        """The share of points (N, 2), in the map frame, that lie on free ground."""
        row, column, inside = self._cells(points_m)
        return float(self._free[row[inside], column[inside]].sum()) / max(len(points_m), 1)

    def _cells(self, points_m: F64) -> tuple[NDArray[np.int64], NDArray[np.int64], BoolGrid]:
        """Rows (N,) and columns (N,) of points (N, 2), and whether they lie on the map."""
        column, row = np.floor((points_m - self.low_m) / self.cell_m).astype(np.int64).T
        inside = (row >= 0) & (row < self.shape[0]) & (column >= 0) & (column < self.shape[1])
        return row, column, inside

    def likelihood(self, sigma_m: float) -> F32:
        """Return the likelihood field (H, W), 0..1, of the cells that hold points."""
        empty = (self._index < 0).astype(np.uint8)
        distance_m = self.cell_m * cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_3)
        field: F32 = np.exp(np.float32(-0.5 / sigma_m**2) * distance_m**2)
        return field

    def weighed(
        self,
        points_m: NDArray[np.floating],
        normal_rad: NDArray[np.floating],
        registered: SE2,
        prior: SE2,
        prior_information: F64,
    ) -> SE2:
        """A pose of KISS-ICP, weighed against a prior by how the walls there hold it: along them it slides.

        Points, normals and prior are as of `match`.
        """
        p = self._parameters
        pose = np.array([registered.x, registered.y, registered.yaw])
        points, normals = np.asarray(points_m, np.float64), np.asarray(normal_rad, np.float64)
        H, _, _ = self._equations(points, normals, pose, p.radii_cells[0])
        away = pose - (prior.x, prior.y, prior.yaw)
        away[2] = wrap_angle(float(away[2]))
        information = H / p.near_sigma_m**2 + prior_information + 1e-6 * np.eye(3)
        x, y, yaw = (pose - np.linalg.solve(information, prior_information @ away)).tolist()
        return SE2(x, y, wrap_angle(yaw))

    def _equations(self, points_m: F64, normal_rad: F64, pose: F64, radius: int) -> tuple[F64, F64, int]:
        """The normal equations of points (N, 2) at a pose (3,), see `_kernels.normal_equations`."""
        corner = np.array([*self.low_m, 0.0])
        scale_m = self._parameters.residual_scale_m * radius
        return normal_equations(
            self._index, self._moments, points_m, normal_rad, pose - corner, self.cell_m, radius, scale_m
        )

    def match(
        self,
        points_m: NDArray[np.floating],
        normal_rad: NDArray[np.floating],
        guess: SE2,
        prior: SE2,
        prior_information: F64,
        *,
        radii: tuple[int, ...] | None = None,
    ) -> Match:
        """Align points (N, 2) with the directions (N,) of their normals, in the points' frame, to the map.

        The iterations start at `guess` and are held to `prior` by `prior_information` (3, 3) of x, y, yaw.
        radii : half widths of the neighbourhood, as `MatchingParameters.radii_cells`, its default.
        """
        p, (low_x, low_y) = self._parameters, self.low_m.tolist()
        points = np.asarray(points_m, np.float64)
        pose, alone, information, found = aligned(
            self._index,
            self._moments,
            points,
            np.asarray(normal_rad, np.float64),
            np.array([guess.x - low_x, guess.y - low_y, guess.yaw]),
            np.array([prior.x - low_x, prior.y - low_y, prior.yaw]),
            prior_information,
            self.cell_m,
            np.array(radii or p.radii_cells),
            p.residual_scale_m,
            p.prior_scale,
            p.converged,
        )
        placed, by_points = (
            SE2(x + low_x, y + low_y, wrap_angle(yaw)) for x, y, yaw in (pose.tolist(), alone.tolist())
        )
        overlap = found / max(len(points), 1)
        return Match(
            placed,
            by_points,
            information,
            overlap,
            min(self.free(placed.apply(points)), 1.0 - overlap),
            weakest(information, 2) > p.least_points / self.cell_m**2,
        )


def sector_of(normal_rad: F64, sectors: int) -> NDArray[np.int64]:
    """Return the number (N,), 0..sectors - 1, of the sector that directions (N,) fall into."""
    found: NDArray[np.int64] = np.rint(normal_rad * (sectors / (2.0 * np.pi))).astype(np.int64) % sectors
    return found


def best_placements(
    field: F32,
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
    """Correlative scan matching (Olson 2009), exhaustive: placements of points (N, 2) on a likelihood field.

    field : (H, W) in 0..1, cell (0, 0) at `low_m`. The window around `guess` is searched in equal steps.
    Returns the best `count` placements no two of which are neighbours, best first, each with the mean
    likelihood of the points.
    """
    steps = math.ceil(window_m / step_m)
    across = step_m * np.arange(-steps, steps + 1, dtype=np.float64)
    turn_steps = math.ceil(window_rad / step_rad)
    turns = step_rad * np.arange(-turn_steps, turn_steps + 1, dtype=np.float64)
    points = np.asarray(points_m, dtype=np.float64) / cell_m
    origin = (np.array([guess.x, guess.y]) - low_m) / cell_m
    first, step = round(float(across[0]) / cell_m), max(round(step_m / cell_m), 1)
    scores = placement_scores(field, points, origin, guess.yaw + turns, first, step, len(across))
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


def evenly(length: int, count: int) -> NDArray[np.intp]:
    """Return at most `count` of the indices below `length`, evenly spread."""
    return np.arange(length) if length <= count else np.linspace(0, length - 1, count).astype(np.intp)
