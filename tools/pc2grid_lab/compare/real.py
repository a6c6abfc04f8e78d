"""`pc2grid compare real`: the sensors compared on real data, a 3D scan and a laser log of one floor.

The scan is driven through, and is a map itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from pc2grid.errors import LogNotFound, MapFileError
from pc2grid.geometry import SE2, invert_pose
from pc2grid.io import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.mapping.drawn_map import load_drawn_map
from pc2grid.model import Health, SensorKind, Trajectory
from pc2grid.pipeline import build_map
from pc2grid.simulate import Building, load_building
from pc2grid.time_span import TimeSpan
from pc2grid_cli.console import Console, json_text, of, print_json
from pc2grid_cli.output_files import make_folder
from pc2grid_lab.compare import options as options
from pc2grid_lab.compare.real_report import draw, print_table
from pc2grid_lab.experiments.answers import localize
from pc2grid_lab.experiments.plan_drives import MAP_SEED
from pc2grid_lab.experiments.real_sensors import FrameAgreement, RealQuery, judge_all, real_cells
from pc2grid_lab.experiments.registered_session import RegisteredSession, register
from pc2grid_lab.experiments.replay import Replay
from pc2grid_lab.experiments.sensor_map import MapKind, SensorMap, is_saved, save_map
from pc2grid_lab.experiments.sensor_matrix import map_building, query_start
from pc2grid_lab.experiments.stored import in_processes, write_text
from pc2grid_lab.experiments.trial import Trial
from pc2grid_lab.worlds import WorldConfig, iter_session
from signature.config import Config
from signature.database import open_database
from signature.sessions import session_of_map

_DRIVEN: tuple[SensorKind, ...] = ("lidar", "depth")
_SCAN = "scan"  # the map that the 3D scan is, without a drive
_LOG, _EARLIER = "laser", "laser-earlier"  # maps of the whole log and of its first part
_MAPS = (*_DRIVEN, _SCAN, _LOG, _EARLIER)


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """The files and numbers of a run; the files of results are named after those that change them."""

    floor: Path
    log: Path
    truth: Path | None
    out: Path
    map_length_m: float
    queries: int
    query_s: float
    window_s: float
    every_s: float
    earlier: float
    rate_hz: float
    clutter: int
    seed: int

    def map_file(self, name: str) -> Path:
        """Of the map by a driven sensor, or of the log."""
        if name in _DRIVEN:
            made = f"{self.floor.stem}.{name}.{self.map_length_m:g}m.{self.rate_hz:g}Hz.{self.clutter}"
        elif name == _SCAN:
            made = f"{self.floor.stem}.{name}"
        else:
            share = f".{self.earlier:g}" if name == _EARLIER else ""
            made = f"{self.log.stem}.{name}.{self._judged_by}{share}"
        return self.out / "maps" / f"{made}.submaps"

    def session_file(self, sensor: str, seed: int) -> Path:
        """Of a registered query session."""
        if sensor in _DRIVEN:
            made = f"{self.floor.stem}.{sensor}.{seed}.{self.query_s:g}s.{self.rate_hz:g}Hz.{self.clutter}"
            made += f".{self.map_length_m:g}m"
        else:
            made = f"{self.log.stem}.{seed}.{self.window_s:g}s.{self._judged_by}"
        return self.out / "sessions" / f"{made}.npz"

    @property
    def _judged_by(self) -> str:
        return self.truth.stem if self.truth else "own"

    def simulation(
        self, length_m: float, seed: int, start_m: tuple[float, float] | None = None
    ) -> WorldConfig:
        """Of one drive through the scan."""
        return WorldConfig.model_validate(
            {
                "length_m": length_m,
                "seed": seed,
                "clutter": self.clutter,
                "start_m": start_m,
                # 720 columns of 16 beams are what a lidar at 10 Hz sends; fewer scans save time.
                "lidar": {"rate_hz": self.rate_hz, "columns": 720},
                "depth": {"rate_hz": self.rate_hz},
            }
        )


def compare_real_command(
    context: typer.Context,
    floor: Annotated[Path, typer.Argument(metavar="FLOOR", help="3D scan of a floor: .ply, .pcd or a mesh")],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="recording of a 2D laser on the same floor")],
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="TUM", help="true poses of the laser [its own map of the whole log]"),
    ] = None,
    out: options.OutputFolder = Path("real-sensors"),
    queries: Annotated[int, typer.Option("--queries", min=1, help="drives of each sensor to locate")] = 10,
    query_time: Annotated[
        float, typer.Option("--query-time", min=2.0, help="seconds each of them lasts")
    ] = 14.0,
    window: Annotated[float, typer.Option("--window", min=2.0, help="seconds of a window of the log")] = 40.0,
    every: Annotated[float, typer.Option("--every", min=2.0, help="seconds between their starts")] = 50.0,
    map_length: Annotated[
        float, typer.Option("--map-length", min=5.0, metavar="M", help="metres driven to make a map")
    ] = 150.0,
    earlier: Annotated[
        float,
        typer.Option("--earlier", min=0.1, max=0.9, help="share of the log whose map later windows ask"),
    ] = 0.55,
    clutter: Annotated[int, typer.Option("--clutter", min=0, help="things added to each drive")] = 15,
    rate: Annotated[float, typer.Option("--rate", min=1.0, help="scans a second of lidar and camera")] = 5.0,
    seed: Annotated[int, typer.Option("--seed", min=1, help="of the first drive to locate")] = 1,
    quick: Annotated[
        bool, typer.Option("--quick", help="a third of the queries, a short map: a look in minutes")
    ] = False,
    jobs: options.Jobs = None,
    as_json: options.AsJson = False,
) -> None:
    """Lidar, depth camera and laser on one real floor: each located in the maps of each, and in the scan.

    Lidar and depth camera are driven through the 3D scan; the laser log is real, of another day. How the
    two lie to each other is fitted to the answers, and each answer is judged by the others.

    Example: pc2grid compare real fr079_floor.ply fr079.mcap --output real-sensors
    """
    if quick:
        queries, every, map_length = max(queries // 3, 1), 3 * every, map_length / 2
    setting = Setting(
        floor=floor,
        log=log,
        truth=truth,
        out=out,
        map_length_m=map_length,
        queries=queries,
        query_s=query_time,
        window_s=window,
        every_s=every,
        earlier=earlier,
        rate_hz=rate,
        clutter=clutter,
        seed=seed,
    )
    _compare(setting, of(context), jobs, as_json)


def _compare(setting: Setting, terminal: Console, jobs: int | None, as_json: bool) -> None:
    _refuse(setting)
    out = setting.out
    for folder in ("maps", "sessions"):
        make_folder(out / folder)
    queries = _queries(setting)
    for what, function, tasks in (
        # The camera takes longest to map and the log's parts wait for its poses, so these come first.
        ("map", _make_map, [(setting, name) for name in ("depth", _LOG, "lidar", _SCAN)]),
        ("drive", _register, [(setting, *task) for task in queries]),
        ("locate", _locate, [(setting, *task) for task in queries]),
    ):
        with terminal.progress(what) as advance:
            answered = in_processes(function, tasks, jobs=jobs, advance=advance)
    found: list[RealQuery] = list(filter(None, answered))
    maps = {name: _map(setting, name) for name in _MAPS}
    agreement = FrameAgreement.of(found, maps)
    trials = judge_all(found, maps, agreement)
    document = _document(setting, agreement, trials)
    write_text(out / "real.json", json_text(document) + "\n")
    draw(out / "real.png", found, maps, agreement, real_cells(trials), trials)
    if as_json:
        print_json(document)
        return
    print_table(real_cells(trials), agreement)
    print("\n".join(str(out / name) for name in ("real.json", "real.png")))


def _refuse(setting: Setting) -> None:
    """Raises MapFileError or LogNotFound where a file is missing."""
    if not setting.floor.is_file():
        raise MapFileError(f"{setting.floor}: no such file", hint="give a 3D scan of the floor")
    if not setting.log.exists():
        raise LogNotFound(f"{setting.log}: no such file")


def _queries(setting: Setting) -> list[tuple[str, int]]:
    """Sensor and seed of each query; of the laser, the first second of its window of the log."""
    with open_log(setting.log, Config().read) as opened:
        length_s = (opened.info.end_ns - opened.info.start_ns) * 1e-9
    windows = int(max(length_s - setting.window_s, 0.0) // setting.every_s) + 1
    queries = [("laser", round(k * setting.every_s)) for k in range(windows)]
    return queries + [(sensor, setting.seed + k) for k in range(setting.queries) for sensor in _DRIVEN]


def _document(setting: Setting, agreement: FrameAgreement, trials: Sequence[Trial]) -> dict[str, Any]:
    transform = agreement.T_floor_log
    return {
        "schema_version": 1,
        "floor": setting.floor.name,
        "log": setting.log.name,
        "T_floor_log": None if transform is None else [transform.x, transform.y, transform.yaw],
        "agreeing": agreement.agreeing,
        "across": len(agreement.clues),
        "setting": {
            "map_length": setting.map_length_m,
            "queries": setting.queries,
            "query_time": setting.query_s,
            "window": setting.window_s,
            "every": setting.every_s,
            "earlier": setting.earlier,
            "clutter": setting.clutter,
            "rate": setting.rate_hz,
            "seed": setting.seed,
        },
        "cells": [asdict(cell) for cell in real_cells(trials)],
        "trials": [asdict(trial) for trial in trials],
    }


@cache
def _building(floor: Path) -> Building:
    building = load_building(floor)
    if not isinstance(building, Building):
        raise MapFileError(f"{floor}: a plan, not a 3D scan", hint="use `pc2grid compare sensors` for plans")
    return building


def _make_map(setting: Setting, name: str) -> None:
    """Make the map of a driven sensor, of the scan, or those of the log, unless they exist."""
    if name == _LOG:
        _map_log(setting)
        return
    target, config = setting.map_file(name), Config()
    if is_saved(target):
        return
    if name == _SCAN:
        _map_scan(setting.floor, target)
        return
    sensor: SensorKind = "lidar" if name == "lidar" else "depth"
    simulation = setting.simulation(setting.map_length_m, MAP_SEED)
    made, T_floor_map = map_building("floor", _building(setting.floor), sensor, simulation, config)
    save_map(target, made, T_floor_map, setting.floor, config)


def _map_scan(floor: Path, target: Path) -> None:
    """The 3D scan as `pc2grid convert` makes a map of it, in the frame that is driven in."""
    config = Config()
    drawn = load_drawn_map(floor, config)
    T_floor_map = SE2.from_matrix(_building(floor).T_map_file @ invert_pose(drawn.T_map_file))
    save_map(target, session_of_map(drawn, "floor-scan", config), T_floor_map, floor, config)


def _map_log(setting: Setting) -> None:
    """Map the whole log and its first part."""
    config = Config()
    whole, part = setting.map_file(_LOG), setting.map_file(_EARLIER)
    with open_log(setting.log, config.read) as log:
        length_s = (log.info.end_ns - log.info.start_ns) * 1e-9
        for target, span in ((whole, TimeSpan()), (part, TimeSpan(0.0, setting.earlier * length_s))):
            if is_saved(target):
                continue
            made = build_map(log, config, session=_LOG, span=span)
            replay = _replay(setting, log, made.trajectory if target == whole else None)
            save_map(target, made, replay.T_world_map(made.trajectory), setting.log, config)


def _replay(setting: Setting, log: Any, whole: Trajectory | None = None) -> Replay:
    """The log with its true poses: those given, or of its map. whole : the trajectory of that map."""
    if setting.truth is not None:
        return Replay(log, read_tum(setting.truth), Config())
    if whole is None:
        with open_database(setting.map_file(_LOG)) as database:
            whole = database.trajectory(_LOG)
    return Replay(log, _without_lost(whole), Config(), of_base=True)


def _without_lost(trajectory: Trajectory) -> Trajectory:
    """The poses that are known."""

    if not trajectory.health:
        return trajectory
    known = np.array([health is not Health.LOST for health in trajectory.health])
    return Trajectory(stamps_ns=trajectory.stamps_ns[known], T_session_base=trajectory.T_session_base[known])


def _register(setting: Setting, sensor: SensorKind, seed: int) -> None:
    """Drive and register one query session, or a window of the log, unless it was done before."""
    target, config = setting.session_file(sensor, seed), Config()
    if target.exists():
        return
    if sensor == "laser":
        with open_log(setting.log, config.read) as log:
            _replay(setting, log).register(TimeSpan(float(seed), setting.window_s)).save(target)
        return
    building = _building(setting.floor)
    start_m = query_start(building, setting.simulation(setting.map_length_m, MAP_SEED), seed)
    # No robot of the simulation drives faster than 0.8 m/s.
    simulation = setting.simulation(0.8 * setting.query_s + 1.0, seed, start_m)
    scans = iter_session(sensor=sensor, grid=building, config=simulation)
    count = round(setting.query_s * setting.rate_hz)
    register(islice(scans, count), config, sensor=sensor).save(target)


@cache
def _map(setting: Setting, name: str) -> SensorMap:
    kinds: dict[str, MapKind] = {"lidar": "lidar", "depth": "depth", _SCAN: "scan"}
    kind = kinds.get(name, "laser")
    return SensorMap.load(setting.map_file(name), name="floor", sensor=kind, config=Config())


def _locate(setting: Setting, sensor: SensorKind, seed: int) -> RealQuery | None:
    """Locate one query session in every map but those made of the same scans; None without a true pose."""

    session = RegisteredSession.load(setting.session_file(sensor, seed))
    if session.lost.all() or np.isnan(session.T_world_base[:, 0]).all():
        return None
    names: list[str] = [*_DRIVEN, _SCAN]
    if sensor != "laser":
        names.append(_LOG)
    elif session.planar_scans[0].stamp_ns > _last_stamp_ns(setting):
        names.append(_EARLIER)
    scans = ((registered, planar_scan) for registered, planar_scan, _ in session.scans())
    (found,) = localize(scans, [_map(setting, name).index for name in names])
    return RealQuery(
        sensor=sensor,
        seed=seed,
        T_frame_base=session.T_world_odom() @ found.answers[0].T_odom_base,
        query=found.query,
        answers=dict(zip(names, found.answers, strict=True)),
        look_up_ms=dict(zip(names, found.elapsed_ms, strict=True)),
    )


@cache
def _last_stamp_ns(setting: Setting) -> int:
    """Stamp of the last scan of the log's first part."""
    with open_database(setting.map_file(_EARLIER)) as database:
        return int(database.trajectory(_LOG).stamps_ns[-1])
