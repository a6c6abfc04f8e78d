"""The free space of a map as a graph: places where ways meet or end, and the ways between them (III-A).

The graph is a `networkx.Graph`. Nodes are numbered from 0 and carry

- `kind`: "junction" (a cluster of junction pixels, DBSCAN of III-A) or "end" (where a way ends);
- `center_m`: (x, y) in the map frame; of a junction, its pixel nearest to the mean of the cluster;
- `pixels`: how many skeleton pixels DBSCAN merged.

Edges carry `length_m`, along the skeleton, and `path_m` (K, 2) float32, the pixels of the way in the map
frame, from the node with the lower number to the other one. Of several ways between the same two places the
shortest is kept; ways that lead back to the same place are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, BoolGrid, freeze
from pc2grid.config import PartitionConfig
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.skeleton import junctions_and_ends, pixel_steps, skeleton_of

if TYPE_CHECKING:
    import networkx as nx

KINDS = ("junction", "end")
"""What a node may be; `GraphArrays.kind` counts from 0 in this order."""


def junction_graph(grid: OccupancyGrid, config: PartitionConfig = PartitionConfig()) -> nx.Graph:
    """The junction graph of a map; without free space it has no nodes.

    >>> import pc2grid
    >>> graph = junction_graph(pc2grid.load_map("map.yaml"))
    >>> kinds = {kind for _, kind in graph.nodes(data="kind")}
    >>> kinds <= {"junction", "end"}, all(length > 0 for _, _, length in graph.edges(data="length_m"))
    (True, True)
    """
    return graph_of_skeleton(map_skeleton(grid, config), grid, config)


def map_skeleton(grid: OccupancyGrid, config: PartitionConfig) -> BoolGrid:
    """The edge map M^E of III-A (H, W): only the major free space, one pixel wide."""
    return skeleton_of(grid.ground, grid.resolution_m, config.clearance_m, config.thinning)


def graph_of_skeleton(skeleton: BoolGrid, grid: OccupancyGrid, config: PartitionConfig) -> nx.Graph:
    """The junction graph of a skeleton (H, W) of the grid's free space."""
    import networkx as nx

    pixels, steps, lengths = pixel_steps(skeleton)
    is_junction, is_end = junctions_and_ends(skeleton, pixels)
    members = clusters(pixels, np.flatnonzero(is_junction), config.cluster_m / grid.resolution_m)
    places = [("junction", middle, cluster) for middle, cluster in members]
    places += [("end", end, np.array([end])) for end in np.flatnonzero(is_end).tolist()]

    graph = nx.Graph()
    points_m = grid.to_point(pixels)
    place_of = np.full(len(pixels), -1)  # number of the node that a pixel belongs to; -1: to a way
    for node, (kind, middle, cluster) in enumerate(places):
        x, y = points_m[middle].tolist()
        graph.add_node(node, kind=kind, center_m=(x, y), pixels=len(cluster))
        place_of[cluster] = node
    for path, length in _ways(place_of, steps, lengths):
        a, b = (int(place_of[end]) for end in (path[0], path[-1]))
        length_m = length * grid.resolution_m
        if not graph.has_edge(a, b) or graph.edges[a, b]["length_m"] > length_m:
            path_m = points_m[path if a < b else path[::-1]].astype(np.float32)
            graph.add_edge(min(a, b), max(a, b), length_m=length_m, path_m=path_m)
    return graph


def clusters(pixels: I64, chosen: I64, radius_cells: float) -> list[tuple[int, I64]]:
    """DBSCAN over some of the pixels (P, 2): `chosen` holds their numbers.

    Every pixel is a core point (`min_samples=1`): a junction seen in one pixel is a junction. The clusters of
    DBSCAN are then the connected components of the pixels that lie at most `radius_cells` apart. Returns for
    each cluster the number of the member nearest to its mean and the numbers of all members. The mean itself
    may lie in a wall; the member nearest to it lies on the skeleton.
    """
    if not len(chosen):
        return []
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    first, second = cKDTree(pixels[chosen]).query_pairs(radius_cells, output_type="ndarray").T
    near = coo_array((np.ones(len(first), bool), (first, second)), shape=(len(chosen), len(chosen)))
    labels = connected_components(near, directed=False)[1]
    order = np.argsort(labels, kind="stable")
    found = []
    for members in np.split(chosen[order], np.cumsum(np.bincount(labels))[:-1]):
        distances = np.linalg.norm(pixels[members] - pixels[members].mean(axis=0), axis=1)
        found.append((int(members[np.argmin(distances)]), members))
    return found


def _ways(place_of: I64, steps: I64, lengths: F64) -> Iterator[tuple[list[int], float]]:
    """The ways between places: their pixels, from a pixel of one place to one of another, and their length.

    place_of : (P,) node of each pixel, or -1. steps, lengths : as `pixel_steps` gives them.

    A way is a connected component of the skeleton without the places, or a single step between two places.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, dijkstra

    first, second = steps.T
    at_place = place_of[steps] >= 0
    between = at_place.all(axis=1) & (place_of[first] != place_of[second])
    for a, b, length in zip(first[between].tolist(), second[between].tolist(), lengths[between], strict=True):
        yield [a, b], float(length)

    inside = ~at_place.any(axis=1)
    shape = (len(place_of), len(place_of))
    ways = coo_array((lengths[inside], (first[inside], second[inside])), shape=shape).tocsr()
    component = connected_components(ways, directed=False)[1]
    # Contacts: steps from a pixel of a way to a pixel of a place; the shortest one to each place counts.
    touching = np.flatnonzero(at_place[:, 0] != at_place[:, 1])
    swapped = at_place[touching, 0]
    way_pixel = np.where(swapped, second[touching], first[touching])
    place_pixel = np.where(swapped, first[touching], second[touching])
    way, node = component[way_pixel], place_of[place_pixel]
    order = np.lexsort((lengths[touching], node, way))
    way, node, order = way[order], node[order], order
    new_way = np.diff(way, prepend=-1) != 0
    new_contact = new_way | (np.diff(node, prepend=-1) != 0)
    # From one pixel of each way, where it touches its first place, along the way.
    sources = way_pixel[order[new_way]]
    if not len(sources):
        return
    distance, previous, _ = dijkstra(
        ways, directed=False, indices=sources, min_only=True, return_predecessors=True
    )
    contacts = order[new_contact]
    for start, end in _pairs(way[new_contact]):
        a, b = contacts[start], contacts[end]
        path = _join(_back(way_pixel[a], previous), _back(way_pixel[b], previous))
        length = distance[path[0]] + distance[path[-1]] - 2 * distance[path].min()
        ends = lengths[touching[a]] + lengths[touching[b]]
        yield [int(place_pixel[a]), *path, int(place_pixel[b])], float(length + ends)


def _pairs(groups: I64) -> Iterator[tuple[int, int]]:
    """All pairs of positions with the same value in a sorted array (N,)."""
    starts = np.flatnonzero(np.diff(groups, prepend=-1, append=-1))
    for start, stop in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        for a in range(start, stop):
            for b in range(a + 1, stop):
                yield a, b


def _back(pixel: int, previous: NDArray[np.int32]) -> list[int]:
    """The pixels from one pixel of a way back to the source of the way."""
    path = [int(pixel)]
    while (before := int(previous[path[-1]])) >= 0:
        path.append(before)
    return path


def _join(a: list[int], b: list[int]) -> list[int]:
    """The path from a[0] to b[0] through where two paths to the same source meet."""
    while len(a) > 1 and len(b) > 1 and a[-2] == b[-2]:
        a, b = a[:-1], b[:-1]
    return a + b[-2::-1]


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphArrays:
    """A junction graph as plain arrays, to be stored.

    center_m : (N, 2) float64. kind : (N,) uint8, index into `KINDS`. pixels : (N,) int32.
    edges : (E, 2) int32, numbers of nodes, the lower one first. length_m : (E,) float64.
    path_start : (E + 1,) int64; `path_m[path_start[e]:path_start[e + 1]]` is the way of edge e.
    path_m : (K, 2) float32.
    """

    center_m: F64
    kind: NDArray[np.uint8]
    pixels: NDArray[np.int32]
    edges: NDArray[np.int32]
    length_m: F64
    path_start: I64
    path_m: F32

    def __post_init__(self) -> None:
        nodes, edges = len(self.kind), len(self.length_m)
        freeze(self, "center_m", np.float64, (nodes, 2))
        freeze(self, "kind", np.uint8, (nodes,))
        freeze(self, "pixels", np.int32, (nodes,))
        freeze(self, "edges", np.int32, (edges, 2))
        freeze(self, "length_m", np.float64, (edges,))
        freeze(self, "path_start", np.int64, (edges + 1,))
        freeze(self, "path_m", np.float32, (None, 2))


def graph_to_arrays(graph: nx.Graph) -> GraphArrays:
    """A junction graph as arrays; `graph_from_arrays` gives the same graph back."""
    nodes = [graph.nodes[node] for node in range(len(graph))]
    edges = [(min(a, b), max(a, b), way) for a, b, way in graph.edges(data=True)]
    paths = [np.asarray(way["path_m"], np.float32).reshape(-1, 2) for _, _, way in edges]
    return GraphArrays(
        center_m=np.array([node["center_m"] for node in nodes], np.float64).reshape(-1, 2),
        kind=np.array([KINDS.index(node["kind"]) for node in nodes], np.uint8),
        pixels=np.array([node["pixels"] for node in nodes], np.int32),
        edges=np.array([(a, b) for a, b, _ in edges], np.int32).reshape(-1, 2),
        length_m=np.array([way["length_m"] for _, _, way in edges], np.float64),
        path_start=np.cumsum([0, *map(len, paths)], dtype=np.int64),
        path_m=np.concatenate((np.empty((0, 2), np.float32), *paths)),
    )


def graph_from_arrays(arrays: GraphArrays) -> nx.Graph:
    """The junction graph that `graph_to_arrays` was given.

    Raises ValueError if the arrays are no junction graph: a kind that does not exist, an edge to a node that
    does not exist, from a node to itself or given twice, a length that is not positive, numbers that are not
    finite, paths that do not follow each other.
    """
    import networkx as nx

    nodes, starts = len(arrays.kind), arrays.path_start
    edges = arrays.edges.tolist()
    positive = np.isfinite(arrays.length_m) & (arrays.length_m > 0)
    valid = {
        "kind": (arrays.kind < len(KINDS)).all(),
        "edges": all(0 <= a < b < nodes for a, b in edges) and len(set(map(tuple, edges))) == len(edges),
        "center_m": np.isfinite(arrays.center_m).all(),
        "length_m": positive.all(),
        "path_start": starts[0] == 0 and starts[-1] == len(arrays.path_m) and (np.diff(starts) >= 0).all(),
        "path_m": np.isfinite(arrays.path_m).all(),
    }
    for name, good in valid.items():
        if not good:
            raise ValueError(f"GraphArrays.{name}: not that of a junction graph")
    graph = nx.Graph()
    about = zip(arrays.kind.tolist(), arrays.center_m.tolist(), arrays.pixels.tolist(), strict=True)
    for node, (kind, (x, y), pixels) in enumerate(about):
        graph.add_node(node, kind=KINDS[kind], center_m=(x, y), pixels=pixels)
    for k, ((a, b), length_m) in enumerate(zip(edges, arrays.length_m.tolist(), strict=True)):
        graph.add_edge(a, b, length_m=length_m, path_m=arrays.path_m[starts[k] : starts[k + 1]])
    return graph
