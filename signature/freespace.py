"""Free-space histogram: the lengths of the shortest paths between the places of a submap (paper III-C)."""

from __future__ import annotations

import functools
import math
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import F32, F64, I64, BoolGrid, cells_of
from pc2grid.model import OccupancyGrid, Submap
from pc2grid.submaps.sampling import sample_evenly
from pc2grid.submaps.skeleton import skeleton_of
from signature.boundary import ROUNDING_BINS, normalized
from signature.config import SignatureConfig

if TYPE_CHECKING:
    import networkx as nx


def freespace_nodes(submap: Submap, config: SignatureConfig) -> I64:
    """Free-space nodes V^F (N, 2) as (row, column): evenly sampled pixels of the skeleton (III-C 1).

    The skeleton is computed on blocks of cells, `config.freespace_cell_m` wide; a block is free if all its
    cells are. A finer skeleton would not move nodes that lie far apart, and thinning is expensive.
    """
    grid = submap.grid
    block = max(1, round(config.freespace_cell_m / grid.resolution_m))
    free = _all_in_blocks(grid.free, block)
    cell_m = block * grid.resolution_m
    skeleton = skeleton_of(free, cell_m, config.freespace_clearance_m, config.thinning)
    return sample_evenly(cells_of(skeleton), config.freespace_spacing_m / cell_m) * block + block // 2


def _all_in_blocks(mask: BoolGrid, block: int) -> BoolGrid:
    """Whether all cells of each block x block square are set; incomplete blocks at the edges are dropped."""
    height, width = mask.shape[0] // block * block, mask.shape[1] // block * block
    rows = functools.reduce(np.logical_and, [mask[k:height:block] for k in range(block)])
    return np.asarray(functools.reduce(np.logical_and, [rows[:, k:width:block] for k in range(block)]))


def freespace_graph(submap: Submap, config: SignatureConfig = SignatureConfig()) -> nx.Graph:
    """The undirected graph G(V, E) of III-C 2: free-space nodes, joined where they see each other."""
    return visibility_graph(submap.grid, freespace_nodes(submap, config), config)


def visibility_graph(
    grid: OccupancyGrid, cells: I64, config: SignatureConfig = SignatureConfig()
) -> nx.Graph:
    """Places (N, 2) of a grid, as (row, column), joined by straight lines that meet no occupied cell.

    Nodes are numbered from 0 and carry `center_m` (x, y in the map frame); edges carry `length_m`. The edges
    are the finite elements of the matrix A of III-C 2. Unknown cells do not block, as in the paper. Lines
    longer than `config.freespace_join_m` are left out.
    """
    import networkx as nx
    from scipy.spatial.distance import pdist

    from signature import _kernels

    graph = nx.Graph()
    graph.add_nodes_from(
        (node, {"center_m": (x, y)}) for node, (x, y) in enumerate(grid.to_point(cells).tolist())
    )
    if len(cells) < 2:
        return graph
    # Both list the pairs i < j in the same order.
    first, second = np.triu_indices(len(cells), 1)
    length_m = pdist(cells) * grid.resolution_m
    if config.freespace_join_m is not None:
        near = length_m <= config.freespace_join_m
        first, second, length_m = first[near], second[near], length_m[near]
    occupied = np.ascontiguousarray(grid.occupied)
    joined = _kernels.in_sight(occupied, np.ascontiguousarray(cells), first, second)
    graph.add_weighted_edges_from(
        zip(first[joined].tolist(), second[joined].tolist(), length_m[joined].tolist(), strict=True),
        weight="length_m",
    )
    return graph


def shortest_paths(graph: nx.Graph) -> F64:
    """Lengths L^F (N, N) in metres of the shortest paths between all nodes, Eq. 3; inf where there is none.

    graph : nodes numbered from 0, edges with `length_m`. The paper names Dijkstra's algorithm. Floyd and
    Warshall's finds the same lengths; with as many edges as a submap has, it takes half the time (2.3 against
    4.4 ms for 147 nodes and 1,624 edges, both by scipy).
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import floyd_warshall

    if not graph:
        return np.empty((0, 0))
    neighbours = [edges for _, edges in graph.adjacency()]
    lengths_m = [edge["length_m"] for edges in neighbours for edge in edges.values()]
    ends = np.fromiter(chain.from_iterable(neighbours), np.int32, len(lengths_m))
    starts = np.cumsum([0, *map(len, neighbours)], dtype=np.int32)
    weights = csr_array((np.array(lengths_m, np.float64), ends, starts), shape=(len(graph), len(graph)))
    return np.asarray(floyd_warshall(weights), np.float64)


def freespace_bins(radius_m: float, config: SignatureConfig) -> int:
    """N_hf = ceil(4 r / delta_f)."""
    return math.ceil(4 * radius_m / config.freespace_bin_m - 1e-9)


def freespace_histogram(lengths_m: F64, radius_m: float, config: SignatureConfig) -> F32:
    """Path lengths of all pairs of nodes as a histogram H^f, Eq. 4.

    lengths_m : (N, N). Returns (N_hf,) float32, sum 1; all 0 if no two nodes are connected. Pairs without a
    path do not count; paths longer than 4 r count in the last bin.
    """
    bins = freespace_bins(radius_m, config)
    pairs = lengths_m[np.triu_indices(len(lengths_m), 1)]
    length_bins = pairs[np.isfinite(pairs)] / config.freespace_bin_m + ROUNDING_BINS
    return normalized(np.bincount(np.minimum(length_bins.astype(np.int64), bins - 1), minlength=bins))
