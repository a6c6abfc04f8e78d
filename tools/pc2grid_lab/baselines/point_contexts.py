"""Shape Context as its authors use it (Belongie et al. 2002): a context for each of many boundary points.

It is not in the paper's tables, which use one shape for the whole submap (`shape_context`). It is here
because a fair comparison contains the strongest form of a rival.

The context of a point is the log-polar histogram of the places of the other boundary points. Angles are
measured from the direction towards the centroid of the boundary, so that contexts do not change when a
submap is turned. Two submaps are compared by representative contexts (Mori, Belongie and Malik 2005): some
contexts of the query, each with the context of the other submap that fits best, by the chi-square
statistic. A full assignment of all points would cost too much, as every query is compared with every
submap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics.pairwise import additive_chi2_kernel

from pc2grid.arrays import F32, F64, cells_of
from pc2grid.model import Submap
from pc2grid.submaps.sampling import sample_evenly
from pc2grid.submaps.skeleton import thin


@dataclass(frozen=True, slots=True, kw_only=True)
class PointContexts:
    """Parameters; bins as in the paper.

    centers : points of a submap that get a context (Belongie et al. use 100).
    representatives : contexts of the query that are compared.
    spacing_m : least distance of the boundary points that a context counts; chosen by hand.
    inner_m : radius of the innermost ring; rings grow by a constant factor up to the submap's diameter;
        chosen by hand.
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
        """Contexts (K, radial * angular), K <= count, each of sum 1, around evenly chosen boundary points."""
        resolution = submap.grid.resolution_m
        cells = sample_evenly(cells_of(thin(submap.grid.occupied)), self.spacing_m / resolution)
        points = (cells[:, ::-1] * resolution).astype(np.float64)
        if len(points) < 2:
            return np.empty((0, self.angular_bins * self.radial_bins), np.float32)
        chosen = np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.int64)
        rings = np.geomspace(self.inner_m, 2 * submap.radius_m, self.radial_bins)
        return _histograms(points, points[chosen], rings, self.angular_bins)


@dataclass(frozen=True, slots=True)
class _Contexts:
    method: PointContexts
    table: F32
    starts: NDArray[np.int64]

    def similarities(self, query: Submap) -> F64:
        wanted = self.method.contexts(query, self.method.representatives)
        return np.asarray(-_mean_best_costs(wanted, self.table, self.starts))


def _histograms(points: F64, centers: F64, rings: F64, angular_bins: int) -> F32:
    """Shares of the other points (N, 2), by ring and sector around each centre: (K, radial * angular)."""
    x, y = np.moveaxis(points - centers[:, None], -1, 0)
    towards_x, towards_y = (points.mean(axis=0) - centers).T
    front = np.arctan2(towards_y, towards_x)[:, None]
    ring = np.minimum(np.searchsorted(rings, np.hypot(x, y)), len(rings) - 1)
    turn = (np.arctan2(y, x) - front) / (2 * np.pi) % 1.0
    sector = (turn * angular_bins).astype(np.int64) % angular_bins
    bins = len(rings) * angular_bins
    at = np.arange(len(centers))[:, None] * bins + ring * angular_bins + sector
    others = (x != 0.0) | (y != 0.0)
    counts = np.bincount(at[others], minlength=len(centers) * bins).reshape(len(centers), bins)
    return np.asarray(counts / (len(points) - 1), np.float32)


def _mean_best_costs(wanted: F32, table: F32, starts: NDArray[np.int64]) -> F64:
    """Chi-square cost (N,), 0 .. 1, of each submap: the mean over the wanted contexts of the least cost.

    wanted (K, B), table (M, B): contexts; submap s has the rows starts[s] to starts[s + 1] of the table.
    Without any context on either side the cost is 1.
    """
    costs = np.ones(len(starts) - 1)
    if len(wanted) and len(table):
        pairs = -0.5 * additive_chi2_kernel(wanted, table)
        filled = np.flatnonzero(np.diff(starts))
        costs[filled] = np.minimum.reduceat(pairs, starts[filled], axis=1).mean(axis=0)
    return costs
