"""`pc2grid compare signatures`: what the signatures are worth, down to none and to a draw at random."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from pc2grid.errors import ConfigError, MapFileError
from pc2grid.geometry import SE2
from pc2grid.io.nav2_map import load_map
from pc2grid.model import OccupancyGrid, SensorKind
from pc2grid.observer import Observer
from pc2grid.simulate import office_floorplan
from pc2grid_cli.console import Console, json_text, of, print_json
from pc2grid_cli.output_files import make_folder
from pc2grid_lab.compare import options as options
from pc2grid_lab.compare.signature_report import draw, print_table
from pc2grid_lab.experiments.ablation import seen_independence
from pc2grid_lab.experiments.plan_drives import PlanDrives
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.experiments.seen_pairs import pairs_of
from pc2grid_lab.experiments.selection import (
    MEASURED,
    SELECTORS,
    TRAVELS_M,
    PlacedQuery,
    Recalled,
    Selection,
    SelectionTrial,
    described_floor,
    floor_session,
    office_floor,
    queries_of,
    recall_at_scale,
    stored_floors,
    tally,
    tally_at_scale,
    with_floors,
)
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.sensor_matrix import SENSORS
from pc2grid_lab.experiments.stored import write_arrays, write_text
from signature.config import Config
from signature.localization.map_index import MapIndex
from signature.localization.query import QueryMap
from signature.seen_likelihood import SeenStatistics
from signature.seen_places import SeenPlaces
from signature.sessions import add_sessions, provenance

_OFFICE = "office:"
_FIRST_FLOOR = 20_000
"""Seed of the first of the other buildings' floors."""
_FIRST_FLOOR_OF_SCALE, _FLOORS_AT_ONCE = 10_000, 50
"""Floors of the very many places; about 500 places each."""
_FIRST_FLOOR_OF_FIT, _FLOORS_OF_FIT = 30_000, 30
"""Floors that the weights are learned from, as places of other buildings."""


def compare_signatures_command(
    context: typer.Context,
    plans: Annotated[
        list[str], typer.Argument(metavar="PLAN...", help="Floor plans: MAP.yaml files, or office:SEED.")
    ],
    out: options.OutputFolder = Path("signatures"),
    queries: options.QuerySessions = 6,
    floors: Annotated[
        int, typer.Option("--floors", min=1, help="Office floors of the city besides the building.")
    ] = 12,
    share: Annotated[
        float, typer.Option("--share", min=0.001, max=1.0, help="Share of the places that is looked at.")
    ] = 0.05,
    map_length: options.MapLength = 150.0,
    clutter: options.Clutter = 30,
    change: options.Change = 0.2,
    rate: options.Rate = 4.0,
    seed: options.FirstSeed = 1,
    scale: Annotated[
        list[int] | None,
        typer.Option("--scale", min=1000, help="Also select among so many places; may be repeated."),
    ] = None,
    locate: Annotated[
        bool,
        typer.Option("--locate/--no-locate", help="Also locate the queries, which takes most of the time."),
    ] = True,
    fit: Annotated[
        Path | None,
        typer.Option("--fit", metavar="FILE.npz", help="Learn the weights from these plans, and store them."),
    ] = None,
    as_json: options.AsJson = False,
) -> None:
    """Locate with places selected by all signatures, by some, by Eq. 6, at random, and with all places.

    With --fit, the weights of the signatures are learned from the plans instead. Those that come with the
    program were learned from office:1, fr079 and intel; judge on others.

    Example: pc2grid compare signatures maps/csail.yaml office:101 --queries 6 --out signatures
    """
    for folder in ("", "maps", "drives", "selected"):
        make_folder(out / folder)
    setting: dict[str, float] = {"map_length": map_length, "clutter": clutter, "change": change, "rate": rate}
    last_m = TRAVELS_M[-1]
    drives = PlanDrives(out=out, setting=tuple(setting.items()), until_m=last_m + 0.5, length_m=last_m + 3.0)
    drawn = {_name(plan): _plan(plan) for plan in plans}
    run = _Run(drives=drives, plans=drawn, seeds=range(seed, seed + queries), terminal=of(context))
    if fit is not None:
        print(f"{fit}: learned from {_fit(fit, run):,} pairs")
        return
    document = _document(run, floors, share, locate, scale or [])
    write_text(out / "signatures.json", json_text(document) + "\n")
    draw(out / "signatures.png", document, SELECTORS)
    if as_json:
        print_json(document)
    else:
        print_table(document, SELECTORS)
        print(f"{out / 'signatures.png'}, {out / 'signatures.json'}")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """The plans, by name, and the seeds of the query sessions of each sensor in each of them."""

    drives: PlanDrives
    plans: Mapping[str, OccupancyGrid]
    seeds: Sequence[int]
    terminal: Console

    def steps(self, advance: Callable[[float], None]) -> Callable[[], None]:
        """What is called once for each map and each query session."""
        done, count = itertools.count(1), len(self.plans) * len(SENSORS) * (1 + len(self.seeds))
        return lambda: advance(next(done) / count)

    def maps(self, name: str, step: Callable[[], None]) -> list[SensorMap]:
        """The maps of a plan by each sensor."""
        for sensor in SENSORS:
            self.drives.make_map(name, lambda: self.plans[name], sensor)
            step()
        return [self.drives.read_map(name, sensor) for sensor in SENSORS]

    def drive(self, name: str, sensor: SensorKind, seed: int) -> RegisteredSession:
        """A query session."""
        return self.drives.drive(name, lambda: self.plans[name], sensor, seed)

    def queries(self, name: str) -> Iterator[PlacedQuery]:
        """The queries in a plan."""
        for sensor, seed in itertools.product(SENSORS, self.seeds):
            for query in queries_of(self.drive(name, sensor, seed), Config()):
                yield sensor, seed, *query


def _trials(
    run: _Run,
    maps: Sequence[SensorMap],
    city: Path,
    share: float,
    locate: bool,
    named: str,
    step: Callable[[], None],
) -> list[SelectionTrial]:
    """The trials in one plan. named : the end of the names of their files."""
    own, trials = maps[0], []
    indexes: dict[str, MapIndex] = {}
    for seed, sensor in itertools.product(run.seeds, SENSORS):
        path = run.drives.file("selected", own.name, sensor, seed, suffix=named)
        if not path.exists():
            indexes = indexes or {"building": own.index, "city": with_floors(own, city, Config())}
            found = _select(own, indexes, run.drive(own.name, sensor, seed), seed, share, locate)
            write_text(path, json.dumps([asdict(trial) for trial in found]))
        trials += [SelectionTrial(**row) for row in json.loads(path.read_text())]
        step()
    return trials


def _recalled(run: _Run, maps: Mapping[str, Sequence[SensorMap]], scale: Sequence[int]) -> list[Recalled]:
    """The queries in each plan among very many places."""
    found: list[Recalled] = []
    for name, (own, *_) in maps.items():
        queries = list(run.queries(name))
        for count in scale:
            found += recall_at_scale(own, _floors(run.drives.out, count), queries)
    return found


def _fit(path: Path, run: _Run) -> int:
    """Learn the weights of what was seen from sessions in these plans; returns the number of pairs."""

    def queries(step: Callable[[], None]) -> Iterator[tuple[QueryMap, SE2, list[SensorMap]]]:
        for name in run.plans:
            maps = run.maps(name, step)
            for sensor, seed in itertools.product(SENSORS, run.seeds):
                for _, query, T_plan_query in queries_of(run.drive(name, sensor, seed), Config()):
                    yield query, T_plan_query, maps
                step()

    floors = [office_floor(_FIRST_FLOOR_OF_FIT + number) for number in range(_FLOORS_OF_FIT)]
    with run.terminal.progress("fit") as advance:
        pairs = pairs_of(queries(run.steps(advance)), floors, Config())
    SeenStatistics.of(pairs).save(path)
    return len(pairs.queries)


def _document(run: _Run, floors: int, share: float, locate: bool, scale: Sequence[int]) -> dict[str, Any]:
    """What is measured. floors, share, locate, scale : the options of the command."""
    with run.terminal.progress("city") as advance:
        city = _city(run.drives.out, floors, advance)
    named = f"floors{floors}.share{share:g}{'' if locate else '.selected'}.json"
    with run.terminal.progress("locate") as advance:
        step = run.steps(advance)
        maps = {name: run.maps(name, step) for name in run.plans}
        trials = [t for name in maps for t in _trials(run, maps[name], city, share, locate, named, step)]
    recalled: list[Recalled] = []
    if scale:
        with run.terminal.progress("scale") as advance:
            _describe_floors(run.drives.out, max(scale), advance)
            recalled = _recalled(run, maps, scale)
    names = ("auc", "low", "high", "same", "other")
    independent = seen_independence(list(maps.values()))
    return {
        "schema_version": 1,
        "plans": list(maps),
        "setting": {**dict(run.drives.setting), "seed": run.seeds[0], "share": share},
        "rows": tally(trials),
        "scale": tally_at_scale(recalled),
        "independence": {name: dict(zip(names, values, strict=True)) for name, values in independent.items()},
    }


def _name(plan: str) -> str:
    return plan.replace(":", "") if plan.startswith(_OFFICE) else Path(plan).stem


def _plan(plan: str) -> OccupancyGrid:
    if plan.startswith(_OFFICE):
        number = plan.removeprefix(_OFFICE)
        if not number.isdecimal():
            raise ConfigError(f"{plan}: the seed is not a number", hint="for example office:101")
        return office_floorplan(int(number))
    if not Path(plan).is_file():
        raise MapFileError(f"{plan}: no such file", hint="give the path of a map.yaml, or office:SEED")
    return load_map(Path(plan))


def _city(out: Path, floors: int, advance: Callable[[float], None]) -> Path:
    """A database of office floors, made unless it exists."""
    config = Config()

    class Described(Observer):
        def __init__(self) -> None:
            self.floors = 0

        def on_progress(self, share: float) -> None:
            advance((self.floors + share) / floors)
            self.floors += share >= 1.0

    path = out / "maps" / f"city.{floors}.submaps"
    if not path.exists():
        sessions = [floor_session(_FIRST_FLOOR + number, config) for number in range(floors)]
        entries = [(made, provenance(Path(made.session), "0" * 64, config)) for made in sessions]
        add_sessions(path, entries, config, keep=False, observer=Described())
    return path


def _block_file(out: Path, number: int) -> Path:
    return out / "floors" / f"{_FIRST_FLOOR_OF_SCALE + number * _FLOORS_AT_ONCE}.npz"


def _describe_floors(out: Path, count: int, advance: Callable[[float], None]) -> None:
    """What is seen from `count` places of office floors, made in blocks unless they exist."""

    make_folder(out / "floors")
    so_far = number = 0
    while so_far < count:
        path = _block_file(out, number)
        if not path.exists():
            first = _FIRST_FLOOR_OF_SCALE + number * _FLOORS_AT_ONCE
            floors = [described_floor(first + k, Config()) for k in range(_FLOORS_AT_ONCE)]
            write_arrays(
                path,
                at_m=np.concatenate([seen.at_m for seen in floors]),
                place=np.concatenate([seen.place for seen in floors]),
                signatures=np.concatenate([seen.signatures for seen in floors]),
                floor=np.repeat(np.arange(len(floors)), [len(seen) for seen in floors]),
            )
        with np.load(path) as stored:
            so_far += sum(int(seen.place[-1]) + 1 for seen in stored_floors(stored))
        number += 1
        advance(min(so_far / count, 1.0))


def _floors(out: Path, count: int) -> Iterator[SeenPlaces]:
    """The first floors of `_describe_floors`, until they have `count` places."""
    for number in itertools.count():
        with np.load(_block_file(out, number)) as stored:
            floors = list(stored_floors(stored))
        for seen in floors:
            yield seen
            count -= int(seen.place[-1]) + 1
            if count <= 0:
                return


def _select(
    own: SensorMap,
    indexes: Mapping[str, MapIndex],
    drive: RegisteredSession,
    seed: int,
    share: float,
    locate: bool,
) -> list[SelectionTrial]:
    found = []
    queries = list(queries_of(drive, Config()))
    for scope, index in indexes.items():
        selection = Selection(index, scope, share, seed)
        for travel_m, query, T_plan_query in queries:
            T_map_query = own.T_plan_map.inverse() @ T_plan_query
            about: dict[str, Any] = {
                "plan": own.name,
                "query_sensor": drive.sensor,
                "seed": seed,
                "travel_m": travel_m,
                "scope": scope,
                "places": len(index.places.table),
            }
            measured = selection.measure(query, T_map_query, locate=locate)
            found += [SelectionTrial(**about | dict(zip(MEASURED, row, strict=True))) for row in measured]
    return found
