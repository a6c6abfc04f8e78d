"""`pc2grid simulate`: a simulated recording with its ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer
from pydantic import ValidationError

from pc2grid.errors import ConfigError
from pc2grid.io.atomic import require_writable
from pc2grid.model import OccupancyGrid, SensorKind
from pc2grid.simulate import Building, SimulatedSession, SimulationConfig, load_building, simulate_session
from pc2grid.simulate.config import OdometryConfig
from pc2grid_cli import console
from signature.localization.answer_json import plain


def run(
    files: list[Path],
    sensor: SensorKind,
    terminal: console.Console,
    *,
    force: bool,
    json: bool,
    clutter: int,
    odometry: bool,
    **drive: Any,
) -> None:
    """Simulate, and print what was written. drive : the further fields of `SimulationConfig`."""
    grid = _building(files, force)
    config = _config(clutter=clutter, odometry=OdometryConfig(enabled=odometry), **drive)
    with terminal.progress(f"simulate {sensor}") as update:
        made = simulate_session(
            files[-1], sensor=sensor, grid=grid, config=config, progress=update, overwrite=force
        )
    if made.clutter < clutter:
        console.warn(f"only {made.clutter} of {clutter} pieces of clutter could be placed")
    text = (
        f"{made.path}: {made.scans} {made.sensor} scans, {made.length_m:.1f} m in {made.duration_s:.1f} s\n"
        f"{made.truth_path}: {made.scans} true poses of base_link in the map frame"
    )
    console.print_result(plain(SimulatedSession, made) if json else text)


def _building(files: list[Path], force: bool) -> OccupancyGrid | Building | None:
    """The building of `[BUILDING] OUT.mcap`, None for the office; what is written must be writable."""
    if len(files) > 2:
        raise typer.BadParameter(f"expected [BUILDING] OUT.mcap, got {len(files)} files")
    if files[-1].suffix != ".mcap":
        raise typer.BadParameter(f"the file to write must end in .mcap: {files[-1]}")
    for path in (files[-1], files[-1].with_suffix(".tum")):
        require_writable(path, force)
    return load_building(files[0]) if len(files) == 2 else None


def _config(**given: Any) -> SimulationConfig:
    """Raises ConfigError for a value that does not fit."""
    try:
        return SimulationConfig(**given)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"{first['loc'][0]}: {first['msg']}, got {first['input']}") from error
