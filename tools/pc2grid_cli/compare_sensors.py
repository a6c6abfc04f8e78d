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

if TYPE_CHECKING:
    from pc2grid.model import SensorKind
    from pc2grid.simulate import SimulationConfig
    from signature.evaluation.contribution import Independence
    from signature.evaluation.mapped import Mapped
    from signature.evaluation.trial import Trial

Setting = dict[str, float]

MAP_SEED = 1000
"""Map sessions and query sessions never share a seed: other clutter, start, direction and noise."""


def compare_sensors_command(
    plans: Annotated[list[Path], typer.Argument(help="Floor plans: MAP.yaml files, two or more.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for results; run again to go on.")] = Path(
        "sensor-matrix"
    ),
    queries: Annotated[int, typer.Option("--queries", min=1, help="Query sessions a plan and sensor.")] = 10,
    map_length: Annotated[float, typer.Option("--map-length", help="Metres driven to make a map.")] = 200.0,
    clutter: Annotated[
        int, typer.Option("--clutter", help="Things in the way, different in each session.")
    ] = 30,
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
    from pc2grid.errors import ConfigError, MapFileError, OutputError
    from pc2grid.io.atomic import replace_file
    from pc2grid_cli.console import json_text, print_json, progress
    from pc2grid_cli.matrix_report import contribution_table, draw, draw_signatures, tables
    from signature.evaluation.contribution import COMBINATIONS, Independence, independence
    from signature.evaluation.sensor_matrix import DISTANCES_M, SENSORS
    from signature.evaluation.summary import Truthfulness, ablation, matrix, reliability

    names = [plan.stem for plan in plans]
    if len(set(names)) != len(names):
        raise ConfigError(f"two plans share a name: {', '.join(names)}", hint="rename one of the files")
    for plan in plans:
        if not plan.is_file():
            raise MapFileError(f"{plan}: no such file", hint="give the path of a map.yaml")
    try:
        for folder in ("maps", "drives", "trials"):
            (out / folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: {error.strerror}", hint="choose another --out") from error
    setting = {"map_length": map_length, "clutter": clutter, "rate": rate, "travel": travel}
    here = [(str(p), sensor, str(out), setting) for p in plans for sensor in SENSORS]
    asking = [
        (str(p), sensor, seed + i, str(out), setting)
        for i in range(queries)
        for p in plans
        for sensor in SENSORS
    ]
    everywhere = [str(p) for p in plans]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs or os.cpu_count(), mp_context=context) as pool:
        for what, function, tasks in (
            ("map", _map, here),
            ("drive", _drive, asking),
            ("locate", _locate, [(*task, everywhere) for task in asking]),
        ):
            with progress(what) as advance:
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
    described_m = max(d for d in DISTANCES_M if d <= min(travel, 8.0))
    cells, elsewhere, contributions = matrix(trials), _elsewhere(trials), ablation(trials, described_m)
    tuned, others = _by_tuning(trials)
    document = {
        **_document(trials, independent, described_m),
        "plans": names,
        "queries": queries,
        "setting": {**setting, "seed": seed},
    }
    with replace_file(out / "matrix.json") as draft:
        draft.write_text(json_text(document) + "\n", encoding="utf-8")
    draw(out / "matrix.png", cells, reliability(others or trials))
    draw_signatures(out / "signatures.png", independent, contributions)
    if as_json:
        print_json(document)
    else:
        tables(cells, elsewhere)
        contribution_table(independent, contributions, described_m)
        for name, some in (("plans it was tuned on", tuned), ("other plans", others)):
            if some:
                truthful = Truthfulness.of(some)
                print(
                    f"confidence, {name}: Brier {truthful.brier:.3f},"
                    f" expected error {truthful.expected_error:.3f} ({truthful.trials} answers)"
                )
        print("\n".join(str(out / name) for name in ("matrix.json", "matrix.png", "signatures.png")))


def _document(
    trials: Sequence[Trial], independent: Mapping[str, Independence], described_m: float
) -> dict[str, Any]:
    """What all trials say together. described_m : metres driven after which the signatures are compared."""
    from signature.evaluation.summary import Truthfulness, ablation, matrix, reliability
    from signature.evaluation.trial import MAPPED

    elsewhere = _elsewhere(trials)
    return {
        "schema_version": 1,
        "cells": [asdict(cell) for cell in matrix(trials)],
        "confidence": {
            name: {**asdict(Truthfulness.of(some)), "reliability": reliability(some)}
            for name, some in zip(("tuned on", "other plans"), _by_tuning(trials), strict=True)
        },
        "outside_the_map": sum(t.in_building and t.mapped < MAPPED for t in trials),
        "elsewhere": {
            "trials": len(elsewhere),
            "not_found": sum(t.status == "not_found" for t in elsewhere),
            "located": sum(t.status == "located" for t in elsewhere),
        },
        "independence": {
            name: {"auc": one.auc, "same": len(one.same), "other": len(one.other)}
            for name, one in independent.items()
        },
        "ablation": {"travel_m": described_m, "recall": ablation(trials, described_m)},
    }


def _elsewhere(trials: Sequence[Trial]) -> list[Trial]:
    """Those of queries from another building than the map."""
    return [t for t in trials if not t.in_building]


def _by_tuning(trials: Sequence[Trial]) -> tuple[list[Trial], list[Trial]]:
    """Those in plans that the confidence was tuned on, and the others."""
    from signature.confidence import TUNED_ON

    tuned = [t for t in trials if t.building in TUNED_ON]
    return tuned, [t for t in trials if t.building not in TUNED_ON]


def _map_file(plan: str, sensor: str, out: str, setting: Setting) -> Path:
    return Path(out) / "maps" / f"{Path(plan).stem}.{sensor}.{_tag(setting)}.submaps"


def _file(kind: str, plan: str, sensor: str, seed: int, out: str, setting: Setting) -> Path:
    """What is kept of a query session: its "drives" (registered, .npz) or its "trials" (.json)."""
    suffix = {"drives": "npz", "trials": "json"}[kind]
    return Path(out) / kind / f"{Path(plan).stem}.{sensor}.{seed}.{_tag(setting)}.{suffix}"


def _tag(setting: Setting) -> str:
    return ".".join(f"{key}{value:g}" for key, value in sorted(setting.items()))


def _mapping(setting: Setting) -> SimulationConfig:
    return _simulation(setting, setting["map_length"], MAP_SEED)


def _simulation(
    setting: Setting, length_m: float, seed: int, start_m: tuple[float, float] | None = None
) -> SimulationConfig:
    from pc2grid.simulate import SimulationConfig

    rate = {"rate_hz": setting["rate"]}
    return SimulationConfig.model_validate(
        {
            "length_m": length_m,
            "seed": seed,
            "clutter": int(setting["clutter"]),
            "start_m": start_m,
            **dict.fromkeys(("lidar", "laser", "depth"), rate),
        }
    )


def _map(plan: str, sensor: SensorKind, out: str, setting: Setting) -> None:
    """Make the map of one plan by one sensor, unless it is there."""
    from pc2grid.io.atomic import replace_file
    from pc2grid.io.nav2_map import load_map
    from signature.build import add_session, provenance
    from signature.config import Config
    from signature.evaluation.sensor_matrix import map_building

    target = _map_file(plan, sensor, out, setting)
    frame = target.with_suffix(".json")
    if target.exists() and frame.exists():
        return
    config = Config()
    session_map, T_plan_map = map_building(
        Path(plan).stem, load_map(Path(plan)), sensor, _mapping(setting), config
    )
    target.unlink(missing_ok=True)
    add_session(target, session_map, config, provenance(Path(plan), "0" * 64, config))
    with replace_file(frame) as draft:
        draft.write_text(json.dumps([T_plan_map.x, T_plan_map.y, T_plan_map.yaw]))


def _drive(plan: str, sensor: SensorKind, seed: int, out: str, setting: Setting) -> None:
    """Simulate and register one query session, unless it was done before."""
    from pc2grid.io.nav2_map import load_map
    from signature.config import Config
    from signature.evaluation.driven import drive
    from signature.evaluation.sensor_matrix import start_of

    target = _file("drives", plan, sensor, seed, out, setting)
    if target.exists():
        return
    grid, until_m = load_map(Path(plan)), setting["travel"]
    start_m = start_of(grid, _mapping(setting), seed)
    simulation = _simulation(setting, until_m + 3.0, seed, start_m)
    drive(grid, sensor, simulation, Config(), until_m=until_m).save(target)


@cache
def _mapped(plan: str, sensor: SensorKind, out: str, tag: tuple[tuple[str, Any], ...]) -> Mapped:
    from pc2grid.geometry import SE2
    from signature.config import Config
    from signature.database import open_database
    from signature.evaluation.mapped import Mapped
    from signature.relocalize import Building

    target = _map_file(plan, sensor, out, dict(tag))
    with open_database(target) as database:
        building = Building.of(database, Config())
    frame = json.loads(target.with_suffix(".json").read_text())
    return Mapped(name=Path(plan).stem, sensor=sensor, T_plan_map=SE2(*frame), building=building)


def _locate(
    plan: str, sensor: SensorKind, seed: int, out: str, setting: Setting, plans: Sequence[str]
) -> None:
    """Locate one query session in the maps of its own plan and of one other, unless it was done before."""
    from pc2grid.io.atomic import replace_file
    from signature.evaluation.driven import Driven
    from signature.evaluation.sensor_matrix import SENSORS, query_trials

    target = _file("trials", plan, sensor, seed, out, setting)
    if target.exists():
        return
    tag = tuple(sorted(setting.items()))
    others = [p for p in plans if p != plan]
    asked = [plan, *others[seed % len(others) :][:1]] if others else [plan]
    maps = [_mapped(p, s, out, tag) for p in asked for s in SENSORS]
    driven = Driven.load(_file("drives", plan, sensor, seed, out, setting))
    trials = query_trials(Path(plan).stem, seed, driven, maps)
    with replace_file(target) as draft:
        draft.write_text(json.dumps([trial.to_json() for trial in trials]))


def _read(path: Path) -> list[Trial]:
    from signature.evaluation.trial import Trial

    rows = json.loads(path.read_text())
    return [Trial(**{**row, "scores": tuple(row["scores"])}) for row in rows]
