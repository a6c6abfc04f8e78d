"""The junction graph of a session with what is visible at its nodes, which two sessions are matched by.

Junctions and ends are few, and lie where one robot has seen enough. So the ways between them get nodes, too,
`LandmarkParameters.spacing_m` apart. Each node is described by the three signatures of what is visible there
(`signature.seen`), and between nodes the graph tells how long the way is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import HIDDEN, look_around
from signature.seen import seen_signatures
from signature.seen_places import PROFILE_BEARINGS

if TYPE_CHECKING:
    import networkx as nx


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkParameters:
    """Which places of a junction graph are compared. By hand.

    spacing_m : distance of nodes along a way. least_seen : share of the rays whose ends are known; of a node
        that has seen less, the signatures say little.
    """

    spacing_m: float = 1.0
    least_seen: float = 0.5


LANDMARKS = LandmarkParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Landmarks:
    """N nodes of a session's graph.

    at_m : (N, 2) in the map frame. ranges_m, seen : (N, B) isovists, and whether the end of each ray is
    known. signatures : (N, K) `signature.seen.seen_signatures`. way_m : (N, N) float32, length of the
    shortest way between two nodes; infinite where none is known.
    """

    at_m: F64
    ranges_m: F32
    seen: NDArray[np.bool_]
    signatures: F32
    way_m: F32

    @staticmethod
    def of(grid: OccupancyGrid, graph: nx.Graph, sight_m: float) -> Landmarks:
        """Of a map and its junction graph (`pc2grid.submaps.junction_graph`). sight_m : length of rays."""
        places = with_places_on_ways(graph, LANDMARKS.spacing_m)
        at_m = np.array([at for _, at in places.nodes(data="center_m")], np.float64).reshape(-1, 2)
        ranges_m, ends = look_around(grid, at_m, sight_m, bearings=PROFILE_BEARINGS)
        kept = np.flatnonzero(np.mean(ends != HIDDEN, axis=1) >= LANDMARKS.least_seen)
        ranges_m, ends = ranges_m[kept], ends[kept]
        return Landmarks(
            at_m=at_m[kept],
            ranges_m=ranges_m,
            seen=ends != HIDDEN,
            signatures=seen_signatures(ranges_m, ends, sight_m),
            way_m=ways_between(places, kept),
        )

    def mirrored(self) -> Landmarks:
        """With x turned into -x. Signatures are those of the mirror image, too."""
        rays = self.ranges_m.shape[1]
        turned = (rays // 2 - np.arange(rays)) % rays
        return replace(
            self,
            at_m=self.at_m * np.array((-1.0, 1.0)),
            ranges_m=self.ranges_m[:, turned],
            seen=self.seen[:, turned],
        )

    def __len__(self) -> int:
        return len(self.at_m)


def with_places_on_ways(graph: nx.Graph, spacing_m: float) -> nx.Graph:
    """The junction graph with further nodes on its ways, at most `spacing_m` apart; nodes keep `center_m`,
    edges `length_m`."""
    import networkx as nx

    places = nx.Graph()
    places.add_nodes_from((node, {"center_m": at}) for node, at in graph.nodes(data="center_m"))
    for a, b, way in graph.edges(data=True):
        a, b = min(a, b), max(a, b)
        pieces = max(1, int(np.ceil(way["length_m"] / spacing_m)))
        inner = np.linspace(0, len(way["path_m"]) - 1, pieces + 1).round().astype(int)[1:-1]
        chain = [a, *range(len(places), len(places) + len(inner)), b]
        for node, (x, y) in zip(chain[1:-1], way["path_m"][inner].tolist(), strict=True):
            places.add_node(node, center_m=(x, y))
        nx.add_path(places, chain, length_m=way["length_m"] / pieces)
    return places


def ways_between(places: nx.Graph, kept: I64) -> F32:
    """(N, N) lengths of the shortest ways between some nodes of a graph."""
    import networkx as nx
    from scipy.sparse.csgraph import dijkstra

    if not len(kept):
        return np.empty((0, 0), np.float32)
    steps = nx.to_scipy_sparse_array(places, nodelist=range(len(places)), weight="length_m", format="csr")
    return np.asarray(dijkstra(steps, directed=False, indices=kept)[:, kept], np.float32)
