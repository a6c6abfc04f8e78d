"""Measure what the program promises, goal beside measured: `make bench`.

python tools/bench/run.py [--only NAME]... [--quick] [--out DIR]

Machines differ and are noisy: figures are medians of interleaved runs, ratios where there is something to
compare with. The table goes to stdout and, with machine and versions, to DIR/bench.md and DIR/bench.json.
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

import finding
import large
import peers
import places
import reading
from measure import ROOT, Row, machine, table

Measure = Callable[[Path, bool], Iterator[Row]]
MEASURES: dict[str, Measure] = {
    "help": reading.help_time,
    "info": reading.info_time,
    "decode": reading.decode_speed,
    "convert": reading.convert_time,
    "memory": reading.convert_memory,
    "growth": reading.growth,
    "describe": places.describe_time,
    "align": places.align_time,
    "retrieve": large.retrieve_time,
    "open": large.open_time,
    "relocalize": finding.relocalize_time,
    "peers": peers.compare,
}


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
    rows: list[Row] = []
    for name in arguments.only or MEASURES:
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory(prefix="bench-") as folder:
            try:
                rows += MEASURES[name](Path(folder), arguments.quick)
            except Exception as error:
                rows.append(Row(what=name, measured=None, unit="", note=f"failed: {error}"))
        print(f"{name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    facts = {"command": " ".join(["python tools/bench/run.py", *sys.argv[1:]]), **machine()}
    facts["data"] = "with PC2GRID_DATA" if os.environ.get("PC2GRID_DATA") else "simulated only"
    text = table(rows) + "\n\n" + "\n".join(f"{key}: {value}" for key, value in facts.items()) + "\n"
    print(text, end="")
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "bench.md").write_text(text)
    document = {"machine": facts, "quick": arguments.quick, "rows": [row.to_json() for row in rows]}
    (arguments.out / "bench.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
