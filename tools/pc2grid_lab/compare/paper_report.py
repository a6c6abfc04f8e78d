"""The paper's tables as text and its Figures 9 and 10 as pictures, from the results of `compare paper`."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from pc2grid.arrays import F64
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare.picture import picture
from pc2grid_lab.experiments.paper_experiment import MatchMeasures, largest_right_share
from pc2grid_lab.experiments.paper_tables import MAPS, SUBMAPS, TABLE_3, TABLE_4, Measures
from pc2grid_lab.experiments.paper_task import (
    ABLATION,
    OPEN_CHOICES,
    RADII_M,
    PaperCell,
    Reading,
    SettingChoice,
)

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
        of_offset = [r for r in results if r.offset_m == offset_m]
        here = [r for r in of_offset if not r.overrides]
        where = f"queries within {offset_m:g} m of a submap centre"
        for measure in MatchMeasures._fields:
            show(_table_3(here, columns, methods, measure, where))
        show(_table_4(here, columns, where))
        for line in verdicts(here):
            show(line)
        _print_choices(of_offset, columns, "What each signature adds", ABLATION, where)
        _print_choices(of_offset, columns, "What other choices move", OPEN_CHOICES, where)


def _table_3(
    results: Sequence[PaperCell], columns: Sequence[Column], methods: Sequence[str], measure: str, where: str
) -> Table:
    title = "R@1" if measure == "r_at_1" else measure.upper()
    shown = _table(f"Table III, {title}, {where}", columns, "noise", "method")
    for level in range(len(_LEVELS)):
        for i, method in enumerate(methods):
            row = [r for r in results if (r.method, r.level, r.radius_m) == (method, level, 8.0)]
            shown.add_row(str(level) if i == 0 else "", method, *_cells(row, columns, measure))
        shown.add_section()
    return shown


def _table_4(results: Sequence[PaperCell], columns: Sequence[Column], where: str) -> Table:
    shown = _table(f"Table IV (proposed, noise level 1), {where}", columns, "radius", "measure")
    for radius_m in RADII_M:
        row = [r for r in results if (r.method, r.level, r.radius_m) == ("proposed", 1, radius_m)]
        for measure in Measures._fields:
            first = f"{radius_m:g} m" if measure == "auc" else ""
            shown.add_row(first, measure.upper(), *_cells(row, columns, measure))
    return shown


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
    here = [r for r in results if r.radius_m == 8.0 and r.reading == "paper" and not r.overrides]
    own = {r.map_name: r for r in here if (r.method, r.level) == ("proposed", 0)}
    paper = TABLE_3[0]["proposed"]
    found = [name for name in MAPS if name in own]
    possible = [name for name in found if own[name].true_share <= largest_right_share(paper[name].f1)]
    near = [name for name in found if abs(own[name].auc - paper[name].auc) <= 0.03]
    return [
        "proposed, without noise: R@1 is possible with the published F1, p <= F1 / (2 - F1), on"
        f" {len(possible)} ({', '.join(possible) or 'none'})",
        f"proposed, without noise: AUC within 0.03 of the paper on {len(near)} ({', '.join(near) or 'none'})",
        *(_leaders([r for r in here if r.level == level], _LEVELS[level]) for level in (0, 2)),
    ]


def _leaders(results: Sequence[PaperCell], title: str) -> str:
    """The method with the best AUC on each map."""
    best: dict[str, PaperCell] = {}
    for result in results:
        name = result.map_name
        if name not in best or result.auc > best[name].auc:
            best[name] = result
    return f"{title}, best AUC: " + ", ".join(f"{m} {best[m].method}" for m in MAPS if m in best)


def _print_choices(
    results: Sequence[PaperCell],
    columns: Sequence[Column],
    title: str,
    choices: Sequence[SettingChoice],
    where: str,
) -> None:
    """A table of some choices: what the paper says, what the default does, and what the choice moves."""
    if {choice.overrides for choice in choices}.isdisjoint(r.overrides for r in results):
        return
    maps = [name for name, reading in columns if reading == "paper"]
    base = {(r.map_name, r.level): _auc_and_right(r) for r in results if _is_base(r)}
    heads = ("choice", "the paper says", "we do", "noise")
    shown = table(f"{title}: AUC x 1000, {where}", heads, (*maps, "mean", "mean R@1"))
    for level in (0, 2):
        defaults = {name: 1000 * base[name, level] for name in maps if (name, level) in base}
        _add_row(shown, ("all three", "", "Eq. 6"), level, defaults, maps, "")
    for choice, level in itertools.product(choices, (0, 2)):
        wanted = (choice.overrides, level)
        words = (choice.name, choice.paper, choice.ours) if level == 0 else ("", "", "")
        moved = {
            r.map_name: 1000 * (_auc_and_right(r) - base[r.map_name, level])
            for r in results
            if (r.overrides, r.level) == wanted and (r.map_name, level) in base
        }
        _add_row(shown, words, level, moved, maps, "+")
    show(shown)


def _auc_and_right(result: PaperCell) -> F64:
    measures = result.matches.measures()
    return np.array((measures.auc, measures.r_at_1))


def _add_row(
    shown: Table, words: Sequence[str], level: int, by_map: Mapping[str, F64], maps: Sequence[str], sign: str
) -> None:
    """AUC on each map, and the means of AUC and R@1; nothing without any map. sign : of the format."""
    if by_map:
        means = np.mean(list(by_map.values()), axis=0)
        values = [by_map[name][0] if name in by_map else None for name in maps]
        texts = ["" if value is None else f"{value:{sign}.0f}" for value in [*values, *means]]
        shown.add_row(*words, str(level), *texts)


def _is_base(result: PaperCell) -> bool:
    return (
        not result.overrides
        and result.method == "proposed"
        and result.radius_m == 8.0
        and result.reading == "paper"
    )


def draw_figures(results: Sequence[PaperCell], out: Path) -> list[Path]:
    """figure-9-OFFSET.png and figure-10-OFFSET.png: precision over recall; returns their paths."""
    paths = []
    plain = [r for r in results if not r.overrides and r.reading == "paper"]
    names = [name for name, _ in _columns(plain)]
    for offset_m in sorted({r.offset_m for r in plain}):
        here = [r for r in plain if r.offset_m == offset_m]
        levels = [[(r.method, r) for r in here if (r.level, r.radius_m) == (k, 8.0)] for k in range(3)]
        radii = [(f"r = {r.radius_m:g} m", r) for r in here if (r.level, r.method) == (1, "proposed")]
        radii.sort(key=lambda pair: pair[1].radius_m)
        for number, rows in (
            (9, list(zip(_LEVELS, levels, strict=True))),
            (10, [("noise level 1", radii)]),
        ):
            paths.append(out / f"figure-{number}-offset-{offset_m:g}.png")
            _draw_figure(paths[-1], rows, names)
    return paths


Curves = Sequence[tuple[str, PaperCell]]
"""Results, and what they are called."""


def _draw_figure(path: Path, rows: Sequence[tuple[str, Curves]], names: Sequence[str]) -> None:
    """The curves of each map (columns) and title (rows)."""
    with picture(path, 3.2 * len(names), 0.4 + 2.7 * len(rows)) as figure:
        axes = figure.subplots(len(rows), len(names), squeeze=False, sharex=True, sharey=True)
        for of_row, (title, curves) in zip(axes, rows, strict=True):
            for axis, name in zip(of_row, names, strict=True):
                _draw_curves(axis, [(label, r) for label, r in curves if r.map_name == name])
                axis.set_title(f"{name}, {title}", fontsize=9)
            of_row[0].set_ylabel("precision")
        for axis in axes[-1]:
            axis.set_xlabel("recall")
        if axes[0, 0].lines:
            axes[0, 0].legend(fontsize=7, loc="lower left")


def _draw_curves(axis: Any, curves: Curves) -> None:
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
