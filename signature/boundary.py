"""Boundary histogram: how far apart the points of the walls are from each other (paper III-B)."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.model import F32, I64, BoolGrid, Submap
from pc2grid.skeleton import cells_of, sample_evenly, thin
from signature.config import SignatureConfig


def boundary_edges(submap: Submap, config: SignatureConfig) -> BoolGrid:
    """The edge map S^E (H, W): clearly occupied cells (III-B 1), thinned to one pixel (III-B 2)."""
    return thin(submap.grid.cells >= config.occupied_percent, config.thinning)


def boundary_points(edges: BoolGrid, resolution_m: float, config: SignatureConfig) -> I64:
    """Evenly sampled boundary points P^B (N, 2) as (row, column) of the edge map (III-B 3)."""
    return sample_evenly(cells_of(edges), config.boundary_spacing_m / resolution_m)


def boundary_bins(radius_m: float, config: SignatureConfig) -> int:
    """N_hb = ceil(2 r / delta_b)."""
    return math.ceil(2 * radius_m / config.boundary_bin_m - 1e-9)


def boundary_histogram(points: I64, radius_m: float, resolution_m: float, config: SignatureConfig) -> F32:
    """Distances of all pairs of boundary points as a histogram H^b, Eq. 1-2.

    points : (N, 2) cells. Returns (N_hb,), sum 1; all 0 if there are fewer than two points.
    A distance of exactly 2 r counts in the last bin.
    """
    counts = _pair_distance_counts(
        np.ascontiguousarray(points, np.int64),
        resolution_m / config.boundary_bin_m,
        boundary_bins(radius_m, config),
    )
    return normalized(counts)


def normalized(counts: NDArray[np.int64]) -> F32:
    """Counts (N,) as shares, float32 of sum 1; all 0 stays all 0."""
    return (counts / max(int(counts.sum()), 1)).astype(np.float32)


@numba.njit(cache=True)
def _pair_distance_counts(points: NDArray[np.int64], bins_per_cell: float, bins: int) -> NDArray[np.int64]:
    """Histogram of the distances of all pairs m < n."""
    counts = np.zeros((4, bins), np.int64)
    n = len(points)
    rows = (points[:, 0] * bins_per_cell).astype(np.float32)
    columns = (points[:, 1] * bins_per_cell).astype(np.float32)
    # More than float32's rounding, less than two distances of cells differ: on an edge the upper bin counts.
    nudge = np.float32(1e-4)
    last = np.float32(bins - 1)
    found = np.empty(n, np.uint16)
    for i in range(n):
        r, c = rows[i], columns[i]
        others_r, others_c = rows[i + 1 :], columns[i + 1 :]
        for j in range(len(others_r)):
            dr, dc = others_r[j] - r, others_c[j] - c
            found[j] = np.uint16(np.int32(min(np.sqrt(dr * dr + dc * dc) + nudge, last)))
        # Four counters in turn, as neighbours often fall into the same bin and would wait for each other.
        j = 0
        while j + 4 <= len(others_r):
            counts[0, found[j]] += 1
            counts[1, found[j + 1]] += 1
            counts[2, found[j + 2]] += 1
            counts[3, found[j + 3]] += 1
            j += 4
        while j < len(others_r):
            counts[0, found[j]] += 1
            j += 1
    total: NDArray[np.int64] = counts[0] + counts[1] + counts[2] + counts[3]
    return total
