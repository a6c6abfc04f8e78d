"""`pc2grid compare paper`: the paper's Tables III and IV on the paper's maps, published beside measured."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pc2grid.errors import ConfigError
from pc2grid_cli.console import Console, json_text
from pc2grid_cli.output_files import make_folder
from pc2grid_lab.experiments.program import BACK, FRONT, LABORATORY, digest_of_sources
from pc2grid_lab.experiments.stored import in_processes, write_text
from pc2grid_lab.paper.cells import cells_of, known_maps, paper_tasks, that_share_submaps
from pc2grid_lab.paper.choices import ABLATION, OPEN_CHOICES
from pc2grid_lab.paper.methods import EXTRA_METHOD_NAMES, METHOD_NAMES
from pc2grid_lab.paper.report import draw_figure, print_tables


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
