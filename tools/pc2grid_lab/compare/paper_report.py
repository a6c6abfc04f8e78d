"""The paper's tables as text and its Figures 9 and 10 as pictures, from the results of `compare paper`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from pc2grid.io.atomic import replace_file
from pc2grid_cli.tables import show, table
from pc2grid_lab.experiments.paper_experiment import MatchMeasures, largest_right_share
from pc2grid_lab.experiments.paper_tables import MAPS, SUBMAPS, TABLE_3, TABLE_4, Measures
from pc2grid_lab.experiments.paper_task import ABLATION, OPEN_CHOICES, RADII_M, Choice, PaperCell, Reading

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
    plain = [r for r in results if not r.overrides]
    columns = _columns(plain)
    show(
        "Of three numbers: paper, ours, difference, in thousandths; +-: half of the interval from 5 to 95 %,"
        " by bootstrap over the queries."
    )
    _print_submaps(plain)
    for offset_m in dict.fromkeys(r.offset_m for r in plain):
        here = [r for r in plain if r.offset_m == offset_m]
        where = f"queries within {offset_m:g} m of a submap centre"
        for measure in MatchMeasures._fields:
            title = "R@1" if measure == "r_at_1" else measure.upper()
            shown = _table(f"Table III, {title}, {where}", columns, "noise", "method")
            for level in range(len(_LEVELS)):
                for i, method in enumerate(methods):
                    row = [r for r in here if (r.method, r.level, r.radius_m) == (method, level, 8.0)]
                    shown.add_row(str(level) if i == 0 else "", method, *_cells(row, columns, measure))
                shown.add_section()
            show(shown)
        shown = _table(f"Table IV (proposed, noise level 1), {where}", columns, "radius", "measure")
        for radius_m in RADII_M:
            row = [r for r in here if (r.method, r.level, r.radius_m) == ("proposed", 1, radius_m)]
            for measure in Measures._fields:
                shown.add_row(
                    f"{radius_m:g} m" if measure == "auc" else "",
                    measure.upper(),
                    *_cells(row, columns, measure),
                )
        show(shown)
        for line in verdicts(here):
            show(line)
        of_offset = [r for r in results if r.offset_m == offset_m]
        _print_choices(of_offset, columns, "What each signature adds", ABLATION, where)
        _print_choices(of_offset, columns, "What other choices move", OPEN_CHOICES, where)


Column = tuple[str, Reading]
"""Name and reading of a map."""


def _columns(results: Sequence[PaperCell]) -> list[Column]:
    """The maps of the results, those of the paper first and in its order."""
    found = {(r.map_name, r.reading): None for r in results}
    readings: tuple[Reading, ...] = ("paper", "true")
    known: list[Column] = [(name, reading) for reading in readings for name in MAPS]
    return [key for key in known if key in found] + [key for key in found if key not in known]


def _table(title: str, columns: Sequence[Column], *heads: str) -> Table:
    """A table with a column for each map; killian* is killian at its true size."""
    maps = [f"{name}*" if reading == "true" else name for name, reading in columns]
    return table(title, heads, maps)


def _cells(row: Sequence[PaperCell], columns: Sequence[Column], measure: str) -> list[str]:
    """A text for each map."""
    texts = []
    for column in columns:
        found = [r for r in row if (r.map_name, r.reading) == column]
        if not found:
            texts.append("")
            continue
        ours, paper = round(1000 * getattr(found[0].matches.measures(), measure)), published(found[0])
        spread = f" +-{round(1000 * getattr(found[0].half_widths, measure)):<2d}"
        if paper is None or measure not in Measures._fields:
            texts.append(f"{ours}{spread}")
        else:
            there = round(1000 * getattr(paper, measure))
            texts.append(f"{there:3d} {ours:4d} {ours - there:+4d}{spread}")
    return texts


def _print_submaps(results: Sequence[PaperCell]) -> None:
    shown = table("Table I, number of submaps", ["map"], ["paper", "ours", "difference"])
    counts = {(r.map_name, r.reading): r.submaps for r in results if r.radius_m == 8.0}
    for name, reading in _columns(results):
        ours, paper = counts[name, reading], SUBMAPS.get(name)
        label = f"{name}*" if reading == "true" else name
        if paper is None:
            shown.add_row(label, "", str(ours), "")
        else:
            shown.add_row(label, str(paper), str(ours), f"{100 * (ours / paper - 1):+.0f} %")
    show(shown)
    if any(reading == "true" for _, reading in counts):
        show("killian: its image as the paper reads it, 0.05 m a pixel; killian*: at its true 0.10 m a pixel")


def verdicts(results: Sequence[PaperCell]) -> list[str]:
    """The tables in words: the differences, and the best method. Results of one offset."""
    cells = {
        (r.method, r.level, r.map_name): r.auc
        for r in results
        if r.radius_m == 8.0 and r.reading == "paper" and not r.overrides
    }
    lines = []
    shares = {
        r.map_name: r.true_share
        for r in results
        if (r.method, r.level, r.radius_m, r.reading, r.overrides) == ("proposed", 0, 8.0, "paper", ())
    }
    possible = [
        name
        for name in MAPS
        if name in shares and shares[name] <= largest_right_share(TABLE_3[0]["proposed"][name].f1)
    ]
    lines.append(
        "proposed, without noise: R@1 is possible with the published F1, p <= F1 / (2 - F1), on"
        f" {len(possible)} ({', '.join(possible) or 'none'})"
    )
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


def _print_choices(
    results: Sequence[PaperCell],
    columns: Sequence[Column],
    title: str,
    choices: Sequence[Choice],
    where: str,
) -> None:
    """A table of some choices: what the paper says, what the default does, and what the choice moves."""
    if not any(r.overrides == choice.overrides for r in results for choice in choices):
        return
    maps = [name for name, reading in columns if reading == "paper"]
    base = {(r.map_name, r.level): r.matches.measures() for r in results if _is_base(r)}
    heads = ("choice", "the paper says", "we do", "noise")
    shown = table(f"{title}: AUC x 1000, {where}", heads, (*maps, "mean", "mean R@1"))
    for level in (0, 2):
        here = [base[name, level] for name in maps if (name, level) in base]
        if here:
            means = [float(np.mean(values)) for values in ([m.auc for m in here], [m.r_at_1 for m in here])]
            cells = [f"{1000 * value:.0f}" for value in [m.auc for m in here] + means]
            shown.add_row("all three", "", "Eq. 6", str(level), *cells)
    for choice in choices:
        for level in (0, 2):
            moved = {
                r.map_name: r.matches.measures()
                for r in results
                if r.overrides == choice.overrides and r.level == level and (r.map_name, level) in base
            }
            if not moved:
                continue
            auc = {name: 1000 * (moved[name].auc - base[name, level].auc) for name in moved}
            right = [1000 * (moved[name].r_at_1 - base[name, level].r_at_1) for name in moved]
            shifts = [f"{auc[name]:+.0f}" if name in auc else "" for name in maps]
            words = (choice.name, choice.paper, choice.ours) if level == 0 else ("", "", "")
            shown.add_row(
                *words, str(level), *shifts, f"{np.mean(list(auc.values())):+.0f}", f"{np.mean(right):+.0f}"
            )
    show(shown)


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
    names = [name for name, _ in _columns(plain)]
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
