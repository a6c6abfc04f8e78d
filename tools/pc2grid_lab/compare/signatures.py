"""`pc2grid compare signatures`: what the signatures are worth, down to none and to a draw at random."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pc2grid_cli.options import OUTPUT_FOLDER
from pc2grid_cli.output_files import make_folder

if TYPE_CHECKING:
    from pc2grid.geometry import SE2
    from pc2grid.model import OccupancyGrid, SensorKind
    from pc2grid_lab.experiments.registered_session import RegisteredSession
    from pc2grid_lab.experiments.selection import Recalled, Selected
    from pc2grid_lab.experiments.sensor_map import SensorMap
    from pc2grid_lab.worlds import WorldConfig
    from signature.config import Config
    from signature.localization.map_index import MapIndex
    from signature.localization.query import QueryMap
    from signature.retrieval.place_index import PlaceBlock

MAP_SEED = 1000
"""Map sessions and query sessions never share a seed: other clutter, start, direction and noise."""
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
    out: Annotated[Path, typer.Option(*OUTPUT_FOLDER, help="Folder for results; run again to go on.")] = Path(
        "signatures"
    ),
    queries: Annotated[int, typer.Option("--queries", min=1, help="Query sessions a plan and sensor.")] = 6,
    floors: Annotated[
        int, typer.Option("--floors", min=1, help="Office floors of the city besides the building.")
    ] = 12,
    share: Annotated[
        float, typer.Option("--share", min=0.001, max=1.0, help="Share of the places that is looked at.")
    ] = 0.05,
    map_length: Annotated[float, typer.Option("--map-length", help="Metres driven to make a map.")] = 150.0,
    clutter: Annotated[
        int, typer.Option("--clutter", help="Things in the way, different in each session.")
    ] = 30,
    change: Annotated[
        float,
        typer.Option("--change", min=0, max=1, help="Share of doors and furniture that differ, by session."),
    ] = 0.2,
    rate: Annotated[float, typer.Option("--rate", help="Scans a second, of every sensor.")] = 4.0,
    seed: Annotated[int, typer.Option("--seed", help="Of the first query session.")] = 1,
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
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document instead of a table.")
    ] = False,
) -> None:
    """Locate with places selected by all signatures, by some, by Eq. 6, at random, and with all places.

    With --fit, the weights of the signatures are learned from the plans instead. Those that come with the
    program were learned from office:1, fr079 and intel; judge on others.

    Example: pc2grid compare signatures maps/csail.yaml office:101 --queries 6 --out signatures
    """
    from pc2grid.io.atomic import replace_file
    from pc2grid_cli.console import json_text, of, print_json
    from pc2grid_lab.compare.signature_report import draw, print_table
    from pc2grid_lab.experiments.ablation import seen_independence
    from pc2grid_lab.experiments.selection import SELECTORS, queries_of, recall_at_scale, with_floors
    from pc2grid_lab.experiments.sensor_matrix import SENSORS
    from signature.config import Config

    for folder in ("", "maps", "drives", "selected"):
        make_folder(out / folder)
    drawn = {_name(plan): _plan(plan) for plan in plans}
    config = Config()
    setting = {"map_length": map_length, "clutter": clutter, "change": change, "rate": rate}
    if fit is not None:
        with of(context).progress("fit") as advance:
            pairs = _fit(fit, out, drawn, [seed + i for i in range(queries)], setting, config, advance)
        print(f"{fit}: learned from {pairs:,} pairs")
        return
    with of(context).progress("city") as advance:
        city = _city(out, floors, config, advance)
    trials: list[Selected] = []
    maps: dict[str, list[SensorMap]] = {}
    with of(context).progress("locate") as advance:
        done, steps = 0, len(drawn) * len(SENSORS) * (1 + queries)
        for name, plan in drawn.items():
            maps[name] = []
            for sensor in SENSORS:
                maps[name].append(_map(out, name, plan, sensor, setting, config))
                advance((done := done + 1) / steps)
            sessions = [(sensor, seed + i) for i in range(queries) for sensor in SENSORS]
            results = {key: _result(out, name, *key, setting, floors, share, locate) for key in sessions}
            indexes = {}
            if not all(path.exists() for path in results.values()):
                own = maps[name][0]
                indexes = {"building": own.index, "city": with_floors(own, city, config)}
            for (sensor, number), path in results.items():
                if not path.exists():
                    drive = _drive(out, name, plan, sensor, number, setting, config)
                    found = _select(maps[name][0], indexes, drive, number, share, locate, config)
                    with replace_file(path) as draft:
                        draft.write_text(json.dumps([asdict(trial) for trial in found]))
                trials += _read(path)
                advance((done := done + 1) / steps)
    independent = seen_independence([maps[name] for name in drawn])
    recalled: list[Recalled] = []
    if scale:
        with of(context).progress("scale") as advance:
            _describe_floors(out, max(scale), config, advance)
            for name, plan in drawn.items():
                asked = [
                    (sensor, number, *query)
                    for sensor in SENSORS
                    for number in range(seed, seed + queries)
                    for query in queries_of(_drive(out, name, plan, sensor, number, setting, config), config)
                ]
                for count in scale:
                    elsewhere = _floors(out, count, config.partition.radius_m)
                    recalled += recall_at_scale(maps[name][0], elsewhere, asked)
    document = _document(trials, independent, recalled, list(drawn), setting, share, seed)
    with replace_file(out / "signatures.json") as draft:
        draft.write_text(json_text(document) + "\n", encoding="utf-8")
    draw(out / "signatures.png", document, SELECTORS)
    if as_json:
        print_json(document)
    else:
        print_table(document, SELECTORS)
        print(f"{out / 'signatures.png'}, {out / 'signatures.json'}")


def _fit(
    path: Path,
    out: Path,
    plans: Mapping[str, OccupancyGrid],
    seeds: Sequence[int],
    setting: dict[str, float],
    config: Config,
    advance: Callable[[float], None],
) -> int:
    """Learn the weights of what was seen from sessions in these plans; returns the number of pairs."""
    from pc2grid_lab.experiments.seen_pairs import pairs_of
    from pc2grid_lab.experiments.selection import office_floor, queries_of
    from pc2grid_lab.experiments.sensor_matrix import SENSORS
    from signature.seen_likelihood import SeenStatistics

    steps = len(plans) * len(SENSORS) * (1 + len(seeds))

    def asked() -> Iterator[tuple[QueryMap, SE2, list[SensorMap]]]:
        done = 0
        for name, plan in plans.items():
            maps = []
            for sensor in SENSORS:
                maps.append(_map(out, name, plan, sensor, setting, config))
                advance((done := done + 1) / steps)
            for sensor in SENSORS:
                for seed in seeds:
                    drive = _drive(out, name, plan, sensor, seed, setting, config)
                    for _, query, T_plan_query in queries_of(drive, config):
                        yield query, T_plan_query, maps
                    advance((done := done + 1) / steps)

    floors = [office_floor(_FIRST_FLOOR_OF_FIT + number) for number in range(_FLOORS_OF_FIT)]
    pairs = pairs_of(asked(), floors, config)
    SeenStatistics.of(pairs).save(path)
    return len(pairs.queries)


def _document(
    trials: Sequence[Selected],
    independent: dict[str, tuple[float, float, float, int, int]],
    recalled: Sequence[Recalled],
    plans: list[str],
    setting: dict[str, float],
    share: float,
    seed: int,
) -> dict[str, Any]:
    from pc2grid_lab.experiments.selection import tally, tally_at_scale

    names = ("auc", "low", "high", "same", "other")
    return {
        "schema_version": 1,
        "plans": plans,
        "setting": {**setting, "seed": seed, "share": share},
        "rows": tally(trials),
        "scale": tally_at_scale(recalled),
        "independence": {name: dict(zip(names, values, strict=True)) for name, values in independent.items()},
    }


def _name(plan: str) -> str:
    return plan.replace(":", "") if plan.startswith(_OFFICE) else Path(plan).stem


def _plan(plan: str) -> OccupancyGrid:
    from pc2grid.errors import ConfigError, MapFileError
    from pc2grid.io.nav2_map import load_map
    from pc2grid.simulate import office_floorplan

    if plan.startswith(_OFFICE):
        number = plan.removeprefix(_OFFICE)
        if not number.isdecimal():
            raise ConfigError(f"{plan}: the seed is not a number", hint="for example office:101")
        return office_floorplan(int(number))
    if not Path(plan).is_file():
        raise MapFileError(f"{plan}: no such file", hint="give the path of a map.yaml, or office:SEED")
    return load_map(Path(plan))


def _tag(setting: dict[str, float]) -> str:
    return ".".join(f"{key}{value:g}" for key, value in sorted(setting.items()))


def _simulation(
    setting: dict[str, float], length_m: float, seed: int, start_m: tuple[float, float] | None = None
) -> WorldConfig:
    from pc2grid_lab.worlds import WorldConfig

    return WorldConfig.model_validate(
        {
            "length_m": length_m,
            "seed": seed,
            "clutter": int(setting["clutter"]),
            "start_m": start_m,
            "change": {"doors": setting["change"], "furniture": setting["change"]},
            **{sensor: {"rate_hz": setting["rate"]} for sensor in ("lidar", "laser", "depth")},
        }
    )


def _city(out: Path, floors: int, config: Config, advance: Callable[[float], None]) -> Path:
    """A database of office floors, made unless it exists."""
    from pc2grid.observer import Observer
    from pc2grid_lab.experiments.selection import floor_session
    from signature.sessions import add_sessions, provenance

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


def _describe_floors(out: Path, count: int, config: Config, advance: Callable[[float], None]) -> None:
    """What is seen from `count` places of office floors, made in blocks unless they exist."""
    import numpy as np

    from pc2grid.io.atomic import replace_file
    from pc2grid_lab.experiments.selection import described_floor
    from signature.retrieval.place_index import PlaceBlock

    make_folder(out / "floors")
    so_far = number = 0
    while so_far < count:
        path = _block_file(out, number)
        if not path.exists():
            first = _FIRST_FLOOR_OF_SCALE + number * _FLOORS_AT_ONCE
            floors = [described_floor(first + k, config) for k in range(_FLOORS_AT_ONCE)]
            block = PlaceBlock.concatenated(floors)
            with replace_file(path) as draft, draft.open("wb") as file:
                np.savez(
                    file,
                    ranges=block.seen.ranges,
                    signatures=block.seen.signatures,
                    center_m=block.center_m,
                    session=block.session,
                )
        with np.load(path) as stored:
            so_far += len(stored["session"])
        number += 1
        advance(min(so_far / count, 1.0))


def _floors(out: Path, count: int, sight_m: float) -> Iterator[PlaceBlock]:
    """The first `count` places of `_describe_floors`, a block at a time."""
    import numpy as np

    from signature.retrieval.place_index import PlaceBlock
    from signature.seen_places import SeenPlaces

    number = 0
    while count > 0:
        with np.load(_block_file(out, number)) as stored:
            columns = {name: stored[name][:count] for name in stored.files}
        seen = SeenPlaces(sight_m=sight_m, ranges=columns["ranges"], signatures=columns["signatures"])
        yield PlaceBlock(seen, columns["center_m"], columns["session"])
        count -= len(seen)
        number += 1


def _map(
    out: Path,
    name: str,
    plan: OccupancyGrid,
    sensor: SensorKind,
    setting: dict[str, float],
    config: Config,
) -> SensorMap:
    """The map of a plan by one sensor, made unless it exists."""
    from pc2grid_lab.experiments.sensor_map import is_saved, load_map, save_map
    from pc2grid_lab.experiments.sensor_matrix import map_building

    path = out / "maps" / f"{name}.{sensor}.{_tag(setting)}.submaps"
    if not is_saved(path):
        simulation = _simulation(setting, setting["map_length"], MAP_SEED)
        session_map, T_plan_map = map_building(name, plan, sensor, simulation, config)
        save_map(path, session_map, T_plan_map, Path(f"{name}.plan"), config)
    return load_map(path, name=name, sensor=sensor, config=config)


def _drive(
    out: Path,
    name: str,
    plan: OccupancyGrid,
    sensor: SensorKind,
    seed: int,
    setting: dict[str, float],
    config: Config,
) -> RegisteredSession:
    """A registered query session, simulated unless it was done before."""
    from pc2grid_lab.experiments.registered_session import RegisteredSession, simulate_and_register
    from pc2grid_lab.experiments.selection import TRAVELS_M
    from pc2grid_lab.experiments.sensor_matrix import query_start

    path = out / "drives" / f"{name}.{sensor}.{seed}.{_tag(setting)}.npz"
    if not path.exists():
        until_m = TRAVELS_M[-1] + 0.5
        start_m = query_start(plan, _simulation(setting, setting["map_length"], MAP_SEED), seed)
        simulation = _simulation(setting, until_m + 2.5, seed, start_m)
        simulate_and_register(plan, sensor, simulation, config, until_m=until_m).save(path)
    return RegisteredSession.load(path)


def _result(
    out: Path,
    name: str,
    sensor: SensorKind,
    seed: int,
    setting: dict[str, float],
    floors: int,
    share: float,
    locate: bool,
) -> Path:
    tag = f"{_tag(setting)}.floors{floors}.share{share:g}{'' if locate else '.selected'}"
    return out / "selected" / f"{name}.{sensor}.{seed}.{tag}.json"


def _select(
    own: SensorMap,
    indexes: Mapping[str, MapIndex],
    drive: RegisteredSession,
    seed: int,
    share: float,
    locate: bool,
    config: Config,
) -> list[Selected]:
    from pc2grid_lab.experiments.selection import Selected, Selection, queries_of

    found = []
    asked = list(queries_of(drive, config))
    for scope, index in indexes.items():
        selection = Selection(index, scope, share, seed)
        for travel_m, query, T_plan_query in asked:
            T_map_query = own.T_plan_map.inverse() @ T_plan_query
            for selector, looked_at, hit, located, right, processor_ms in selection.measure(
                query, T_map_query, locate=locate
            ):
                found.append(
                    Selected(
                        plan=own.name,
                        query_sensor=drive.sensor,
                        seed=seed,
                        travel_m=travel_m,
                        scope=scope,
                        places=len(index.places.table),
                        selector=selector,
                        looked_at=looked_at,
                        found=hit,
                        located=located,
                        right=right,
                        processor_ms=processor_ms,
                    )
                )
    return found


def _read(path: Path) -> list[Selected]:
    from pc2grid_lab.experiments.selection import Selected

    return [Selected(**row) for row in json.loads(path.read_text())]
