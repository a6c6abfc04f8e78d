"""A picture of the results of a comparison.

`pc2grid compare recordings`: every real recording as a map, and located in the maps of others.

`pc2grid compare sensors`: maps by each sensor, queries by each, in real floor plans.

`pc2grid compare peers`: other programs that locate a robot, with the same maps and queries.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pc2grid.errors import ConfigError, LogNotFound
from pc2grid.io.atomic import replace_file
from pc2grid.io.building_file import is_building_file
from pc2grid.io.maps import load_map
from pc2grid.model import SensorKind
from pc2grid_cli import console
from pc2grid_cli.console import Console, json_text, warn
from pc2grid_cli.output import make_folder, show, table
from pc2grid_lab.experiments.answers import index_of
from pc2grid_lab.experiments.program import (
    BACK,
    FRONT,
    LABORATORY,
    commit,
    digest_of_product,
    digest_of_sources,
    in_processes,
    once,
    write_text,
)
from pc2grid_lab.experiments.recordings.catalogue import Catalogue, Pair, Recording, own_recordings, state_of
from pc2grid_lab.experiments.recordings.judging import judged_table
from pc2grid_lab.experiments.recordings.kidnaps import followed_in, tasks
from pc2grid_lab.experiments.recordings.page import change_lines, changes, page
from pc2grid_lab.experiments.recordings.rows import Table
from pc2grid_lab.experiments.recordings.run import Folder, run_all
from pc2grid_lab.experiments.sensor_matrix import SENSORS, PlanDrives, SensorMap, query_trials
from pc2grid_lab.experiments.trial import MatrixCell, Trial, matrix, reliability
from pc2grid_lab.peers.programs import PEERS, PINS, PeerCell, PeerTrial, answers, counted, missing
from pc2grid_lab.peers.site import Site, recorded_site, simulated_site, truth_file
from signature.config import Config
from signature.localization.shown.picture import BLUE, GREEN, ORANGE, VERMILLION
from signature.sessions import digest_of


@contextmanager
def picture(path: Path, width_in: float, height_in: float, *, dpi: int = 110) -> Iterator[Any]:
    """A figure of matplotlib that is a PNG file when the body ends."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    yield figure
    with replace_file(path) as draft:
        figure.savefig(draft, format="png", metadata={"Software": "pc2grid"})


def compare_recordings(
    data: Path,
    out: Path,
    table: Path | None,
    terminal: console.Console,
    *,
    only: str | None,
    of_base: bool,
    quick: bool,
    jobs: int,
) -> None:
    """Map and locate what is not in `out` yet, judge all, and print the table and what changed."""
    own = own_recordings(data, without=out, of_base=of_base)
    catalogue = _catalogue(data, own, only, quick)
    work = out / "work" / (digest_of_product() + state_of(data, own[0]))
    make_folder(work)
    _remove_others(work)
    folder = Folder(data.absolute(), work.absolute())
    followed = followed_in(catalogue, folder, only)
    if not (catalogue.mapped or catalogue.pairs or followed):
        raise ConfigError(f"--only {only}: no recording, building, sensor or kind is named so")
    with terminal.progress("recordings") as advance, _note_kept(terminal, out):
        mapped, further = tasks(catalogue, folder, followed)
        run_all(catalogue, folder, mapped=mapped, further=further, jobs=jobs, advance=advance)
    with terminal.progress("judge") as advance:
        found = judged_table(
            catalogue, folder, followed, program=digest_of_product(), commit=commit(), advance=advance
        )
    is_whole = only is None and not quick
    _tell(found, table or out / "real.json", replace=is_whole)


def _tell(found: Table, kept: Path, *, replace: bool) -> None:
    """Print a table and what changed since the one that is kept. replace : whether it is then kept itself."""
    before = _read(kept)
    changed = [] if before is None else changes(before, found)
    if replace:
        write_text(kept, found.to_text())
        write_text(kept.with_suffix(".md"), page(found, changed))
    print(page(found))
    if before is None:
        print(f"nothing to compare with: there is no {kept}")
    else:
        print(f"changed since {before.commit} ({kept}):", *(change_lines(changed) or ["- nothing"]), sep="\n")


@contextlib.contextmanager
def _note_kept(terminal: console.Console, out: Path) -> Iterator[None]:
    """If the block is interrupted, print where its results are: they stay."""
    try:
        yield
    except KeyboardInterrupt:
        terminal.note(f"what is done is kept in {out}; the same command goes on from there")
        raise


def _catalogue(
    data: Path, own: tuple[list[Recording], list[Pair]], only: str | None, quick: bool
) -> Catalogue:
    """What is run: what the catalogue names, and one's own. Raises ConfigError if there is nothing."""
    named = Catalogue.in_folder(data)
    recordings, pairs = [*named[0], *own[0]], [*named[1], *own[1]]
    if not recordings:
        raise ConfigError(f"{data}: holds no recording", hint="they end in .mcap, .bag or .db3")
    return Catalogue.of(recordings, pairs, only=only, quick=quick)


def _read(file: Path) -> Table | None:
    """The table of an earlier run; None if there is none. Raises ConfigError if it cannot be read."""

    if not file.exists():
        return None
    try:
        return Table.from_json(json.loads(file.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{file}: not a table of this command ({error})", hint="remove it, or name another by --table"
        ) from error


def _remove_others(work: Path) -> None:
    """Remove what other versions of the program made: their results are not used again."""
    for other in work.parent.iterdir():
        if other.name != work.name and other.is_dir():
            shutil.rmtree(other)


def compare_sensors(
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
    trials = _asked_sensors(drives, plans, range(seed, seed + queries), terminal, jobs)
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
    draw_sensors(out / "matrix.png", cells, reliability(trials))
    print_tables(cells)
    if elsewhere:
        right = elsewhere.count("not_found")
        show(f"queries from another building: {right} of {len(elsewhere)} answered not_found")
    print(out / "matrix.json", out / "matrix.png", sep="\n")


def _asked_sensors(
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
            detail.add_row(*pair, *_sensor_figures(row[last]))
    show(shares, detail)


def _shares(row: Mapping[float, MatrixCell], distances: Sequence[float]) -> list[str]:
    """Of a pair of sensors; without a row no query drove where the map is."""
    shown = [f"{row[d].located_right:.2f}" if d in row else "" if row else "-" for d in distances]
    return [*shown, str(max((cell.trials for cell in row.values()), default=0))]


def _sensor_figures(cell: MatrixCell) -> tuple[str, ...]:
    return (
        f"{cell.wrong:.3f}",
        f"{cell.ambiguous:.2f}",
        f"{cell.not_found:.2f}",
        "/".join(f"{share:.2f}" for share in cell.recall),
        *("-" if m is None else f"{m:.3f} m" for m in (cell.median_error_m, cell.p95_error_m)),
        f"{cell.look_up_ms:.0f}",
    )


def draw_sensors(
    path: Path, cells: Sequence[MatrixCell], reliable: Sequence[tuple[float, float, int]]
) -> None:
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


TITLES = {kind.name: kind.title for kind in PEERS}


def compare_peers(
    recordings: Sequence[Path],
    out: Path,
    terminal: Console,
    *,
    queries: int,
    travel: float,
    mapped: Sequence[str],
    of_base: bool,
) -> None:
    """Ask every program that is installed, and write the table and its picture."""
    seconds = _seconds(mapped, recordings)
    not_installed = {kind.name: command for kind in PEERS if (command := missing(kind)) is not None}
    for name, command in not_installed.items():
        warn(f"{name} is not installed: {command}")
    work = out / digest_of_sources((FRONT, BACK, LABORATORY))
    make_folder(out)
    sites, trials = [], []
    with terminal.progress("prepare") as advance:
        for recording in recordings:
            sites.append(_site(recording, work, queries, travel, seconds.get(recording.stem), of_base))
            advance(len(sites) / len(recordings))
    tasks = _tasks(sites, not_installed)
    with terminal.progress("locate") as advance:
        for done, (name, site, map_site) in enumerate(tasks, start=1):
            trials += _asked_peers(name, site, map_site, work)
            advance(done / len(tasks))
    cells = counted(trials)
    setting = {"queries": queries, "travel": travel, "pins": PINS, "not_installed": not_installed, **seconds}
    document = {"setting": setting, "cells": list(map(asdict, cells)), "trials": list(map(asdict, trials))}
    write_text(out / "peers.json", json_text(document) + "\n")
    draw_peers(out / "peers.png", cells)
    print_table(cells)
    print(out / "peers.json", out / "peers.png", sep="\n")


def _tasks(sites: Sequence[Site], not_installed: Mapping[str, str]) -> list[tuple[str, Site, Site]]:
    """What is run: each installed program with the sites of its sensors, each in its own map and another."""
    tasks = []
    for kind in PEERS:
        for sensor in kind.sensors if kind.name not in not_installed else ():
            of_sensor = [site for site in sites if site.sensor == sensor]
            for k, site in enumerate(of_sensor):
                tasks += [(kind.name, site, other) for other in dict.fromkeys((site, of_sensor[k - 1]))]
    return tasks


def _asked_peers(name: str, site: Site, map_site: Site, work: Path) -> list[PeerTrial]:
    """The judged answers of a program; those of an earlier run of the same sources are used again."""
    (kind,) = (kind for kind in PEERS if kind.name == name)
    queries = site.queries()
    kept = work / f"{name}.{site.folder.name}.in.{map_site.folder.name}.json"
    found = answers(kind, map_site.map_stem, [site.stem(number) for number in queries], kept)
    return [
        PeerTrial.of(name, site.name, map_site.name, query, answer)
        for query, answer in zip(queries.values(), found, strict=True)
    ]


def _site(
    recording: Path, work: Path, queries: int, travel_m: float, mapped_s: float | None, of_base: bool
) -> Site:
    """The building of a recording, or of a 3D scan; what was prepared from the same before is used again."""
    if not recording.exists():
        raise LogNotFound(f"{recording}: no such file")
    config, is_building = Config(), is_building_file(recording)
    truth = b"" if is_building else truth_file(recording).read_bytes()
    made_of = (digest_of(recording, config), truth, queries, travel_m, mapped_s, of_base)
    folder = work / f"{recording.stem}.{hashlib.sha256(repr(made_of).encode()).hexdigest()[:12]}"
    if is_building:
        return simulated_site(recording, folder, config, queries=queries, travel_m=travel_m)
    return recorded_site(
        recording, folder, config, queries=queries, travel_m=travel_m, mapped_s=mapped_s, of_base=of_base
    )


def _seconds(mapped: Sequence[str], recordings: Sequence[Path]) -> dict[str, float]:
    """The values of `--mapped`, by name. Raises ConfigError."""
    names, seconds = [recording.stem for recording in recordings], {}
    if len(set(names)) != len(names):
        raise ConfigError(f"two recordings share a name: {', '.join(names)}", hint="rename one of the files")
    for text in mapped:
        name, _, value = text.partition("=")
        try:
            seconds[name] = float(value)
        except ValueError:
            seconds[name] = 0.0
        if name not in names or seconds[name] <= 0.0:
            raise ConfigError(
                f"--mapped {text}: not seconds of one of the recordings", hint=f"for example {names[0]}=600"
            )
    return seconds


def print_table(cells: Sequence[PeerCell]) -> None:
    """Print a row for each building and program."""
    title = "later parts of recordings in a map of an earlier part; of the queries that the map covers:"
    figures = ("covered", "right", "5-95 %", "wrong", "none", "uncovered\nwrong", "elsewhere\nwrong")
    shown = table(title, ("building", "program"), (*figures, "off by", "CPU", "CPU\nelsewhere", "memory"))
    for cell in cells:
        shown.add_row(cell.site, TITLES[cell.peer], *_peer_figures(cell))
    show(
        shown,
        "uncovered wrong, elsewhere wrong: answers to queries that have no right one. pc2grid decides itself;"
        " the others have the threshold with the most right answers less wrong ones in this very table",
    )


def _peer_figures(cell: PeerCell) -> tuple[str, ...]:
    return (
        str(cell.covered),
        str(cell.right),
        "" if cell.interval is None else "{:.2f}-{:.2f}".format(*cell.interval),
        str(cell.wrong),
        str(cell.covered - cell.right - cell.wrong),
        f"{cell.uncovered_wrong} of {cell.uncovered}",
        f"{cell.elsewhere_wrong} of {cell.elsewhere}",
        "" if cell.median_error_m is None else f"{cell.median_error_m:.2f} m",
        *("" if cpu_s is None else f"{cpu_s:.2f} s" for cpu_s in (cell.cpu_s, cell.elsewhere_cpu_s)),
        f"{cell.peak_mb:.0f} MB",
    )


def draw_peers(path: Path, cells: Sequence[PeerCell]) -> None:
    """A bar for each building and program: right, none and wrong of all queries, elsewhere included.

    In the building, queries that the map does not cover are rightly left without an answer, as those
    elsewhere are.
    """
    order = sorted(cells, key=lambda cell: cell.site)
    with picture(path, 9.0, 0.9 + 0.3 * max(len(order), 1)) as figure:
        inside, outside = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
        for y, cell in enumerate(order):
            rest, elsewhere = cell.covered - cell.right - cell.wrong, cell.uncovered + cell.elsewhere
            wrong = cell.uncovered_wrong + cell.elsewhere_wrong
            _draw_bar(inside, y, ((cell.right, GREEN), (rest, "0.85"), (cell.wrong, VERMILLION)))
            _draw_bar(outside, y, ((elsewhere - wrong, BLUE), (wrong, VERMILLION)))
        names = [f"{cell.site}: {TITLES[cell.peer]}" for cell in order]
        inside.set_yticks(range(len(order)), names, fontsize=8)
        inside.invert_yaxis()
        inside.set_title("covered by the map: right, none, wrong", fontsize=9)
        outside.set_title("not in the map: refused, wrong", fontsize=9)
        for axes in (inside, outside):
            axes.set_xlim(0, 1)
            axes.set_xlabel("share of the queries", fontsize=8)


def _draw_bar(axes: Any, y: int, parts: Sequence[tuple[int, str]]) -> None:
    """Counts and their colours, as shares of their sum."""
    left, total = 0.0, max(sum(count for count, _ in parts), 1)
    for count, colour in parts:
        axes.barh(y, count / total, left=left, color=colour, height=0.75)
        if count:
            axes.text(left + count / total / 2, y, str(count), ha="center", va="center", fontsize=7)
        left += count / total
