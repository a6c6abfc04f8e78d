"""The three signatures of what was seen: of an isovist, without the rays whose ends are hidden.

A submap of a map is known whole, a view of a query often in part: a camera that has driven a metre has seen a
quarter of what surrounds it. The histograms of III-B to III-D then compare a part with a whole. Here every
bin is a share of what *was seen*: a ray that ends on unknown cells, and each pair of rays with such a ray,
counts neither for nor against. A part then has about the histogram of the whole. All three are invariant to
rotation, as in the paper. Each stands beside that of a submap, in `signature.boundary`, `signature.freespace`
and `signature.symmetry`.

`SeenPlaces` are those of a map, as they are stored and searched. A place is a point of the junction graph or
of the skeleton, and signatures are compared where a query may stand: at viewpoints on a lattice over the free
space around the places. A number takes 8 bits: a signature is exact to 0.002, which moves the vectors of
`signature.weights` by at most a tenth of the standard deviation of two views of one place. `View` is a
viewpoint of a query.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64, I64, U8, BoolGrid, frozen_arrays
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.submaps import HIDDEN, Isovist, look_around
from signature.boundary import RANGE_BINS, RIMS, boundary_seen, rim_columns
from signature.freespace import DETOUR_BINS, PATH_BINS, STEPS_M, freespace_seen
from signature.symmetry import BESIDE, QUANTILES, symmetry_seen

_AT_ONCE = 4096
"""Isovists whose pairs are in memory at the same time."""


_SIZES = {
    "boundary": RANGE_BINS + 1 + sum(len(rim_columns(rim)) for rim in RIMS),
    "freespace": PATH_BINS + DETOUR_BINS + len(STEPS_M) + 1,
    "symmetry": len(BESIDE) + 2 + len(QUANTILES) + 1,
}
_ENDS = np.cumsum(list(_SIZES.values())).tolist()
PARTS = {name: slice(end - size, end) for (name, size), end in zip(_SIZES.items(), _ENDS, strict=True)}
"""Which columns of `seen_signatures` belong to which of the three signatures."""
WITHOUT_SHARE = slice(0, -1)
"""All columns of the three signatures; the last one, the share of rays that were seen, is left out."""


def seen_signatures(ranges_m: F32, ends: NDArray[np.int8], sight_m: float) -> F32:
    """Return the signatures of what was seen, side by side, and the share that was seen: (N, K) float32.

    ranges_m, ends : (N, B) of isovists, as of `pc2grid.submaps.submaps.look_around` with `sight_m`, B a
    multiple of 8. The columns of each signature are those of `PARTS`. Histograms are square roots of shares,
    so that their Euclidean distance is that of Hellinger, and 0 where nothing was seen. The last column is
    the share of the rays, 0..1, whose ends are known.
    """
    found = [
        np.concatenate(
            (
                boundary_seen(ranges_m[part], ends[part], sight_m),
                freespace_seen(ranges_m[part], ends[part], sight_m),
                symmetry_seen(ranges_m[part], ends[part]),
                np.mean(ends[part] != HIDDEN, axis=1, keepdims=True),
            ),
            axis=1,
        )
        for part in (slice(at, at + _AT_ONCE) for at in range(0, max(len(ranges_m), 1), _AT_ONCE))
    ]
    return np.concatenate(found).astype(np.float32)


PROFILE_BEARINGS = 48
"""Rays of the isovists: one every 7.5 degrees. Chosen on fr079 and intel."""
LATTICE_M = 0.4
"""Distance of viewpoints: a view is at most 0.28 m from one of them. With
0.8 m a tenth fewer queries find their place after 1 m."""
AROUND_M = 1.2
"""A viewpoint farther than this from every place is left out: places are 1 m apart by default."""
CLEARANCE_M = 0.5 * LATTICE_M
"""A viewpoint is at least so far from walls and unknown cells: what is nearest to it is free."""
SIGNATURE_UNITS = np.iinfo(np.uint8).max
"""Units of a column of a signature up to 1."""
SIGNATURE_COLUMNS = 1 + _ENDS[-1]
"""Columns of the three signatures of what was seen, and of the share that was seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(at_m=(np.float32, "V", 2), place=(np.int64, "V"), signatures=(np.uint8, "V", "K"))
class SeenPlaces:
    """What is seen from K viewpoints around the places of one map, ordered by place.

    at_m : (K, 2) float32, the viewpoints in the map frame. place : (K,) int32, the nearest place of each.
    signatures : (K, C) uint8, `signature.visible.seen_signatures` in `SIGNATURE_UNITS`.
    """

    at_m: F32
    place: I64
    signatures: U8

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
        """Return the signatures (K, C) as `signature.visible.seen_signatures` makes them, but for
        rounding."""
        return self.signatures.astype(np.float32) / np.float32(SIGNATURE_UNITS)


def viewpoints_of(grid: OccupancyGrid, centers_m: F64) -> tuple[F32, I64]:
    """Return the points (K, 2) of the lattice that a robot may stand at near the places (N, 2) of a map, and
    the nearest place of each (K,), ascending. A place that is too narrow for any is its own viewpoint."""
    from scipy.spatial import cKDTree

    if not len(centers_m):
        return np.empty((0, 2), np.float32), np.empty(0, np.int64)
    low, high = np.floor(centers_m.min(axis=0) / LATTICE_M), np.ceil(centers_m.max(axis=0) / LATTICE_M)
    reach = np.ceil(AROUND_M / LATTICE_M)
    axes = [np.arange(a - reach, b + reach + 1) for a, b in zip(low, high, strict=True)]
    lattice_m = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2) * LATTICE_M
    lattice_m = lattice_m[grid.look_up(_roomy(grid), lattice_m, outside=False)]
    distance_m, place = cKDTree(centers_m).query(lattice_m)
    near = distance_m <= AROUND_M
    alone = np.setdiff1d(np.arange(len(centers_m)), place[near])
    at_m = np.concatenate((lattice_m[near], centers_m[alone]))
    place = np.concatenate((place[near], alone)).astype(np.int64)
    order = np.argsort(place, kind="stable")
    return at_m[order].astype(np.float32), place[order]


def _roomy(grid: OccupancyGrid) -> BoolGrid:
    """Return the cells (H, W) that have free cells around them."""
    n = round(CLEARANCE_M / grid.resolution_m)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * n + 1, 2 * n + 1))
    return np.asarray(cv2.erode(grid.ground.astype(np.uint8), kernel), bool)


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The query described at one place.

    center_m : (x, y) in the query's frame.
    profile : its isovist with `signature.visible.PROFILE_BEARINGS` rays.
    """

    center_m: tuple[float, float]
    profile: Isovist
