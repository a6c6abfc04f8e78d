"""The junction graph of a map as GraphML (Gephi, yEd, networkx)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.io.atomic import replace_file

if TYPE_CHECKING:
    import networkx as nx


def write_graph(path: str | Path, graph: nx.Graph) -> None:
    """Write a graph as `pc2grid.submaps.junction_graph` makes it.

    GraphML holds plain numbers and text only: `center_m` becomes `x_m` and `y_m`, and the pixels of the edges
    (`path_m`) are left out. Raises OutputError if the file cannot be written.
    """
    import networkx as nx

    flat = nx.Graph(**graph.graph)
    for node, about in graph.nodes(data=True):
        x_m, y_m = about["center_m"]
        flat.add_node(node, kind=about["kind"], pixels=about["pixels"], x_m=x_m, y_m=y_m)
    flat.add_weighted_edges_from(graph.edges(data="length_m"), weight="length_m")
    with replace_file(path) as temporary:
        nx.write_graphml_xml(flat, temporary)
