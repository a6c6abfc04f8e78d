"""Parts of a session that cannot be placed to each other.

Where tracking was lost and started again, the pose relative to what was before is unknown: a new segment
begins. Loops that were accepted between two segments join them again; what remains unconnected is a part,
and becomes a session of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pc2grid.arrays import I64
from pc2grid.mapping.pose_graph import Edge


@dataclass(frozen=True, slots=True, kw_only=True)
class PartParameters:
    """Numbers of the division into parts.

    joining : different local maps on each of the two sides that must be in agreeing loops, to join
        them; a single room may look like another one. Chosen by hand.
    least_travel_m : a part with less travel is left out: later recordings are recognised by stretches of 8 m
        and more.
    """

    joining: int = 2
    least_travel_m: float = 8.0


PARTS = PartParameters()


def connected(segment: I64, loops: Sequence[Edge]) -> I64:
    """(N,) number of the part of each local map, in the order in which the parts begin.

    segment : (N,) number of the segment of each, from 0. loops : that were accepted. Two segments are joined
    if enough different local maps of the one lie on enough different ones of the other.
    """
    ends: dict[tuple[int, int], list[Edge]] = {}
    for loop in loops:
        ends.setdefault((int(segment[loop.first]), int(segment[loop.second])), []).append(loop)
    joined = [
        pair
        for pair, between in ends.items()
        if len({loop.first for loop in between}) >= PARTS.joining
        and len({loop.second for loop in between}) >= PARTS.joining
    ]
    count = int(segment.max(initial=-1)) + 1
    rows, columns = np.array(joined, dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first, part = np.unique(label[segment], return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[part], dtype=np.int64)
