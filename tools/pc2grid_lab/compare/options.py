"""The options that several commands of `pc2grid compare` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pc2grid_cli.options import OUTPUT_FOLDER

OutputFolder = Annotated[Path, typer.Option(*OUTPUT_FOLDER, help="folder for results; run again to go on")]
Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="processes [one a core]")]
