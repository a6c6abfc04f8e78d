"""`pc2grid demo` and `pc2grid simulate`: recordings of simulated robots.

In the demonstration a robot with a lidar makes a map, and another one with a depth camera is found in it.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import typer
from pydantic import ValidationError

from pc2grid.display import counted, plain
from pc2grid.errors import ConfigError
from pc2grid.geometry import wrap_angle
from pc2grid.io.atomic import require_writable
from pc2grid.io.trajectory import read_tum
from pc2grid.model import OccupancyGrid, SensorKind
from pc2grid.simulate import Building, SimulationConfig, load_building, simulate_session
from pc2grid.simulate.config import LidarConfig
from pc2grid_cli import console, options
from pc2grid_cli.output import make_folder
from pc2grid_cli.relocalize import as_text
from signature.config import Config
from signature.database import open_database
from signature.sessions import add_sessions, build_session, find
from signature.shown.page import write_report
from signature.shown.picture import draw_answer

BUILDING_SEED = 3
MAP_LENGTH_M = 60.0
QUERY_LENGTH_M = 15.0
QUERY_START_M = (7.6, 8.0)


def run(given: options.Demo, terminal: console.Console) -> int:
    """Map the office, find the other robot, and leave all files in a folder. Return the exit code."""
    begin, out, force = time.monotonic(), given.out, given.force
    lidar, depth = out / "lidar.mcap", out / "depth.mcap"
    database, picture, page = out / "office.submaps", out / "answer.png", out / "report.html"
    make_folder(out)
    for path in (lidar, depth, database, picture, page):
        require_writable(path, force)

    terminal.note("1/4 simulate a robot with a lidar, and days later one with a depth camera")
    # Half of the rate and columns of a VLP-16: enough for an indoor map, and the demo stays short.
    short = LidarConfig(rate_hz=5.0, columns=450)
    mapper = SimulationConfig(length_m=MAP_LENGTH_M, seed=1, building_seed=BUILDING_SEED, lidar=short)
    visitor = SimulationConfig(
        length_m=QUERY_LENGTH_M, seed=12, start_m=QUERY_START_M, building_seed=BUILDING_SEED
    )
    drives: tuple[tuple[SensorKind, Path, SimulationConfig], ...]
    drives = (("lidar", lidar, mapper), ("depth", depth, visitor))
    for sensor, path, drive in drives:
        with terminal.progress(f"simulate {sensor}") as update:
            simulate_session(path, sensor=sensor, config=drive, progress=update, overwrite=force)

    terminal.note("2/4 convert the lidar's recording into a database")
    config = Config()
    session, origin = build_session(lidar, "lidar", config, observer=terminal)
    add_sessions(database, [(session, origin)], config, keep=False)

    terminal.note("3/4 relocalize the depth camera's recording in it")
    truth_map, truth_query = read_tum(lidar.with_suffix(".tum")), read_tum(depth.with_suffix(".tum"))
    with open_database(database) as opened:
        answer = find(depth, opened, config, observer=terminal)
        # The frame of the database is the first pose of the lidar robot; the truth is in that of the plan.
        T_map_plan = next(truth_map.poses()).inverse()
        true_poses = [T_map_plan @ pose for pose in truth_query.poses()]
        terminal.note("4/4 draw it")
        truth_m = np.array([(p.x, p.y) for p in true_poses])
        with terminal.progress("draw the picture and the page") as update:
            draw_answer(picture, opened, answer, answer.poses, truth_m)
            update(0.5)
            write_report(page, opened, found=answer, truth_m=truth_m)
    scans, submaps = counted(len(session.trajectory), "lidar scan"), counted(len(session.submaps), "submap")
    print(f"map: {scans}, {submaps}: {database}")
    print(as_text(answer))
    if answer.T_map_base is not None:
        pose, true = answer.T_map_base, true_poses[-1]
        distance = math.hypot(pose.x - true.x, pose.y - true.y)
        turn = abs(math.degrees(wrap_angle(pose.yaw - true.yaw)))
        print(f"truth: x {true.x:.2f} m, y {true.y:.2f} m: off by {distance:.2f} m and {turn:.1f} deg")
    print(f"picture: {picture}, page to look into it: {page}   ({time.monotonic() - begin:.0f} s)")
    return console.OK if answer.status == "located" else console.UNSURE


def simulate(given: options.Simulate, terminal: console.Console) -> None:
    """Record a simulated drive, and print what was written."""
    files, sensor, force = given.files, given.sensor, given.force
    grid = _building(files, force)
    drive = {name: value for name, value in vars(given).items() if name in SimulationConfig.model_fields}
    config = _config(**drive, odometry={"enabled": not given.no_odometry})
    with terminal.progress(f"simulate {sensor}") as update:
        made = simulate_session(
            files[-1], sensor=sensor, grid=grid, config=config, progress=update, overwrite=force
        )
    if made.clutter < given.clutter:
        console.warn(f"only {made.clutter} of {given.clutter} pieces of clutter could be placed")
    text = (
        f"{made.path}: {made.scans} {made.sensor} scans, {made.length_m:.1f} m in {made.duration_s:.1f} s\n"
        f"{made.truth_path}: {made.scans} true poses of base_link in the map frame"
    )
    console.print_result(plain(made) if given.json else text)


def _building(files: list[Path], force: bool) -> OccupancyGrid | Building | None:
    """Return the building of `[BUILDING] OUT.mcap`, None for the office; check that OUT can be written."""
    if len(files) > 2:
        raise typer.BadParameter(f"expected [BUILDING] OUT.mcap, got {len(files)} files")
    if files[-1].suffix != ".mcap":
        raise typer.BadParameter(f"the file to write must end in .mcap: {files[-1]}")
    for path in (files[-1], files[-1].with_suffix(".tum")):
        require_writable(path, force)
    return load_building(files[0]) if len(files) == 2 else None


def _config(**given: Any) -> SimulationConfig:
    """Return the settings of a drive. Raises ConfigError for a value that does not fit."""
    try:
        return SimulationConfig(**given)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"{first['loc'][0]}: {first['msg']}, got {first['input']}") from error
