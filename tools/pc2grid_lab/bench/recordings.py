"""Real recordings against the table that is kept: the quick form of `make real`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import ROOT, Row, program

_TABLE = ROOT / "examples" / "real.json"


def against_table(folder: Path, quick: bool) -> Iterator[Row]:
    """What became worse by more than chance, and what the run costs."""
    what = "real recordings: worse than examples/real.json"
    data = fixtures.data_file("README.md")
    if data is None:
        yield Row(what=what, measured=None, unit="rows", goal=0, note="needs PC2GRID_DATA")
        return
    child = program(
        "compare", "recordings", data.parent, "--quick", "--json", "--table", _TABLE, "--out", folder / "real"
    )
    document = json.loads(child.stdout)
    worse = [change for change in document["changes"] if change["worse"]]
    note = "; ".join(f"{change['row']}: {change['text']}" for change in worse)
    yield Row(what=what, measured=len(worse), unit="rows", goal=0, note=note)
    minutes = document["cpu_s"] / 60
    yield Row(what="real recordings, quick form", measured=minutes, unit="min of cpu", goal=12.0)
