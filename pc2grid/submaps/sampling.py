"""Thinning out points evenly (paper III-B 3, III-C 1)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", np.int64, np.float64)

_TOLERANCE = 1e-9
"""Relative: points exactly one spacing apart are both kept, whatever the rounding of their distance."""
_CROWDED = 20.0
"""Points within the spacing of a point, from which on a search around each kept point is faster than all
pairs at once (measured on boundaries and skeletons of the maps of Table I)."""


def sample_evenly(points: NDArray[Number], spacing: float) -> NDArray[Number]:
    """Thin out points (N, 2) until no two are closer than `spacing`; returns (M, 2), M <= N.

    Greedy in the given order: a point is kept unless it lies closer than the spacing to one that was kept
    before it. The unit is that of the points (cells, metres).

    >>> sample_evenly(np.array([[0, 0], [0, 1], [0, 2], [0, 3]]), 2.0).tolist()
    [[0, 0], [0, 2]]
    """
    from scipy.spatial import cKDTree

    # An unbalanced tree gives the same neighbours; balancing it takes longer than it saves here.
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    reach = spacing * (1.0 - _TOLERANCE)
    kept = [True] * len(points)
    some = points[:: 1 + len(points) // 32]
    if len(points) and tree.query_ball_point(some, reach, return_length=True).mean() > _CROWDED:
        for first in range(len(points)):
            if kept[first]:
                for second in tree.query_ball_point(points[first], reach):
                    kept[second] = second <= first and kept[second]
        return points[np.array(kept, np.bool_)]
    # Pairs (first, second), first < second, sorted by the first: when a point is reached, every earlier point
    # that could exclude it is decided.
    pairs = tree.query_pairs(reach, output_type="ndarray")
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    for first, second in zip(pairs[:, 0].tolist(), pairs[:, 1].tolist(), strict=True):
        if kept[first]:
            kept[second] = False
    return points[np.array(kept, np.bool_)]
