"""How alike two isovists are, at every rotation: rays that either side has not observed are left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, I64


@dataclass(frozen=True, slots=True, kw_only=True)
class LikenessParameters:
    """How isovists are compared. Both chosen on fr079 and intel.

    range_scale_m : the likeness of two ranges is 1/2 at this difference and 0 at twice that; about the
        distance of a view from the nearest viewpoint.
    prior_share : rays added to the number of common rays, as a share of all rays, so that a likeness of few
        common rays counts for less.
    """

    range_scale_m: float = 0.25
    prior_share: float = 0.15


LIKENESS = LikenessParameters()
_UNSEEN = 65535
"""Stands for an unknown range, in units: it is alike to no known one."""


def rotate_and_compare(
    ranges_m: F32, seen: NDArray[np.bool_], others_m: F32, others_seen: NDArray[np.bool_]
) -> F32:
    """Likeness (V, B, N), 0..1, of isovists (V, B) with others (N, B), for each rotation by 2 pi s / B.

    See `plain_rotate_and_compare`, which this agrees with to 0.002 for ranges up to 20 m.
    """
    from signature.retrieval._kernels import compare_rotated

    views, bearings = ranges_m.shape
    # In units of 16 bits, as fine as the sum over all rays and the longest range permit.
    longest_m = max(float(ranges_m.max(initial=0.0)), float(others_m.max(initial=0.0)))
    width_m = 2.0 * LIKENESS.range_scale_m
    per_m = np.float32(min(65535 // bearings / width_m, (_UNSEEN - 1) / (longest_m + width_m)))
    own, others = ((m * per_m + np.float32(0.5)).astype(np.uint16) for m in (ranges_m, others_m))
    others[~others_seen] = _UNSEEN
    likeness = np.empty((views, bearings, len(others)), np.float32)
    for view in range(views):
        rays = np.flatnonzero(seen[view])
        compare_rotated(
            rays,
            own[view, rays],
            others,
            np.ascontiguousarray(others_seen),
            int(width_m * per_m),
            LIKENESS.prior_share * bearings,
            likeness[view],
        )
    return likeness


def peaks(likeness: F32, columns: I64) -> tuple[I64, I64]:
    """Column and rotation of the local maxima over the rotations in the `columns` of `likeness` (B, K):
    higher than at the next rotation and no lower than at the one before. Ordered by column, then rotation."""
    chosen = likeness[:, columns].T
    before, after = np.roll(chosen, 1, axis=1), np.roll(chosen, -1, axis=1)
    at, shift = np.nonzero((chosen >= before) & (chosen > after))
    return columns[at], shift
