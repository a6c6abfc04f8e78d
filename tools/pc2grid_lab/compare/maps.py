"""`pc2grid compare maps`: maps against the truth, beside bare KISS-ICP on the same scans."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from pc2grid.errors import ConfigError
from pc2grid.io import open_log
from pc2grid.io.nav2_map import load_map
from pc2grid.io.trajectory import read_tum
from pc2grid.model import Health
from pc2grid.simulate.config import OdometryConfig
from pc2grid_cli.console import of, print_json
from pc2grid_cli.output_files import make_folder
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare import options as options
from pc2grid_lab.experiments.map_quality import MappingRun, map_beside_bare, map_simulated
from pc2grid_lab.experiments.relation_fit import relation_fit
from pc2grid_lab.experiments.sensor_matrix import SENSORS
from pc2grid_lab.experiments.slam_relations import read_relations, relation_error
from pc2grid_lab.experiments.stored import in_processes, write_text
from pc2grid_lab.experiments.trajectory_error import trajectory_error
from pc2grid_lab.worlds import WorldConfig, prepare_session
from signature.config import Config

Row = dict[str, Any]


def compare_maps_command(
    context: typer.Context,
    plans: Annotated[
        list[Path] | None, typer.Argument(metavar="[MAP.yaml]...", help="floor plans to drive through")
    ] = None,
    log: Annotated[list[Path] | None, typer.Option("--log", help="a recording, with its --truth")] = None,
    truth: Annotated[
        list[Path] | None,
        typer.Option("--truth", help="of the --log of the same rank: a TUM file, or *.relations"),
    ] = None,
    sensors: Annotated[str, typer.Option(help="which to simulate")] = "lidar,laser,depth",
    length: Annotated[float, typer.Option(min=1.0, metavar="M", help="metres to drive")] = 200.0,
    seeds: Annotated[str, typer.Option(help="of the simulated sessions, for example 1,2,3")] = "1",
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="leave odometry out of them")] = False,
    out: options.OutputFolder = Path("map-quality"),
    jobs: options.Jobs = None,
    as_json: options.AsJson = False,
) -> None:
    """How good are the maps? Trajectory, health and cells of each against the truth.

    Example: pc2grid compare maps fr079.yaml intel.yaml --log hall.mcap --truth hall.tum
    """
    tasks = _simulated_tasks(plans or [], sensors, length, seeds, not no_odometry)
    tasks += _recorded_tasks(log or [], truth or [])
    _refuse(tasks)
    make_folder(out)
    waiting = [(task, out) for task in tasks if not _result(task, out).exists()]
    with of(context).progress("map") as advance:
        in_processes(_run, waiting, jobs=jobs, advance=advance)
    rows = [json.loads(_result(task, out).read_text()) for task in tasks]
    if as_json:
        print_json({"schema_version": 1, "rows": rows})
        return
    _show([row for row in rows if "plan" in row], [row for row in rows if "log" in row])


def _show(simulated: list[Row], recorded: list[Row]) -> None:
    title = "{}: trajectories against the truth, beside bare KISS-ICP"
    if simulated:
        show(
            _table(title.format("simulated"), _PLAN, [*_SIMULATED, *_HEALTH], simulated),
            _table("simulated: cells of the maps against the truth, %", _PLAN, _CELLS, simulated),
        )
    if recorded:
        show(_table(title.format("recorded"), _LOG, [*_RECORDED, *_HEALTH], recorded))


def _recorded_tasks(logs: list[Path], truths: list[Path]) -> list[dict[str, Any]]:
    """A task for each recording. Raises ConfigError unless each has its truth."""
    if len(logs) != len(truths):
        raise ConfigError(
            f"{len(logs)} times --log, but {len(truths)} times --truth", hint="give each log its truth"
        )
    return [{"log": str(log), "truth": str(truth)} for log, truth in zip(logs, truths, strict=True)]


def _refuse(tasks: list[dict[str, Any]]) -> None:
    """Raises ConfigError if there is no task, or a file of one is missing."""
    if not tasks:
        raise ConfigError("nothing to compare", hint="name floor plans, or a --log with its --truth")
    for file in (Path(task[key]) for task in tasks for key in ("plan", "log", "truth") if key in task):
        if not file.exists():
            raise ConfigError(f"{file}: no such file")


def _simulated_tasks(
    plans: list[Path], sensors: str, length_m: float, seeds: str, odometry: bool
) -> list[dict[str, Any]]:
    """A task for each plan, sensor and seed. Raises ConfigError for words that cannot be read."""
    kinds = [name.strip() for name in sensors.split(",")]
    unknown = [name for name in kinds if name not in SENSORS]
    if unknown:
        raise ConfigError(f"--sensors: no sensor {unknown[0]!r}", hint=f"known are {', '.join(SENSORS)}")
    try:
        numbers = [int(text) for text in seeds.split(",")]
    except ValueError:
        raise ConfigError(f"--seeds: expected whole numbers, found {seeds!r}") from None
    return [
        {"plan": str(plan), "sensor": kind, "length_m": length_m, "seed": seed, "odometry": odometry}
        for plan in plans
        for kind in kinds
        for seed in numbers
    ]


def _result(task: dict[str, Any], out: Path) -> Path:
    if "log" in task:
        return out / f"{Path(task['log']).stem}.{Path(task['truth']).suffix[1:]}.json"
    wheels = "odometry" if task["odometry"] else "alone"
    name = f"{Path(task['plan']).stem}.{task['sensor']}.{task['length_m']:g}m.{task['seed']}.{wheels}.json"
    return out / name


def _run(task: dict[str, Any], out: Path) -> None:
    """Map one session or log, and store the result."""
    row = _of_log(task) if "log" in task else _of_plan(task)
    write_text(_result(task, out), json.dumps({**task, **row}, indent=1))


def _of_plan(task: dict[str, Any]) -> Row:
    simulation = WorldConfig(
        length_m=task["length_m"], seed=task["seed"], odometry=OdometryConfig(enabled=task["odometry"])
    )
    session = prepare_session(sensor=task["sensor"], grid=load_map(Path(task["plan"])), config=simulation)
    run, truth, quality = map_simulated(session, Config())
    return {
        **_health(run),
        "ours": asdict(trajectory_error(run.trajectory, truth)),
        "bare": asdict(trajectory_error(run.bare, truth)),
        "grid": asdict(quality),
    }


def _of_log(task: dict[str, Any]) -> Row:
    config = Config()
    truth = Path(task["truth"])
    with open_log(Path(task["log"]), config.read) as log:
        run = map_beside_bare(log.scans(), config)
        row = {**_health(run), "sensor": log.choose().sensor}
    if truth.suffix != ".relations":
        true = read_tum(truth)
        return {
            **row,
            "ours": asdict(trajectory_error(run.trajectory, true)),
            "bare": asdict(trajectory_error(run.bare, true)),
        }
    relations = read_relations(truth)
    x, y = (float(v) for v in run.T_base_sensor[:2, 3])
    with open_log(Path(task["log"]), config.read) as log:
        fit = relation_fit(log.scans(), run.trajectory, relations, base_to_reference_m=(x, y))
    return {
        **row,
        "ours": asdict(relation_error(run.trajectory, relations, base_to_reference_m=(x, y))),
        "bare": asdict(relation_error(run.bare, relations, base_to_reference_m=(x, y))),
        "fit": asdict(fit),
    }


def _health(run: MappingRun) -> Row:
    return {
        "scans": len(run.trajectory),
        "lost": run.share(Health.LOST),
        "degenerate": run.share(Health.DEGENERATE),
        "loops": run.loops,
        "map_ms": run.map_ms,
        "bare_ms": run.bare_ms,
    }


def _number(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _percent(value: float) -> str:
    return _number(100 * value, 2)


def _errors(row: Row, who: str) -> str:
    found = row[who]
    if "ate_m" in found:
        return f"{_number(found['ate_m'])} m"
    return f"{_number(found['translation_m'])} m, {found['rotation_deg']:.2f} deg"


def _fits(row: Row) -> str:
    """How well the raw scans of a pair fit, placed by the relations and by our trajectory."""
    fit = row.get("fit")
    if fit is None:
        return "-"
    return f"{fit['relations_m']:.4f} / {fit['trajectory_m']:.4f} (ours better in {fit['better']:.0%})"


Columns = list[tuple[str, Callable[[Row], str]]]
"""Headings, and what stands below them."""

_HEALTH: Columns = [
    ("lost, %", lambda r: _percent(r["lost"])),
    ("degenerate, %", lambda r: _percent(r["degenerate"])),
    ("loops", lambda r: str(r["loops"])),
    ("time / bare", lambda r: f"{r['map_ms'] / r['bare_ms']:.2f}"),
]
_PLAN: Columns = [
    ("plan", lambda r: Path(r["plan"]).stem),
    ("sensor", lambda r: r["sensor"]),
    ("seed", lambda r: str(r["seed"])),
    ("odometry", lambda r: "yes" if r["odometry"] else "no"),
]
_SIMULATED: Columns = [
    ("ATE, m", lambda r: _number(r["ours"]["ate_m"])),
    ("RPE, m/m", lambda r: _number(r["ours"]["rpe_m"])),
    ("bare: ATE, m", lambda r: _number(r["bare"]["ate_m"])),
]
_CELLS: Columns = [
    ("occupied right", lambda r: _percent(r["grid"]["occupied_right"])),
    ("walls found", lambda r: _percent(r["grid"]["walls_found"])),
    ("free wrong", lambda r: _percent(r["grid"]["free_wrong"])),
    ("unseen free", lambda r: _percent(r["grid"]["unseen_free"])),
]
_LOG: Columns = [
    ("log", lambda r: Path(r["log"]).stem),
    ("sensor", lambda r: r["sensor"]),
    ("truth", lambda r: Path(r["truth"]).name),
]
_RECORDED: Columns = [
    ("error", lambda r: _errors(r, "ours")),
    ("bare: error", lambda r: _errors(r, "bare")),
    ("scans fit: truth / ours, m", lambda r: _fits(r)),
]


def _table(title: str, texts: Columns, numbers: Columns, rows: list[Row]) -> Table:
    made = table(title, [name for name, _ in texts], [name for name, _ in numbers])
    for row in rows:
        made.add_row(*(shown(row) for _, shown in (*texts, *numbers)))
    return made
