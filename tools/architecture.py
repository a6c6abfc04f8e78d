"""Draw the folders, their files, and what they import, as SVG: `python tools/architecture.py OUT.svg`.

A band for each package; the importing package stands above the imported one. In a band each folder, and
each file that lies beside the folders, is a box; what imports stands above what it imports. An arrow that
others imply (a -> b -> c implies a -> c) is left out. Files that nearly everything imports share one box at
the bottom, without arrows. The picture is made from the code by grimp, which import-linter installs.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import grimp
import networkx as nx

BANDS = {"pc2grid_lab": "#8A6D00", "pc2grid_cli": "#B0568A", "signature": "#00805C", "pc2grid": "#0066A6"}
ABOUT = {
    "pc2grid_lab": "the laboratory: experiments, peers, benchmarks",
    "pc2grid_cli": "the program: one file for each command",
    "signature": "submaps to signatures, database, localization",
    "pc2grid": "recordings to clouds, trajectories, maps, submaps",
}
PAPER = ("boundary", "freespace", "symmetry", "describe", "similarity", "seen", "seen_likelihood", "_kernels")
"""Files of `signature` that share the box "the paper"."""
STAGES = ("pipeline",)
"""Files of `pc2grid` beside the folders that have a box of their own; the others share the box "types"."""

WIDTH, GAP, LINE, TITLE = 820, 24, 16, 20  # as wide as a page, so that the text is not shrunk
CHARACTER = 6.6  # mean width of a character, pixels


@dataclass(frozen=True)
class Box:
    """A folder or file: its name, and the lines of text in it."""

    name: str
    lines: tuple[str, ...]

    @property
    def width(self) -> float:
        """Pixels."""
        longest = max([len(self.name) * 1.15, *map(len, self.lines)])
        return CHARACTER * longest + 22

    @property
    def height(self) -> float:
        """Pixels."""
        return TITLE + LINE * len(self.lines) + 9


def imports() -> tuple[nx.DiGraph, dict[str, list[str]]]:
    """What each folder or file imports of its own package, and the modules in each of them.

    Their names are like "signature.localization" and "pc2grid.pipeline". Imports for type checking only are
    left out, and the `__init__` files of the three packages, which only pass names on.
    """
    code = grimp.build_graph(*BANDS, exclude_type_checking_imports=True)
    graph, members = nx.DiGraph(), defaultdict(list)
    for module in sorted(code.modules - set(BANDS)):
        owner = ".".join(module.split(".")[:2])
        graph.add_node(owner)
        if not code.find_children(module):
            members[owner].append(module)
        for other in sorted(code.find_modules_directly_imported_by(module) - set(BANDS)):
            target = ".".join(other.split(".")[:2])
            if target != owner and target.split(".")[0] == owner.split(".")[0]:
                graph.add_edge(owner, target)
    return graph, members


def grouped(
    package: str, graph: nx.DiGraph, members: dict[str, list[str]]
) -> tuple[nx.DiGraph, dict[str, Box]]:
    """The boxes of one package and the imports between them."""
    inside = graph.subgraph(n for n in graph if n.startswith(f"{package}."))
    group = {n: n.partition(".")[2] for n in inside}
    if package == "pc2grid_cli":
        group = dict.fromkeys(inside, "commands, and what they share")
    for n in inside:
        name = n.partition(".")[2]
        if package == "signature" and name in PAPER:
            group[n] = "the paper"
        if package == "pc2grid" and members[n] == [n] and name not in STAGES:
            group[n] = "types"
    boxes: dict[str, list[str]] = defaultdict(list)
    for n in sorted(inside):
        boxes[group[n]] += members[n]
    edges = {(group[a], group[b]) for a, b in inside.edges if group[a] != group[b]}
    merged = nx.DiGraph(edges)
    merged.add_nodes_from(boxes)
    return merged, {name: Box(name, lines(package, name, modules)) for name, modules in boxes.items()}


def lines(package: str, name: str, modules: list[str]) -> tuple[str, ...]:
    """The files of a box as lines of text; a folder inside it begins a line."""
    if [f"{package}.{name}"] == modules:
        return ()
    by_folder: dict[str, list[str]] = defaultdict(list)
    for module in modules:
        *folders, file = module.removeprefix(f"{package}.").removeprefix(f"{name}.").split(".")
        by_folder["/".join(folders)].append(file)
    most = 112 if package == "pc2grid_cli" else 64 if len(by_folder) > 2 else 44 if len(modules) > 10 else 30
    found: list[str] = []
    for folder, files in sorted(by_folder.items()):
        line = f"{folder}/ " if folder else ""
        for file in files:
            if len(line) + len(file) > most:
                found.append(line)
                line = "   " if folder else ""
            line += file + "  "
        found.append(line)
    return tuple(line.rstrip() for line in found)


def rows(graph: nx.DiGraph) -> list[list[str]]:
    """The boxes of one package in rows: what imports stands above what it imports."""
    whole = nx.condensation(graph)
    depth: dict[int, int] = {}
    for node in reversed(list(nx.topological_sort(whole))):
        depth[node] = 1 + max((depth[n] for n in whole[node]), default=-1)
    found: list[list[str]] = [[] for _ in range(max(depth.values()) + 1)]
    for node, level in depth.items():
        found[-1 - level] += sorted(whole.nodes[node]["members"])
    return found


def essential(graph: nx.DiGraph) -> list[tuple[str, str]]:
    """The imports that no chain of others implies."""
    whole = nx.condensation(graph)
    group = whole.graph["mapping"]
    kept = set(nx.transitive_reduction(whole).edges)
    return [(a, b) for a, b in graph.edges if group[a] == group[b] or (group[a], group[b]) in kept]


def place(graph: nx.DiGraph, boxes: dict[str, Box], top: float) -> dict[str, tuple[float, float]]:
    """Middle of the upper edge of each box; rows are ordered by the middles of the importing boxes."""
    places: dict[str, tuple[float, float]] = {}
    for row in rows(graph):
        importing = {name: [places[a][0] for a in graph.predecessors(name) if a in places] for name in row}
        middle = {name: sum(xs) / len(xs) if xs else WIDTH / 2 for name, xs in importing.items()}
        wrapped: list[list[str]] = [[]]
        for name in sorted(row, key=lambda n: (middle[n], n)):
            if wrapped[-1] and sum(boxes[n].width + GAP for n in (*wrapped[-1], name)) > WIDTH - GAP:
                wrapped.append([])
            wrapped[-1].append(name)
        for line in wrapped:
            space = (WIDTH - sum(boxes[n].width for n in line)) / (len(line) + 1)
            x = space
            for name in line:
                places[name] = (x + boxes[name].width / 2, top)
                x += boxes[name].width + space
            top += max(boxes[n].height for n in line) + GAP
    return places


def arrow(start: tuple[float, float], end: tuple[float, float], color: str) -> str:
    """A curve from the lower edge of one box to the upper edge of another."""
    (xa, ya), (xb, yb) = start, end
    bend = max((yb - ya) / 2, 14)
    return (
        f'<path d="M{xa:.0f} {ya:.0f} C{xa:.0f} {ya + bend:.0f} {xb:.0f} {yb - bend:.0f} '
        f'{xb:.0f} {yb - 1:.0f}" fill="none" stroke="{color}" stroke-opacity="0.55" marker-end="url(#head)"/>'
    )


def text_box(box: Box, x: float, y: float, color: str) -> str:
    """A box with its name and its lines; x is the middle, y the upper edge."""
    left = x - box.width / 2
    parts = [
        f'<rect x="{left:.0f}" y="{y:.0f}" width="{box.width:.0f}" height="{box.height:.0f}" rx="5" '
        f'fill="#fff" stroke="{color}"/>',
        f'<text x="{x:.0f}" y="{y + 17:.0f}" text-anchor="middle" font-weight="bold">'
        f"{escape(box.name)}</text>",
    ]
    for k, line in enumerate(box.lines):
        parts.append(
            f'<text x="{left + 10:.0f}" y="{y + TITLE + 12 + LINE * k:.0f}" font-size="12" fill="#333" '
            f'xml:space="preserve">{escape(line)}</text>'
        )
    return "".join(parts)


def draw() -> str:
    """The whole picture."""
    graph, members = imports()
    parts: list[str] = []
    top = 0.0
    for package, color in BANDS.items():
        inside, boxes = grouped(package, graph, members)
        places = place(inside, boxes, top + 42)
        bottom = max(y + boxes[name].height for name, (_, y) in places.items()) + 16
        parts.append(
            f'<rect x="2" y="{top + 4:.0f}" width="{WIDTH - 4}" height="{bottom - top - 6:.0f}" rx="10" '
            f'fill="{color}" fill-opacity="0.07" stroke="{color}"/>'
            f'<text x="16" y="{top + 26:.0f}" font-size="16" font-weight="bold" fill="{color}">'
            f"{package}</text>"
            f'<text x="{WIDTH - 16}" y="{top + 26:.0f}" text-anchor="end" fill="#555">{ABOUT[package]}</text>'
        )
        for a, b in sorted(essential(inside)):
            (xa, ya), end = places[a], places[b]
            if b != "types":
                parts.append(arrow((xa, ya + boxes[a].height), end, color))
        parts += [text_box(boxes[name], x, y, color) for name, (x, y) in sorted(places.items())]
        top = bottom
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {top + 4:.0f}" '
        'font-family="sans-serif" font-size="14">'
        '<defs><marker id="head" viewBox="0 0 6 6" refX="5" refY="3" markerWidth="6" markerHeight="6" '
        'orient="auto"><path d="M0 0 L6 3 L0 6 z" fill="#666"/></marker></defs>'
        f'<rect width="{WIDTH}" height="{top + 4:.0f}" fill="#fff"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(draw(), encoding="utf-8")
