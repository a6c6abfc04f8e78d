"""Measure the program and compare the figures with the goals: `make bench`.

python -m pc2grid_lab.bench.run [--only NAME]... [--quick] [--out DIR]

Machines differ and their load varies. Therefore the figures are medians of interleaved runs, and ratios where
there is another program to compare with. The table is printed to stdout and written, with the machine and the
versions, to DIR/bench.md and DIR/bench.json.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from pc2grid.errors import Pc2GridError
from pc2grid.extras import require
from pc2grid_lab.bench import (
    large_database,
    live,
    locating,
    points,
    reading,
    space,
    submaps,
)
from pc2grid_lab.bench.measure import ROOT, Row, machine, table

Measure = Callable[[Path, bool], Iterator[Row]]


def fleet_reading(folder: Path, quick: bool) -> Iterator[Row]:
    """`fleet.fleet_reading`, imported only when it runs, because PostgreSQL's libraries are an extra."""
    from pc2grid_lab.bench import fleet

    yield from fleet.fleet_reading(folder, quick)


MEASURES: dict[str, Measure] = {
    "help": reading.help_time,
    "info": reading.info_time,
    "decode": reading.decode_speed,
    "convert": reading.convert_time,
    "memory": reading.convert_memory,
    "growth": reading.growth,
    "points": points.kept,
    "space": space.poses,
    "twins": space.twins,
    "describe": submaps.describe_time,
    "align": submaps.align_time,
    "retrieve": large_database.retrieve_time,
    "open": large_database.open_time,
    "floors": large_database.floors_time,
    "look-up": locating.look_up_time,
    "relocalize": locating.relocalize_time,
    "live": live.lag,
    "hour": live.memory,
    "fleet": fleet_reading,
}

_EXTRAS = {"retrieve": "bench", "fleet": "postgres"}


def main() -> None:
    """Run the measures and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", choices=MEASURES, help="one measure; repeatable")
    parser.add_argument("--quick", action="store_true", help="smaller inputs, fewer rounds: a smoke test")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "results", help="folder for bench.md and bench.json"
    )
    arguments = parser.parse_args()
    chosen = arguments.only or MEASURES
    try:
        require({name: what for what, name in _EXTRAS.items() if what in chosen})
    except Pc2GridError as error:
        parser.error(str(error))
    facts = {"command": " ".join(["python -m pc2grid_lab.bench.run", *sys.argv[1:]]), **machine()}
    facts["data"] = "with PC2GRID_DATA" if os.environ.get("PC2GRID_DATA") else "simulated only"
    rows: list[Row] = []
    for name in chosen:
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory(prefix="bench-") as folder:
            try:
                rows += MEASURES[name](Path(folder), arguments.quick)
            except Exception as error:
                rows.append(Row(what=name, measured=None, unit="", note=f"failed: {error}"))
        print(f"{name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
        facts["load"] = f"{os.getloadavg()[0]:.1f} processes, including this one"
        write(arguments.out, rows, facts, quick=arguments.quick)
    print((arguments.out / "bench.md").read_text(), end="")


def write(folder: Path, rows: list[Row], facts: dict[str, str], *, quick: bool) -> None:
    """Write the rows so far to bench.md and bench.json, after every measure, because all take long."""
    folder.mkdir(parents=True, exist_ok=True)
    text = table(rows) + "\n\n" + "\n".join(f"{key}: {value}" for key, value in facts.items()) + "\n"
    (folder / "bench.md").write_text(text)
    document = {"machine": facts, "quick": quick, "rows": [row.to_json() for row in rows]}
    (folder / "bench.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
