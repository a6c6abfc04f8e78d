"""`pc2grid info`: what is in a recording, and what `convert` would use of it; in a map or a database."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, fields
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid import libraries
from pc2grid.display import plain
from pc2grid.errors import Pc2GridError, one_line
from pc2grid.geometry import invert_pose, transform_points
from pc2grid.io.source import Choice, LogInfo, is_submap_file
from pc2grid.model import SENSOR_MODELS
from pc2grid_cli import console, options, output


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenTopics(Choice):
    """What `convert` would use, and why. camera_topic: the calibration of depth images; else null."""

    camera_topic: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Info(LogInfo):
    """`pc2grid info --json`. choice is null, and problem says why, if `convert` could not use the log."""

    choice: ChosenTopics | None
    problem: str | None
    bytes_lost: int


def run(given: options.ShowInfo, terminal: console.Console) -> int | None:
    """Print what is in a recording, a map or a database. Return the exit code."""
    log, path = given.log, Path(given.log)
    if "postgres" in libraries.of_addresses(log) or is_submap_file(path):
        from pc2grid_cli import db

        db.info(options.DbInfo(database=log, json=given.json), terminal)
        return None
    from pc2grid.io.building_file import is_building_file
    from pc2grid.io.maps import is_map_file

    if is_map_file(path) or is_building_file(path):
        of_map = describe_map(path, given.assignments)
        console.print_result(plain(of_map) if given.json else one_line(_map_as_text(of_map)))
        for warning in of_map["warnings"]:
            console.warn(warning)
        return None
    info = describe(path, topic=given.topic, recover=given.recover, assignments=given.assignments)
    if given.json:
        console.print_result(plain(info))
    else:
        _show(info)
    return console.LOSSY if info.bytes_lost else None


def describe_map(path: Path, assignments: list[str] | None = None) -> dict[str, Any]:
    """Return the document of a map. Raises MapFileError if it cannot be read."""
    from pc2grid.grids.drawn import load_drawn_map

    drawn = load_drawn_map(path, options.Settings(assignments=assignments).settings())
    grid, R = drawn.grid, drawn.T_map_file[:3, :3]
    height, width = grid.cells.shape
    middle = [*grid.to_point(np.array([(height // 2, width // 2)]))[0], 0.0]
    floor_z_m = float(transform_points(invert_pose(drawn.T_map_file), np.array([middle]))[0, 2])
    return {
        "path": str(path),
        "format": drawn.kind,
        "width": width,
        "height": height,
        "resolution_m": grid.resolution_m,
        "origin_m": list(grid.origin_m),
        "free_m2": round(grid.free_m2, 2),
        "occupied_m2": round(float(np.count_nonzero(grid.occupied)) * grid.resolution_m**2, 2),
        "voxels": len(drawn.level_points_m),
        "floor_z_m": round(floor_z_m, 3),  # in the frame of the file, in the middle of the map
        "tilt_deg": round(math.degrees(math.acos(min(1.0, float(R[2, 2])))), 2),
        "warnings": list(drawn.warnings),
    }


def _map_as_text(d: dict[str, Any]) -> str:
    x, y = d["origin_m"]
    of_cloud = ""
    if d["voxels"]:
        of_cloud = f", floor at z {d['floor_z_m']:.2f} m, tilted by {d['tilt_deg']:.1f} degrees"
    return (
        f"{d['path']}: {d['format']}, {d['width']} x {d['height']} cells of {d['resolution_m']:g} m"
        f" ({d['width'] * d['resolution_m']:.1f} x {d['height'] * d['resolution_m']:.1f} m),"
        f" {d['free_m2']:.0f} m2 free, lower left corner at x {x:.2f} m, y {y:.2f} m{of_cloud}"
    )


def describe(
    path: Path, *, topic: str | None = None, recover: bool = False, assignments: list[str] | None = None
) -> Info:
    """Return the document of a recording. If convert could not use it, `choice` is null, and `problem` why.

    Reads the log's summary, a few messages and the first scans only, unless it has no summary.
    Raises LogError if the file cannot be opened.
    """
    from pc2grid.io.recording import open_log
    from pc2grid.io.stream import PARAMETERS

    config = options.Reading(topic=topic, assignments=assignments).settings()
    with open_log(path, config.read, recover=recover) as log:
        choice: ChosenTopics | None = None
        problem: str | None = None
        try:
            choice = _chosen(log.choose(), log.info)
            for _ in itertools.islice(log.scans(), PARAMETERS.patience):  # what convert would say of them
                pass
        except Pc2GridError as error:
            choice, problem = None, error.in_short
        report = log.report()
        warnings = tuple(dict.fromkeys((*log.info.warnings, *report.warnings)))
        found = _fields(log.info) | {"warnings": warnings}
        return Info(**found, choice=choice, problem=problem, bytes_lost=report.bytes_lost)


def _chosen(choice: Choice, log: LogInfo) -> ChosenTopics:
    """Return what would be used, with the topic of the camera's calibration if depth images are."""
    from pc2grid.io.topics import camera_info_topic

    images = [
        topic for topic in log.topics if topic.topic == choice.topic and SENSOR_MODELS[choice.sensor].image
    ]
    camera = camera_info_topic(images[0], log.topics).topic if images else None
    named = _fields(choice) | {"sensor_frame": choice.sensor_frame or ""}
    return ChosenTopics(**named, camera_topic=camera)


def _fields(of: Choice | LogInfo) -> dict[str, Any]:
    return {field.name: getattr(of, field.name) for field in fields(of)}


def _show(info: Info) -> None:
    from rich import markup
    from rich.console import Console
    from rich.table import Table

    from pc2grid.io.topics import Namespaces

    def escape(text: str) -> str:
        # Names come from the log, and may hold control sequences for a terminal.
        return markup.escape(one_line(text))

    out = Console()
    choice, count = info.choice, info.message_count
    out.print(f"[bold]{escape(str(info.path))}[/bold]", soft_wrap=True, highlight=False)
    out.print(
        f"{info.format}, {info.size_bytes / 1e6:.1f} MB, {info.duration_s:.1f} s from "
        f"{_when(info.start_ns)}, {'?' if count is None else count} messages",
        soft_wrap=True,
        highlight=False,
    )
    table = Table(box=None, pad_edge=False)
    for name in ("topic", "type", "messages", "used as"):
        table.add_column(name, justify="right" if name == "messages" else "left", overflow="fold")
    uses: dict[str | None, str] = {}
    if choice is not None:
        scans = next(t for t in info.topics if t.topic == choice.topic)
        uses = {t.topic: "transforms" for t in Namespaces(scans, info.topics).tf_topics()}
        uses |= {choice.camera_topic: "calibration", choice.imu_topic: "gravity"}
        uses |= {choice.odometry_topic: "odometry", choice.topic: f"scans ({choice.sensor})"}
    for topic in info.topics:
        number = "?" if topic.message_count is None else str(topic.message_count)
        table.add_row(escape(topic.topic), escape(topic.type), number, uses.get(topic.topic, ""))
    # As wide as the names are: a terminal wraps long lines better than a table breaks names.
    Console(width=output.WIDEST).print(table)
    if choice is not None:
        out.print(f"convert uses {escape(choice.topic)}: {escape(choice.reason)}", soft_wrap=True)
        frames = ", ".join((choice.sensor_frame or "(unnamed)", *choice.further_frames))
        where = f"base frame {choice.base_frame}, scans in frame {frames}"
        out.print(escape(where), soft_wrap=True, highlight=False)
    else:
        out.print(f"convert cannot use this log: {escape(str(info.problem))}", soft_wrap=True)
    for warning in info.warnings:
        out.print(f"note: {escape(warning)}", soft_wrap=True, highlight=False)


def _when(stamp_ns: int) -> str:
    """Return the time as RFC 3339 writes it, in UTC."""
    try:
        moment = datetime.fromtimestamp(stamp_ns // 1_000_000_000, tz=timezone.utc)
    except (OverflowError, ValueError, OSError):
        return f"{stamp_ns} ns"
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")
