"""Shape Context of a whole submap: 24 angular, 12 radial bins (paper IV-A, "describes global shapes").

One log-polar histogram of the boundary around the submap's centre (the descriptor of Belongie et al. 2002),
compared by the chi-square statistic in every of the 24 turns. The paper does not describe how it treats
rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64, cells_of
from pc2grid.model import Submap
from pc2grid.submaps.skeleton import thin


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeContext:
    """Bins as in the paper; rings grow by a constant factor from `inner_m`, chosen by hand, to the radius."""

    angular_bins: int = 24
    radial_bins: int = 12
    inner_m: float = 0.5

    def fit(self, submaps: Sequence[Submap]) -> _Shapes:
        """Describe every submap."""
        bins = (self.radial_bins, self.angular_bins)
        shapes = [self.context(submap) for submap in submaps]
        return _Shapes(self, np.stack(shapes) if shapes else np.empty((0, *bins), np.float32))

    def context(self, submap: Submap) -> F32:
        """Shares of the boundary pixels, (radial, angular); sum 1, or all 0 without any."""
        edges = thin(submap.grid.occupied)
        y, x = ((cells_of(edges) - (np.array(edges.shape) - 1) / 2) * submap.grid.resolution_m).T
        rings = np.geomspace(self.inner_m, submap.radius_m, self.radial_bins)
        ring = np.minimum(np.searchsorted(rings, np.hypot(x, y)), self.radial_bins - 1)
        turn = np.arctan2(y, x) / (2 * np.pi) % 1.0
        sector = (turn * self.angular_bins).astype(np.int64) % self.angular_bins
        counts = np.bincount(
            ring * self.angular_bins + sector, minlength=self.radial_bins * self.angular_bins
        )
        shares = counts.reshape(self.radial_bins, self.angular_bins) / max(len(x), 1)
        return np.asarray(shares, np.float32)


@dataclass(frozen=True, slots=True)
class _Shapes:
    method: ShapeContext
    table: F32

    def similarities(self, query: Submap) -> F64:
        shape = self.method.context(query)
        best = np.ones(len(self.table))
        for turn in range(shape.shape[1]):
            turned = np.roll(shape, turn, axis=1)
            total = self.table + turned
            terms = np.divide((self.table - turned) ** 2, total, out=np.zeros_like(total), where=total > 0)
            # An empty submap shares no bin with any other: its cost is the largest, 1.
            cost = 0.5 * terms.sum(axis=(1, 2)) if shape.any() else np.ones(len(self.table))
            best = np.minimum(best, np.where(self.table.any(axis=(1, 2)), cost, 1.0))
        return -best
