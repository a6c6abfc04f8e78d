"""The junction graph of the free space of a map: junctions, ends, and the ways between them (paper III-A).

The graph is a `networkx.Graph`. Nodes are numbered from 0 and carry

- `kind`: "junction" (a cluster of junction pixels, DBSCAN of III-A) or "end" (where a way ends);
- `center_m`: (x, y) in the map frame; of a junction, its pixel nearest to the mean of the cluster;
- `pixels`: how many skeleton pixels DBSCAN merged.

Edges carry `length_m`, along the skeleton, and `path_m` (K, 2) float32, the pixels of the way in the map
frame, from the node with the lower number to the other one. Of several ways between the same two places the
shortest is kept; ways that lead back to the same place are left out.

It is made from a skeleton one pixel wide, which III-B 2 and III-C 1 need, too. The paper names a thinning
algorithm for each use but not which one; both classical parallel algorithms are here. scikit-image's were
compared on the five maps of Table I and not taken: `skeletonize` keeps up to twice as many junction pixels as
the rules that Zhang and Suen print (killian: 269 against 137, so more submaps than Table I has) and needs 4
to 25 times as long; `thin` (Guo and Hall) needs 80 to 300 times as long.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, combinations
from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, I64, BoolGrid
from pc2grid.libraries import compiled
from pc2grid.model import OccupancyGrid
from pc2grid.settings import PartitionConfig, Thinning

if TYPE_CHECKING:
    import networkx as nx


def junction_graph(grid: OccupancyGrid, config: PartitionConfig = PartitionConfig()) -> nx.Graph:
    """Return the junction graph of a map; without free space it has no nodes.

    >>> import pc2grid
    >>> graph = junction_graph(pc2grid.load_map("map.yaml"))
    >>> kinds = {kind for _, kind in graph.nodes(data="kind")}
    >>> kinds <= {"junction", "end"}, all(length > 0 for _, _, length in graph.edges(data="length_m"))
    (True, True)
    """
    return graph_of_skeleton(map_skeleton(grid, config), grid, config)


def map_skeleton(grid: OccupancyGrid, config: PartitionConfig) -> BoolGrid:
    """Return the edge map M^E of III-A (H, W): only the major free space, one pixel wide."""
    return skeleton_of(grid.ground, grid.resolution_m, config.clearance_m, config.thinning)


def graph_of_skeleton(skeleton: BoolGrid, grid: OccupancyGrid, config: PartitionConfig) -> nx.Graph:
    """Return the junction graph of a skeleton (H, W) of the grid's free space."""
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
    """Cluster some of the pixels (P, 2) by DBSCAN; `chosen` holds their numbers.

    Every pixel is a core point (`min_samples=1`): a single pixel is a junction, too. The clusters of DBSCAN
    are then the connected components of the pixels that lie at most `radius_cells` apart. Returns for each
    cluster the number of the member nearest to its mean and the numbers of all members. The mean itself may
    lie in a wall; the member nearest to it lies on the skeleton.
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
    """Yield the ways between places: their pixels, from a pixel of one place to one of another, and their
    length.

    place_of : (P,) node of each pixel, or -1. steps, lengths : of `pixel_steps`.

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
    contacts, ways_begin = order[new_contact], np.flatnonzero(np.diff(way[new_contact]))
    pairs = (combinations(of_way, 2) for of_way in np.split(contacts, ways_begin + 1))
    for a, b in chain.from_iterable(pairs):
        path = _join(_back(way_pixel[a], previous), _back(way_pixel[b], previous))
        length = distance[path[0]] + distance[path[-1]] - 2 * distance[path].min()
        ends = lengths[touching[a]] + lengths[touching[b]]
        yield [int(place_pixel[a]), *path, int(place_pixel[b])], float(length + ends)


def _back(pixel: int, previous: NDArray[np.int32]) -> list[int]:
    """Return the pixels from one pixel of a way back to the source of the way."""
    path = [int(pixel)]
    while (before := int(previous[path[-1]])) >= 0:
        path.append(before)
    return path


def _join(a: list[int], b: list[int]) -> list[int]:
    """Return the path from a[0] to b[0] through the point where two paths to the same source meet."""
    while len(a) > 1 and len(b) > 1 and a[-2] == b[-2]:
        a, b = a[:-1], b[:-1]
    return a + b[-2::-1]


# --- skeletons ----------------------------------------------------------------------------------------

# Neighbours clockwise from north: bit k of a code is neighbour k.
_NEIGHBOURS = [tuple((code >> k) & 1 for k in range(8)) for code in range(256)]


def skeleton_of(
    free: BoolGrid, resolution_m: float, clearance_m: float, thinning: Thinning = "guo_hall"
) -> BoolGrid:
    """Return the middle lines of free space: distance transform, erosion by `clearance_m`, thinning (III-A).

    free : (H, W) cells known to be free. Returns (H, W).
    """
    return thin(clearance_of(free, resolution_m) > clearance_m, thinning)


def clearance_of(free: BoolGrid, resolution_m: float) -> NDArray[np.float32]:
    """Return the distance (H, W) in metres from every free cell's centre to the nearest cell that is not
    free.

    What lies outside the array is not free. Precise to about 2 % (5x5 chamfer distance).
    """
    padded = np.pad(free, 1).astype(np.uint8)
    distance_m = np.asarray(cv2.distanceTransform(padded, cv2.DIST_L2, 5), np.float32)
    distance_m *= np.float32(resolution_m)
    return distance_m[1:-1, 1:-1]


def thin(mask: BoolGrid, thinning: Thinning = "guo_hall") -> BoolGrid:
    """Reduce an area (H, W) to lines one pixel wide, with the same connections.

    guo_hall (default) leaves neither 2x2 blocks nor stairs on slanted lines, so that a line's pixels have
    two neighbours whatever its direction; zhang_suen leaves both, and erases slanted lines two pixels wide.
    """
    image = np.pad(mask, 1).astype(np.uint8)
    border = np.flatnonzero(image != cv2.erode(image, np.ones((3, 3), np.uint8)))
    thin_in_place(image.reshape(-1), _neighbour_steps(image.shape[1]), border, _DELETABLE[thinning])
    return image[1:-1, 1:-1].view(np.bool_)


def junctions_and_ends(skeleton: BoolGrid, pixels: I64) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks (N,) of the skeleton's pixels (N, 2) that are junctions, and of those that end a branch.

    A junction (III-A) is a pixel where three or more branches meet; an end has one neighbour.
    """
    image = np.pad(skeleton, 1).view(np.uint8)
    at = (pixels + 1) @ np.array([image.shape[1], 1])
    neighbours = image.reshape(-1)[at[:, None] + _neighbour_steps(image.shape[1])]
    codes = np.packbits(neighbours, axis=1, bitorder="little").reshape(-1)
    return _JUNCTION[codes], _END[codes]


def pixel_steps(skeleton: BoolGrid) -> tuple[I64, I64, F64]:
    """Return the pixels of a skeleton and the steps between 8-neighbours.

    The pixels (P, 2) are (row, column), row by row; the steps (S, 2) pairs of pixel numbers; the length (S,)
    of each step is in cells, 1 or sqrt(2). A diagonal step is left out where two straight steps lead the same
    way, so that a corner does not become a triangle.
    """
    image = np.pad(skeleton, 1)
    width = image.shape[1]
    flat = image.reshape(-1)
    at = np.flatnonzero(flat)
    firsts, seconds, lengths = [], [], []
    for step, length in ((1, 1.0), (width, 1.0), (width - 1, 2**0.5), (width + 1, 2**0.5)):
        joined = flat[at + step]
        if length > 1.0:
            joined &= ~(flat[at + width] | flat[at + step - width])
        firsts.append(np.flatnonzero(joined))
        seconds.append(np.searchsorted(at, at[joined] + step))
        lengths.append(np.full(len(firsts[-1]), length))
    steps = np.column_stack((np.concatenate(firsts), np.concatenate(seconds)))
    return np.column_stack(np.divmod(at, width)) - 1, steps, np.concatenate(lengths)


def _neighbour_steps(width: int) -> I64:
    """Return the steps (8,) from a pixel of an image, row by row, to its neighbours, in the order of the
    codes."""
    return np.array([-width, 1 - width, 1, width + 1, width, width - 1, -1, -width - 1], np.int64)


def _guo_hall(p: tuple[int, ...], half: int) -> bool:
    """Return True if a pixel with neighbours p is deleted in this half of an iteration (Guo and Hall
    1989)."""
    n, ne, e, se, s, sw, w, nw = p
    # Number of groups of connected neighbours.
    groups = ((1 - n) & (ne | e)) + ((1 - e) & (se | s)) + ((1 - s) & (sw | w)) + ((1 - w) & (nw | n))
    pairs = min((nw | n) + (ne | e) + (se | s) + (sw | w), (n | ne) + (e | se) + (s | sw) + (w | nw))
    side = (s | sw | (1 - nw)) & w if half == 0 else (n | ne | (1 - se)) & e
    return groups == 1 and 2 <= pairs <= 3 and not side


def _zhang_suen(p: tuple[int, ...], half: int) -> bool:
    """Return True if a pixel with neighbours p is deleted in this half of an iteration (Zhang and Suen
    1984)."""
    n, _, e, _, s, _, w, _ = p
    three = (n & e & s) | (e & s & w) if half == 0 else (n & e & w) | (n & s & w)
    return _crossings(p) == 1 and 2 <= sum(p) <= 6 and not three


def _crossings(p: tuple[int, ...]) -> int:
    """Count the changes from 0 to 1 around the ring of neighbours."""
    return sum(1 - p[k] and p[(k + 1) % 8] for k in range(8))


_DELETABLE: dict[str, NDArray[np.bool_]] = {
    name: np.array([[rule(p, half) for p in _NEIGHBOURS] for half in (0, 1)])
    for name, rule in (("guo_hall", _guo_hall), ("zhang_suen", _zhang_suen))
}
_JUNCTION = np.array([_crossings(p) >= 3 or sum(p[::2]) >= 3 for p in _NEIGHBOURS])
_END = np.array([sum(p) == 1 for p in _NEIGHBOURS])


@compiled()
def thin_in_place(flat: NDArray[np.uint8], steps: I64, border: I64, deletable: NDArray[np.bool_]) -> None:
    """Thin a 0/1 image in place.

    In each half of an iteration all pixels are tested on the same image, and those that may go are deleted
    together. A pixel is tested again only if a neighbour of it has gone.

    flat : the image row by row, with a border of zeros. steps : (8,) to the neighbours of a pixel. border :
    indices of the set pixels that have a zero neighbour. deletable : (2, 256), by half of an iteration and
    neighbour code.

    Measured: 20 times as fast as the numpy form on a whole map (killian, 20 million cells: 0.12 against 2.6
    s) and 20 to 30 times on one submap (0.2 against 4 ms for its boundary, 0.16 against 5 ms for its free
    space), both of which every description needs.
    """
    # In how many halves of an iteration a pixel still has to be tested: two after a neighbour has gone.
    pending = np.zeros(len(flat), np.uint8)
    # One entry more than there are pixels: what is written behind the last one is not read.
    set_pixels = np.count_nonzero(flat)
    waiting, gone = np.empty(set_pixels + 1, np.int64), np.empty(set_pixels, np.int64)
    count, half = len(border), 0
    waiting[:count] = border
    pending[border] = 2
    while count > 0:
        left, losses = 0, 0
        for k in range(count):
            i = waiting[k]
            code = 0
            for n in range(8):
                code |= int(flat[i + steps[n]]) << n
            if deletable[half, code]:
                pending[i] = 0
                gone[losses] = i
                losses += 1
            else:
                pending[i] -= 1
                waiting[left] = i
                left += pending[i]
        count = left
        for k in range(losses):
            flat[gone[k]] = 0
        for k in range(losses):
            for n in range(8):
                j = gone[k] + steps[n]
                waiting[count] = j
                count += int((flat[j] != 0) & (pending[j] == 0))
                pending[j] = 2 * flat[j]
        half = 1 - half


# --- even sampling of points (III-B 3, III-C 1) -------------------------------------------------------

Number = TypeVar("Number", np.int64, np.float64)
ROUNDING = 1e-6
"""By so much, as a share, a distance may be wrong by rounding: points exactly one spacing apart are both
kept. It exceeds the rounding of float64 and is less than what unequal distances of cells differ by."""
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
    reach = spacing * (1.0 - ROUNDING)
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
