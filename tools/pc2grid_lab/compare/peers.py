"""`pc2grid compare peers`: other programs that locate a robot, with the same maps and queries."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pc2grid.errors import ConfigError, LogNotFound
from pc2grid.io.building_file import is_building_file
from pc2grid_cli.console import Console, json_text, warn
from pc2grid_cli.output_files import make_folder
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare.picture import picture
from pc2grid_lab.experiments.program import BACK, FRONT, LABORATORY, digest_of_sources
from pc2grid_lab.experiments.stored import write_text
from pc2grid_lab.peers.outcome import PeerCell, PeerTrial, counted
from pc2grid_lab.peers.programs import PEERS, PINS, answers, missing
from pc2grid_lab.peers.site import Site, recorded_site, simulated_site, truth_file
from signature.config import Config
from signature.localization.shown.picture import BLUE, GREEN, VERMILLION
from signature.sessions import digest_of

TITLES = {kind.name: kind.title for kind in PEERS}


def run(
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
            trials += _asked(name, site, map_site, work)
            advance(done / len(tasks))
    cells = counted(trials)
    setting = {"queries": queries, "travel": travel, "pins": PINS, "not_installed": not_installed, **seconds}
    document = {"setting": setting, "cells": list(map(asdict, cells)), "trials": list(map(asdict, trials))}
    write_text(out / "peers.json", json_text(document) + "\n")
    draw(out / "peers.png", cells)
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


def _asked(name: str, site: Site, map_site: Site, work: Path) -> list[PeerTrial]:
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
        shown.add_row(cell.site, TITLES[cell.peer], *_figures(cell))
    show(
        shown,
        "uncovered wrong, elsewhere wrong: answers to queries that have no right one. pc2grid decides itself;"
        " the others have the threshold with the most right answers less wrong ones in this very table",
    )


def _figures(cell: PeerCell) -> tuple[str, ...]:
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


def draw(path: Path, cells: Sequence[PeerCell]) -> None:
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
