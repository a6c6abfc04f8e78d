"""Table and picture of `pc2grid compare real`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid_cli.picture import BLUE, ORANGE, VERMILLION
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare.picture import picture
from pc2grid_lab.experiments.real_sensors import FrameAgreement, RealCell, RealQuery
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.trial import Trial
from signature.localization.answer import Answer

_SENSORS = ("lidar", "depth", "laser")
_MAPS = (*_SENSORS, "scan")
_COLOURS = dict(zip(_SENSORS, (BLUE, ORANGE, VERMILLION), strict=True))
_SHOWN = {"lidar": "lidar", "depth": "depth camera", "laser": "2D laser"}
_TITLES = {**{name: f"map by {shown}" for name, shown in _SHOWN.items()}, "scan": "the 3D scan as map"}
_SIZES = {"lidar": 9.0, "depth": 5.5, "laser": 7.0}  # lidar and camera drive the same ways
_DRAWN_AT_MOST = 30_000  # wall points of a map; more would only make the picture heavier


def print_table(cells: Sequence[RealCell], agreement: FrameAgreement) -> None:
    """Print a row for each pair of sensors."""
    title = "one real floor, maps by each sensor, queries by each"
    counts = ("queries", "located, right", "right first", "in the map", "share right")
    others = ("wrong", "ambiguous", "not found", "median", "95 %", "wrong outside")
    shown = table(title, ("map", "query"), (*counts, *others))
    for cell in _in_order(cells):
        shown.add_row(
            cell.map_sensor,
            cell.query_sensor,
            str(cell.queries),
            str(cell.located_right),
            str(cell.right_first),
            str(cell.in_map),
            _share(cell),
            str(cell.wrong),
            str(cell.ambiguous),
            str(cell.not_found),
            _metres(cell.median_error_m),
            _metres(cell.p95_error_m),
            f"{cell.wrong_outside} of {cell.queries - cell.in_map}" if cell.queries > cell.in_map else "",
        )
    show(
        shown,
        f"one rigid transform between scan and log agrees with the first place of {agreement.agreeing} of"
        f" {len(agreement.clues)} answers across them",
    )


def _in_order(cells: Sequence[RealCell]) -> list[RealCell]:
    return sorted(cells, key=lambda c: (_MAPS.index(c.map_sensor), _SENSORS.index(c.query_sensor)))


def _share(cell: RealCell) -> str:
    if cell.right_share is None:
        return ""
    return f"{cell.right_share:.2f} [{cell.low:.2f}, {cell.high:.2f}]"


def _metres(value: float | None) -> str:
    return "" if value is None else f"{value:.3f} m"


def draw(
    path: Path,
    queries: Sequence[RealQuery],
    maps: Mapping[str, SensorMap],
    agreement: FrameAgreement,
    cells: Sequence[RealCell],
    trials: Sequence[Trial],
) -> None:
    """One panel for each map, all in the frame of the scan, with the queries where they were located.

    An arrow is an answer. A mark without one is the true place of a query that got none: filled if the right
    place came first, open if not.
    """
    T_floor_log = agreement.T_floor_log or SE2()
    frames = {name: T_floor_log if m.sensor == "laser" else SE2() for name, m in maps.items()}
    first = {(t.map_sensor, t.query_sensor, t.seed) for t in trials if t.right}
    walls_m = {name: _walls_m(sensor_map, frames[name]) for name, sensor_map in maps.items()}
    everything = np.concatenate(list(walls_m.values()))
    (x0, y0), (x1, y1) = everything.min(axis=0), everything.max(axis=0)
    height = min(max(9.0 * (y1 - y0) / (x1 - x0), 2.0), 9.0) + 0.45
    with picture(path, 9.0, height * len(_MAPS)) as figure:
        axes = figure.subplots(len(_MAPS), 1, sharex=True)
        for ax, name in zip(axes, _MAPS, strict=True):
            ax.plot(*walls_m[name].T, ".", color="0.35", ms=1.0, mew=0)
            for query in queries:
                of_map = "laser-earlier" if name == query.sensor == "laser" else name
                if of_map in query.answers:
                    T_floor_map = frames[of_map] @ maps[of_map].T_plan_map
                    is_first = (name, query.sensor, query.seed) in first
                    _draw_answer(ax, query, query.answers[of_map], T_floor_map, T_floor_log, is_first)
            ax.set_title(f"{_TITLES[name]}; located and right: {_counts(name, cells)}", fontsize=9)
            ax.set(xlim=(x0 - 0.5, x1 + 0.5), ylim=(y0 - 0.5, y1 + 0.5), aspect="equal")
            ax.tick_params(labelsize=7)
        _legend(axes[0])
        axes[-1].set_xlabel("metres, frame of the 3D scan", fontsize=8)


def _legend(ax: Any) -> None:
    for sensor in _SENSORS:
        ax.plot([], [], ">", color=_COLOURS[sensor], label=f"{_SHOWN[sensor]}, located")
    ax.plot([], [], "o", color="0.3", label="no answer, right place first")
    ax.plot([], [], "o", mfc="none", mec="0.3", label="no answer")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.1), fontsize=7, ncols=5)


def _walls_m(sensor_map: SensorMap, T_floor_plan: SE2) -> F64:
    """Points (N, 2) of the walls of a map, in the frame of the scan."""
    grid = sensor_map.index.grids[0]
    points = grid.to_point(np.argwhere(grid.occupied))
    return (T_floor_plan @ sensor_map.T_plan_map).apply(points[:: len(points) // _DRAWN_AT_MOST + 1])


def _counts(map_sensor: str, cells: Sequence[RealCell]) -> str:
    """What became of the queries of each sensor in a map."""
    texts = []
    for cell in (c for c in _in_order(cells) if c.map_sensor == map_sensor):
        wrong = cell.wrong + cell.wrong_outside
        counts = f"{_SHOWN[cell.query_sensor]} {cell.located_right} of {cell.queries}"
        texts.append(f"{counts}, {wrong} wrong" if wrong else counts)
    return "; ".join(texts)


def _draw_answer(
    ax: Any, query: RealQuery, answer: Answer, T_floor_map: SE2, T_floor_log: SE2, is_first: bool
) -> None:
    colour = _COLOURS[query.sensor]
    if answer.T_map_base is not None:
        _arrow(ax, T_floor_map @ answer.T_map_base, colour, size=_SIZES[query.sensor])
    else:
        true = T_floor_log @ query.T_frame_base if query.sensor == "laser" else query.T_frame_base
        ax.plot(true.x, true.y, "o", mfc=colour if is_first else "none", mec=colour, mew=1.2, ms=5)


def _arrow(ax: Any, pose: Any, colour: str, *, size: float) -> None:
    ax.plot(pose.x, pose.y, "o", color=colour, ms=size, mec="white", mew=0.6, zorder=20 - size)
    ax.annotate(
        "",
        xy=(pose.x + 1.2 * math.cos(pose.yaw), pose.y + 1.2 * math.sin(pose.yaw)),
        xytext=(pose.x, pose.y),
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.4, "mutation_scale": 9},
        zorder=4,
    )
