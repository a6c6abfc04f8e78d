"""`pc2grid compare floors`: floors that look alike, reached by stairs or a lift or recorded separately."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pc2grid_cli.options import OUTPUT_FOLDER
from pc2grid_cli.output_files import make_folder
from pc2grid_cli.simulate import SensorName

if TYPE_CHECKING:
    from rich.table import Table

    from pc2grid_cli.json_schemas import CompareFloors, FloorRow
    from signature.evaluation.floors import FloorTask


def compare_floors_command(
    context: typer.Context,
    ways: Annotated[str, typer.Option(help="how the house becomes a database")] = "stairs,lift,logs",
    seeds: Annotated[str, typer.Option(help="of the houses, for example 1,2,3")] = "1,2",
    visits: Annotated[str, typer.Option(help="floors in the order in which they are reached")] = "0,1,2",
    sensor: Annotated[SensorName, typer.Option(help="of maps and queries")] = SensorName.lidar,
    length: Annotated[float, typer.Option(min=8.0, metavar="M", help="metres to drive on each floor")] = 15.0,
    query: Annotated[float, typer.Option(min=1.0, metavar="M", help="the same of a query")] = 8.0,
    queries: Annotated[int, typer.Option(min=1, help="on each floor")] = 2,
    out: Annotated[Path, typer.Option(*OUTPUT_FOLDER, help="folder for results; run again to go on")] = Path(
        "floors"
    ),
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document, not a table")] = False,
) -> None:
    """Are floors told apart, and is the right one found? Simulated houses whose floors have one plan.

    Each house twice: with the same furniture everywhere, and with other furniture on each floor.

    Wrong up to: what so few queries leave possible, at 95 % (Wilson's interval).

    Example: pc2grid compare floors --seeds 1,2,3
    """
    from pc2grid.errors import ConfigError
    from pc2grid_cli.console import of, print_json
    from pc2grid_cli.tables import show
    from signature.evaluation.floors import WAYS, FloorTask

    names = [word.strip() for word in ways.split(",")]
    unknown = [name for name in names if name not in WAYS]
    if unknown:
        raise ConfigError(f"--ways: no way {unknown[0]!r}", hint=f"known are {', '.join(WAYS)}")
    numbers, floors = _whole_numbers(seeds, "--seeds"), _whole_numbers(visits, "--visits")
    tasks = [
        FloorTask(
            seed=seed,
            way=way,
            alike=alike,
            sensor=sensor.value,
            visits=floors,
            length_m=length,
            query_m=query,
            queries=queries,
        )
        for seed in numbers
        for way in WAYS
        if way in names
        for alike in (True, False)
    ]
    make_folder(out)
    with of(context).progress("floors") as advance:
        rows = []
        for done, task in enumerate(tasks, start=1):
            rows.append(_row(task, out))
            advance(done / len(tasks))
    if as_json:
        document: CompareFloors = {"schema_version": 1, "rows": rows}
        print_json(document)
        return
    show(_table(rows))


def _whole_numbers(text: str, option: str) -> tuple[int, ...]:
    from pc2grid.errors import ConfigError

    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(f"{option}: expected whole numbers, found {text!r}") from None


def _row(task: FloorTask, out: Path) -> FloorRow:
    """The result of one house; computed unless it is in the folder."""
    from dataclasses import asdict

    from pc2grid.io.atomic import replace_file
    from signature.evaluation.floors import run_floors

    furniture = "alike" if task.alike else "differs"
    travel = f"{task.length_m:g}m.{task.query_m:g}m.{task.queries}"
    visits = "".join(map(str, task.visits))
    file = out / f"{task.sensor}.{task.way}.{visits}.{furniture}.{task.seed}.{travel}.json"
    if not file.exists():
        row = {**asdict(task), **asdict(run_floors(task))}
        with replace_file(file) as draft:
            draft.write_text(json.dumps(row, indent=1))
    stored: FloorRow = json.loads(file.read_text())
    return stored


_ANSWERS: tuple[Literal["right", "ambiguous", "not_found", "wrong", "misplaced"], ...] = (
    "right",
    "ambiguous",
    "not_found",
    "wrong",
    "misplaced",
)


def _table(rows: list[FloorRow]) -> Table:
    from scipy.stats import binomtest

    from pc2grid_cli.tables import table

    made = table(
        "floors with one plan",
        ("by", "furniture"),
        ("houses", "told apart", "named", *(name.replace("_", " ") for name in _ANSWERS), "wrong up to"),
    )
    for way, alike in dict.fromkeys((row["way"], row["alike"]) for row in rows):
        group = [row for row in rows if (row["way"], row["alike"]) == (way, alike)]
        asked = sum(row["queries"] * len(set(row["visits"])) for row in group)
        wrong = binomtest(sum(row["wrong"] for row in group), asked).proportion_ci(method="wilson")
        made.add_row(
            way,
            "alike" if alike else "differs",
            str(len(group)),
            str(sum(row["told_apart"] for row in group)),
            str(sum(row["named"] for row in group)),
            *(str(sum(row[answer] for row in group)) for answer in _ANSWERS),
            f"{wrong.high:.1%}",
        )
    return made
