"""What is seen from the places of a map, as it is stored and searched: the three signatures at viewpoints.

A place is a point of the junction graph or of the skeleton, and signatures are compared where a query may
stand: at viewpoints on a lattice over the free space around the places. A number takes 8 bits: a signature
is exact to 0.002, which moves the vectors of `signature.seen_likelihood` by at most a tenth of the standard
deviation of two views of one place.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pc2grid.arrays import F32, F64, I64, U8, BoolGrid, freeze
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import look_around
from signature.seen import parts, seen_signatures

PROFILE_BEARINGS = 48
"""Rays of the isovists: one every 7.5 degrees. Chosen on fr079 and intel."""
LATTICE_M = 0.4
"""Distance of viewpoints: a view is at most 0.28 m from one of them. With
0.8 m a tenth fewer queries find their place after 1 m."""
AROUND_M = 1.2
"""A viewpoint farther than this from every place is left out: places are 1 m apart by default."""
CLEARANCE_M = 0.2
"""A viewpoint is at least so far from walls and unknown cells."""
SIGNATURE_UNITS = 255
"""Units of a column of a signature up to 1."""
SIGNATURE_COLUMNS = 1 + max(part.stop for part in parts().values())
"""Columns of the three signatures of what was seen, and of the share that was seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenPlaces:
    """What is seen from K viewpoints around the places of one map, ordered by place.

    at_m : (K, 2) float32, the viewpoints in the map frame. place : (K,) int32, the nearest place of each.
    signatures : (K, C) uint8, `signature.seen.seen_signatures` in `SIGNATURE_UNITS`.
    """

    at_m: F32
    place: I64
    signatures: U8

    def __post_init__(self) -> None:
        freeze(self, "at_m", np.float32, (None, 2))
        freeze(self, "place", np.int64, (len(self.at_m),))
        freeze(self, "signatures", np.uint8, (len(self.at_m), None))

    @staticmethod
    def of(grid: OccupancyGrid, centers_m: F64, sight_m: float) -> SeenPlaces:
        """Look around at the viewpoints of places (N, 2) of a map: 0.1 ms each, a dozen a place."""
        at_m, place = viewpoints_of(grid, centers_m)
        ranges_m, ends = look_around(grid, at_m.astype(np.float64), sight_m, bearings=PROFILE_BEARINGS)
        signatures = seen_signatures(ranges_m, ends, sight_m)
        return SeenPlaces(
            at_m=at_m, place=place, signatures=np.rint(signatures * SIGNATURE_UNITS).astype(np.uint8)
        )

    def __len__(self) -> int:
        return len(self.at_m)

    @property
    def shares(self) -> F32:
        """The signatures (K, C) as `signature.seen.seen_signatures` makes them, but for rounding."""
        return self.signatures.astype(np.float32) / np.float32(SIGNATURE_UNITS)


def viewpoints_of(grid: OccupancyGrid, centers_m: F64) -> tuple[F32, I64]:
    """The points (K, 2) of the lattice that a robot may stand at near the places (N, 2) of a map, and the
    nearest place of each (K,), ascending. A place that is too narrow for any is its own viewpoint."""
    from scipy.spatial import cKDTree

    if not len(centers_m):
        return np.empty((0, 2), np.float32), np.empty(0, np.int64)
    low, high = np.floor(centers_m.min(axis=0) / LATTICE_M), np.ceil(centers_m.max(axis=0) / LATTICE_M)
    reach = np.ceil(AROUND_M / LATTICE_M)
    axes = [np.arange(a - reach, b + reach + 1) for a, b in zip(low, high, strict=True)]
    lattice_m = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2) * LATTICE_M
    cells = grid.to_cell(lattice_m)
    usable: BoolGrid = np.asarray(np.all((cells >= 0) & (cells < grid.cells.shape), axis=1))
    usable[usable] = _roomy(grid)[tuple(cells[usable].T)]
    lattice_m = lattice_m[usable]
    distance_m, place = cKDTree(centers_m).query(lattice_m)
    near = distance_m <= AROUND_M
    alone = np.setdiff1d(np.arange(len(centers_m)), place[near])
    at_m = np.concatenate((lattice_m[near], centers_m[alone]))
    place = np.concatenate((place[near], alone)).astype(np.int64)
    order = np.argsort(place, kind="stable")
    return at_m[order].astype(np.float32), place[order]


def _roomy(grid: OccupancyGrid) -> BoolGrid:
    """Cells (H, W) with free cells around them."""
    n = round(CLEARANCE_M / grid.resolution_m)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * n + 1, 2 * n + 1))
    return np.asarray(cv2.erode(grid.ground.astype(np.uint8), kernel), bool)
