"""Parts of a session that cannot be placed to each other, and where a session is cut into them.

Two things make the pose of one stretch of a session relative to another unknown: tracking was lost in between
and started again, or the map that was drawn of both contradicts itself. The pose graph is cut there into
segments. Loops that were accepted between two segments join them again, unless these contradict each other;
what remains unconnected is a part, and becomes a session of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64
from pc2grid.mapping.local_maps import LocalMaps, pose_at
from pc2grid.mapping.pose_graph import Edge


@dataclass(frozen=True, slots=True, kw_only=True)
class PartParameters:
    """Numbers of the division into parts.

    contradicting : share of the points of a local map on ground that another one saw free from which the
        other contradicts it, as for the windows of `ConsistencyParameters.contradicted_from`; chosen on maps
        with loops closed and without (`examples/map-quality.md`).
    joining : different local maps on each of the two sides of a cut that must be in agreeing loops, to join
        them; a single room may look like another one. Chosen by hand.
    least_travel_m : a part with less travel is left out: later recordings are recognised by stretches of 8 m
        and more.
    rounds : divisions at most, each of the parts that are still bent. Chosen by hand.
    """

    contradicting: float = 0.2
    joining: int = 2
    least_travel_m: float = 8.0
    rounds: int = 4


PARTS = PartParameters()


@dataclass(frozen=True, slots=True)
class Conflict:
    """Two local maps of one part that contradict each other.

    older, newer : their numbers. mutual : whether each contradicts the other, not only one of them.
    """

    older: int
    newer: int
    mutual: bool


def connected(segment: I64, loops: Sequence[Edge], parameters: PartParameters = PARTS) -> I64:
    """(N,) number of the part of each local map, in the order in which the parts begin.

    segment : (N,) number of the segment of each, from 0. loops : that were accepted. Two segments are joined
    if enough different local maps of the one lie on enough different ones of the other.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends: dict[tuple[int, int], list[Edge]] = {}
    for loop in loops:
        ends.setdefault((int(segment[loop.first]), int(segment[loop.second])), []).append(loop)
    joined = [
        pair
        for pair, between in ends.items()
        if len({loop.first for loop in between}) >= parameters.joining
        and len({loop.second for loop in between}) >= parameters.joining
    ]
    count = int(segment.max(initial=-1)) + 1
    rows, columns = np.array(joined, dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first, part = np.unique(label[segment], return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[part], dtype=np.int64)


def cuts_for(conflicts: Sequence[Conflict], segment: I64) -> list[int]:
    """Local maps at which to cut segments whose local maps contradict each other.

    conflicts : in the order of the newer local map. segment : (N,) number of the segment of each local map.
    A segment is cut only if two of its local maps contradict each other mutually. Then it is divided in the
    order of travel: a new segment begins where a local map contradicts one of the segment so far.
    """
    within = [c for c in conflicts if segment[c.older] == segment[c.newer]]
    cuts: list[int] = []
    for number in sorted({int(segment[c.newer]) for c in within if c.mutual}):
        begin = 0
        for conflict in within:
            if segment[conflict.newer] == number and conflict.older >= begin:
                cuts.append(conflict.newer)
                begin = conflict.newer
    return cuts


def conflicts_of(
    local_maps: LocalMaps,
    poses: F64,
    part: I64,
    doubtful: NDArray[np.bool_],
    near_m: float,
    parameters: PartParameters = PARTS,
) -> Iterator[Conflict]:
    """The local maps that contradict each other, in the order of the newer.

    poses : (N, 3) settled poses of the local maps. part : (N,) number of the part of each.
    doubtful : (N,) local maps in stretches that contradict the map drawn of their part; one of two must be.
    near_m : local maps whose anchors lie farther apart are not compared.
    """
    for newer in range(len(poses)):
        # The local map before the newest is left out: tracking matched both against the same walls.
        before = np.arange(max(newer - 1, 0))
        near = np.hypot(*(poses[before, :2] - poses[newer, :2]).T) < near_m
        near &= (part[before] == part[newer]) & (doubtful[before] | doubtful[newer])
        for older in before[near].tolist():
            T_older_newer = pose_at(poses, older).inverse() @ pose_at(poses, newer)
            first, second = local_maps[older], local_maps[newer]
            shares = []
            for target, points_m, pose in (
                (first, second.points_m, T_older_newer),
                (second, first.points_m, T_older_newer.inverse()),
            ):
                observed, agreement = target.agreement(points_m, pose)
                shares.append(observed * (1.0 - agreement))
            if max(shares) >= parameters.contradicting:
                yield Conflict(older, newer, min(shares) >= parameters.contradicting)
