"""Shape Context as its authors use it (Belongie et al. 2002): a context for each of many boundary points.

Not in the paper's tables, which speak of one shape for the whole submap (`shape_context`). It is here because
a fair comparison has to name the strongest form of a rival.

A point's context is the log-polar histogram of where the other boundary points lie. Turned submaps are
made comparable by measuring angles from the direction towards the centroid of the boundary. Two submaps
are compared by representative contexts (Mori, Belongie and Malik 2005): some of the query's contexts, each
against the one of the other submap that fits best, by the chi-square statistic. This is what the full
assignment of all points costs too much for: every query meets every submap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, Submap
from pc2grid.skeleton import cells_of, sample_evenly, thin


@dataclass(frozen=True, slots=True, kw_only=True)
class PointContexts:
    """Parameters; bins as in the paper.

    centers : points of a submap that get a context (Belongie et al. use 100).
    representatives : contexts of the query that are looked for.
    spacing_m : least distance of the boundary points that a context counts.
    inner_m : radius of the innermost ring; rings grow by a constant factor up to the submap's diameter.
    """

    angular_bins: int = 24
    radial_bins: int = 12
    centers: int = 100
    representatives: int = 25
    spacing_m: float = 0.2
    inner_m: float = 0.5

    def fit(self, submaps: Sequence[Submap]) -> _Contexts:
        """Describe every submap."""
        tables = [self.contexts(submap, self.centers) for submap in submaps]
        starts = np.cumsum([0, *(len(table) for table in tables)])
        bins = self.angular_bins * self.radial_bins
        return _Contexts(self, np.concatenate([np.empty((0, bins), np.float32), *tables]), starts)

    def contexts(self, submap: Submap, count: int) -> F32:
        """Contexts (K, angular * radial), K <= count, each of sum 1, around evenly chosen boundary points."""
        resolution = submap.grid.resolution_m
        cells = sample_evenly(cells_of(thin(submap.grid.occupied)), self.spacing_m / resolution)
        points = (cells[:, ::-1] * resolution).astype(np.float64)
        if len(points) < 2:
            return np.empty((0, self.angular_bins * self.radial_bins), np.float32)
        chosen = np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.int64)
        rings = np.geomspace(self.inner_m, 2 * submap.radius_m, self.radial_bins)
        histograms: F32 = _histograms(points, points[chosen], rings, self.angular_bins)
        return histograms


@dataclass(frozen=True, slots=True)
class _Contexts:
    method: PointContexts
    table: F32
    starts: NDArray[np.int64]

    def similarities(self, query: Submap) -> F64:
        wanted = self.method.contexts(query, self.method.representatives)
        return np.asarray(-_mean_best_costs(wanted, self.table, self.starts))


@numba.njit(cache=True)
def _histograms(points: F64, centers: F64, rings: F64, angular_bins: int) -> NDArray[np.float32]:
    out = np.zeros((len(centers), len(rings) * angular_bins), np.float32)
    middle_x, middle_y = points[:, 0].mean(), points[:, 1].mean()
    share = np.float32(1.0 / (len(points) - 1))
    for i in range(len(centers)):
        x, y = centers[i]
        front = math.atan2(middle_y - y, middle_x - x)
        for j in range(len(points)):
            dx, dy = points[j, 0] - x, points[j, 1] - y
            if dx == 0.0 and dy == 0.0:
                continue
            ring = min(int(np.searchsorted(rings, math.sqrt(dx * dx + dy * dy))), len(rings) - 1)
            turn = ((math.atan2(dy, dx) - front) / (2 * math.pi)) % 1.0
            sector = ring * angular_bins + int(turn * angular_bins) % angular_bins
            out[i, sector] += share
    return out


@numba.njit(cache=True, fastmath=True)
def _mean_best_costs(
    wanted: NDArray[np.float32], table: NDArray[np.float32], starts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Mean over the wanted contexts of the least chi-square cost in each submap; 1 without any."""
    n = len(starts) - 1
    costs = np.ones(n)
    for s in range(n):
        if starts[s] == starts[s + 1] or len(wanted) == 0:
            continue
        total = 0.0
        for i in range(len(wanted)):
            a = wanted[i]
            best = 2.0
            for j in range(starts[s], starts[s + 1]):
                b = table[j]
                cost = np.float32(0.0)
                for k in range(len(a)):
                    difference = a[k] - b[k]
                    cost += difference * difference / (a[k] + b[k] + np.float32(1e-12))
                best = min(best, float(cost))
            total += best
        costs[s] = 0.5 * total / len(wanted)
    return costs
