"""`pc2grid compare floors`: floors that look alike, reached by stairs or a lift or recorded separately."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated

import typer

from pc2grid.errors import ConfigError
from pc2grid.model import OccupancyGrid
from pc2grid_cli.console import of, print_json
from pc2grid_cli.options import SensorName
from pc2grid_cli.output_files import make_folder
from pc2grid_cli.tables import show
from pc2grid_lab.compare import options as options
from pc2grid_lab.compare.floors_report import draw, example_of, floors_table, mapped
from pc2grid_lab.documents import FloorRow
from pc2grid_lab.experiments.floors import WAYS, FloorResult, FloorTask, Way, database_file, stored_floors
from pc2grid_lab.experiments.program import program_digest
from pc2grid_lab.experiments.stored import in_processes
from signature.database import open_database


def compare_floors_command(
    context: typer.Context,
    ways: Annotated[str, typer.Option(help="how the house becomes a database")] = "stairs,lift,logs",
    seeds: Annotated[str, typer.Option(help="of the houses, for example 1,2,3")] = "1,2",
    visits: Annotated[str, typer.Option(help="floors in the order in which they are reached")] = "0,1,2",
    sensor: Annotated[
        SensorName | None, typer.Option(help="of maps and queries [by stairs lidar, else laser]")
    ] = None,
    length: Annotated[float, typer.Option(min=8.0, metavar="M", help="metres to drive on each floor")] = 15.0,
    query: Annotated[float, typer.Option(min=1.0, metavar="M", help="the same of a query")] = 8.0,
    queries: Annotated[int, typer.Option(min=1, help="on each floor")] = 6,
    out: options.OutputFolder = Path("floors"),
    as_json: options.AsJson = False,
) -> None:
    """Are floors told apart, and is the right one found? Simulated houses whose floors have one plan.

    Each house twice: with the same furniture everywhere, and with other furniture on each floor. A 2D laser
    cannot notice stairs, and needs a fraction of a lidar's time for the other ways.

    floors.png in the folder shows the answers in each house, and one query on the map of each floor.

    Wrong up to: what so few queries leave possible, at 95 % (Wilson's interval, as if they were independent).
    In the map: queries of which the map of their floor shows half of the walls; the others cannot be found.

    In brackets: 5th and 95th percentile over plans drawn anew (bootstrap), for queries in one plan are alike.

    Results of another version of the program are not used.

    Example: pc2grid compare floors --seeds 1,2,3
    """
    numbers, floors = _whole_numbers(seeds, "--seeds"), _whole_numbers(visits, "--visits")
    tasks = [
        FloorTask(
            seed=seed,
            way=way,
            alike=alike,
            sensor=("lidar" if way == "stairs" else "laser") if sensor is None else sensor.value,
            visits=floors,
            length_m=length,
            query_m=query,
            queries=queries,
        )
        for seed, way, alike in itertools.product(numbers, _known(ways), (True, False))
    ]
    make_folder(out)
    with of(context).progress("floors") as advance:
        results = in_processes(stored_floors, [(task, out) for task in tasks], jobs=1, advance=advance)
    houses = list(zip(tasks, results, strict=True))
    example, picture = example_of(houses), out / "floors.png"
    draw(picture, houses, _grids(*example, out), example)
    there = [mapped(result, _grids(task, result, out)) for task, result in houses]
    if as_json:
        rows = [_row(*row) for row in zip(tasks, results, there, strict=True)]
        print_json({"schema_version": 1, "program": program_digest(), "rows": rows})
    else:
        show(floors_table(houses, list(zip(tasks, there, strict=True))), str(picture))


def _known(ways: str) -> list[Way]:
    """The ways that are named, in the order of `WAYS`. Raises ConfigError for a word that is none."""
    names = [word.strip() for word in ways.split(",")]
    unknown = [name for name in names if name not in WAYS]
    if unknown:
        raise ConfigError(f"--ways: no way {unknown[0]!r}", hint=f"known are {', '.join(WAYS)}")
    return [way for way in WAYS if way in names]


def _whole_numbers(text: str, option: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(f"{option}: expected whole numbers, found {text!r}") from None


def _grids(task: FloorTask, result: FloorResult, out: Path) -> dict[str, OccupancyGrid]:
    """The maps in the database of a house."""
    with open_database(database_file(task, out)) as database:
        return {name: database.grid(name) for name in result.floors}


def _row(task: FloorTask, result: FloorResult, in_the_map: FloorResult) -> FloorRow:
    return {
        "seed": task.seed,
        "way": task.way,
        "alike": task.alike,
        "sensor": task.sensor,
        "visits": list(task.visits),
        "length_m": task.length_m,
        "query_m": task.query_m,
        "queries": task.queries,
        "told_apart": result.told_apart,
        "named": result.named,
        "right": result.count("right"),
        "wrong": result.count("wrong"),
        "ambiguous": result.count("ambiguous"),
        "not_found": result.count("not_found"),
        "misplaced": result.misplaced,
        "in_the_map": len(in_the_map.answers),
        "not_found_in_the_map": in_the_map.count("not_found"),
    }
