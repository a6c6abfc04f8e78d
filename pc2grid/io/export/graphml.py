"""The junction graph of a map as GraphML (Gephi, yEd, networkx) or as networkx's node-link JSON (D3)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.errors import OutputError
from pc2grid.io.atomic import replace_file

if TYPE_CHECKING:
    import networkx as nx


def write_graph(path: str | Path, graph: nx.Graph) -> None:
    """Write a graph as `pc2grid.submaps.junction_graph` makes it, by the suffix `.graphml` or `.json`.

    Both formats hold plain numbers and text only: `center_m` becomes `x_m` and `y_m`, and the pixels of the
    edges (`path_m`) are left out.
    Raises OutputError for another suffix or if the file cannot be written.
    """
    import networkx as nx

    suffix = Path(path).suffix.lower()
    if suffix not in (".graphml", ".json"):
        raise OutputError(
            f"{path}: not a kind of graph file",
            hint="end its name in .graphml or .json; poses and loops: --g2o",
        )
    flat = nx.Graph(**graph.graph)
    for node, about in graph.nodes(data=True):
        x_m, y_m = about["center_m"]
        rest = {key: value for key, value in about.items() if key != "center_m"}
        flat.add_node(node, x_m=x_m, y_m=y_m, **rest)
    for a, b, length_m in graph.edges(data="length_m"):
        flat.add_edge(a, b, length_m=length_m)
    with replace_file(path) as temporary:
        if suffix == ".graphml":
            nx.write_graphml_xml(flat, temporary)
        else:
            document = nx.node_link_data(flat, edges="edges")
            temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
