"""`pc2grid compare paper`: the paper's Tables III and IV on the paper's maps, published beside measured."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from pc2grid import __version__
from pc2grid.errors import ConfigError, MapFileError
from pc2grid.io.atomic import replace_file
from pc2grid_cli.console import Console, json_text, of, print_json
from pc2grid_cli.output_files import make_folder
from pc2grid_lab.baselines import EXTRA_METHOD_NAMES, METHOD_NAMES, require_packages
from pc2grid_lab.compare import options as options
from pc2grid_lab.compare import paper_report
from pc2grid_lab.compare.paper_report import published
from pc2grid_lab.experiments.paper_task import (
    ABLATION,
    OPEN_CHOICES,
    PaperCell,
    PaperTask,
    known_maps,
    load_result,
    paper_tasks,
    run_task,
)
from pc2grid_lab.experiments.stored import in_processes, write_text


def compare_paper_command(
    context: typer.Context,
    maps: Annotated[
        Path,
        typer.Option(
            "--maps",
            help="Folder with fr079.yaml, intel.yaml, ... of the paper; or a map, or a folder of maps.",
        ),
    ],
    out: options.OutputFolder = Path("paper-tables"),
    queries: Annotated[
        int, typer.Option("--queries", min=1, help="Queries a map. 2000 take hours; 200 for a quick look.")
    ] = 2000,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--methods",
            help="Only these; repeatable. Extras: point_contexts, shape_rings, opencv_shape_context, "
            "verified, proposed_centres, boundary_centres, shape_context_centres.",
        ),
    ] = None,
    offset: Annotated[
        list[float] | None,
        typer.Option(
            "--offset", help="Farthest a query lies from a submap centre, m; repeatable. [1.0 and 0.5]"
        ),
    ] = None,
    open_choices: Annotated[
        bool,
        typer.Option("--open-choices", help="Also what each departure and open parameter moves."),
    ] = False,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Also the proposed method without some of its signatures.")
    ] = False,
    speckles: Annotated[
        float,
        typer.Option("--speckles", min=0.0, help="Spread of the boundary noise, m; the paper gives none."),
    ] = 0.1,
    jobs: options.Jobs = None,
    seed: Annotated[int, typer.Option("--seed", help="Of the queries and their noise.")] = 1,
    as_json: options.AsJson = False,
) -> None:
    """Reproduce the paper's tables and figures 9 and 10, each number beside the published one.

    Example: pc2grid compare paper --maps maps/ --queries 200 --ablation
    """
    chosen, offsets_m = _chosen(methods), _offsets(offset)
    cells, map_paths = out / "cells", _maps(maps)
    make_folder(cells)
    choices = (ABLATION if ablation else ()) + (OPEN_CHOICES if open_choices else ())
    setting: dict[str, Any] = {"methods": chosen, "offsets_m": offsets_m, "queries": queries, "seed": seed}
    tasks = list(paper_tasks(map_paths, **setting, choices=choices, speckle_sigma_m=speckles))
    run_tasks(tasks, cells, jobs, of(context))
    results = _results(tasks, cells)
    document = _write(results, out, queries, seed)
    pictures = paper_report.draw_figures(results, out)
    if as_json:
        print_json(document)
    else:
        paper_report.print_tables(results, chosen)
        print(f"written: {out / 'results.json'}, {out / 'results.csv'}, {', '.join(map(str, pictures))}")


def _offsets(offset: Sequence[float] | None) -> tuple[float, ...]:
    offsets_m = tuple(offset or (1.0, 0.5))
    if min(offsets_m) <= 0:
        raise ConfigError("--offset: expected a distance above 0 m")
    return offsets_m


def _maps(path: Path) -> list[Path]:
    found = known_maps(path)
    if not found:
        raise MapFileError(
            f"{path}: no map is here", hint="a map.yaml, or a folder with intel.yaml, fr079.yaml, ..."
        )
    return list(found)


def _chosen(methods: Sequence[str] | None) -> tuple[str, ...]:
    """The methods that are compared. Raises ConfigError if one is not known, or cannot be run."""
    chosen, known = tuple(methods or METHOD_NAMES), METHOD_NAMES + EXTRA_METHOD_NAMES
    for name in chosen:
        if name not in known:
            raise ConfigError(f"--methods: no method {name!r}", hint=f"one of {', '.join(known)}")
    require_packages(chosen)
    return chosen


def run_tasks(tasks: Sequence[PaperTask], cells: Path, jobs: int | None, terminal: Console) -> None:
    """Run the tasks that have no result yet in `jobs` processes, and show the progress on `terminal`."""
    waiting = [(task, cells) for task in tasks if len(_results([task], cells)) < len(task.methods)]
    if waiting:
        with terminal.progress(f"{len(waiting)} cells of the tables") as advance:
            in_processes(run_task, waiting, jobs=jobs, advance=advance)


def _results(tasks: Iterable[PaperTask], cells: Path) -> list[PaperCell]:
    found = (load_result(task, method, cells) for task in tasks for method in task.methods)
    return [result for result in found if result is not None]


def _write(results: Sequence[PaperCell], out: Path, queries: int, seed: int) -> dict[str, Any]:
    """results.json and results.csv; returns the JSON document."""
    rows = []
    for result in results:
        paper = published(result)
        rows.append(
            result.summary()
            | {f"paper_{key}": None if paper is None else getattr(paper, key) for key in ("auc", "rp9", "f1")}
        )
    document = {"schema_version": 1, "version": __version__, "queries": queries, "seed": seed, "cells": rows}
    write_text(out / "results.json", json_text(document) + "\n")
    with replace_file(out / "results.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else ["map_name"])
        writer.writeheader()
        writer.writerows(rows)
    return document
