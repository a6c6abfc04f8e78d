"""Plausibility of stored content, which a checksum does not show: it shows only that nothing changed.

Each check raises ValueError that says what is wrong; the caller adds where. Arrays are checked as a whole: a
million signatures take a fraction of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.io.messages.types import FARTHEST_M
from pc2grid.model import POINT_STEPS, Loop, OccupancyGrid, PointMap, Trajectory
from pc2grid.submaps.junction_graph import GraphArrays, graph_from_arrays
from signature.boundary import boundary_bins
from signature.config import Config
from signature.database.document import SubmapArrays
from signature.database.protocol import SessionInfo
from signature.freespace import freespace_bins
from signature.seen_places import SIGNATURE_COLUMNS, SeenPlaces

# All chosen by hand: wide enough for every real session.
MOST_VOXELS = 1 << 21
"""Voxels along an axis; 104 km of 5 cm."""
EDGES_M = (1e-3, 100.0)
"""Least and largest edge of a cell or voxel."""
_ROUNDING = 1e-4
"""Largest deviation of R R^T from the identity, and of the sum of a histogram, which is float32, from 1."""


def check(part: str, value: Any, others: Mapping[str, Any]) -> None:
    """What must be true of a part of a session, beside the types of its fields.

    others : the parts that it is compared with: always the info, and the grid if that is known.
    """
    if part in _CHECKS:
        _CHECKS[part](value, others["info"], others.get("grid"))


def check_grid(grid: OccupancyGrid, info: SessionInfo, _: object = None) -> None:
    """The cells of a grid are unknown, or percents, and it lies at plausible coordinates."""
    _edge(grid.resolution_m)
    _near(np.array([grid.origin_m]), "corner")
    if grid.cells.size and (grid.cells.min() < -1 or grid.cells.max() > 100):
        raise ValueError("a cell outside -1..100")
    if grid.resolution_m != info.resolution_m:
        raise ValueError(f"resolution_m is {grid.resolution_m} where {info.resolution_m} was stored")


def check_trajectory(trajectory: Trajectory, info: SessionInfo, _: object = None) -> None:
    """Stamps do not decrease, and poses are rigid: an orthonormal rotation with determinant > 0, the last row
    of a pose, and a translation that is not too far."""
    stamps_ns, poses = trajectory.stamps_ns, trajectory.T_session_base
    _each(stamps_ns[1:] >= stamps_ns[:-1], "the stamp after {} is earlier")
    turns = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        rigid = (off <= _ROUNDING) & (np.linalg.det(turns) > 0) & (poses[:, 3] == np.eye(4)[3]).all(axis=1)
    _each(rigid, "pose {} is not rigid")
    _near(poses[:, :3, 3], "pose")
    _as_many(len(trajectory), info.scans, "poses")


def check_loops(loops: tuple[Loop, ...], info: SessionInfo, _: object = None) -> None:
    """Loops are between two of the poses."""
    between = [0 <= loop.older < loop.newer < info.scans for loop in loops]
    _each(np.array(between, bool), f"loop {{}} is not between two of {info.scans} poses")


def check_graph(graph: GraphArrays, _: SessionInfo, grid: OccupancyGrid | None) -> None:
    """A junction graph lies on its map."""
    graph_from_arrays(graph)
    _on_map(graph.center_m, grid, "node")


def check_points(points: PointMap | None, info: SessionInfo, _: object = None) -> None:
    """The voxels of points in space increase by x, then y, then z, none twice. None: there are no points."""
    _as_many(0 if points is None else len(points), info.points, "points")
    if points is None:
        return
    _edge(points.voxel_m)
    _near(points.origin_m[None], "origin")
    if len(points) and (points.steps.min() < 0 or points.steps.max() >= MOST_VOXELS * POINT_STEPS):
        raise ValueError(f"a voxel outside 0..{MOST_VOXELS}")
    x, y, z = (points.steps // POINT_STEPS).astype(np.int64).T
    code = (x << 42) + (y << 21) + z
    _each(code[1:] > code[:-1], "the voxel after {} is not after it")


def check_submaps(submaps: SubmapArrays, info: SessionInfo, grid: OccupancyGrid | None) -> None:
    """Submap ids increase, the submaps lie on their map, and their histograms have the sum 1, or 0."""
    _as_many(len(submaps), info.submaps, "submaps")
    _each(np.diff(submaps.submap_id, prepend=-1) > 0, "the number of submap {} does not increase")
    _on_map(submaps.center_m, grid, "submap")
    check_bins(submaps, info.provenance.config)
    for name in ("boundary", "freespace"):
        check_histograms(getattr(submaps, name), name)


def check_histograms(histograms: F32, what: str) -> None:
    """Histograms (N, K): no negative share, each row of sum 1, or all 0."""
    sums = histograms @ np.ones(histograms.shape[1], np.float32)
    _each((np.abs(sums - 1.0) <= _ROUNDING) | (sums == 0.0), f"{what} histogram {{}} does not have the sum 1")
    _each((histograms >= 0).all(axis=1), f"{what} histogram {{}} has a negative share")


def check_bins(submaps: SubmapArrays, config: Config) -> None:
    """Histograms have as many bins as the configuration makes; others cannot be compared with a query's."""
    radius_m, bins = config.partition.radius_m, (submaps.boundary.shape[1], submaps.freespace.shape[1])
    wanted = boundary_bins(radius_m, config.signature), freespace_bins(radius_m, config.signature)
    if len(submaps) and bins != wanted:
        raise ValueError(
            f"histograms of {bins[0]} and {bins[1]} bins where its settings make {wanted[0]} and {wanted[1]}"
        )


def check_seen(seen: SeenPlaces, info: SessionInfo, _: object = None) -> None:
    """What is seen from places has the columns that queries are compared by; each of the places has a
    viewpoint, and they are in order."""
    columns = seen.signatures.shape[1]
    if columns != SIGNATURE_COLUMNS:
        raise ValueError(f"signatures of {columns} columns; this version compares {SIGNATURE_COLUMNS}")
    _near(seen.at_m, "viewpoint")
    if not np.array_equal(np.unique(seen.place), np.arange(info.submaps)) or (np.diff(seen.place) < 0).any():
        raise ValueError(f"viewpoints that do not belong to {info.submaps} places, in their order")


_CHECKS: dict[str, Callable[[Any, SessionInfo, OccupancyGrid | None], None]] = {
    "grid": check_grid,
    "trajectory": check_trajectory,
    "loops": check_loops,
    "graph": check_graph,
    "points": check_points,
    "submaps": check_submaps,
    "seen": check_seen,
}


def _each(right: Any, what: str) -> None:
    """Raises ValueError with the number of the first of `right` (N,) that is false, in place of `{}`."""
    if not right.all():
        raise ValueError(what.format(int(right.argmin())))


def _edge(edge_m: float) -> None:
    low, high = EDGES_M
    if not low <= edge_m <= high:
        raise ValueError(f"cells of {edge_m:g} m instead of {low:g}..{high:g}")


def _near(points_m: F64 | F32, what: str) -> None:
    """Points (N, 2 or 3) are at plausible coordinates."""
    _each((np.abs(points_m) <= FARTHEST_M).all(axis=1), f"{what} {{}} is more than {FARTHEST_M:g} m away")


def _on_map(points_m: F64, grid: OccupancyGrid | None, what: str) -> None:
    """Points (N, 2) lie on a map, or within a cell of it."""
    if grid is None:
        return
    cell_m = grid.resolution_m
    low_m = np.array(grid.origin_m) - cell_m
    high_m = low_m + cell_m * np.array([grid.cells.shape[1] + 2, grid.cells.shape[0] + 2])
    inside = (points_m >= low_m) & (points_m <= high_m)
    _each(inside.all(axis=1), f"{what} {{}} lies outside its map")


def _as_many(found: int, stored: int, what: str) -> None:
    if found != stored:
        raise ValueError(f"{found} {what} where {stored} were stored")
