"""Boundary histogram: the distances between all pairs of points on the walls (paper III-B)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, I64, BoolGrid, cells_of
from pc2grid.model import Submap
from pc2grid.submaps.sampling import sample_evenly
from pc2grid.submaps.skeleton import thin
from signature.config import SignatureConfig

ROUNDING_BINS = 1e-6
"""Added to a distance in bins before it is rounded down, so that a distance on the edge of two bins counts in
the upper one: 0.6 m / 0.2 m is 2.9999999999999996. It exceeds the rounding of float64 and is less than what
a distance of cells differs from an edge if it does not lie on it."""


def boundary_edges(submap: Submap, config: SignatureConfig) -> BoolGrid:
    """The edge map S^E (H, W): clearly occupied cells (III-B 1), thinned to one pixel (III-B 2)."""
    return thin(submap.grid.occupied, config.thinning)


def boundary_points(edges: BoolGrid, resolution_m: float, config: SignatureConfig) -> I64:
    """Evenly sampled boundary points P^B (N, 2) as (row, column) of the edge map (III-B 3)."""
    return sample_evenly(cells_of(edges), config.boundary_spacing_m / resolution_m)


def boundary_bins(radius_m: float, config: SignatureConfig) -> int:
    """N_hb = ceil(2 r / delta_b)."""
    return math.ceil(2 * radius_m / config.boundary_bin_m - 1e-9)


def boundary_histogram(points: I64, radius_m: float, resolution_m: float, config: SignatureConfig) -> F32:
    """Distances of all pairs of boundary points as a histogram H^b, Eq. 1-2.

    points : (N, 2) cells. Returns (N_hb,) float32, sum 1; all 0 if there are fewer than two points.
    Distances of 2 r and more count in the last bin.
    """
    from signature import _kernels

    cells = np.ascontiguousarray(points, np.int64)
    bins_per_cell = resolution_m / config.boundary_bin_m
    bins = boundary_bins(radius_m, config)
    return normalized(_kernels.pair_distance_counts(cells, bins_per_cell, ROUNDING_BINS, bins))


def normalized(counts: NDArray[np.generic]) -> F32:
    """Counts (N,) as shares, float32 of sum 1; all 0 stays all 0."""
    return np.asarray(counts / max(counts.sum(), 1), np.float32)
