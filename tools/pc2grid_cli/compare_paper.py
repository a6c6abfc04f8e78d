"""`pc2grid compare paper`: the paper's Tables III and IV on the paper's maps, published beside measured."""

from __future__ import annotations

import csv
import multiprocessing
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from signature.evaluation.reproduce import Result, Task

_COSTS = {"proposed": 1.0, "shape_context": 1.0, "sdf": 14.0, "sift_bow": 8.0, "surf_bow": 14.0}


def compare_paper_command(
    maps: Annotated[
        Path, typer.Option("--maps", help="Folder with fr079.yaml, intel.yaml, ... of the paper.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for results; run again to go on.")] = Path(
        "paper-tables"
    ),
    queries: Annotated[
        int, typer.Option("--queries", min=1, help="Queries a map; 200 for a quick look.")
    ] = 2000,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--methods", help="Only these, repeatable. Extras: point_contexts, shape_rings, verified."
        ),
    ] = None,
    offset: Annotated[
        list[float] | None,
        typer.Option(
            "--offset", help="Farthest a query lies from a submap centre, m; repeatable. [0.5 and 1.0]"
        ),
    ] = None,
    open_choices: Annotated[
        bool,
        typer.Option("--open-choices", help="Also measure what each parameter the paper leaves open moves."),
    ] = False,
    jobs: Annotated[int | None, typer.Option("--jobs", min=1, help="Processes. [one a core]")] = None,
    seed: Annotated[int, typer.Option("--seed", help="Of the queries and their noise.")] = 1,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document instead of tables.")
    ] = False,
) -> None:
    """Reproduce the paper's tables and figures 9 and 10 on its maps, each number beside the published one.

    Example: pc2grid compare paper --maps maps/ --queries 200
    """
    from pc2grid.errors import ConfigError, MapFileError, OutputError
    from pc2grid_cli import paper_report
    from pc2grid_cli.console import print_json
    from signature.baselines import EXTRA_METHOD_NAMES, METHOD_NAMES
    from signature.evaluation.reproduce import known_maps, paper_tasks

    chosen = tuple(methods or METHOD_NAMES)
    known = METHOD_NAMES + EXTRA_METHOD_NAMES
    for name in chosen:
        if name not in known:
            raise ConfigError(f"--methods: no method {name!r}", hint=f"one of {', '.join(known)}")
    offsets_m = tuple(offset or (0.5, 1.0))
    if min(offsets_m) <= 0:
        raise ConfigError("--offset: expected a distance above 0 m")
    map_paths = known_maps(maps)
    if not map_paths:
        raise MapFileError(
            f"{maps}: none of the paper's maps is here", hint="a folder with intel.yaml, fr079.yaml, ..."
        )
    cells = out / "cells"
    try:
        cells.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{cells}: {error.strerror}") from error
    tasks = list(
        paper_tasks(
            map_paths,
            methods=chosen,
            offsets_m=offsets_m,
            queries=queries,
            seed=seed,
            open_choices=open_choices,
        )
    )
    run_tasks(tasks, cells, jobs or os.cpu_count() or 1)
    results = _results(tasks, cells)
    document = _write(results, out, queries, seed)
    pictures = paper_report.draw_figures(results, out)
    if as_json:
        print_json(document)
    else:
        paper_report.print_tables(results, chosen)
        print(f"written: {out / 'results.json'}, {out / 'results.csv'}, {', '.join(map(str, pictures))}")


def run_tasks(tasks: Sequence[Task], cells: Path, jobs: int) -> None:
    """Run the tasks that have no result yet in `jobs` processes, with a progress bar on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from signature.evaluation.reproduce import load_result

    open_tasks = [t for t in tasks if any(load_result(t, m, cells) is None for m in t.methods)]
    if not open_tasks:
        return
    # One thread a process, as the processes are the parallelism; libraries read this when they are loaded.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    context = multiprocessing.get_context("spawn")
    done_shares = context.SimpleQueue()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with (
        Progress(*columns, console=Console(stderr=True)) as progress,
        ProcessPoolExecutor(
            jobs, mp_context=context, initializer=_start_worker, initargs=(done_shares,)
        ) as pool,
    ):
        bar = progress.add_task("cells of the tables", total=len(open_tasks))
        shares = dict.fromkeys(range(len(open_tasks)), 0.0)
        costs = [_cost(task) for task in open_tasks]
        pending = {pool.submit(_run, index, task, cells) for index, task in enumerate(open_tasks)}
        try:
            while pending:
                finished, pending = wait(pending, timeout=0.5, return_when=FIRST_COMPLETED)
                for future in finished:
                    shares[future.result()] = 1.0
                while not done_shares.empty():
                    index, share = done_shares.get()
                    shares[index] = max(shares[index], share)
                weighted = sum(costs[i] * share for i, share in shares.items()) / sum(costs)
                progress.update(bar, completed=round(weighted * len(open_tasks), 2))
        except BaseException:
            # Whole cells are kept; what is queued must not go on after the user has stopped.
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _cost(task: Task) -> float:
    """Rough relative time of a task, so that the bar moves evenly."""
    return _COSTS.get(task.methods[0], 10.0) * (5.0 if task.reading == "true" else 1.0)


_shares: Any = None


def _start_worker(shares: Any) -> None:
    global _shares
    import cv2

    _shares = shares
    cv2.setNumThreads(1)


def _run(index: int, task: Task, cells: Path) -> int:
    from signature.evaluation.reproduce import run_task

    reported = 0.0

    def report(share: float) -> None:
        nonlocal reported
        if share >= reported + 0.05:
            reported = share
            _shares.put((index, share))

    run_task(task, cells, report)
    return index


def _results(tasks: Iterable[Task], cells: Path) -> list[Result]:
    from signature.evaluation.reproduce import load_result

    found = (load_result(task, method, cells) for task in tasks for method in task.methods)
    return [result for result in found if result is not None]


def _write(results: Sequence[Result], out: Path, queries: int, seed: int) -> dict[str, Any]:
    """results.json and results.csv; returns the JSON document."""
    from pc2grid import __version__
    from pc2grid.io.atomic import replace_file
    from pc2grid_cli.console import json_text
    from pc2grid_cli.paper_report import published

    rows = []
    for result in results:
        paper = published(result)
        rows.append(
            result.summary()
            | {f"paper_{key}": None if paper is None else getattr(paper, key) for key in ("auc", "rp9", "f1")}
        )
    document = {"schema_version": 1, "version": __version__, "queries": queries, "seed": seed, "cells": rows}
    with replace_file(out / "results.json") as temporary:
        temporary.write_text(json_text(document) + "\n", encoding="utf-8")
    with replace_file(out / "results.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else ["map_name"])
        writer.writeheader()
        writer.writerows(rows)
    return document
