"""Pictures of maps and answers, in the colours of Okabe and Ito, which colour-blind people can tell apart."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.display import probability
from pc2grid.io.atomic import replace_file

if TYPE_CHECKING:
    from pc2grid.model import OccupancyGrid, Trajectory
    from signature.database import SubmapDatabase
    from signature.relocalization.relocalizer import Answer

BLUE, ORANGE, GREEN, VERMILLION, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
YELLOW = "#F0E442"
_SHADES = {"unknown": 0.87, "free": 1.0, "wall": 0.15}


def draw_session(path: Path, database: SubmapDatabase, session: str) -> None:
    """The map of a session with its submaps and the path of the robot."""
    figure, axes = _canvas(database.grid(session))
    _draw_submaps(axes, database, session)
    poses = database.trajectory(session).planar()
    if len(poses):
        axes.plot(poses[:, 0], poses[:, 1], color=BLUE, lw=1.2, label="path of the map's robot")
    axes.set_title(session)
    _finish(figure, axes, path)


def draw_answer(
    path: Path,
    database: SubmapDatabase,
    answer: Answer,
    poses: Trajectory,
    truth_m: np.ndarray | None = None,
) -> None:
    """The map with the answer: the path of the query in it, and the hypotheses.

    poses : the query in its own frame. truth_m : (N, 2) its true path in the map frame, if known.
    """
    best = answer.session or (
        answer.sessions[answer.hypotheses[0].session_index] if answer.hypotheses else None
    )
    session = best or answer.sessions[0]
    figure, axes = _canvas(database.grid(session))
    _draw_submaps(axes, database, session)
    way = database.trajectory(session).planar()
    if len(way):
        axes.plot(way[:, 0], way[:, 1], color=BLUE, lw=0.9, alpha=0.6, label="path of the map's robot")
    if truth_m is not None:
        axes.plot(truth_m[:, 0], truth_m[:, 1], color="black", lw=3.5, alpha=0.35, label="query: truth")
    if answer.T_map_odom is not None:
        found = answer.T_map_odom.apply(poses.planar()[:, :2])
        axes.plot(found[:, 0], found[:, 1], color=VERMILLION, lw=1.6, label="query: as located")
    rivals = answer.hypotheses[1:6] if answer.status == "located" else answer.hypotheses[:6]
    places = [
        h.fit.T_map_query @ answer.T_odom_base for h in rivals if answer.sessions[h.session_index] == session
    ]
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    shown = [(p.x, p.y) for p in places if left < p.x < right and bottom < p.y < top]
    if shown:
        label = "other hypotheses" if answer.status == "located" else "hypotheses"
        axes.plot(*zip(*shown, strict=True), "s", color=PURPLE, ms=6, mfc="none", mew=1.5, label=label)
    if answer.T_map_base is not None:
        pose = answer.T_map_base
        length = 0.035 * max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
        axes.annotate(
            "",
            xy=(pose.x + length * np.cos(pose.yaw), pose.y + length * np.sin(pose.yaw)),
            xytext=(pose.x, pose.y),
            arrowprops={"arrowstyle": "-|>", "color": VERMILLION, "lw": 2.5, "mutation_scale": 18},
            zorder=6,
        )
        axes.plot(
            pose.x, pose.y, "o", color=VERMILLION, mec="white", ms=9, zorder=7, label="robot at the last scan"
        )
    axes.set_title(f"{answer.status.replace('_', ' ')}, confidence {probability(answer.confidence)}")
    _finish(figure, axes, path)


def _canvas(grid: OccupancyGrid) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    known = np.argwhere(grid.cells >= 0)
    (r0, c0), (r1, c1) = (
        (known.min(axis=0), known.max(axis=0) + 1) if len(known) else ((0, 0), grid.cells.shape)
    )
    cells, occupied = grid.cells[r0:r1, c0:c1], grid.occupied[r0:r1, c0:c1]
    grey = np.where(cells < 0, _SHADES["unknown"], np.where(occupied, _SHADES["wall"], _SHADES["free"]))
    x0, y0 = grid.origin_m[0] + c0 * grid.resolution_m, grid.origin_m[1] + r0 * grid.resolution_m
    width, height = (c1 - c0) * grid.resolution_m, (r1 - r0) * grid.resolution_m
    ratio = float(np.clip(height / max(width, 1e-6), 0.35, 1.6))
    figure = Figure(figsize=(10, 10 * ratio + 1.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    extent = (x0, x0 + width, y0, y0 + height)
    axes.imshow(grey, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_aspect("equal")
    axes.autoscale(False)
    return figure, axes


def _draw_submaps(axes: Any, database: SubmapDatabase, session: str) -> None:
    index = [info.name for info in database.sessions()].index(session)
    table = database.signatures()
    centers = table.center_m[table.session_index == index]
    axes.plot(centers[:, 0], centers[:, 1], ".", color=GREEN, ms=4, label=f"{len(centers)} submap centres")


def _finish(figure: Any, axes: Any, path: Path) -> None:
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    with replace_file(path) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": "pc2grid"})
