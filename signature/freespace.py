"""Free-space histogram: how long the ways between the places in a submap are (paper III-C)."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.model import F32, I64, BoolGrid, Submap
from pc2grid.skeleton import cells_of, sample_evenly, skeleton_of
from signature.boundary import normalized
from signature.config import SignatureConfig

if TYPE_CHECKING:
    import networkx as nx

_STRIDE = 3


def freespace_nodes(submap: Submap, config: SignatureConfig) -> I64:
    """Free-space nodes V^F (N, 2) as (row, column): evenly sampled pixels of the free-space skeleton.

    The skeleton is found on blocks of cells (`config.freespace_cell_m`), free if all their cells are: nodes
    far apart need no finer one, and thinning a wide area is the dearest step.
    """
    grid = submap.grid
    block = max(1, round(config.freespace_cell_m / grid.resolution_m))
    free = _all_in_blocks(grid.free, block)
    cell_m = block * grid.resolution_m
    skeleton = skeleton_of(free, cell_m, config.freespace_clearance_m, config.thinning)
    return sample_evenly(cells_of(skeleton), config.freespace_spacing_m / cell_m) * block + block // 2


def _all_in_blocks(mask: BoolGrid, block: int) -> BoolGrid:
    """Whether all cells of each block x block square are set; a rest at the far edges is left out."""
    height, width = mask.shape[0] // block * block, mask.shape[1] // block * block
    rows = functools.reduce(np.logical_and, [mask[k:height:block] for k in range(block)])
    return np.asarray(functools.reduce(np.logical_and, [rows[:, k:width:block] for k in range(block)]))


def adjacency(nodes: I64, occupied: BoolGrid, resolution_m: float, config: SignatureConfig) -> F32:
    """The matrix A (N, N) of III-C 2: straight distance in metres, inf where an occupied cell is between.

    Unknown cells do not block, as printed. Distances beyond `config.freespace_join_m` are inf too.
    """
    reach_m = math.inf if config.freespace_join_m is None else config.freespace_join_m
    return _adjacency(
        np.ascontiguousarray(nodes, np.int64), np.ascontiguousarray(occupied), reach_m / resolution_m
    ) * np.float32(resolution_m)


def freespace_graph(submap: Submap, config: SignatureConfig = SignatureConfig()) -> nx.Graph:
    """The undirected graph G(V, E) of III-C 2.

    Nodes are numbered from 0 and carry `center_m` (x, y in the map frame); edges carry `length_m`.
    """
    import networkx as nx

    nodes = freespace_nodes(submap, config)
    weights = adjacency(nodes, submap.grid.cells >= config.occupied_percent, submap.grid.resolution_m, config)
    graph = nx.Graph()
    for i, (x, y) in enumerate(submap.grid.to_point(nodes)):
        graph.add_node(i, center_m=(float(x), float(y)))
    for i, j in zip(*np.nonzero(np.triu(np.isfinite(weights), 1)), strict=True):
        graph.add_edge(int(i), int(j), length_m=float(weights[i, j]))
    return graph


def shortest_paths(weights: F32) -> F32:
    """Shortest path lengths L^F (N, N) from an adjacency matrix (N, N), Eq. 3; inf where there is no way.

    The paper names Dijkstra's algorithm. On a graph where every pair in sight is joined, Floyd-Warshall
    over the dense matrix gives the same lengths faster (tests compare with networkx's Dijkstra).
    """
    lengths = np.array(weights, np.float32, order="C")
    _floyd_warshall(lengths)
    return lengths


def freespace_bins(radius_m: float, config: SignatureConfig) -> int:
    """N_hf = ceil(4 r / delta_f)."""
    return math.ceil(4 * radius_m / config.freespace_bin_m - 1e-9)


def freespace_histogram(lengths_m: F32, radius_m: float, config: SignatureConfig) -> F32:
    """Path lengths of all pairs of nodes as a histogram H^f, Eq. 4.

    lengths_m : (N, N). Returns (N_hf,), sum 1; all 0 if no two nodes are connected. Pairs without a way do
    not count; ways longer than 4 r count in the last bin.
    """
    return normalized(
        _length_counts(lengths_m, 1.0 / config.freespace_bin_m, freespace_bins(radius_m, config))
    )


@numba.njit(cache=True)
def _walled_off(occupied: NDArray[np.bool_], width: int, r0: int, c0: int, r1: int, c1: int) -> bool:
    """Whether a few of the cells on the straight line between two cell centres show that it is blocked.

    Every `_STRIDE`-th column (or row, if there are more) is looked at where the line passes its middle. On a
    border of two cells either will do: it passes through both.
    """
    dr, dc = r1 - r0, c1 - c0
    major, minor = abs(dc), abs(dr)
    ahead, aside = (1 if dc > 0 else -1), (width if dr > 0 else -width)
    if minor > major:
        major, minor, ahead, aside = minor, major, aside, ahead
    slope = int(minor / max(major, 1) * 4294967296.0) * _STRIDE
    at, beside = r0 * width + c0, 2147483648
    for _ in range(major // _STRIDE):
        at += ahead * _STRIDE
        beside += slope
        if occupied[np.uint64(at + (beside >> 32) * aside)]:
            return True
    return False


@numba.njit(cache=True)
def _in_sight(occupied: NDArray[np.bool_], width: int, r0: int, c0: int, r1: int, c1: int) -> bool:
    """Whether the straight line between two cell centres meets no occupied cell; `occupied` row by row.

    Visits every cell the line passes through, so it cannot slip through a wall one pixel wide; a line
    through the very corner of four cells is blocked only if both cells beside the corner are occupied.
    """
    dr, dc = abs(r1 - r0), abs(c1 - c0)
    down, across = (width if r1 > r0 else -width), (1 if c1 > c0 else -1)
    at, end = np.uint64(r0 * width + c0), np.uint64(r1 * width + c1)
    lead = dr - dc  # > 0: the next border crossed is a row's
    while True:
        if occupied[at]:
            return False
        if at == end:
            return True
        if lead != 0:
            # By arithmetic: which border comes next is as good as random, and a wrong guess costs more.
            row = int(lead > 0)
            at += np.uint64(across + row * (down - across))
            lead += 2 * (dr - row * (dr + dc))
        else:
            if occupied[at + np.uint64(down)] and occupied[at + np.uint64(across)]:
                return False
            at += np.uint64(down + across)
            lead += 2 * (dr - dc)


@numba.njit(cache=True)
def _adjacency(nodes: NDArray[np.int64], occupied: NDArray[np.bool_], reach: float) -> NDArray[np.float32]:
    n, flat, width = len(nodes), occupied.reshape(-1), occupied.shape[1]
    weights = np.full((n, n), np.float32(np.inf), np.float32)
    for i in range(n):
        weights[i, i] = 0.0
        r0, c0 = nodes[i]
        for j in range(i + 1, n):
            r1, c1 = nodes[j]
            d = math.sqrt((r1 - r0) ** 2 + (c1 - c0) ** 2)
            if d > reach or _walled_off(flat, width, r0, c0, r1, c1):
                continue
            if _in_sight(flat, width, r0, c0, r1, c1):
                weights[i, j] = d
                weights[j, i] = d
    return weights


@numba.njit(cache=True, fastmath={"nnan"})
def _floyd_warshall(lengths: NDArray[np.float32]) -> None:
    """In place, for lengths (N, N) that are the same both ways: of each pair one half is worked on."""
    n = len(lengths)
    via = np.empty(n, np.float32)
    for k in range(n):
        via[:k] = lengths[k, :k]
        for i in range(k, n):
            via[i] = lengths[i, k]
        for i in range(n):
            first = via[i]
            if i == k or first == np.float32(np.inf):
                continue
            row = lengths[i, :i]
            for j in range(len(row)):
                total = first + via[j]
                row[j] = total if total < row[j] else row[j]
    for i in range(n):
        for j in range(i):
            lengths[j, i] = lengths[i, j]


@numba.njit(cache=True)
def _length_counts(lengths: NDArray[np.float32], bins_per_m: float, bins: int) -> NDArray[np.int64]:
    counts = np.zeros(bins, np.int64)
    n = len(lengths)
    for i in range(n):
        for j in range(i + 1, n):
            if lengths[i, j] < np.inf:
                # 1e-5 exceeds float32's rounding at tens of metres: a length on an edge goes up.
                counts[min(int(lengths[i, j] * bins_per_m + 1e-5), bins - 1)] += 1
    return counts
