"""A place described from several centres: any method, given smaller discs around many points of a submap.

It is not in the paper, whose submaps have one centre each. A query lies up to a metre beside it, and its disc
then shows other walls at the rim and other distances inside. Here every submap of the map is cut into smaller
discs around the points of a lattice, and the best of them counts; the query is cut to the same size around
its own centre only. All discs lie inside the submaps, so that no method sees more of the map than the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pc2grid.arrays import F64, I64
from pc2grid.model import UNKNOWN, OccupancyGrid, Submap
from pc2grid_lab.paper.protocol import Matcher, Method


@dataclass(frozen=True, slots=True, kw_only=True)
class SeveralCentres:
    """`method` on discs around the points of a lattice.

    reach_m : farthest centre of a disc from that of its submap; the discs are smaller by as much.
    spacing_m : of the lattice. Both are chosen by hand, for queries within 1 m of a centre.
    """

    method: Method
    reach_m: float = 1.0
    spacing_m: float = 0.5

    def fit(self, submaps: Sequence[Submap]) -> _Centres:
        """Describe every disc of every submap."""
        offsets = lattice(self.reach_m, self.spacing_m)
        discs = [smaller_disc(submap, offset, self.reach_m) for submap in submaps for offset in offsets]
        own = np.repeat(np.arange(len(submaps)), len(offsets))
        centers_m = np.array([submap.center_m for submap in submaps]).reshape(-1, 2)
        at_m = centers_m[own] + np.tile(offsets, (len(submaps), 1))
        return _Centres(self.method.fit(discs), _nearest(at_m, centers_m, own), len(submaps), self.reach_m)


def _nearest(at_m: F64, centers_m: F64, own: I64) -> I64:
    """For each disc, at (N, 2), the submap with the nearest centre (M, 2); its own (N,) if none is nearer.

    Submaps overlap. A disc of one of them that lies beside the centre of another one stands for that one.
    """
    if not len(at_m):
        return own
    away_m, nearest = cKDTree(centers_m).query(at_m)
    own_m = np.hypot(*(at_m - centers_m[own]).T)
    return np.where(own_m <= away_m + 1e-9, own, nearest)


@dataclass(frozen=True, slots=True)
class _Centres:
    matcher: Matcher
    owner: I64
    count: int
    reach_m: float

    def similarities(self, query: Submap) -> F64:
        scores = self.matcher.similarities(smaller_disc(query, np.zeros(2), self.reach_m))
        best = np.full(self.count, -np.inf)
        np.maximum.at(best, self.owner, scores)
        return best


def lattice(reach_m: float, spacing_m: float) -> F64:
    """(K, 2) points of a square lattice within `reach_m` of (0, 0), which is one of them."""
    steps = np.arange(-int(reach_m / spacing_m), int(reach_m / spacing_m) + 1) * spacing_m
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.asarray(points[np.hypot(*points.T) <= reach_m + 1e-9])


def smaller_disc(submap: Submap, offset_m: F64, less_m: float) -> Submap:
    """The part of a submap within its radius less `less_m` of its centre plus `offset_m` (2,)."""
    grid = submap.grid
    radius_m = submap.radius_m - less_m
    height, width = grid.cells.shape
    middle_m = np.asarray(grid.origin_m) + 0.5 * grid.resolution_m * np.array([width, height]) + offset_m
    part = grid.crop((float(middle_m[0]), float(middle_m[1])), radius_m)
    rows, columns = np.indices(part.cells.shape)
    x_m, y_m = (
        (np.stack((columns, rows), axis=-1) + 0.5) * part.resolution_m + np.asarray(part.origin_m) - middle_m
    ).transpose(2, 0, 1)
    inside = np.hypot(x_m, y_m) <= radius_m + 0.5 * part.resolution_m
    return Submap(
        submap_id=submap.submap_id,
        center_m=submap.center_m,
        radius_m=radius_m,
        grid=OccupancyGrid(
            cells=np.where(inside, part.cells, np.int8(UNKNOWN)),
            resolution_m=part.resolution_m,
            origin_m=part.origin_m,
        ),
    )
