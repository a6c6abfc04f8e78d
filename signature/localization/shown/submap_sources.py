"""Where the signatures of a submap come from, as plain data for the page: points, a graph and two axes.

Positions are cells of the submap's grid, x before y; the page turns them into metres of the map frame.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from signature.boundary import boundary_edges, boundary_points
from signature.freespace import freespace_nodes, visibility_graph
from signature.similarity import score_matrix
from signature.symmetry import line_segments, symmetry_axes

if TYPE_CHECKING:
    import networkx as nx

    from pc2grid.arrays import I64
    from pc2grid.config import PartitionConfig
    from pc2grid.model import Submap
    from signature.config import SignatureConfig
    from signature.similarity import SignatureTable

_SIMILAR = 5
"""So many most similar places are listed for each submap; chosen by hand."""


def sources(submap: Submap, config: SignatureConfig) -> dict[str, Any]:
    """What the three histograms and scores of a submap are computed from (paper III-B to III-D).

    corner, cell_m : the lower left corner of the submap's grid in the map frame, and the size of its cells.
    boundary : the boundary points. nodes, edges : the free-space graph, see `joined_pairs`.
    axes : directions of the symmetry axes alpha and beta, radians; empty if there is none.
    """
    grid = submap.grid
    edges = boundary_edges(submap, config)
    nodes = freespace_nodes(submap, config)
    axes = symmetry_axes(line_segments(edges, grid.resolution_m, config), config)
    return {
        "corner": [round(float(v), 4) for v in grid.origin_m],
        "cell_m": grid.resolution_m,
        "boundary": _columns_first(boundary_points(edges, grid.resolution_m, config)),
        "nodes": _columns_first(nodes),
        "edges": joined_pairs(visibility_graph(grid, nodes, config)),
        "axes": [] if axes is None else [round(angle, 4) for angle in axes],
    }


def joined_pairs(graph: nx.Graph) -> str:
    """The edges of a graph with nodes 0 .. N - 1 as bits, base64: whether i < j are joined, (0, 1) first.

    A graph of lines of sight has so many edges that a list of them would be the largest part of the page.
    """
    first, second = np.triu_indices(len(graph), 1)
    pairs = zip(first.tolist(), second.tolist(), strict=True)
    bits = np.fromiter((graph.has_edge(i, j) for i, j in pairs), np.bool_, len(first))
    return base64.b64encode(np.packbits(bits, bitorder="little").tobytes()).decode()


def similar_places(
    table: SignatureTable, rows: Sequence[int], partition: PartitionConfig, config: SignatureConfig
) -> list[list[tuple[int, float]]]:
    """For each of these rows of a table the most similar places elsewhere: (row, score of Eq. 6), best first.

    Submaps of the same session whose centre is nearer than the radius show the same walls and are left out.
    """
    found = []
    for row in rows:
        one = slice(row, row + 1)
        scores = score_matrix(table.boundary[one], table.freespace[one], table.symmetry[one], table, config)[
            0
        ]
        near = np.hypot(*(table.center_m - table.center_m[row]).T) < partition.radius_m
        scores[near & (table.session_index == table.session_index[row])] = np.inf
        best = np.argsort(scores, kind="stable")[:_SIMILAR]
        found.append([(int(k), float(scores[k])) for k in best if np.isfinite(scores[k])])
    return found


def _columns_first(cells: I64) -> list[int]:
    """Cells (N, 2) as (row, column) in one list: x, y, x, y, ..."""
    return [int(v) for v in cells[:, ::-1].ravel()]
