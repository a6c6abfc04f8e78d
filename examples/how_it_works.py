"""Draw how a recording becomes a map with signatures, and how another recording is located in it.

python examples/how_it_works.py demo_out/lidar.mcap demo_out/depth.mcap --out how_it_works.png

The first recording is mapped, the second one located. Everything in the picture is computed from the two.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import pc2grid
import signature
from pc2grid.display import probability
from pc2grid.model import OccupancyGrid, SessionMap, Submap
from signature.boundary import boundary_edges, boundary_points
from signature.freespace import freespace_graph
from signature.symmetry import line_segments, symmetry_axes

FREE, WALL, UNSEEN = (1.0, 1.0, 1.0), (0.15, 0.15, 0.15), (0.88, 0.88, 0.88)
BLUE, ORANGE, GREEN, VERMILLION, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
SCANS_DRAWN = 120
"""Of a registered recording, spread evenly."""
HEAD_ROOM_M = 1.9
"""Points that are higher are left out of the clouds, so that ceilings do not hide the rooms."""
MARGIN_M = 2.5
"""Drawn around the path of the map's robot."""
SCAN_M = 9.0
"""Farther points of the single scan are left out."""
ASPECT = 0.8
"""Height over width of the panels of the upper row."""
SAME_PLACE_M = 0.5
"""Centres of submaps that count as one place."""
SENSORS = {"lidar": "3D lidar", "laser": "2D laser", "depth": "depth camera"}

Box = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max in metres."""


def scans_of(recording: Path) -> list[pc2grid.RegisteredScan]:
    """Return the scans of a recording with their poses."""
    with pc2grid.open_log(recording) as log:
        return [scan for scan, _ in pc2grid.follow(log.scans(), pc2grid.Config())]


def cloud_of(scans: list[pc2grid.RegisteredScan]) -> np.ndarray:
    """Return the points (N, 3) of many of the scans in the session frame."""
    some = scans[:: max(1, len(scans) // SCANS_DRAWN)]
    return np.concatenate(
        [s.scan.points_m @ s.T_session_base[:3, :3].T + s.T_session_base[:3, 3] for s in some]
    )


def path_of(scans: list[pc2grid.RegisteredScan]) -> np.ndarray:
    """Positions (N, 3) of the base in the session frame."""
    return np.array([s.T_session_base[:3, 3] for s in scans])


def from_above(points_m: np.ndarray) -> np.ndarray:
    """(N, 2) of points (N, 3) seen obliquely from above: parallel projection, 25 degrees aside, 50 down."""
    aside, down = math.radians(25.0), math.radians(50.0)
    x, y, z = points_m.T
    right = x * math.cos(aside) - y * math.sin(aside)
    away = x * math.sin(aside) + y * math.cos(aside)
    return np.stack((right, away * math.sin(down) + z * math.cos(down)), axis=1)


def draw_cloud(axis: Any, points_m: np.ndarray, *, size: float) -> None:
    """Points (N, 3) coloured by height, low ones first."""
    shown = points_m[points_m[:, 2] < HEAD_ROOM_M]
    shown = shown[np.argsort(shown[:, 2], kind="stable")]
    flat = from_above(shown)
    axis.scatter(
        *flat.T,
        c=shown[:, 2],
        s=size,
        cmap="viridis",
        vmin=0.0,
        vmax=HEAD_ROOM_M,
        linewidths=0,
    )
    low, high = np.quantile(flat, (0.0, 1.0), axis=0)
    half = 0.52 * np.max((high - low) / (1.0, ASPECT)) * np.array((1.0, ASPECT))
    for limits, centre, reach in zip((axis.set_xlim, axis.set_ylim), (low + high) / 2, half, strict=True):
        limits(centre - reach, centre + reach)


def box_around(points_m: np.ndarray, aspect: float) -> Box:
    """Return the smallest box of an aspect (height over width) around points (N, 2), with a margin."""
    low, high = points_m.min(axis=0) - MARGIN_M, points_m.max(axis=0) + MARGIN_M
    half = 0.5 * np.max((high - low) / (1.0, aspect)) * np.array((1.0, aspect))
    (x0, y0), (x1, y1) = (low + high) / 2 - half, (low + high) / 2 + half
    return float(x0), float(y0), float(x1), float(y1)


def draw_grid(axis: Any, grid: OccupancyGrid, box: Box) -> None:
    """Draw a grid in metres of its map frame, cut to a box."""
    image = np.full((*grid.cells.shape, 3), UNSEEN)
    image[grid.free], image[grid.occupied] = FREE, WALL
    x, y = grid.origin_m
    height, width = np.array(grid.cells.shape) * grid.resolution_m
    axis.imshow(image, origin="lower", extent=(x, x + width, y, y + height), interpolation="antialiased")
    axis.set_facecolor(UNSEEN)
    axis.set_xlim(box[0], box[2])
    axis.set_ylim(box[1], box[3])


def draw_graph(axis: Any, session: SessionMap) -> None:
    """Draw the junction graph: junctions, ends, and the ways between them."""
    graph = session.graph
    ways = [data["path_m"] for _, _, data in graph.edges(data=True)]
    axis.add_collection(LineCollection(ways, colors=BLUE, linewidths=1.8))
    for kind, colour in (("end", BLUE), ("junction", VERMILLION)):
        at = np.array([d["center_m"] for _, d in graph.nodes(data=True) if d["kind"] == kind]).reshape(-1, 2)
        axis.plot(*at.T, "o", color=colour, markersize=6, markeredgewidth=0)


def draw_parts(axes: Any, submap: Submap, config: signature.Config) -> None:
    """Draw what each of the three signatures is computed from: in three panels."""
    x, y = submap.center_m
    radius_m, grid = submap.radius_m, submap.grid
    for axis in axes:
        draw_grid(axis, grid, (x - radius_m, y - radius_m, x + radius_m, y + radius_m))
    edges = boundary_edges(submap, config.signature)
    points = grid.to_point(boundary_points(edges, grid.resolution_m, config.signature))
    axes[0].plot(*points.T, "o", color=BLUE, markersize=3.2, markeredgewidth=0)
    graph = freespace_graph(submap, config.signature)
    places = {node: data["center_m"] for node, data in graph.nodes(data=True)}
    lines = [(places[a], places[b]) for a, b in graph.edges]
    axes[1].add_collection(LineCollection(lines, colors=GREEN, linewidths=0.7, alpha=0.5))
    axes[1].plot(
        *np.array(list(places.values())).reshape(-1, 2).T,
        "o",
        color=GREEN,
        markersize=5,
        markeredgewidth=0,
    )
    found = symmetry_axes(line_segments(edges, grid.resolution_m, config.signature), config.signature)
    for angle in found or ():
        c, s = radius_m * math.cos(angle), radius_m * math.sin(angle)
        axes[2].plot([x - c, x + c], [y - s, y + s], "--", color=VERMILLION, linewidth=2)


def draw_signatures(
    axes: Any, in_map: signature.Signature, in_query: signature.Signature, config: signature.Config
) -> None:
    """Both histograms and the symmetry scores: of the map filled, of the query as a line."""
    widths_m = (config.signature.boundary_bin_m, config.signature.freespace_bin_m)
    for axis, name, bin_m in zip(axes[:2], ("boundary", "freespace"), widths_m, strict=True):
        filled, line = getattr(in_map, name), getattr(in_query, name)
        edges_m = np.arange(len(filled) + 1) * bin_m
        axis.stairs(filled, edges_m, fill=True, color=BLUE, alpha=0.5)
        axis.stairs(line, edges_m, color=ORANGE, linewidth=2.5)
        axis.set_xlim(0, edges_m[np.flatnonzero(filled + line)[-1] + 1])
    for k, (one, colour, alpha) in enumerate(((in_map, BLUE, 0.5), (in_query, ORANGE, 1.0))):
        axes[2].barh([1.2 - 0.4 * k, -0.4 * k], one.symmetry, height=0.36, color=colour, alpha=alpha)
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_yticks([])


def draw_answer(axis: Any, session: SessionMap, answer: pc2grid.Answer, path: np.ndarray) -> None:
    """Draw the walls and the path (N, 2) of the query where it was located."""
    assert answer.T_map_odom is not None
    walls = answer.T_map_odom.apply(answer.local_map.to_point(np.argwhere(answer.local_map.occupied)))
    way = answer.T_map_odom.apply(path)
    draw_grid(axis, session.grid, box_around(np.concatenate((walls, way)), 1.0))
    axis.plot(*walls.T, "s", color=ORANGE, markersize=2.6, markeredgewidth=0)
    axis.plot(*way.T, color=PURPLE, linewidth=2.5)
    axis.plot(*way[-1], "o", color=PURPLE, markersize=11, markeredgewidth=0)


def same_place(
    session: SessionMap, answer: pc2grid.Answer, config: signature.Config
) -> tuple[Submap, Submap]:
    """Return a submap of the map, and one of what the query has seen, whose centres are at one place: of all
    such pairs the one of which the query has seen most."""
    assert answer.T_map_odom is not None
    seen = pc2grid.submaps_of(answer.local_map, config.partition)
    here = answer.T_map_odom.apply(np.array([submap.center_m for submap in seen]))
    there = np.array([submap.center_m for submap in session.submaps])
    apart_m = np.linalg.norm(here[:, None] - there[None], axis=2)
    near = np.flatnonzero(apart_m.min(axis=1) <= max(SAME_PLACE_M, apart_m.min()))
    best = max(near, key=lambda i: np.count_nonzero(seen[i].grid.free))
    return session.submaps[int(apart_m[best].argmin())], seen[best]


def draw(
    session: SessionMap,
    answer: pc2grid.Answer,
    scans: list[pc2grid.RegisteredScan],
    query: list[pc2grid.RegisteredScan],
) -> Figure:
    """Draw the whole picture.

    scans : of the session. query : those that the answer is about.
    """
    config = signature.Config()
    box = box_around(session.trajectory.planar()[:, :2], ASPECT)
    map_by, query_by = (SENSORS[some[0].scan.sensor] for some in (scans, query))

    figure = Figure(figsize=(14, 9.9), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.04, hspace=0.0, wspace=0.02)  # type: ignore[union-attr]
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.0, 1.75))
    steps = upper.subplots(1, 4)
    parts, shares = lower.subplots(2, 4, gridspec_kw={"height_ratios": (1.0, 0.45)})

    middle = scans[len(scans) // 2].scan.points_m
    draw_cloud(steps[0], middle[np.linalg.norm(middle, axis=1) < SCAN_M], size=9.0)
    cloud = cloud_of(scans)
    inside = np.logical_and(cloud[:, :2] > box[:2], cloud[:, :2] < box[2:]).all(axis=1)
    draw_cloud(steps[1], cloud[inside], size=1.0)
    steps[1].plot(
        *from_above(path_of(scans) + np.array((0.0, 0.0, HEAD_ROOM_M))).T, color=VERMILLION, linewidth=2
    )
    draw_grid(steps[2], session.grid, box)
    draw_grid(steps[3], session.grid, box)
    draw_graph(steps[3], session)

    in_map, in_query = same_place(session, answer, config)
    draw_parts(parts[:3], in_map, config)
    draw_signatures(
        shares[:3],
        signature.signature_of(in_map, config.signature),
        signature.signature_of(in_query, config.signature),
        config,
    )
    draw_answer(parts[3], session, answer, path_of(query)[:, :2])

    for axis in (*steps, *parts):
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_aspect("equal", adjustable="box")
    for axis in steps[:2]:
        axis.set_frame_on(False)
    shares[3].set_axis_off()
    words = (
        (steps[0], f"1  One scan of the recording\n    ({map_by})"),
        (steps[1], "2  All scans, registered,\n    and the path of the robot"),
        (steps[2], "3  Occupancy grid: walls,\n    free, and not seen"),
        (steps[3], "4  Junction graph\n    of the free space"),
        (parts[0], "5  Boundary: how far wall\n    points lie from each other"),
        (parts[1], "6  Free space: how long the\n    ways between nodes are"),
        (parts[2], "7  Symmetry: how well walls\n    fit their mirror image"),
        (parts[3], f"8  Answer: {answer.status},\n    confidence {probability(answer.confidence)}"),
    )
    for axis, text in words:
        axis.set_title(text, loc="left", fontsize=15, linespacing=1.15)
    for axis, text in zip(
        shares,
        ("metres between two wall points", "metres from node to node", "score of each axis"),
        strict=False,
    ):
        axis.set_xlabel(text, fontsize=13)
        axis.tick_params(labelsize=12)
    handles = [
        Patch(color=BLUE, alpha=0.5, label=f"place in the map\n({map_by})"),
        Patch(color=ORANGE, label=f"the same in the query\n({query_by})"),
        Line2D([], [], color=PURPLE, marker="o", markersize=9, linewidth=2.5, label="path of the query"),
    ]
    shares[3].legend(handles=handles, loc="upper left", fontsize=14, frameon=False, borderaxespad=0)
    return figure


def main() -> None:
    """Read the arguments and write the picture."""
    parser = argparse.ArgumentParser(description="Draw how a recording is mapped and another one located.")
    parser.add_argument("mapped", type=Path, help="the recording that becomes the map")
    parser.add_argument("query", type=Path, help="the recording that is located in it")
    parser.add_argument("--out", type=Path, default=Path("how_it_works.png"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "map.submaps"
        session = pc2grid.convert(arguments.mapped, database)
        answer = pc2grid.relocalize(arguments.query, database)
    if answer.T_map_odom is None:
        raise SystemExit(f"{arguments.query} is not located in the map of {arguments.mapped}")
    picture = draw(session, answer, scans_of(arguments.mapped), scans_of(arguments.query))
    picture.savefig(arguments.out, dpi=120)
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
