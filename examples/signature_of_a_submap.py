"""Draw the three signatures of a submap: figures 2, 3, 4 and 6 of the paper in one picture.

python examples/signature_of_a_submap.py path/to/map.yaml            # the submap nearest the map's middle
python examples/signature_of_a_submap.py path/to/map.yaml --submap 12 --out submap.png
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from pc2grid.io.maps import load_map
from pc2grid.model import OccupancyGrid, Submap
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.junction_graph import junction_graph, map_skeleton
from pc2grid.submaps.submaps import partition
from signature.boundary import boundary_edges, boundary_histogram, boundary_points
from signature.config import SignatureConfig
from signature.freespace import freespace_graph, freespace_histogram, shortest_paths
from signature.paper import describe
from signature.symmetry import blurred, line_segments, symmetry_axes

FREE, WALL, UNSEEN = (1.0, 1.0, 1.0), (0.1, 0.1, 0.1), (0.86, 0.86, 0.86)
BLUE, ORANGE, GREEN, RED = "#1f77b4", "#e6842a", "#2ca02c", "#d62728"


def picture(grid: OccupancyGrid) -> np.ndarray:
    """(H, W, 3) colours of a grid, row 0 at the bottom."""
    image = np.full((*grid.cells.shape, 3), UNSEEN)
    image[grid.free], image[grid.occupied] = FREE, WALL
    return image


def show(axis: Any, grid: OccupancyGrid, title: str) -> None:
    """Draw a grid in metres of its map frame."""
    x, y = grid.origin_m
    height, width = np.array(grid.cells.shape) * grid.resolution_m
    axis.imshow(picture(grid), origin="lower", extent=(x, x + width, y, y + height), interpolation="nearest")
    axis.set_title(title, fontsize=13, loc="left")
    axis.set_xticks([])
    axis.set_yticks([])


def draw_partition(axis: Any, grid: OccupancyGrid, submaps: tuple[Submap, ...], chosen: Submap) -> None:
    """Figure 2: the map, its skeleton, the junctions and the chosen submap."""
    config = PartitionConfig.paper()
    show(
        axis,
        grid,
        f"The map, its skeleton, and {len(submaps)} junctions (dots),\none submap each (III-A)",
    )
    skeleton = grid.to_point(np.argwhere(map_skeleton(grid, config)))
    axis.plot(*skeleton.T, ",", color=BLUE)
    graph = junction_graph(grid, config)
    places = [data["center_m"] for _, data in graph.nodes(data=True) if data["kind"] == "junction"]
    axis.plot(*np.array(places).T, "o", color=RED, markersize=3)
    turns = np.linspace(0, 2 * math.pi, 100)
    x, y = chosen.center_m
    axis.plot(
        x + chosen.radius_m * np.cos(turns), y + chosen.radius_m * np.sin(turns), color=ORANGE, linewidth=2.5
    )


def draw_boundary(axes: Any, submap: Submap, config: SignatureConfig) -> None:
    """Figure 3: the sampled boundary points and the histogram of their distances."""
    points = boundary_points(boundary_edges(submap, config), submap.grid.resolution_m, config)
    show(axes[0], submap.grid, f"Boundary: {len(points)} points (III-B)")
    places = submap.grid.to_point(points)
    axes[0].plot(*places.T, ".", color=BLUE, markersize=2.5)
    histogram = boundary_histogram(points, submap.radius_m, submap.grid.resolution_m, config)
    bars(axes[1], histogram, config.boundary_bin_m, BLUE, "Distances between boundary points (Eq. 2)")


def draw_freespace(axes: Any, submap: Submap, config: SignatureConfig) -> None:
    """Figure 4: the free-space graph and its path lengths."""
    graph = freespace_graph(submap, config)
    show(axes[0], submap.grid, f"Free space: {len(graph)} nodes (III-C)")
    places = {node: data["center_m"] for node, data in graph.nodes(data=True)}
    lines = [(places[a], places[b]) for a, b in graph.edges]
    axes[0].add_collection(LineCollection(lines, colors=GREEN, linewidths=0.4, alpha=0.25))
    if places:
        axes[0].plot(*np.array(list(places.values())).T, "o", color=GREEN, markersize=3.5)
    bars(
        axes[1],
        path_histogram(submap, config),
        config.freespace_bin_m,
        GREEN,
        "Lengths of the shortest paths (Eq. 4)",
    )


def path_histogram(submap: Submap, config: SignatureConfig) -> np.ndarray:
    """H^f of a submap."""
    return freespace_histogram(shortest_paths(freespace_graph(submap, config)), submap.radius_m, config)


def draw_symmetry(axes: Any, submap: Submap, config: SignatureConfig) -> None:
    """Figure 6: line segments with both axes, and the blurred walls at the mirrored walls."""
    grid = submap.grid
    edges = boundary_edges(submap, config)
    segments = line_segments(edges, grid.resolution_m, config)
    found = symmetry_axes(segments, config)
    show(axes[0], grid, f"Symmetry: {len(segments)} segments, two axes (III-D)")
    ends = grid.to_point(segments.reshape(-1, 2)[:, ::-1].astype(np.int64)).reshape(-1, 2, 2)
    axes[0].add_collection(LineCollection(list(ends), colors=ORANGE, linewidths=1.5))
    if found is None:
        return
    scores = describe(submap, config).symmetry
    center = np.array(submap.center_m)
    for angle, name, score, color in zip(found, ("α", "β"), scores, (RED, BLUE), strict=True):
        reach = submap.radius_m * np.array([math.cos(angle), math.sin(angle)])
        axes[0].plot(
            *np.array([center - reach, center + reach]).T,
            "--",
            color=color,
            label=f"{name}: score {score:.1f}",
        )
    axes[0].legend(fontsize=11, loc="lower right")
    field = blurred(edges, grid.resolution_m, config)
    # Eq. 5 averages these values: the blurred image at the walls mirrored at the axis alpha.
    middle = (np.array(edges.shape) - 1) / 2
    rows, columns = (np.argwhere(edges) - middle).T
    c, s = math.cos(2 * found.alpha_rad), math.sin(2 * found.alpha_rad)
    mirrored = np.stack((s * columns - c * rows, c * columns + s * rows), axis=1) + middle
    inside = np.clip(np.rint(mirrored).astype(int), 0, np.array(edges.shape) - 1)
    values = field[inside[:, 0], inside[:, 1]]
    x, y = grid.origin_m
    size = np.array(grid.cells.shape) * grid.resolution_m
    extent = (x, x + size[1], y, y + size[0])
    axes[1].imshow(field, origin="lower", extent=extent, cmap="Greys", vmax=2 * config.symmetry_peak)
    places = (mirrored[:, ::-1] + 0.5) * grid.resolution_m + grid.origin_m
    dots = axes[1].scatter(*places.T, c=values, s=2, cmap="plasma", vmin=0, vmax=config.symmetry_peak)
    axes[1].figure.colorbar(dots, ax=axes[1], shrink=0.8, label="brightness (Eq. 5 is its mean)")
    axes[1].set_title("Walls mirrored at α (dots) over blurred walls", fontsize=13, loc="left")
    axes[1].set_xlim(extent[:2])
    axes[1].set_ylim(extent[2:])
    axes[1].set_xticks([])
    axes[1].set_yticks([])


def bars(axis: Any, histogram: np.ndarray, bin_m: float, color: str, title: str) -> None:
    """Draw a histogram over metres."""
    axis.bar(np.arange(len(histogram)) * bin_m, histogram, width=bin_m, align="edge", color=color, alpha=0.7)
    axis.set_title(title, fontsize=13, loc="left")
    axis.set_xlabel("metres")
    axis.set_ylabel("share of pairs")
    filled = np.flatnonzero(histogram)
    axis.set_xlim(0, (filled[-1] + 2) * bin_m if len(filled) else len(histogram) * bin_m)
    axis.spines[["top", "right"]].set_visible(False)


def draw(grid: OccupancyGrid, submaps: tuple[Submap, ...], chosen: Submap, name: str) -> Figure:
    """Draw the whole picture."""
    config = SignatureConfig()
    figure = Figure(figsize=(20, 9.5), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 3.0))
    draw_partition(left.subplots(), grid, submaps, chosen)
    axes = right.subplots(2, 3)
    draw_boundary(axes[:, 0], chosen, config)
    draw_freespace(axes[:, 1], chosen, config)
    draw_symmetry(axes[:, 2], chosen, config)
    figure.suptitle(f"{name}, submap {chosen.submap_id}: its three signatures", fontsize=16)
    return figure


def main() -> None:
    """Read the arguments and write the picture."""
    parser = argparse.ArgumentParser(description="Draw how a submap becomes its three signatures.")
    parser.add_argument("map", type=Path, help="a nav2 map.yaml")
    parser.add_argument("--submap", type=int, help="its number; by default the one nearest the map's middle")
    parser.add_argument("--out", type=Path, default=Path("signature_of_a_submap.png"))
    arguments = parser.parse_args()
    grid = load_map(arguments.map)
    submaps = partition(grid, PartitionConfig.paper())
    if not submaps:
        parser.error(f"{arguments.map} has no free space")
    if arguments.submap is not None and not 0 <= arguments.submap < len(submaps):
        parser.error(f"--submap: {arguments.map} has submaps 0 to {len(submaps) - 1}")
    centers = np.array([submap.center_m for submap in submaps])
    middle = int(np.argmin(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))
    chosen = submaps[middle if arguments.submap is None else arguments.submap]
    draw(grid, submaps, chosen, arguments.map.stem).savefig(arguments.out, dpi=90)
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
