"""`pc2grid compare sensors`: maps by each sensor, queries by each, in real floor plans."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import typer

from pc2grid.errors import ConfigError, MapFileError
from pc2grid.io.nav2_map import load_map
from pc2grid.model import SensorKind
from pc2grid_cli.console import Console, json_text, of, print_json
from pc2grid_cli.output_files import make_folder
from pc2grid_lab.compare import options as options
from pc2grid_lab.compare.matrix_report import contribution_table, draw, draw_signatures, tables
from pc2grid_lab.experiments.ablation import COMBINATIONS, Independence, independence, recall_by_combination
from pc2grid_lab.experiments.metrics import ConfidenceError, matrix, reliability
from pc2grid_lab.experiments.plan_drives import PlanDrives
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.sensor_matrix import SENSORS, TRAVELS_M, query_trials
from pc2grid_lab.experiments.stored import in_processes, write_text
from pc2grid_lab.experiments.trial import Trial
from pc2grid_lab.worlds import prepare_session
from signature.localization.posterior import FITTED_ON


def compare_sensors_command(
    context: typer.Context,
    plans: Annotated[
        list[Path],
        typer.Argument(help="Floor plans: MAP.yaml files; of several, each query is also sought in another."),
    ],
    out: options.OutputFolder = Path("sensor-matrix"),
    queries: Annotated[int, typer.Option("--queries", min=1, help="query sessions a plan and sensor")] = 10,
    map_length: Annotated[float, typer.Option("--map-length", help="metres driven to make a map")] = 200.0,
    clutter: Annotated[
        int, typer.Option("--clutter", help="things in the way, different in each session")
    ] = 30,
    change: Annotated[
        float,
        typer.Option("--change", min=0, max=1, help="share of doors and furniture that differ, by session"),
    ] = 0.0,
    rate: Annotated[float, typer.Option("--rate", help="scans a second, of every sensor")] = 10.0,
    travel: Annotated[
        float, typer.Option("--travel", min=1.0, help="Metres that a query drives at most.")
    ] = 15.0,
    seed: Annotated[int, typer.Option("--seed", help="of the first query session")] = 1,
    jobs: options.Jobs = None,
    as_json: options.AsJson = False,
) -> None:
    """Map plans with lidar, laser and depth camera, locate sessions of each in each: nine cells.

    Example: pc2grid compare sensors maps/fr079.yaml maps/intel.yaml --queries 40 --out matrix
    """
    _refuse(plans)
    for folder in ("", "maps", "drives", "trials"):
        make_folder(out / folder)
    setting: dict[str, float] = {"map_length": map_length, "clutter": clutter, "rate": rate, "travel": travel}
    if change:  # without it the results of earlier runs stay valid
        setting["change"] = change
    drives = PlanDrives(out=out, setting=tuple(setting.items()), until_m=travel, length_m=travel + 3.0)
    trials = _asked(drives, plans, range(seed, seed + queries), of(context), jobs)
    independent = _independent([[drives.read_map(plan.stem, sensor) for sensor in SENSORS] for plan in plans])
    document = {
        **_document(trials, independent, max(d for d in TRAVELS_M if d <= min(travel, 8.0))),
        "plans": [plan.stem for plan in plans],
        "queries": queries,
        "setting": {**setting, "seed": seed},
        "change": {plan.stem: _mean_change(plan, drives, seed, min(queries, 5)) for plan in plans},
    }
    write_text(out / "matrix.json", json_text(document) + "\n")
    _, others = _by_tuning(trials)
    draw(out / "matrix.png", matrix(trials), reliability(others or trials), fitted_on=not others)
    draw_signatures(out / "signatures.png", independent, document["ablation"]["recall"])
    if as_json:
        print_json(document)
    else:
        _print(document, trials, independent)
        print("\n".join(str(out / name) for name in ("matrix.json", "matrix.png", "signatures.png")))


def _asked(
    drives: PlanDrives, plans: Sequence[Path], seeds: Sequence[int], terminal: Console, jobs: int | None
) -> list[Trial]:
    """The trials of all query sessions, after the maps are made and the sessions driven."""
    sessions = [(drives, plan, sensor, seed) for seed in seeds for plan in plans for sensor in SENSORS]
    for what, function, tasks in (
        ("map", _map, [(drives, plan, sensor) for plan in plans for sensor in SENSORS]),
        ("drive", _drive, sessions),
        ("locate", _locate, [(*task, plans) for task in sessions]),
    ):
        with terminal.progress(what) as advance:
            found = in_processes(function, tasks, jobs=jobs, advance=advance)
    return [trial for trials in found for trial in trials]


def _refuse(plans: Sequence[Path]) -> None:
    """Raises ConfigError or MapFileError for plans that cannot be compared."""
    names = [plan.stem for plan in plans]
    if len(set(names)) != len(names):
        raise ConfigError(f"two plans share a name: {', '.join(names)}", hint="rename one of the files")
    for plan in plans:
        if not plan.is_file():
            raise MapFileError(f"{plan}: no such file", hint="give the path of a map.yaml")


def _independent(buildings: Sequence[Sequence[SensorMap]]) -> dict[str, Independence]:
    """Of all buildings together, by combination of signatures."""
    measured = zip(*(independence(maps) for maps in buildings), strict=True)
    return dict(zip(COMBINATIONS, map(Independence.together, measured), strict=True))


def _print(
    document: Mapping[str, Any], trials: Sequence[Trial], independent: Mapping[str, Independence]
) -> None:
    tables(matrix(trials), _elsewhere(trials))
    for name, counts in document["change"].items():
        print(f"{name}: between sessions {_change_text(counts)}")
    ablation = document["ablation"]
    contribution_table(independent, ablation["recall"], ablation["travel_m"])
    for name, some in zip(("plans it was fitted on", "other plans"), _by_tuning(trials), strict=True):
        if some:
            errors = ConfidenceError.of(some)
            print(
                f"confidence, {name}: Brier {errors.brier:.3f},"
                f" expected error {errors.expected_error:.3f} ({errors.trials} answers)"
            )


def _document(
    trials: Sequence[Trial], independent: Mapping[str, Independence], described_m: float
) -> dict[str, Any]:
    """The document of all trials. described_m : metres driven after which the signatures are compared."""
    elsewhere = _elsewhere(trials)
    return {
        "schema_version": 1,
        "cells": [asdict(cell) for cell in matrix(trials)],
        "confidence": {
            name: asdict(ConfidenceError.of(some))
            for name, some in zip(("tuned on", "other plans"), _by_tuning(trials), strict=True)
        },
        "outside_the_map": sum(t.in_building and not t.in_map for t in trials),
        "elsewhere": {
            "trials": len(elsewhere),
            "not_found": sum(t.status == "not_found" for t in elsewhere),
            "located": sum(t.status == "located" for t in elsewhere),
        },
        "independence": {
            name: {"auc": one.auc, "same": len(one.same), "other": len(one.other)}
            for name, one in independent.items()
        },
        "ablation": {"travel_m": described_m, "recall": recall_by_combination(trials, described_m)},
    }


def _mean_change(plan: Path, drives: PlanDrives, seed: int, sessions: int) -> dict[str, float]:
    """What differs in a session from the plan, and its clutter: mean of the first sessions."""
    grid = load_map(plan)
    configs = [drives.simulation(drives.until_m, seed + k) for k in range(sessions)]
    prepared = [prepare_session(sensor="laser", grid=grid, config=config) for config in configs]
    counts = [{**p.change.counts(), "clutter": float(len(p.clutter))} for p in prepared]
    return {key: sum(c[key] for c in counts) / len(counts) for key in counts[0]}


def _change_text(counts: Mapping[str, float]) -> str:
    text = f"{counts['clutter']:.0f} objects stand elsewhere"
    if counts["doorways"]:
        text += (
            f", {counts['closed']:.1f} of {counts['doorways']:.0f} doors are shut, {counts['ajar']:.1f} ajar"
        )
    if counts["pieces"]:
        moved = counts["moved"] + counts["exchanged"]
        text += f", {moved:.1f} of {counts['pieces']:.0f} pieces of furniture are moved or exchanged"
    return text + f"; {100 * counts['walls_changed']:.0f} % of the visible walls differ from the plan"


def _elsewhere(trials: Sequence[Trial]) -> list[Trial]:
    """The trials whose query comes from another building than the map."""
    return [t for t in trials if not t.in_building]


def _by_tuning(trials: Sequence[Trial]) -> tuple[list[Trial], list[Trial]]:
    """The trials in plans that the confidence was fitted on, and the other ones."""
    tuned = [t for t in trials if FITTED_ON.intersection(t.buildings)]
    return tuned, [t for t in trials if not FITTED_ON.intersection(t.buildings)]


def _map(drives: PlanDrives, plan: Path, sensor: SensorKind) -> None:
    drives.make_map(plan.stem, partial(load_map, plan), sensor)


def _drive(drives: PlanDrives, plan: Path, sensor: SensorKind, seed: int) -> None:
    drives.drive(plan.stem, partial(load_map, plan), sensor, seed)


_mapped = cache(PlanDrives.read_map)


def _locate(
    drives: PlanDrives, plan: Path, sensor: SensorKind, seed: int, plans: Sequence[Path]
) -> list[Trial]:
    """One query session in the maps of its own plan and of one other."""
    file = drives.file("trials", plan.stem, sensor, seed, suffix="json")
    if not file.exists():
        others = [p for p in plans if p != plan]
        searched = [plan, *others[seed % len(others) :][:1]] if others else [plan]
        maps = [_mapped(drives, p.stem, s) for p in searched for s in SENSORS]
        session = drives.drive(plan.stem, partial(load_map, plan), sensor, seed)
        write_text(file, json.dumps([asdict(t) for t in query_trials(plan.stem, seed, session, maps)]))
    return [Trial(**row) for row in json.loads(file.read_text())]
