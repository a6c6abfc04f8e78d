"""`pc2grid compare sensors`: maps by each sensor, queries by each, in real floor plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache
from itertools import product
from pathlib import Path

from pc2grid.errors import ConfigError
from pc2grid.io.nav2_map import load_map
from pc2grid.model import SensorKind
from pc2grid_cli.console import Console, json_text
from pc2grid_cli.output_files import make_folder
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare.picture import picture
from pc2grid_lab.experiments.answers import index_of
from pc2grid_lab.experiments.sensor_matrix import SENSORS, PlanDrives, SensorMap, query_trials
from pc2grid_lab.experiments.stored import in_processes, once, write_text
from pc2grid_lab.experiments.trial import MatrixCell, Trial, matrix, reliability
from signature.config import Config
from signature.localization.shown.picture import BLUE, ORANGE, VERMILLION


def run(
    plans: Sequence[Path],
    out: Path,
    terminal: Console,
    *,
    queries: int,
    map_length: float,
    clutter: int,
    rate: float,
    travel: float,
    seed: int,
    jobs: int | None,
) -> None:
    """Map the plans, locate the sessions, and write the table and its picture."""
    _refuse(plans)
    make_folder(out)
    setting: dict[str, float] = {"map_length": map_length, "clutter": clutter, "rate": rate, "travel": travel}
    drives = PlanDrives(out=out, setting=tuple(setting.items()), until_m=travel, length_m=travel + 3.0)
    trials = _asked(drives, plans, range(seed, seed + queries), terminal, jobs)
    cells, elsewhere = matrix(trials), [t.status for t in trials if not t.in_building]
    document = {
        "plans": [plan.stem for plan in plans],
        "queries": queries,
        "setting": {**setting, "seed": seed},
        "cells": list(map(asdict, cells)),
        "outside_the_map": sum(t.in_building and not t.in_map for t in trials),
        "elsewhere": {status: elsewhere.count(status) for status in sorted(set(elsewhere))},
    }
    write_text(out / "matrix.json", json_text(document) + "\n")
    draw(out / "matrix.png", cells, reliability(trials))
    print_tables(cells)
    if elsewhere:
        right = elsewhere.count("not_found")
        show(f"queries from another building: {right} of {len(elsewhere)} answered not_found")
    print(out / "matrix.json", out / "matrix.png", sep="\n")


def _asked(
    drives: PlanDrives, plans: Sequence[Path], seeds: Sequence[int], terminal: Console, jobs: int | None
) -> list[Trial]:
    """The trials of all query sessions, after the maps are made."""
    with terminal.progress("map") as advance:
        mapped = [(drives, *one) for one in product(plans, SENSORS)]
        in_processes(_map, mapped, jobs=jobs, advance=advance)
    with terminal.progress("locate") as advance:
        asked = [(drives, *one, plans) for one in product(seeds, plans, SENSORS)]
        found = in_processes(_locate, asked, jobs=jobs, advance=advance)
    return [trial for trials in found for trial in trials]


def _refuse(plans: Sequence[Path]) -> None:
    """Raises ConfigError for plans that cannot be told apart."""
    names = [plan.stem for plan in plans]
    if len(set(names)) != len(names):
        raise ConfigError(f"two plans share a name: {', '.join(names)}", hint="rename one of the files")


def _map(drives: PlanDrives, plan: Path, sensor: SensorKind) -> None:
    drives.map(plan.stem, load_map(plan), sensor)


@cache
def _mapped(drives: PlanDrives, plan: Path, sensor: SensorKind) -> SensorMap:
    grid, T_plan_map = drives.map(plan.stem, load_map(plan), sensor)
    index = index_of(f"{plan.stem}-{sensor}", grid, Config())
    return SensorMap(name=plan.stem, sensor=sensor, T_plan_map=T_plan_map, index=index)


def _locate(
    drives: PlanDrives, seed: int, plan: Path, sensor: SensorKind, plans: Sequence[Path]
) -> list[Trial]:
    """One query session in the maps of its own plan and of one other."""

    def located() -> list[Trial]:
        others = [p for p in plans if p != plan]
        searched = [plan, *others[seed % len(others) :][:1]] if others else [plan]
        maps = [_mapped(drives, p, s) for p in searched for s in SENSORS]
        session = drives.drive(plan.stem, load_map(plan), sensor, seed)
        return query_trials(plan.stem, seed, session, maps)

    return once(drives.file("trials", plan.stem, sensor, seed), located)


def print_tables(cells: Sequence[MatrixCell]) -> None:
    """Print the share located and right by metres driven, and the other figures of each cell."""
    distances = sorted({cell.travel_m for cell in cells})
    last = distances[-1] if distances else 0.0
    who = ("map", "query")
    shares = table("located and right, by metres driven", who, (*(f"{d:g} m" for d in distances), "n"))
    figures = ("wrong", "ambiguous", "not found", "recall 1/5/20", "median", "95 %", "ms")
    detail = table(f"after {last:g} m", who, figures)
    for pair in product(SENSORS, SENSORS):
        row = {c.travel_m: c for c in cells if (c.map_sensor, c.query_sensor) == pair}
        shares.add_row(*pair, *_shares(row, distances))
        if last in row:
            detail.add_row(*pair, *_figures(row[last]))
    show(shares, detail)


def _shares(row: Mapping[float, MatrixCell], distances: Sequence[float]) -> list[str]:
    """Of a pair of sensors; without a row no query drove where the map is."""
    shown = [f"{row[d].located_right:.2f}" if d in row else "" if row else "-" for d in distances]
    return [*shown, str(max((cell.trials for cell in row.values()), default=0))]


def _figures(cell: MatrixCell) -> tuple[str, ...]:
    return (
        f"{cell.wrong:.3f}",
        f"{cell.ambiguous:.2f}",
        f"{cell.not_found:.2f}",
        "/".join(f"{share:.2f}" for share in cell.recall),
        *("-" if m is None else f"{m:.3f} m" for m in (cell.median_error_m, cell.p95_error_m)),
        f"{cell.look_up_ms:.0f}",
    )


def draw(path: Path, cells: Sequence[MatrixCell], reliable: Sequence[tuple[float, float, int]]) -> None:
    """One picture: share located and right by metres for each map sensor; confidence against truth."""
    colours = dict(zip(SENSORS, (BLUE, ORANGE, VERMILLION), strict=False))
    farthest_m = max((c.travel_m for c in cells), default=1.0)
    with picture(path, 15.0, 3.8, dpi=130) as figure:
        *axes, last = figure.subplots(1, 4)
        for ax, map_sensor in zip(axes, SENSORS, strict=False):
            for query_sensor, marker in zip(SENSORS, "os^", strict=False):
                row = [c for c in cells if (c.map_sensor, c.query_sensor) == (map_sensor, query_sensor)]
                at, right = [c.travel_m for c in row], [c.located_right for c in row]
                label = f"{query_sensor} query"
                ax.plot(at, right, marker=marker, color=colours[query_sensor], label=label)
            ax.set(title=f"{map_sensor} map", xlabel="driven, m", xlim=(0, 1.05 * farthest_m), ylim=(0, 1.03))
            ax.grid(alpha=0.3)
        axes[0].set_ylabel("located and right")
        axes[0].legend(loc="lower right")
        last.plot([0, 1], [0, 1], color="0.6", lw=1)
        if reliable:
            confidence, share, count = zip(*reliable, strict=True)
            last.scatter(confidence, share, s=[20 + 2 * min(n, 200) for n in count], color=BLUE, alpha=0.7)
        last.set(title="all answers", xlabel="confidence", ylabel="share that was right")
        last.grid(alpha=0.3)
