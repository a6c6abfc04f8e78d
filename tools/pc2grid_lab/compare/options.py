"""The options that several commands of `pc2grid compare` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pc2grid_cli.options import OUTPUT_FOLDER

OutputFolder = Annotated[Path, typer.Option(*OUTPUT_FOLDER, help="folder for results; run again to go on")]
Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="processes [one a core]")]
AsJson = Annotated[bool, typer.Option("--json", help="print one JSON document, not a table")]
QuerySessions = Annotated[int, typer.Option("--queries", min=1, help="query sessions a plan and sensor")]
FirstSeed = Annotated[int, typer.Option("--seed", help="of the first query session")]
MapLength = Annotated[float, typer.Option("--map-length", help="metres driven to make a map")]
Clutter = Annotated[int, typer.Option("--clutter", help="things in the way, different in each session")]
Change = Annotated[
    float, typer.Option("--change", min=0, max=1, help="share of doors and furniture that differ, by session")
]
Rate = Annotated[float, typer.Option("--rate", help="scans a second, of every sensor")]
