"""From a submap to its three signatures (paper III, Figure 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64, freeze
from pc2grid.model import Submap
from signature.boundary import boundary_edges, boundary_histogram, boundary_points
from signature.config import SignatureConfig
from signature.freespace import freespace_graph, freespace_histogram, shortest_paths
from signature.symmetry import symmetry_scores


@dataclass(frozen=True, slots=True, kw_only=True)
class Signature:
    """The three signatures of a submap.

    boundary : (Nb,) float32, H^b of Eq. 2; sum 1, or all 0 if fewer than two boundary points are known.
    freespace : (Nf,) float32, H^f of Eq. 4; sum 1, or all 0 if no two free places are connected.
    symmetry : (2,) float32, s^alpha and s^beta of Eq. 5; 0 where there is no axis.

    Raises ValueError if an array does not have one axis.
    """

    boundary: F32
    freespace: F32
    symmetry: F32

    def __post_init__(self) -> None:
        for name in ("boundary", "freespace", "symmetry"):
            freeze(self, name, np.float32, (None,))

    def __repr__(self) -> str:
        alpha, beta = self.symmetry
        bins = f"{len(self.boundary)} boundary bins, {len(self.freespace)} free-space bins"
        return f"Signature({bins}, symmetry {alpha:.1f} and {beta:.1f})"


def describe(submap: Submap, config: SignatureConfig = SignatureConfig()) -> Signature:
    """The three signatures of a submap; defined for every submap, never NaN.

    >>> import pc2grid
    >>> submaps = pc2grid.submaps_of(pc2grid.load_map("map.yaml"))
    >>> signature = describe(submaps[0])
    >>> signature.boundary.shape, signature.freespace.shape, signature.symmetry.shape
    ((50,), (50,), (2,))
    >>> round(float(signature.boundary.sum()), 5)
    1.0
    """
    return described(submap, shortest_paths(freespace_graph(submap, config)), config)


def described(submap: Submap, paths_m: F64, config: SignatureConfig) -> Signature:
    """The three signatures of a submap, given the lengths L^F (N, N) of the paths in its free space."""
    radius_m, resolution_m = submap.radius_m, submap.grid.resolution_m
    edges = boundary_edges(submap, config)
    points = boundary_points(edges, resolution_m, config)
    return Signature(
        boundary=boundary_histogram(points, radius_m, resolution_m, config),
        freespace=freespace_histogram(paths_m, radius_m, config),
        symmetry=symmetry_scores(edges, resolution_m, config),
    )
