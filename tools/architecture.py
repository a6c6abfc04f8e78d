"""Draw which module imports which, as SVG: `python tools/architecture.py OUT.svg` (what `make picture` does).

A band for each package, the importing above the imported; folders are one box. An arrow that others imply
(a -> b -> c makes a -> c) is left out. Made from the code by grimp, which import-linter brings.
"""

from __future__ import annotations

import sys
from pathlib import Path

import grimp
import networkx as nx

BANDS = {"pc2grid_cli": "#CC79A7", "signature": "#009E73", "pc2grid": "#0072B2"}
ABOUT = {
    "pc2grid_cli": "the program: a file a command",
    "signature": "submaps to signatures, database, answer",
    "pc2grid": "recordings to scans, grids, submaps",
}
WIDTH, HEIGHT, ROW, PAD = 1240, 24, 46, 14


def imports() -> nx.DiGraph:
    """Boxes ("signature.verify", "pc2grid.io") and what they import; type-checking imports left out."""
    code = grimp.build_graph(*BANDS, exclude_type_checking_imports=True)
    graph = nx.DiGraph()
    for module in sorted(code.modules):
        box = ".".join(module.split(".")[:2])
        if box in BANDS:  # a package's own file only hands names on
            continue
        graph.add_node(box)
        for other in sorted(code.find_modules_directly_imported_by(module)):
            target = ".".join(other.split(".")[:2])
            if target not in (*BANDS, box):
                graph.add_edge(box, target)
    return graph


def levels(graph: nx.DiGraph) -> list[list[str]]:
    """Boxes of one package in rows: what imports stands above what it imports (circles side by side)."""
    whole = nx.condensation(graph)
    depth: dict[int, int] = {}
    for node in reversed(list(nx.topological_sort(whole))):
        depth[node] = 1 + max((depth[n] for n in whole[node]), default=-1)
    rows: list[list[str]] = [[] for _ in range(max(depth.values()) + 1)]
    for node, level in depth.items():
        rows[-1 - level] += sorted(whole.nodes[node]["members"])
    return rows


def essential(graph: nx.DiGraph) -> list[tuple[str, str]]:
    """The imports that no chain of others implies, and all within a circle."""
    whole = nx.condensation(graph)
    group = whole.graph["mapping"]
    kept = set(nx.transitive_reduction(whole).edges)
    return [(a, b) for a, b in graph.edges if group[a] == group[b] or (group[a], group[b]) in kept]


def place(rows: list[list[str]], graph: nx.DiGraph, top: float) -> dict[str, tuple[float, float, float]]:
    """Box -> x, y of its middle, width; each row in the order of the middles of what stands above it."""
    places: dict[str, tuple[float, float, float]] = {}
    for row in rows:
        wrapped: list[list[str]] = [[]]
        above = {box: [places[a][0] for a in graph.predecessors(box) if a in places] for box in row}
        middle = {box: sum(xs) / len(xs) if xs else WIDTH / 2 for box, xs in above.items()}
        for box in sorted(row, key=lambda b: (middle[b], b)):
            if sum(size(b) + PAD for b in (*wrapped[-1], box)) > WIDTH - 2 * PAD:
                wrapped.append([])
            wrapped[-1].append(box)
        for line in wrapped:
            gap = (WIDTH - sum(map(size, line))) / (len(line) + 1)
            x = gap
            for box in line:
                places[box] = (x + size(box) / 2, top, size(box))
                x += size(box) + gap
            top += ROW
    return places


def size(box: str) -> float:
    """Width of a box by its text."""
    return 7.0 * len(box.rpartition(".")[2]) + 16


def draw(graph: nx.DiGraph) -> str:
    """The whole picture."""
    parts: list[str] = []
    top = 0.0
    for band, color in BANDS.items():
        inside = graph.subgraph(box for box in graph if box.startswith(f"{band}."))
        places = place(levels(inside), inside, top + 52)
        bottom = max(y for _, y, _ in places.values()) + ROW / 2 + 4
        parts.append(
            f'<rect x="2" y="{top + 4:.0f}" width="{WIDTH - 4}" height="{bottom - top - 8:.0f}" rx="10" '
            f'fill="{color}" fill-opacity="0.08" stroke="{color}"/>'
            f'<text x="16" y="{top + 24:.0f}" font-weight="bold" fill="{color}">{band}</text>'
            f'<text x="{WIDTH - 16}" y="{top + 24:.0f}" text-anchor="end" fill="#555">{ABOUT[band]}</text>'
        )
        for a, b in sorted(essential(inside)):
            (xa, ya, _), (xb, yb, _) = places[a], places[b]
            bend = (yb - ya) / 2
            parts.append(
                f'<path d="M{xa:.0f} {ya + 12:.0f} C{xa:.0f} {ya + bend:.0f} {xb:.0f} {yb - bend:.0f} '
                f'{xb:.0f} {yb - 13:.0f}" fill="none" stroke="{color}" stroke-opacity="0.45" '
                'marker-end="url(#head)"/>'
            )
        for box, (x, y, width) in sorted(places.items()):
            parts.append(
                f'<rect x="{x - width / 2:.0f}" y="{y - 12:.0f}" width="{width:.0f}" height="{HEIGHT}" '
                f'rx="5" fill="#fff" stroke="{color}"/>'
                f'<text x="{x:.0f}" y="{y + 4:.0f}" text-anchor="middle">{box.rpartition(".")[2]}</text>'
            )
        top = bottom
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {top:.0f}" '
        'font-family="sans-serif" font-size="12">'
        '<defs><marker id="head" viewBox="0 0 6 6" refX="5" refY="3" markerWidth="6" markerHeight="6" '
        'orient="auto"><path d="M0 0 L6 3 L0 6 z" fill="#777"/></marker></defs>'
        f'<rect width="{WIDTH}" height="{top:.0f}" fill="#fff"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(draw(imports()), encoding="utf-8")
