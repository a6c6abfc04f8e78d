"""`pc2grid compare sensors`: maps by each sensor, queries by each, in real floor plans."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pc2grid_cli.options import OUTPUT_FOLDER
from pc2grid_cli.output_files import make_folder

if TYPE_CHECKING:
    from pc2grid.model import SensorKind
    from pc2grid_lab.experiments.ablation import Independence
    from pc2grid_lab.experiments.sensor_map import SensorMap
    from pc2grid_lab.experiments.trial import Trial
    from pc2grid_lab.worlds import WorldConfig

Setting = dict[str, float]

MAP_SEED = 1000
"""Map sessions and query sessions never share a seed: other clutter, start, direction and noise."""


def compare_sensors_command(
    context: typer.Context,
    plans: Annotated[
        list[Path],
        typer.Argument(help="Floor plans: MAP.yaml files; of several, each query is also asked in another."),
    ],
    out: Annotated[Path, typer.Option(*OUTPUT_FOLDER, help="Folder for results; run again to go on.")] = Path(
        "sensor-matrix"
    ),
    queries: Annotated[int, typer.Option("--queries", min=1, help="Query sessions a plan and sensor.")] = 10,
    map_length: Annotated[float, typer.Option("--map-length", help="Metres driven to make a map.")] = 200.0,
    clutter: Annotated[
        int, typer.Option("--clutter", help="Things in the way, different in each session.")
    ] = 30,
    change: Annotated[
        float,
        typer.Option("--change", min=0, max=1, help="Share of doors and furniture that differ, by session."),
    ] = 0.0,
    rate: Annotated[float, typer.Option("--rate", help="Scans a second, of every sensor.")] = 10.0,
    travel: Annotated[
        float, typer.Option("--travel", min=1.0, help="Metres that a query drives at most.")
    ] = 15.0,
    seed: Annotated[int, typer.Option("--seed", help="Of the first query session.")] = 1,
    jobs: Annotated[int | None, typer.Option("--jobs", min=1, help="Processes. [one a core]")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document instead of tables.")
    ] = False,
) -> None:
    """Map plans with lidar, laser and depth camera, locate sessions of each in each: nine cells.

    Example: pc2grid compare sensors maps/fr079.yaml maps/intel.yaml --queries 40 --out matrix
    """
    from pc2grid.errors import ConfigError, MapFileError
    from pc2grid.io.atomic import replace_file
    from pc2grid_cli.console import json_text, of, print_json
    from pc2grid_lab.compare.matrix_report import contribution_table, draw, draw_signatures, tables
    from pc2grid_lab.experiments.ablation import (
        COMBINATIONS,
        Independence,
        independence,
        recall_by_combination,
    )
    from pc2grid_lab.experiments.metrics import ConfidenceError, matrix, reliability
    from pc2grid_lab.experiments.sensor_matrix import SENSORS, TRAVELS_M

    names = [plan.stem for plan in plans]
    if len(set(names)) != len(names):
        raise ConfigError(f"two plans share a name: {', '.join(names)}", hint="rename one of the files")
    for plan in plans:
        if not plan.is_file():
            raise MapFileError(f"{plan}: no such file", hint="give the path of a map.yaml")
    for folder in ("", "maps", "drives", "trials"):
        make_folder(out / folder)
    setting = {"map_length": map_length, "clutter": clutter, "rate": rate, "travel": travel}
    if change:  # without it the results of earlier runs stay valid
        setting["change"] = change
    here = [(str(p), sensor, str(out), setting) for p in plans for sensor in SENSORS]
    asking = [
        (str(p), sensor, seed + i, str(out), setting)
        for i in range(queries)
        for p in plans
        for sensor in SENSORS
    ]
    everywhere = [str(p) for p in plans]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs or os.cpu_count(), mp_context=spawn) as pool:
        for what, function, tasks in (
            ("map", _map, here),
            ("drive", _drive, asking),
            ("locate", _locate, [(*task, everywhere) for task in asking]),
        ):
            with of(context).progress(what) as advance:
                waiting = [pool.submit(function, *task) for task in tasks]
                for done, future in enumerate(as_completed(waiting), start=1):
                    future.result()
                    advance(done / len(waiting))
    trials = [t for task in asking for t in _read(_file("trials", *task))]
    tag = tuple(sorted(setting.items()))
    known = [
        measured
        for plan in plans
        for measured in independence([_mapped(str(plan), s, str(out), tag) for s in SENSORS])
    ]
    independent = {
        name: Independence.together([k for k in known if k.combination == name]) for name in COMBINATIONS
    }
    described_m = max(d for d in TRAVELS_M if d <= min(travel, 8.0))
    cells, elsewhere = matrix(trials), _elsewhere(trials)
    contributions = recall_by_combination(trials, described_m)
    tuned, others = _by_tuning(trials)
    changed = {
        plan.stem: _mean_change(
            plan, [_simulation(setting, travel, seed + k) for k in range(min(queries, 5))]
        )
        for plan in plans
    }
    document = {
        **_document(trials, independent, described_m),
        "plans": names,
        "queries": queries,
        "setting": {**setting, "seed": seed},
        "change": changed,
    }
    with replace_file(out / "matrix.json") as draft:
        draft.write_text(json_text(document) + "\n", encoding="utf-8")
    draw(out / "matrix.png", cells, reliability(others or trials), fitted_on=not others)
    draw_signatures(out / "signatures.png", independent, contributions)
    if as_json:
        print_json(document)
    else:
        tables(cells, elsewhere)
        for name, counts in changed.items():
            print(f"{name}: between sessions {_change_text(counts)}")
        contribution_table(independent, contributions, described_m)
        for name, some in (("plans it was fitted on", tuned), ("other plans", others)):
            if some:
                errors = ConfidenceError.of(some)
                print(
                    f"confidence, {name}: Brier {errors.brier:.3f},"
                    f" expected error {errors.expected_error:.3f} ({errors.trials} answers)"
                )
        print("\n".join(str(out / name) for name in ("matrix.json", "matrix.png", "signatures.png")))


def _document(
    trials: Sequence[Trial], independent: Mapping[str, Independence], described_m: float
) -> dict[str, Any]:
    """The document of all trials. described_m : metres driven after which the signatures are compared."""
    from pc2grid_lab.experiments.ablation import recall_by_combination
    from pc2grid_lab.experiments.metrics import ConfidenceError, matrix

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


def _mean_change(plan: Path, sessions: Sequence[WorldConfig]) -> dict[str, float]:
    """What differs in a session from the plan, and its clutter: mean of some sessions."""
    from pc2grid.io.nav2_map import load_map
    from pc2grid_lab.worlds import prepare_session

    grid = load_map(plan)
    prepared = [prepare_session(sensor="laser", grid=grid, config=config) for config in sessions]
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
    from signature.localization.confidence import FITTED_ON

    tuned = [t for t in trials if FITTED_ON.intersection(t.buildings)]
    return tuned, [t for t in trials if not FITTED_ON.intersection(t.buildings)]


def _map_file(plan: str, sensor: str, out: str, setting: Setting) -> Path:
    return Path(out) / "maps" / f"{Path(plan).stem}.{sensor}.{_tag(setting)}.submaps"


def _file(kind: str, plan: str, sensor: str, seed: int, out: str, setting: Setting) -> Path:
    """The file of a query session: of its "drives" (registered, .npz) or its "trials" (.json)."""
    suffix = {"drives": "npz", "trials": "json"}[kind]
    return Path(out) / kind / f"{Path(plan).stem}.{sensor}.{seed}.{_tag(setting)}.{suffix}"


def _tag(setting: Setting) -> str:
    return ".".join(f"{key}{value:g}" for key, value in sorted(setting.items()))


def _mapping(setting: Setting) -> WorldConfig:
    return _simulation(setting, setting["map_length"], MAP_SEED)


def _simulation(
    setting: Setting, length_m: float, seed: int, start_m: tuple[float, float] | None = None
) -> WorldConfig:
    from pc2grid_lab.worlds import WorldConfig

    rate = {"rate_hz": setting["rate"]}
    return WorldConfig.model_validate(
        {
            "length_m": length_m,
            "seed": seed,
            "clutter": int(setting["clutter"]),
            "start_m": start_m,
            "change": {"doors": setting.get("change", 0.0), "furniture": setting.get("change", 0.0)},
            **dict.fromkeys(("lidar", "laser", "depth"), rate),
        }
    )


def _map(plan: str, sensor: SensorKind, out: str, setting: Setting) -> None:
    """Make the map of one plan by one sensor, unless it exists."""
    from pc2grid.io.nav2_map import load_map
    from pc2grid_lab.experiments.sensor_map import is_saved, save_map
    from pc2grid_lab.experiments.sensor_matrix import map_building
    from signature.config import Config

    target = _map_file(plan, sensor, out, setting)
    if is_saved(target):
        return
    config = Config()
    session_map, T_plan_map = map_building(
        Path(plan).stem, load_map(Path(plan)), sensor, _mapping(setting), config
    )
    save_map(target, session_map, T_plan_map, Path(plan), config)


def _drive(plan: str, sensor: SensorKind, seed: int, out: str, setting: Setting) -> None:
    """Simulate and register one query session, unless it was done before."""
    from pc2grid.io.nav2_map import load_map
    from pc2grid_lab.experiments.registered_session import simulate_and_register
    from pc2grid_lab.experiments.sensor_matrix import query_start
    from signature.config import Config

    target = _file("drives", plan, sensor, seed, out, setting)
    if target.exists():
        return
    grid, until_m = load_map(Path(plan)), setting["travel"]
    start_m = query_start(grid, _mapping(setting), seed)
    simulation = _simulation(setting, until_m + 3.0, seed, start_m)
    simulate_and_register(grid, sensor, simulation, Config(), until_m=until_m).save(target)


@cache
def _mapped(plan: str, sensor: SensorKind, out: str, tag: tuple[tuple[str, Any], ...]) -> SensorMap:
    from pc2grid_lab.experiments.sensor_map import load_map
    from signature.config import Config

    target = _map_file(plan, sensor, out, dict(tag))
    return load_map(target, name=Path(plan).stem, sensor=sensor, config=Config())


def _locate(
    plan: str, sensor: SensorKind, seed: int, out: str, setting: Setting, plans: Sequence[str]
) -> None:
    """Locate one query session in the maps of its own plan and of one other, unless it was done before."""
    from pc2grid.io.atomic import replace_file
    from pc2grid_lab.experiments.registered_session import RegisteredSession
    from pc2grid_lab.experiments.sensor_matrix import SENSORS, query_trials

    target = _file("trials", plan, sensor, seed, out, setting)
    if target.exists():
        return
    tag = tuple(sorted(setting.items()))
    others = [p for p in plans if p != plan]
    asked = [plan, *others[seed % len(others) :][:1]] if others else [plan]
    maps = [_mapped(p, s, out, tag) for p in asked for s in SENSORS]
    session = RegisteredSession.load(_file("drives", plan, sensor, seed, out, setting))
    trials = query_trials(Path(plan).stem, seed, session, maps)
    with replace_file(target) as draft:
        draft.write_text(json.dumps([asdict(trial) for trial in trials]))


def _read(path: Path) -> list[Trial]:
    from pc2grid_lab.experiments.trial import Trial

    rows = json.loads(path.read_text())
    return [Trial(**row) for row in rows]
