"""`pc2grid simulate`: a recording of a robot that never was, with the truth beside it."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli.settings import AsJson, Force


class SensorName(str, enum.Enum):
    """The three kinds of sensor."""

    lidar = "lidar"
    depth = "depth"
    laser = "laser"


def simulate_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="[MAP.yaml] OUT.mcap", help="floor plan (default: an office), and what to write"
        ),
    ],
    sensor: Annotated[SensorName, typer.Option(help="what the robot carries")],
    length: Annotated[float, typer.Option(min=0.1, metavar="M", help="metres to drive")] = 40.0,
    seed: Annotated[int, typer.Option(min=0, help="route, clutter, noise and odometry")] = 0,
    clutter: Annotated[int, typer.Option(min=0, help="movable pieces in the way")] = 30,
    walkers: Annotated[int, typer.Option(min=0, help="people who walk about meanwhile")] = 0,
    start: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="where to start in the map; default: anywhere"),
    ] = None,
    building_seed: Annotated[int, typer.Option(min=0, help="which office, when there is no MAP.yaml")] = 0,
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="leave odometry out of the log")] = False,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Drive a robot through a building and record it: OUT.mcap, and OUT.tum with the true poses.

    Example: pc2grid simulate map.yaml drive.mcap --sensor depth --length 20
    """
    from pydantic import ValidationError

    from pc2grid.errors import ConfigError
    from pc2grid.io.nav2_map import load_map
    from pc2grid.simulate import SimulationConfig, simulate_session
    from pc2grid.simulate.config import OdometryConfig

    if len(files) > 2:
        raise typer.BadParameter(f"expected [MAP.yaml] OUT.mcap, got {len(files)} files")
    if files[-1].suffix != ".mcap":
        raise typer.BadParameter(f"the file to write must end in .mcap: {files[-1]}")
    grid = load_map(files[0]) if len(files) == 2 else None
    try:
        config = SimulationConfig(
            length_m=length,
            seed=seed,
            clutter=clutter,
            walkers=walkers,
            start_m=start,
            building_seed=building_seed,
            odometry=OdometryConfig(enabled=not no_odometry),
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"{first['loc'][0]}: {first['msg']}, got {first['input']}") from error
    with console.progress(f"simulate {sensor.value}") as update:
        made = simulate_session(
            files[-1], sensor=sensor.value, grid=grid, config=config, progress=update, force=force
        )
    if made.clutter < clutter:
        console.warn(f"only {made.clutter} of {clutter} pieces of clutter found room")
    if json:
        console.print_json(
            {
                "schema_version": 1,
                "recording": str(made.path),
                "truth": str(made.truth_path),
                "sensor": made.sensor,
                "scans": made.scans,
                "duration_s": made.duration_s,
                "length_m": made.length_m,
                "clutter": made.clutter,
            }
        )
        return
    print(f"{made.path}: {made.scans} {made.sensor} scans, {made.length_m:.1f} m in {made.duration_s:.1f} s")
    print(f"{made.truth_path}: {made.scans} true poses of base_link in the map frame")
