"""`pc2grid compare peers`: other programs that locate a robot, with the same maps and queries."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from pc2grid.errors import ConfigError, LogNotFound
from pc2grid.io.building_file import is_building_file
from pc2grid_cli.console import json_text, of, print_json, warn
from pc2grid_cli.output_files import make_folder
from pc2grid_lab.compare import options as options
from pc2grid_lab.compare.peers_report import draw, print_table
from pc2grid_lab.experiments.stored import in_processes, write_text
from pc2grid_lab.peers.environment import PEERS, PeerEnvironment
from pc2grid_lab.peers.experiment import run, tasks
from pc2grid_lab.peers.outcome import OUTCOME, PeerCell, PeerTrial, counted
from pc2grid_lab.peers.site import Site, recorded_site, simulated_site, site_name
from signature.config import Config


def compare_peers_command(
    context: typer.Context,
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG|SCAN.ply...",
            help="recordings of a laser or lidar, true poses beside them (NAME.tum or NAME_corrected.tum);"
            " and 3D scans, in which a lidar is simulated",
        ),
    ],
    out: options.OutputFolder = Path("peers"),
    queries: Annotated[int, typer.Option("--queries", min=1, help="queries of each building")] = 24,
    travel: Annotated[float, typer.Option("--travel", min=0.0, help="metres that each drives")] = 10.0,
    mapped: Annotated[
        list[str] | None,
        typer.Option("--mapped", metavar="NAME=S", help="seconds of a recording that become the map [55 %]"),
    ] = None,
    of_base: Annotated[
        bool, typer.Option("--of-base", help="the true poses are of the base, not of the sensor")
    ] = False,
    environment: Annotated[
        Path | None,
        typer.Option("--environment", help="virtual environment of the peers [peers/ in that of pc2grid]"),
    ] = None,
    install: Annotated[
        bool, typer.Option("--install", help="make that environment if it does not exist: 100 MB")
    ] = False,
    as_json: options.AsJson = False,
) -> None:
    """Other programs and pc2grid locate later parts of real recordings in maps of earlier parts.

    MRPT's particle filter gets recordings of a laser; KISS-Matcher, MapClosures and Open3D's FPFH + RANSAC
    those of a lidar. Each query is also located in another building, where every answer is wrong.

    Example: pc2grid compare peers intel.mcap fr079.mcap hall.mcap --mapped intel=900 --mapped fr079=600
    """
    seconds = _seconds(mapped or [], recordings)
    where, terminal = _environment(environment, install), of(context)
    missing = _missing(where)
    for folder in ("sites", "trials"):
        make_folder(out / folder)
    with terminal.progress("prepare") as advance:
        prepare = [(r, out / "sites", queries, travel, seconds.get(r.stem), of_base) for r in recordings]
        sites = in_processes(_site, prepare, jobs=1, advance=advance)
    with terminal.progress("locate") as advance:
        waiting = [(task, where, out / "trials") for task in tasks(sites, where)]
        found = in_processes(run, waiting, jobs=1, advance=advance)
    trials = list(itertools.chain.from_iterable(found))
    document = {
        "schema_version": 1,
        "recordings": [recording.name for recording in recordings],
        "setting": {"queries": queries, "travel": travel, "seed": OUTCOME.seed, **seconds},
        "not_installed": missing,
    }
    sensors = {site.name: site.sensor for site in sites}
    _finish(out, counted(trials), trials, sensors, document, as_json)


def _missing(environment: PeerEnvironment) -> dict[str, str]:
    """The peers that are not installed, and how they are; each is warned of."""
    missing = {kind.name: command for kind in PEERS if (command := environment.missing(kind)) is not None}
    for name, command in missing.items():
        warn(f"{name} is not installed: {command}")
    return missing


def _finish(
    out: Path,
    cells: Sequence[PeerCell],
    trials: Sequence[PeerTrial],
    sensors: Mapping[str, str],
    about: Mapping[str, Any],
    as_json: bool,
) -> None:
    """Write and print the results. sensors : of the sites. about : the rest of the document."""
    document = {**about, "cells": list(map(asdict, cells)), "trials": list(map(asdict, trials))}
    write_text(out / "peers.json", json_text(document) + "\n")
    draw(out / "peers.png", cells, sensors)
    if as_json:
        print_json(document)
        return
    print_table(cells, sensors, about["not_installed"])
    print("\n".join(str(out / name) for name in ("peers.json", "peers.png")))


def _site(
    recording: Path, folder: Path, queries: int, travel_m: float, mapped_s: float | None, of_base: bool
) -> Site:
    """The building of a recording, or of a 3D scan; what was prepared from the same before is used again."""
    if not recording.exists():
        raise LogNotFound(f"{recording}: no such file")
    config = Config()
    setting: dict[str, Any] = {"queries": queries, "travel_m": travel_m}
    known: dict[str, Any] = {"mapped_s": mapped_s, "of_base": of_base}
    made = folder / site_name(recording, config, **setting, **known)
    if is_building_file(recording):
        return simulated_site(recording, made, config, **setting)
    return recorded_site(recording, made, config, **setting, **known)


def _environment(folder: Path | None, install: bool) -> PeerEnvironment:

    environment = PeerEnvironment(folder=(folder or Path(sys.prefix) / "peers").absolute())
    if install and any("pip install" in (environment.missing(kind) or "") for kind in PEERS):
        environment.install()
    return environment


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
