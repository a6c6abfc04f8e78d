"""What is seen from the places of a map, as it is stored and searched: isovists and their signatures.

Both take 8 bits a number, 160 bytes a place. A range is exact to 1 cm at 5 m, less than the width of a cell;
a signature to 0.002, which moves the vectors of `signature.seen_likelihood` by at most a tenth of the
standard deviation of two views of one place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64, U8, freeze
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import HIDDEN, look_around
from signature.seen import parts, seen_signatures

PROFILE_BEARINGS = 48
"""Rays of the isovists whose ranges are compared: one every 7.5 degrees, the window of headings that the
coarse search covers around each proposal. Chosen on fr079 and intel."""
RANGE_UNITS = 254
"""Units of a range up to the limit of sight."""
UNSEEN = 255
"""Stands for a range whose end is hidden."""
SIGNATURE_UNITS = 255
"""Units of a column of a signature up to 1."""
SIGNATURE_COLUMNS = 1 + max(part.stop for part in parts().values())
"""Columns of the three signatures of what was seen, and of the share that was seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenPlaces:
    """What is seen from N places of one map.

    sight_m : length of the rays. ranges : (N, B) uint8, in units of `sight_m` / `RANGE_UNITS`; `UNSEEN` where
    the end is hidden. signatures : (N, K) uint8, `signature.seen.seen_signatures` in `SIGNATURE_UNITS`.
    """

    sight_m: float
    ranges: U8
    signatures: U8

    def __post_init__(self) -> None:
        freeze(self, "ranges", np.uint8, (None, None))
        freeze(self, "signatures", np.uint8, (len(self.ranges), None))

    @staticmethod
    def of(grid: OccupancyGrid, centers_m: F64, sight_m: float) -> SeenPlaces:
        """Look around at points (N, 2) of a map: 0.3 ms each."""
        ranges_m, ends = look_around(grid, centers_m, sight_m, bearings=PROFILE_BEARINGS)
        signatures = seen_signatures(ranges_m, ends, sight_m)
        return SeenPlaces(
            sight_m=sight_m,
            ranges=np.where(ends == HIDDEN, UNSEEN, in_units(ranges_m, sight_m)),
            signatures=np.rint(signatures * SIGNATURE_UNITS).astype(np.uint8),
        )

    @staticmethod
    def concatenated(parts: Sequence[SeenPlaces]) -> SeenPlaces:
        """The places of one or more parts, in their order."""
        return SeenPlaces(
            sight_m=parts[0].sight_m,
            ranges=np.concatenate([part.ranges for part in parts]),
            signatures=np.concatenate([part.signatures for part in parts]),
        )

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def shares(self) -> F32:
        """The signatures (N, K) as `signature.seen.seen_signatures` makes them, but for rounding."""
        return self.signatures.astype(np.float32) / np.float32(SIGNATURE_UNITS)


def in_units(ranges_m: F32, sight_m: float) -> U8:
    """Ranges (N, B) of at most `sight_m` as `SeenPlaces.ranges`."""
    return np.asarray(np.rint(np.minimum(ranges_m / sight_m, 1.0) * RANGE_UNITS), np.uint8)
