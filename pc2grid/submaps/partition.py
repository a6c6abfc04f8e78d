"""A map's division into submaps around the junctions of its free space (paper III-A)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import F64, BoolGrid, cells_of
from pc2grid.config import PartitionConfig
from pc2grid.model import UNKNOWN, OccupancyGrid, Submap
from pc2grid.submaps.isovist import isovist, visible_submap
from pc2grid.submaps.junction_graph import graph_of_skeleton, map_skeleton
from pc2grid.submaps.sampling import sample_evenly
from pc2grid.submaps.skeleton import clearance_of

if TYPE_CHECKING:
    import networkx as nx


def partition(grid: OccupancyGrid, config: PartitionConfig = PartitionConfig()) -> tuple[Submap, ...]:
    """Divide a map into submaps of `config.radius_m` around the junctions of its junction graph (III-A).

    With `config.spacing_m`, points of the skeleton that far apart become centres as well. Submaps are
    numbered from 0 by (y, x) of their centre. A map with free space but without any junction (one room, one
    corridor) has a centre where it is widest; a map without free space has no submaps.

    >>> import pc2grid
    >>> submaps = partition(pc2grid.load_map("map.yaml"), PartitionConfig(radius_m=4.0))
    >>> [submap.submap_id for submap in submaps] == list(range(len(submaps)))
    True
    """
    return divide(grid, config)[1]


def divide(grid: OccupancyGrid, config: PartitionConfig) -> tuple[nx.Graph, tuple[Submap, ...]]:
    """The junction graph of a map, and the submaps of `partition`, which are made around its nodes."""
    skeleton = map_skeleton(grid, config)
    graph = graph_of_skeleton(skeleton, grid, config)
    centers_m = _centers(graph, skeleton, grid, config)
    return graph, tuple(
        view_at(grid, (x, y), config, submap_id=number) for number, (x, y) in enumerate(centers_m.tolist())
    )


def view_at(
    grid: OccupancyGrid, center_m: tuple[float, float], config: PartitionConfig, *, submap_id: int = 0
) -> Submap:
    """The submap around `center_m` as `config.view` defines it: the whole disc, or its isovist.

    The views of a query are made by this function, too, because only views of one kind are comparable.
    """
    if config.view == "isovist":
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
    skeleton = map_skeleton(grid, config)
    return _centers(graph_of_skeleton(skeleton, grid, config), skeleton, grid, config)


def _centers(graph: nx.Graph, skeleton: BoolGrid, grid: OccupancyGrid, config: PartitionConfig) -> F64:
    """The same, from the junction graph and the skeleton that it was made from."""
    if not grid.ground.any():
        return np.empty((0, 2))
    points_m = [node["center_m"] for _, node in graph.nodes(data=True) if node["kind"] == "junction"]
    centers = grid.to_cell(np.array(points_m).reshape(-1, 2))
    if not len(centers):
        clearance_m = clearance_of(grid.ground, grid.resolution_m)
        centers = np.array([np.unravel_index(int(np.argmax(clearance_m)), clearance_m.shape)])
    if config.spacing_m is not None:
        # Junctions come first, so they are kept; the skeleton fills the gaps between them.
        candidates = np.concatenate((centers, cells_of(skeleton)))
        more = sample_evenly(candidates, config.spacing_m / grid.resolution_m)
        centers = np.unique(np.concatenate((centers, more)), axis=0)
    return grid.to_point(centers[np.lexsort(centers.T[::-1])])
