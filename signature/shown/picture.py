"""Pictures of maps and answers, in the colours of Okabe and Ito, which colour-blind people can tell apart."""

from __future__ import annotations

import io
import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.display import counted, probability
from pc2grid.geometry import F64, SE2, U8
from pc2grid.io.atomic import replace_file
from pc2grid.matching.score import Agreement, Fit, Support, agreement
from pc2grid.matching.walls import Walls
from pc2grid.model import OccupancyGrid, Trajectory
from signature.database import SubmapDatabase
from signature.database.protocol import BuildingFrame
from signature.localization.answer import Answer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, VERMILLION, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
GREY = "#777777"
SUPPORT_COLOURS = {"FITS": GREEN, "CONTRADICTED": VERMILLION, "UNKNOWN": BLUE}
"""Of the query's wall points, by the name of their `pc2grid.matching.score.Support`."""
MISSED_COLOUR = ORANGE
"""Of the map's wall points where the query saw free ground."""
SUPPORT_LABELS = {
    "FITS": "query's wall: fits the map",
    "CONTRADICTED": "query's wall: on free ground of the map",
    "UNKNOWN": "query's wall: unknown to the map",
}
MISSED_LABEL = "map's wall: the query saw free ground"
UNKNOWN, FREE, FURNITURE, WALL = range(4)
"""What a cell of a map is drawn as, the more important the higher."""
PALETTE = np.array([(222, 222, 222), (255, 255, 255), (165, 182, 208), (38, 38, 38)], np.uint8)
"""Red, green and blue of each. All that is drawn over furniture can be seen on its light blue."""
_FURNITURE_LABEL = "map's furniture: an obstacle, no wall"
_WIDTH_IN, _GAP_IN = 10.0, 0.55
_MARGIN = 0.03
"""Around a map, as a share of its longer side; an arrow at its edge must not be cut."""
_CLOSE_MARGIN_M = 1.0
_CLOSE_SHARE = 0.5
"""A close-up is drawn if the query is shorter than this share of the map."""


def _box(points_m: F64, margin_m: float = 0.0) -> F64:
    """Return the box around points (N, 2), or around the corners of boxes: (2, 2), low and high corner."""
    return np.array((points_m.min(axis=0) - margin_m, points_m.max(axis=0) + margin_m), np.float64)


def _with_ratio(box: F64, height_by_width: float) -> F64:
    """Return the smallest box around one with a given ratio of its sides."""
    width_m, height_m = np.ptp(box, axis=0)
    half_m = 0.5 * max(width_m, height_m / height_by_width)
    return np.asarray(
        box.mean(axis=0) + half_m * np.array(((-1.0, -height_by_width), (1.0, height_by_width)))
    )


def _in_panel(axes: Any, pose: SE2) -> bool:
    """Return whether a pose lies within what a panel shows."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    return bool(left < pose.x < right and bottom < pose.y < top)


def agreements(answer: Answer, database: SubmapDatabase) -> tuple[Agreement, ...]:
    """Return for each hypothesis of an answer, best first, what supports and what contradicts it."""
    query = Walls.of(answer.local_map)
    maps = {
        index: Walls.of(database.grid(name), drawn=not len(database.trajectory(name)))
        for index, name in enumerate(answer.sessions)
        if index in {hypothesis.session_index for hypothesis in answer.hypotheses}
    }
    return tuple(
        agreement(maps[hypothesis.session_index], query, hypothesis.T_map_query)
        for hypothesis in answer.hypotheses
    )


def drawn_as(grid: OccupancyGrid) -> U8:
    """Return as what each cell (H, W) is drawn: the map that nav2 gets, but furniture differs from walls."""
    kinds = np.full(grid.cells.shape, UNKNOWN, np.uint8)
    for cells, kind in ((grid.free, FREE), (grid.things, FURNITURE), (grid.occupied, WALL)):
        kinds[cells] = kind
    return kinds


def draw_session(path: Path, database: SubmapDatabase, session: str) -> None:
    """Draw the map of a session with its submaps and the path of the robot."""
    grid = database.grid(session)
    figure, (axes,) = _panels(_known(grid))
    _draw_map(axes, grid)
    centers_m = database.signatures(session).center_m
    label = counted(len(centers_m), "submap centre")
    axes.plot(centers_m[:, 0], centers_m[:, 1], ".", color=GREEN, ms=4, label=label)
    poses = database.trajectory(session).planar()
    if len(poses):
        axes.plot(poses[:, 0], poses[:, 1], color=BLUE, lw=1.2, label="path of the map's robot")
    axes.set_title(session, loc="left")
    write_figure(_with_legend(figure, axes), path)


def draw_building(path: Path, name: str, maps: Mapping[str, tuple[OccupancyGrid, BuildingFrame]]) -> None:
    """Draw the walls of the sessions of a building over each other: as they were stored, and as joined.

    name : of the building's frame.
    """
    before = {session: grid.to_point(np.argwhere(grid.occupied)) for session, (grid, _) in maps.items()}
    after = {session: at.apply(before[session]) for session, (_, at) in maps.items()}
    figure, panels = _panels(*(_around_walls(walls.values()) for walls in (before, after)))
    for axes, walls in zip(panels, (before, after), strict=True):
        axes.set_facecolor(_colour(FREE))
        colours = itertools.cycle((BLUE, ORANGE, GREEN, VERMILLION, PURPLE, GREY))
        # Each thinner than the one below it, so that both colours are visible where walls coincide.
        for k, ((session, points_m), colour) in enumerate(zip(walls.items(), colours, strict=False)):
            axes.plot(*points_m.T, "s", color=colour, ms=max(3.4 - 2.0 * k, 1.4), mew=0, label=session)
    panels[0].set_title("before: each map in its own frame", loc="left", fontsize=10)
    panels[1].set_title(f"after: joined in the frame of {name}", loc="left", fontsize=10)
    write_figure(_with_legend(figure, panels[0]), path)


def _around_walls(walls: Iterable[F64]) -> F64:
    """Return the box of all walls; of none a square metre."""
    boxes = [_box(points_m, _CLOSE_MARGIN_M) for points_m in walls if len(points_m)]
    return _box(np.concatenate(boxes or [np.eye(2)]))


def draw_answer(
    path: Path,
    database: SubmapDatabase,
    answer: Answer,
    poses: Trajectory,
    truth_m: F64 | None = None,
) -> None:
    """Write the picture of `answer_figure`.

    truth_m : (N, 2) the query's true path in the map frame, if known.
    """
    session = answer.sessions[answer.best.session_index if answer.best else 0]
    way = database.trajectory(session)
    write_figure(answer_figure(answer, database.grid(session), poses, way=way, truth_m=truth_m), path)


def answer_figure(
    answer: Answer,
    grid: OccupancyGrid,
    poses: Trajectory,
    *,
    way: Trajectory | None = None,
    truth_m: F64 | None = None,
) -> Figure:
    """Return the map with the best hypothesis: the query's walls, coloured by what the map shows there.

    In a large map a second panel shows the place from near. Without any hypothesis there is only the map.

    grid : the map. poses : the query in its own frame, empty for a map. way : path of the map's robot, empty
    of a map that somebody else made.
    """
    best = answer.best
    session = answer.sessions[best.session_index if best else 0]
    compared = None
    if best is not None:
        walls = Walls.of(grid, drawn=way is not None and not len(way))
        compared = agreement(walls, Walls.of(answer.local_map), best.T_map_query)
    whole, close = _known(grid), None
    if best is not None and compared is not None and len(compared.points_m):
        close = _box(best.T_map_query.apply(compared.points_m), _CLOSE_MARGIN_M)
        whole = _box(np.concatenate((whole, close)))
        if np.ptp(close, axis=0).max() > _CLOSE_SHARE * np.ptp(whole, axis=0).max():
            close = None
    figure, panels = _panels(whole, *(() if close is None else (close,)))
    for axes in panels:
        _draw_map(axes, grid)
        _draw_way(axes, way)
        if truth_m is not None:
            axes.plot(truth_m[:, 0], truth_m[:, 1], color="black", lw=3.5, alpha=0.3, label="query: truth")
        if best is not None and compared is not None:
            _draw_agreement(axes, best, compared, point_size=2.0 if axes is panels[-1] else 1.0)
            _draw_robot(axes, best, answer, poses)
        _draw_rivals(axes, answer, session)
    if close is not None:
        _outline(panels[0], panels[1])
    panels[0].set_title(_title(answer, session, compared), loc="left")
    made: Figure = _with_legend(figure, panels[0])
    return made


def draw_answers(
    path: Path, database: SubmapDatabase, found: Sequence[tuple[Answer, Trajectory, str]]
) -> None:
    """Draw the maps in which queries were located, each with their paths, and arrows where these end.

    found : answers, with the poses of the query in its own frame, and the name of its recording. Each
    recording has a colour. If none was located there is only the first map.
    """
    located = Counter(answer.session for answer, *_ in found if answer.session is not None)
    sessions = [session for session, _ in located.most_common()] or [database.sessions()[0].name]
    sources = dict.fromkeys(source for *_, source in found)
    colours = dict(zip(sources, itertools.cycle((PURPLE, BLUE, VERMILLION, GREEN, ORANGE)), strict=False))
    grids = [database.grid(session) for session in sessions]
    figure, panels = _panels(*(_known(grid) for grid in grids))
    for axes, session, grid in zip(panels, sessions, grids, strict=True):
        _draw_map(axes, grid)
        _draw_way(axes, database.trajectory(session))
        title = f"located in {session}: {located[session]} of {len(found)} queries"
        axes.set_title(title, loc="left", fontsize=10)
        for answer, poses, source in found:
            if answer.session == session and answer.T_map_odom and answer.T_map_base:
                path_m = answer.T_map_odom.apply(poses.planar()[:, :2])
                axes.plot(*path_m.T, color=colours[source], lw=1.8, label=f"{source}: path as located")
                _draw_arrow(axes, answer.T_map_base, colours[source])
    write_figure(_with_legend(figure, panels[0]), path)


def _title(answer: Answer, session: str, compared: Agreement | None) -> str:
    """Return the answer, and what it rests on, as the title of its picture."""
    said = {"located": f"located in {session}", "ambiguous": "ambiguous", "not_found": "not found"}
    title = f"{said[answer.status]}, confidence {probability(answer.confidence)}"
    if compared is None:
        return title
    what = "" if answer.status == "located" else " at the best hypothesis"
    fits, against, unknown = (
        f"{100 * compared.share(kind):.0f} %"
        for kind in (Support.FITS, Support.CONTRADICTED, Support.UNKNOWN)
    )
    return (
        f"{title}\nquery's walls{what}: {fits} fit the map, {against} on free ground, {unknown} unknown to it"
    )


def _known(grid: OccupancyGrid) -> F64:
    """Return the part of the map that is known, with a margin."""
    cells = np.argwhere(grid.cells >= 0)
    if not len(cells):
        cells = np.array([(0, 0), grid.cells.shape])
    corners = np.array([cells.min(axis=0), cells.max(axis=0) + 1])[:, ::-1]
    corners_m = np.asarray(grid.origin_m) + corners * grid.resolution_m
    return _box(corners_m, _MARGIN * float(np.ptp(corners_m, axis=0).max()))


def _panels(whole: F64, *more: F64) -> tuple[Any, list[Any]]:
    """Return a figure with a panel for a map and, beside or below it, one for each other box."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width_m, height_m = np.ptp(whole, axis=0)
    ratio = float(np.clip(height_m / width_m, 0.1, 2.5))
    boxes, sizes_in = [_with_ratio(whole, ratio)], [(_WIDTH_IN, _WIDTH_IN * ratio)]
    beside = ratio > 0.8
    if more:
        if beside:
            sizes_in = [(_WIDTH_IN * 0.6, _WIDTH_IN * 0.6 * ratio)] * (1 + len(more))
        else:
            sizes_in += [(_WIDTH_IN, _WIDTH_IN * 0.55)] * len(more)
        boxes += [_with_ratio(box, sizes_in[1][1] / sizes_in[1][0]) for box in more]
    step = (1, 0) if beside else (0, 1)
    total_in = [
        sum(size[k] for size in sizes_in) + _GAP_IN * (len(boxes) - 1) if step[k] else sizes_in[0][k]
        for k in (0, 1)
    ]
    figure = Figure(figsize=(total_in[0], total_in[1]), dpi=110)
    FigureCanvasAgg(figure)
    panels, left, top = [], 0.0, total_in[1]
    for box, (width, height) in zip(boxes, sizes_in, strict=True):
        place = (left / total_in[0], (top - height) / total_in[1], width / total_in[0], height / total_in[1])
        axes = figure.add_axes(place)
        axes.set_xlim(*box[:, 0])
        axes.set_ylim(*box[:, 1])
        axes.set_aspect("equal")
        axes.set_facecolor(_colour(UNKNOWN))
        axes.tick_params(labelsize=8, color=GREY, labelcolor="#444444")
        for spine in axes.spines.values():
            spine.set_color(GREY)
        axes.autoscale(False)
        panels.append(axes)
        left += step[0] * (width + _GAP_IN)
        top -= step[1] * (height + _GAP_IN)
    panels[-1].set_xlabel("x, m", fontsize=9)
    panels[0].set_ylabel("y, m", fontsize=9)
    return figure, panels


def _colour(kind: int) -> str:
    """Return the colour of a kind of cell as matplotlib takes it."""
    return f"#{bytes(PALETTE[kind]).hex()}"


def _draw_map(axes: Any, grid: OccupancyGrid) -> None:
    (x0, y0), (height, width) = grid.origin_m, np.array(grid.cells.shape) * grid.resolution_m
    axes.imshow(
        PALETTE[drawn_as(grid)],
        origin="lower",
        extent=(x0, x0 + width, y0, y0 + height),
        interpolation="nearest",
    )
    if grid.things.any():
        axes.plot([], [], "s", color=_colour(FURNITURE), label=_FURNITURE_LABEL)


def _draw_way(axes: Any, way: Trajectory | None) -> None:
    if way is not None and len(way):
        axes.plot(*way.planar()[:, :2].T, color=GREY, lw=0.7, label="path of the map's robot")


def _draw_agreement(axes: Any, best: Fit, compared: Agreement, *, point_size: float) -> None:
    """Draw the query's walls at a hypothesis, and the map's walls that it should have seen."""
    points_m = best.T_map_query.apply(compared.points_m)
    for kind in (Support.FITS, Support.CONTRADICTED, Support.UNKNOWN):
        chosen = points_m[compared.support == kind]
        if len(chosen):
            label = SUPPORT_LABELS[kind.name]
            axes.plot(*chosen.T, ".", color=SUPPORT_COLOURS[kind.name], ms=3 * point_size, mew=0, label=label)
    if len(compared.missed_m):
        axes.plot(
            *compared.missed_m.T,
            "x",
            color=MISSED_COLOUR,
            ms=1.8 * point_size,
            mew=0.6 * point_size,
            label=MISSED_LABEL,
        )


def _draw_robot(axes: Any, best: Fit, answer: Answer, poses: Trajectory) -> None:
    """Draw the path of the query at a hypothesis, and an arrow where it ends; of a map, its frame."""
    if len(poses):
        path = best.T_map_query.apply(poses.planar()[:, :2])
        label = (
            "query: path as located" if answer.status == "located" else "query: path at the best hypothesis"
        )
        axes.plot(path[:, 0], path[:, 1], color=PURPLE, lw=1.8, label=label)
    pose = best.T_map_query @ answer.T_odom_base
    if not _in_panel(axes, pose):
        return
    _draw_arrow(axes, pose, PURPLE)
    label = "robot at the last scan" if answer.status == "located" else "robot, if it were here"
    if not len(poses):
        label = "frame of the query"
    axes.plot(pose.x, pose.y, "o", color=PURPLE, mec="white", ms=9, zorder=7, label=label)


def _draw_arrow(axes: Any, pose: SE2, colour: str) -> None:
    """Draw an arrow from where a robot is to where it looks."""
    length = 0.035 * max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    axes.annotate(
        "",
        xy=(pose.x + length * np.cos(pose.yaw), pose.y + length * np.sin(pose.yaw)),
        xytext=(pose.x, pose.y),
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.5, "mutation_scale": 18},
        zorder=6,
    )


def _draw_rivals(axes: Any, answer: Answer, session: str) -> None:
    """Draw the next hypotheses in this session, where they lie within the panel."""
    places = [
        h.T_map_query @ answer.T_odom_base
        for h in answer.hypotheses[1:6]
        if answer.sessions[h.session_index] == session
    ]
    shown = [(pose.x, pose.y) for pose in places if _in_panel(axes, pose)]
    if shown:
        label = "other hypotheses"
        axes.plot(*zip(*shown, strict=True), "s", color=PURPLE, ms=6, mfc="none", mew=1.5, label=label)
    if answer.line is not None:
        begin, end = answer.line.begin, answer.line.end
        axes.plot(
            (begin.x, end.x), (begin.y, end.y), "--", color=PURPLE, lw=1.2, label="line of likely places"
        )


def _outline(whole: Any, close: Any) -> None:
    """Mark in the whole map what the close-up shows."""
    from matplotlib.patches import Rectangle

    (left, right), (bottom, top) = close.get_xlim(), close.get_ylim()
    frame = Rectangle((left, bottom), right - left, top - bottom, fill=False, ec="black", lw=1.0, ls="--")
    whole.add_patch(frame)


def _with_legend(figure: Any, axes: Any) -> Any:
    """Return the figure with the legend of what it shows."""
    entries: dict[str, Any] = {}
    for panel in figure.axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    axes.title.set_fontsize(10)
    if entries:
        legend = figure.legend(
            entries.values(),
            entries.keys(),
            loc="upper left",
            bbox_to_anchor=(0.0, -0.5 / figure.get_figheight()),
            borderaxespad=0.0,
            ncols=3,
            frameon=False,
            fontsize=9,
        )
        for handle in legend.legend_handles:
            if handle.get_marker() in (".", "s", "x"):  # as small as in the figure, colours look alike
                handle.set_markersize(9 if handle.get_marker() == "." else 6)
    return figure


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    with replace_file(path) as temporary:
        temporary.write_bytes(figure_png(figure))


def figure_png(figure: Figure) -> bytes:
    """Return a figure as PNG, without empty bands."""
    png = io.BytesIO()
    figure.savefig(png, format="png", bbox_inches="tight", pad_inches=0.12, metadata={"Software": "pc2grid"})
    return png.getvalue()
