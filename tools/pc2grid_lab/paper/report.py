"""The paper's tables as text and its Figure 9 as a picture, from the results of `compare paper`.

`pc2grid compare paper`: the paper's Tables III and IV on the paper's maps, published beside measured.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.errors import ConfigError
from pc2grid.geometry import F64
from pc2grid_cli.console import Console, json_text
from pc2grid_cli.output import make_folder, show, table
from pc2grid_lab.compare import picture
from pc2grid_lab.experiments.program import (
    BACK,
    FRONT,
    LABORATORY,
    digest_of_sources,
    in_processes,
    write_text,
)
from pc2grid_lab.paper.cells import (
    RADII_M,
    SUBMAPS,
    PaperCell,
    cells_of,
    known_maps,
    paper_tasks,
    that_share_submaps,
)
from pc2grid_lab.paper.methods import (
    ABLATION,
    EXTRA_METHOD_NAMES,
    METHOD_NAMES,
    OPEN_CHOICES,
    OURS,
    SettingChoice,
)

_LEVELS = ("without noise", "noise level 1", "noise level 2")
_MEASURES = ("auc", "rp9", "f1", "r_at_1")
"""Those that the paper has come first."""


def print_tables(results: Sequence[PaperCell], methods: Sequence[str]) -> None:
    """Tables I, III and IV on stdout, in the order of a reader's questions: does the method hold, how do its
    rivals do, what beats it, and what do its parts and open choices move.
    """
    maps = list(dict.fromkeys(r.task.map_name for r in results))
    counts = {r.task.map_name: r.submaps for r in results if r.task.radius_m == 8.0}
    first = table("Table I, number of submaps", ["map"], ["paper", "ours"])
    for name in maps:
        first.add_row(name, str(SUBMAPS.get(name, "")), str(counts[name]))
    show(
        first,
        "Of three numbers: paper, ours, difference, in thousandths; +-: half of the interval from 5 to 95 %,"
        " by bootstrap over the queries. Methods that the paper does not have stand beside its own.",
    )
    ours, rivals, beyond = (
        [name for name in methods if name in group] for group in (OURS, METHOD_NAMES, EXTRA_METHOD_NAMES)
    )
    rivals, beyond = ([name for name in group if name not in OURS] for group in (rivals, beyond))
    for offset_m in dict.fromkeys(r.task.offset_m for r in results):
        of_offset = [r for r in results if r.task.offset_m == offset_m]
        plain = [r for r in of_offset if not r.task.overrides]
        where = f"queries within {offset_m:g} m of a submap centre"
        at_8_m = [(str(level), level, 8.0) for level in range(len(_LEVELS))]
        _print_measures(f"Table III, does it hold: {where}", "noise", at_8_m, plain, maps, ours)
        by_radius = [(f"{radius_m:g} m", 1, radius_m) for radius_m in RADII_M]
        _print_measures(f"Table IV, noise level 1: {where}", "radius", by_radius, plain, maps, ours)
        _print_measures(f"Table III, its rivals: {where}", "noise", at_8_m, plain, maps, rivals)
        _print_measures(f"What beats it: {where}", "noise", at_8_m, plain, maps, beyond)
        _print_choices(of_offset, maps, f"What each signature adds: {where}", ABLATION)
        _print_choices(of_offset, maps, f"What other choices move: {where}", OPEN_CHOICES)


def _print_measures(
    title: str,
    heading: str,
    settings: Sequence[tuple[str, int, float]],
    plain: Sequence[PaperCell],
    maps: Sequence[str],
    methods: Sequence[str],
) -> None:
    """A table of some methods: a row for each measure and setting (its name, noise level and radius), a
    column for each map and one for their mean."""
    shown = table(title, (heading, "measure", "method"), (*maps, "mean"))
    for (name, level, radius_m), measure, method in itertools.product(settings, _MEASURES, methods):
        wanted = (method, level, radius_m)
        row = {r.task.map_name: r for r in plain if (r.task.method, r.task.level, r.task.radius_m) == wanted}
        if row:
            title_of = "R@1" if measure == "r_at_1" else measure.upper()
            cells = [_cell([row[m]], measure) if m in row else "" for m in maps]
            shown.add_row(name, title_of, method, *cells, _cell(list(row.values()), measure))
    if shown.row_count:
        show(shown)


def _cell(cells: Sequence[PaperCell], measure: str) -> str:
    """The mean over maps: paper, ours, difference and interval; only ours if the paper lacks one of them."""
    ours = 1000 * float(np.mean([getattr(cell.measures, measure) for cell in cells]))
    halves = [getattr(cell.half_widths, measure) for cell in cells]
    # The queries of the maps are independent of each other.
    spread = f"+-{1000 * float(np.linalg.norm(halves)) / len(cells):<2.0f}"
    published = [p for cell in cells if (p := getattr(cell.published, measure, None)) is not None]
    if len(published) < len(cells):
        return f"{ours:.0f} {spread}"
    there = 1000 * float(np.mean(published))
    return f"{there:3.0f} {ours:4.0f} {ours - there:+4.0f} {spread}"


def _print_choices(
    results: Sequence[PaperCell], maps: Sequence[str], title: str, choices: Sequence[SettingChoice]
) -> None:
    """A table of some choices: what the paper says, what the letter does, and what the choice moves: AUC on
    each map, and the means of AUC and R@1, in thousandths."""
    if {choice.overrides for choice in choices}.isdisjoint(r.task.overrides for r in results):
        return
    shown = table(title, ("choice", "the paper says", "the letter", "noise"), (*maps, "mean", "mean R@1"))
    for level in (0, 2):
        wanted = ("proposed", level, 8.0)
        here = [r for r in results if (r.task.method, r.task.level, r.task.radius_m) == wanted]
        base = {r.task.map_name: _auc_and_right(r) for r in here if not r.task.overrides}
        shown.add_row("all three", "", "Eq. 6", str(level), *_with_means(base, maps, ""))
        for choice in choices:
            moved = {
                r.task.map_name: _auc_and_right(r) - base[r.task.map_name]
                for r in here
                if r.task.overrides == choice.overrides
            }
            words = (choice.name, choice.paper, choice.letter, str(level))
            shown.add_row(*words, *_with_means(moved, maps, "+"))
    show(shown)


def _auc_and_right(cell: PaperCell) -> F64:
    return 1000.0 * np.array((cell.measures.auc, cell.measures.r_at_1))


def _with_means(by_map: dict[str, F64], maps: Sequence[str], sign: str) -> list[str]:
    """AUC of each map, and the means of AUC and R@1. sign : of the format."""
    means = np.mean(list(by_map.values()), axis=0).tolist()
    values = [by_map[name][0] if name in by_map else None for name in maps]
    return ["" if value is None else f"{value:{sign}.0f}" for value in [*values, *means]]


def draw_figure(results: Sequence[PaperCell], offset_m: float, out: Path) -> Path:
    """Draw figure-9-offset-OFFSET.png, precision over recall by map and noise level; returns its path."""
    from matplotlib import colormaps

    plain = [
        r for r in results if not r.task.overrides and (r.task.offset_m, r.task.radius_m) == (offset_m, 8.0)
    ]
    maps = list(dict.fromkeys(r.task.map_name for r in plain))
    path = out / f"figure-9-offset-{offset_m:g}.png"
    with picture(path, 3.2 * len(maps), 9.0) as figure:
        axes = figure.subplots(len(_LEVELS), len(maps), squeeze=False, sharex=True, sharey=True)
        colours = colormaps["tab20"]
        number = {name: k for k, name in enumerate(dict.fromkeys(r.task.method for r in plain))}
        for (level, title), (k, name) in itertools.product(enumerate(_LEVELS), enumerate(maps)):
            axis = axes[level, k]
            for cell in (r for r in plain if (r.task.level, r.task.map_name) == (level, name)):
                curve = cell.matches.curve()
                if len(curve.recall):
                    # Like the area under the curve: from recall 0 at the precision of the first point.
                    recall, precision = [0.0, *curve.recall], [curve.precision[0], *curve.precision]
                    colour = colours(number[cell.task.method] % colours.N)
                    axis.plot(recall, precision, label=cell.task.method, linewidth=1.2, color=colour)
            axis.set_title(f"{name}, {title}", fontsize=9)
            axis.set(xlim=(0, 1.01), ylim=(0, 1.01), xlabel="recall", ylabel="precision")
            axis.label_outer()
            axis.grid(alpha=0.3)
        if axes[0, 0].lines:
            figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return path


def run(
    maps: Path,
    out: Path,
    terminal: Console,
    *,
    queries: int,
    methods: Sequence[str] | None,
    offset: Sequence[float] | None,
    open_choices: bool,
    ablation: bool,
    speckles: float,
    jobs: int | None,
    seed: int,
) -> None:
    """Compute the cells that are not in `out` yet, and write the tables and figures."""
    chosen, offsets_m = _chosen(methods), tuple(offset or (1.0, 0.5))
    if min(offsets_m) <= 0:
        raise ConfigError("--offset: expected a distance above 0 m")
    found = known_maps(maps)
    make_folder(out)
    choices = (ABLATION if ablation else ()) + (OPEN_CHOICES if open_choices else ())
    setting: dict[str, Any] = {"queries": queries, "seed": seed, "speckle_sigma_m": speckles}
    tasks = list(paper_tasks(found, methods=chosen, offsets_m=offsets_m, choices=choices, **setting))
    with terminal.progress(f"{len(tasks)} cells of the tables") as advance:
        kept = kept_in(out, found)
        groups = [(group, kept) for group in that_share_submaps(tasks)]
        cells = itertools.chain.from_iterable(in_processes(cells_of, groups, jobs=jobs, advance=advance))
    by_task = {cell.task: cell for cell in cells}
    results = [by_task[task] for task in tasks]
    document = {**setting, "cells": [cell.summary() for cell in results]}
    write_text(out / "results.json", json_text(document) + "\n")
    pictures = [draw_figure(results, offset_m, out) for offset_m in offsets_m]
    print_tables(results, chosen)
    print(f"written: {out / 'results.json'}, {', '.join(map(str, pictures))}")


def kept_in(out: Path, maps: Sequence[Path]) -> Path:
    """The folder of the results of these sources, these maps, and those beside them to learn from."""
    beside = {path for folder in {path.parent for path in maps} for path in known_maps(folder)}
    images = {file for path in {*maps, *beside} for file in path.parent.glob(f"{path.stem}.*")}
    return out / "cells" / digest_of_sources((FRONT, BACK, LABORATORY, *sorted(images)))


def _chosen(methods: Sequence[str] | None) -> tuple[str, ...]:
    """The methods that are compared. Raises ConfigError if one is not known."""
    chosen, known = tuple(methods or METHOD_NAMES), METHOD_NAMES + EXTRA_METHOD_NAMES
    for name in chosen:
        if name not in known:
            raise ConfigError(f"--methods: no method {name!r}", hint=f"one of {', '.join(known)}")
    return chosen
