"""A map's division into submaps around the junctions of its free space (paper III-A)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pc2grid.config import PartitionConfig
from pc2grid.geometry import F64
from pc2grid.model import I64, UNKNOWN, BoolGrid, OccupancyGrid, Submap
from pc2grid.skeleton import clearance_of, ends, junctions, pixel_graph, sample_evenly, skeleton_of

if TYPE_CHECKING:
    import networkx as nx


def partition(grid: OccupancyGrid, config: PartitionConfig = PartitionConfig()) -> tuple[Submap, ...]:
    """Divide a map into discs of `config.radius_m` around its clustered junctions.

    Submaps are numbered from 0 by (y, x) of their centre. A map with free space but without any junction
    (one room, one corridor) gets one submap, where it is widest; a map without free space gets none.
    With `config.spacing_m`, points of the skeleton that far apart become centres as well.

    >>> import pc2grid
    >>> submaps = partition(pc2grid.load_map("map.yaml"), PartitionConfig(radius_m=4.0))
    >>> [submap.submap_id for submap in submaps] == list(range(len(submaps)))
    True
    """
    centers_m = submap_centers(grid, config)
    return tuple(
        view_at(grid, (float(x), float(y)), config, submap_id=i) for i, (x, y) in enumerate(centers_m)
    )


def view_at(
    grid: OccupancyGrid, center_m: tuple[float, float], config: PartitionConfig, *, submap_id: int = 0
) -> Submap:
    """The submap around `center_m` as `config.view` asks: the whole disc, or what is seen from its centre.

    Both sides of a comparison must be cut alike, so the query's submaps come from here too.
    """
    if config.view == "isovist":
        from pc2grid.visibility import isovist, visible_submap

        return visible_submap(grid, isovist(grid, center_m, config.radius_m), submap_id)
    return submap_at(grid, center_m, config.radius_m, submap_id=submap_id)


def submap_at(
    grid: OccupancyGrid, center_m: tuple[float, float], radius_m: float, *, submap_id: int = 0
) -> Submap:
    """The disc of `grid` around `center_m` (map frame); cells farther than `radius_m` become unknown."""
    crop = grid.crop(center_m, radius_m)
    n = crop.cells.shape[0] // 2
    steps = np.arange(-n, n + 1) ** 2
    inside = steps[:, None] + steps <= (radius_m / grid.resolution_m) ** 2 + 1e-9
    cells = np.where(inside, crop.cells, np.int8(UNKNOWN))
    return Submap(
        submap_id=submap_id,
        center_m=center_m,
        radius_m=radius_m,
        grid=OccupancyGrid(cells=cells, resolution_m=crop.resolution_m, origin_m=crop.origin_m),
    )


def submap_centers(grid: OccupancyGrid, config: PartitionConfig) -> F64:
    """Centres (N, 2) of the submaps in the map frame, metres, sorted by (y, x)."""
    free = grid.free
    if not free.any():
        return np.empty((0, 2))
    skeleton = map_skeleton(grid, config)
    cells = [cell for cell, _ in _clusters(np.argwhere(junctions(skeleton)), grid.resolution_m, config)]
    if not cells:
        clearance = clearance_of(free, grid.resolution_m)
        cells = [np.array(np.unravel_index(int(np.argmax(clearance)), clearance.shape))]
    centers = np.array(cells)
    if config.spacing_m is not None:
        # Junctions first: they are kept, the skeleton fills the gaps between them.
        candidates = np.concatenate((centers, np.argwhere(skeleton)))
        more = sample_evenly(candidates, config.spacing_m / grid.resolution_m)
        centers = np.unique(np.concatenate((centers, more)), axis=0)
    return grid.to_point(centers[np.lexsort(centers.T[::-1])])


def map_skeleton(grid: OccupancyGrid, config: PartitionConfig) -> BoolGrid:
    """The edge map M^E of III-A (H, W): only the major free space, one pixel wide."""
    return skeleton_of(grid.free, grid.resolution_m, config.clearance_m, config.thinning)


def _clusters(cells: I64, resolution_m: float, config: PartitionConfig) -> list[tuple[I64, I64]]:
    """DBSCAN over cells (N, 2): for each cluster the member next to its mean, and all members.

    Every cell is a core point: a junction seen in one pixel is a junction. Then DBSCAN's clusters are the
    connected components of the cells within its radius of each other (tests compare with scikit-learn's).
    The mean itself may lie in a wall; the member next to it lies on the skeleton.
    """
    if len(cells) == 0:
        return []
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(cells).query_pairs(config.cluster_m / resolution_m, output_type="ndarray")
    near = coo_array((np.ones(len(pairs), np.bool_), pairs.T), shape=(len(cells), len(cells)))
    labels = connected_components(near, directed=False)[1]
    clusters = []
    for label in range(labels.max() + 1):
        members = cells[labels == label]
        distances = np.linalg.norm(members - members.mean(axis=0), axis=1)
        clusters.append((members[int(np.argmin(distances))], members))
    return clusters


def junction_graph(grid: OccupancyGrid, config: PartitionConfig = PartitionConfig()) -> nx.Graph:
    """The free space as a graph: places where ways meet or end, joined by the ways between them.

    Nodes are numbered from 0 and carry `kind` ("junction" or "end"), `center_m` (x, y in the map frame) and
    `pixels` (how many junction pixels DBSCAN merged). Edges carry `length_m` along the skeleton; of several
    ways between the same two places the shortest is kept.
    """
    import networkx as nx

    skeleton = map_skeleton(grid, config)
    pixels = pixel_graph(skeleton, grid.resolution_m)
    graph = nx.Graph()
    owner: dict[tuple[int, int], int] = {}
    clusters = _clusters(np.argwhere(junctions(skeleton)), grid.resolution_m, config)
    places = [("junction", cell, members) for cell, members in clusters]
    places += [("end", cell, cell[None]) for cell in np.argwhere(ends(skeleton))]
    for node, (kind, cell, members) in enumerate(places):
        x, y = grid.to_point(cell[None])[0]
        graph.add_node(node, kind=kind, center_m=(float(x), float(y)), pixels=len(members))
        for r, c in members.tolist():
            owner.setdefault((r, c), node)
    # A way is a component of the skeleton once the places are taken out, together with the steps to them.
    ways = pixels.subgraph(p for p in pixels if p not in owner)
    for way in nx.connected_components(ways):
        length = sum(d for _, _, d in ways.subgraph(way).edges(data="length_m"))
        steps = [(owner[q], pixels.edges[p, q]["length_m"]) for p in way for q in pixels[p] if q in owner]
        touched = sorted({node for node, _ in steps})
        for i, a in enumerate(touched):
            for b in touched[i + 1 :]:
                total = length + sum(min(d for node, d in steps if node == end) for end in (a, b))
                _join(graph, a, b, total)
    for p, q, d in pixels.edges(data="length_m"):
        if p in owner and q in owner and owner[p] != owner[q]:
            _join(graph, owner[p], owner[q], d)
    return graph


def _join(graph: nx.Graph, a: int, b: int, length_m: float) -> None:
    if not graph.has_edge(a, b) or graph.edges[a, b]["length_m"] > length_m:
        graph.add_edge(a, b, length_m=length_m)
