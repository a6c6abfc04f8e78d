"""List the folders with their files in CONTRIBUTING.md: `python tools/architecture.py CONTRIBUTING.md`.

The importing package stands above the imported one, and within a package the importing folder above the
imported one; folders on one line do not import each other. The list is made from the code by grimp, which
import-linter installs, and replaces what stands between two marks in the file.
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections import defaultdict
from pathlib import Path

import grimp
import networkx as nx

ABOUT = {
    "pc2grid_lab": "the laboratory: experiments, peers",
    "pc2grid_cli": "the program: what can be typed, a file for the work of each command, and what they share",
    "signature": "submaps to signatures, database, localization",
    "pc2grid": "recordings to clouds, trajectories, maps, submaps",
}
BEGIN, END = "<!-- modules: made by `make modules` -->\n", "<!-- end of modules -->"


def imports(code: grimp.ImportGraph, package: str) -> tuple[nx.DiGraph, dict[str, list[str]]]:
    """What each folder or file of a package imports of it, and the modules in each of them."""
    graph, members = nx.DiGraph(), defaultdict(list)
    for module in sorted(code.find_descendants(package)):
        owner, _, rest = module.removeprefix(f"{package}.").partition(".")
        graph.add_node(owner)
        if not code.find_children(module):
            members[owner].append(rest.replace(".", "/"))
        for other in code.find_modules_directly_imported_by(module):
            target = other.removeprefix(f"{package}.").split(".")[0]
            if other.startswith(f"{package}.") and target != owner:
                graph.add_edge(owner, target)
    return graph, members


def listed() -> str:
    """All packages as lines of text. Imports for type checking only are left out."""
    code = grimp.build_graph(*ABOUT, exclude_type_checking_imports=True)
    lines = []
    for package, about in ABOUT.items():
        graph, members = imports(code, package)
        whole = nx.condensation(graph)
        lines.append(f"{package}: {about}")
        for generation in nx.topological_generations(whole):
            names = sorted(name for node in generation for name in whole.nodes[node]["members"])
            folders = [f"{name} ({' '.join(members[name])})" for name in names if members[name] != [""]]
            files = " ".join(name for name in names if members[name] == [""])
            text = ", ".join([*folders, files] if files else folders)
            lines += textwrap.wrap(text, 108, initial_indent="  ", subsequent_indent="      ")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    page = Path(sys.argv[1])
    block = f"{BEGIN}\n```text\n{listed()}```\n\n{END}"
    old = page.read_text(encoding="utf-8")
    page.write_text(re.sub(f"{BEGIN}.*{END}", lambda _: block, old, flags=re.DOTALL), encoding="utf-8")
