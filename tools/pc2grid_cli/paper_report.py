"""The paper's tables as text and its Figures 9 and 10 as pictures, from the results of `compare paper`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from pc2grid.io.atomic import replace_file
from signature.evaluation.paper_tables import MAPS, SUBMAPS, TABLE_3, TABLE_4, Measures
from signature.evaluation.paper_task import RADII_M, PaperCell

_LEVELS = ("without noise", "noise level 1", "noise level 2")


def published(result: PaperCell) -> Measures | None:
    """The published number for a cell; None if there is none."""
    if result.overrides or result.map_name not in MAPS or result.reading != "paper":
        return None
    if result.radius_m == 8.0:
        return TABLE_3[result.level].get(result.method, {}).get(result.map_name)
    if result.level == 1 and result.method == "proposed":
        return TABLE_4.get(int(result.radius_m), {}).get(result.map_name)
    return None


def print_tables(results: Sequence[PaperCell], methods: Sequence[str]) -> None:
    """Tables I, III and IV on stdout: published, ours and the difference, in thousandths."""
    console = Console(width=120, highlight=False)
    plain = [r for r in results if not r.overrides]
    console.print("Of three numbers: paper, ours, difference, in thousandths.")
    _print_submaps(console, plain)
    for offset_m in sorted({r.offset_m for r in plain}):
        here = [r for r in plain if r.offset_m == offset_m]
        where = f"queries within {offset_m:g} m of a submap centre"
        for measure in Measures._fields:
            table = _table(f"Table III, {measure.upper()}, {where}", "noise", "method")
            for level in range(len(_LEVELS)):
                for i, method in enumerate(methods):
                    row = [r for r in here if (r.method, r.level, r.radius_m) == (method, level, 8.0)]
                    table.add_row(str(level) if i == 0 else "", method, *_cells(row, measure))
                table.add_section()
            console.print(table)
        table = _table(f"Table IV (proposed, noise level 1), {where}", "radius", "measure")
        for radius_m in RADII_M:
            row = [r for r in here if (r.method, r.level, r.radius_m) == ("proposed", 1, radius_m)]
            for measure in Measures._fields:
                table.add_row(
                    f"{radius_m:g} m" if measure == "auc" else "", measure.upper(), *_cells(row, measure)
                )
        console.print(table)
        for line in verdicts(here):
            console.print(line)
        _print_open_choices(console, [r for r in results if r.offset_m == offset_m], where)


def _table(title: str, *heads: str) -> Table:
    """A table with a column for each map; killian* is killian at its true size."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for head in (*heads, *MAPS, "killian*"):
        table.add_column(head, no_wrap=True, justify="left" if head in heads else "right")
    return table


def _cells(row: Sequence[PaperCell], measure: str) -> list[str]:
    """A text for each map, and one for killian at its true size."""
    texts = []
    for name, reading in [*((name, "paper") for name in MAPS), ("killian", "true")]:
        found = [r for r in row if (r.map_name, r.reading) == (name, reading)]
        if not found:
            texts.append("")
            continue
        ours, paper = round(1000 * getattr(found[0], measure)), published(found[0])
        if paper is None:
            texts.append(str(ours))
        else:
            there = round(1000 * getattr(paper, measure))
            texts.append(f"{there:3d} {ours:4d} {ours - there:+4d}")
    return texts


def _print_submaps(console: Console, results: Sequence[PaperCell]) -> None:
    table = Table(title="Table I, number of submaps", title_justify="left", box=SIMPLE_HEAD)
    for head in ("map", "paper", "ours", "difference"):
        table.add_column(head, justify="right")
    counts = {(r.map_name, r.reading): r.submaps for r in results if r.radius_m == 8.0}
    for (name, reading), ours in sorted(
        counts.items(), key=lambda item: (MAPS.index(item[0][0]), item[0][1])
    ):
        paper = SUBMAPS[name]
        label = f"{name}*" if reading == "true" else name
        table.add_row(label, str(paper), str(ours), f"{100 * (ours / paper - 1):+.0f} %")
    console.print(table)
    console.print(
        "killian: its image as the paper reads it, 0.05 m a pixel; killian*: at its true 0.10 m a pixel"
    )


def verdicts(results: Sequence[PaperCell]) -> list[str]:
    """The tables in words: the differences, and the best method. Results of one offset."""
    cells = {
        (r.method, r.level, r.map_name): r.auc
        for r in results
        if r.radius_m == 8.0 and r.reading == "paper" and not r.overrides
    }
    lines = []
    near = [
        name
        for name in MAPS
        if abs(cells.get(("proposed", 0, name), -1.0) - TABLE_3[0]["proposed"][name].auc) <= 0.03
    ]
    lines.append(
        f"proposed, without noise: AUC within 0.03 of the paper on {len(near)} ({', '.join(near) or 'none'})"
    )
    for level in (0, 2):
        leaders = {}
        for name in MAPS:
            here = {method: auc for (method, at, m), auc in cells.items() if (at, m) == (level, name)}
            if here:
                leaders[name] = max(here, key=lambda method: here[method])
        lines.append(f"{_LEVELS[level]}, best AUC: " + ", ".join(f"{m} {who}" for m, who in leaders.items()))
    return lines


def _print_open_choices(console: Console, results: Sequence[PaperCell], where: str) -> None:
    changed = [r for r in results if r.overrides]
    if not changed:
        return
    base = {(r.map_name, r.level): r.auc for r in results if _is_base(r)}
    table = Table(title=f"What open choices move, AUC x 1000, {where}", title_justify="left", box=SIMPLE_HEAD)
    for head in ("choice", "noise", *MAPS):
        table.add_column(head, justify="left" if head == "choice" else "right")
    for choice in dict.fromkeys(r.overrides for r in changed):
        for level in (0, 2):
            cells = {r.map_name: r.auc for r in changed if r.overrides == choice and r.level == level}
            shifts = [
                f"{1000 * (cells[m] - base[m, level]):+.0f}" if m in cells and (m, level) in base else ""
                for m in MAPS
            ]
            table.add_row(" ".join(f"{k} = {v}" for k, v in choice), str(level), *shifts)
    console.print(table)


def _is_base(result: PaperCell) -> bool:
    return (
        not result.overrides
        and result.method == "proposed"
        and result.radius_m == 8.0
        and result.reading == "paper"
    )


def draw_figures(results: Sequence[PaperCell], out: Path) -> list[Path]:
    """figure-9-OFFSET.png and figure-10-OFFSET.png: precision over recall; returns their paths."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    paths = []
    plain = [r for r in results if not r.overrides and r.reading == "paper"]
    names = [name for name in MAPS if any(r.map_name == name for r in plain)]
    for offset_m in sorted({r.offset_m for r in plain}):
        here = [r for r in plain if r.offset_m == offset_m]
        figure = Figure(figsize=(3.2 * len(names), 8.4), layout="constrained")
        axes = figure.subplots(len(_LEVELS), len(names), squeeze=False, sharex=True, sharey=True)
        for row, title in enumerate(_LEVELS):
            for column, name in enumerate(names):
                cell = [r for r in here if (r.level, r.map_name, r.radius_m) == (row, name, 8.0)]
                _draw_curves(axes[row, column], [(r.method, r) for r in cell])
                axes[row, column].set_title(f"{name}, {title}", fontsize=9)
        paths.append(_save(figure, axes, out / f"figure-9-offset-{offset_m:g}.png"))
        figure = Figure(figsize=(3.2 * len(names), 3.2), layout="constrained")
        axes = figure.subplots(1, len(names), squeeze=False, sharex=True, sharey=True)
        for column, name in enumerate(names):
            cell = [r for r in here if (r.level, r.map_name, r.method) == (1, name, "proposed")]
            cell.sort(key=lambda r: r.radius_m)
            _draw_curves(axes[0, column], [(f"r = {r.radius_m:g} m", r) for r in cell])
            axes[0, column].set_title(f"{name}, noise level 1", fontsize=9)
        paths.append(_save(figure, axes, out / f"figure-10-offset-{offset_m:g}.png"))
    return paths


def _draw_curves(axis: Any, curves: Sequence[tuple[str, PaperCell]]) -> None:
    for label, result in curves:
        curve = result.matches.curve()
        if len(curve.recall):
            # Like the area under the curve: from recall 0 at the precision of the first point.
            axis.plot(
                [0.0, *curve.recall], [curve.precision[0], *curve.precision], label=label, linewidth=1.2
            )
    axis.set_xlim(0, 1.01)
    axis.set_ylim(0, 1.01)
    axis.grid(alpha=0.3)


def _save(figure: Any, axes: Any, path: Path) -> Path:
    for axis in axes[-1]:
        axis.set_xlabel("recall")
    for axis in axes[:, 0]:
        axis.set_ylabel("precision")
    if axes[0, 0].lines:
        axes[0, 0].legend(fontsize=7, loc="lower left")
    with replace_file(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    return path
