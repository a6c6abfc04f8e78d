"""Plausibility of stored content, which a checksum does not show: it shows only that nothing changed.

Each function raises ValueError that says what is wrong; the caller adds where. Arrays are checked as a
whole: a million signatures take a fraction of a second.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64
from pc2grid.io.messages.types import FARTHEST_M
from pc2grid.model import POINT_STEPS, Loop, OccupancyGrid, PointMap, Trajectory
from signature.boundary import boundary_bins
from signature.freespace import freespace_bins
from signature.seen_places import SIGNATURE_COLUMNS

if TYPE_CHECKING:
    from signature.config import Config
    from signature.seen_places import SeenPlaces

# All chosen by hand: wide enough for every real session.
MOST_VOXELS = 1 << 21
"""Voxels along an axis; 104 km of 5 cm."""
EDGES_M = (1e-3, 100.0)
"""Least and largest edge of a cell or voxel."""
_RIGID = 1e-4
"""Largest deviation of R R^T from the identity."""
_UNIT = 1e-3
"""Largest deviation of the sum of a histogram, which is stored as float32, from 1."""


def _each(right: Any, what: str) -> None:
    """Raises ValueError with the number of the first of `right` (N,) that is false, in place of `{}`."""
    if not right.all():
        raise ValueError(what.format(int(right.argmin())))


def check_edge(edge_m: float) -> None:
    """The edge of a cell or voxel is plausible."""
    low, high = EDGES_M
    if not low <= edge_m <= high:
        raise ValueError(f"cells of {edge_m:g} m instead of {low:g}..{high:g}")


def check_grid(grid: OccupancyGrid) -> None:
    """The cells of a grid are unknown, or percents, and it lies at plausible coordinates."""
    check_edge(grid.resolution_m)
    check_near(np.array([grid.origin_m]), "corner")
    if grid.cells.size and (grid.cells.min() < -1 or grid.cells.max() > 100):
        raise ValueError("a cell outside -1..100")


def check_near(points_m: F64 | F32, what: str) -> None:
    """Points (N, 2 or 3) are at plausible coordinates."""
    _each((np.abs(points_m) <= FARTHEST_M).all(axis=1), f"{what} {{}} is more than {FARTHEST_M:g} m away")


def check_on_map(points_m: F64 | F32, grid: OccupancyGrid, what: str) -> None:
    """Points (N, 2) lie on a map, or within a cell of it."""
    cell_m = grid.resolution_m
    low_m = np.array(grid.origin_m) - cell_m
    high_m = low_m + cell_m * np.array([grid.cells.shape[1] + 2, grid.cells.shape[0] + 2])
    inside = (points_m >= low_m) & (points_m <= high_m)
    _each(inside.all(axis=1), f"{what} {{}} lies outside its map")


def check_trajectory(trajectory: Trajectory) -> None:
    """Stamps do not decrease, and poses are rigid: an orthonormal rotation with determinant > 0, the last row
    of a pose, and a translation that is not too far."""
    stamps_ns, poses = trajectory.stamps_ns, trajectory.T_session_base
    _each(stamps_ns[1:] >= stamps_ns[:-1], "the stamp after {} is earlier")
    turns = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        rigid = (off <= _RIGID) & (np.linalg.det(turns) > 0) & (poses[:, 3] == np.eye(4)[3]).all(axis=1)
    _each(rigid, "pose {} is not rigid")
    check_near(poses[:, :3, 3], "pose")


def check_loops(loops: tuple[Loop, ...], scans: int) -> None:
    """Loops are between two of so many poses."""
    between = [0 <= loop.older < loop.newer < scans for loop in loops]
    _each(np.array(between, bool), f"loop {{}} is not between two of {scans} poses")


def check_points(points: PointMap | None) -> None:
    """The voxels of points in space increase by x, then y, then z, none twice. None: there are no points."""
    if points is None:
        return
    check_edge(points.voxel_m)
    check_near(points.origin_m[None], "origin")
    if len(points) and (points.steps.min() < 0 or points.steps.max() >= MOST_VOXELS * POINT_STEPS):
        raise ValueError(f"a voxel outside 0..{MOST_VOXELS}")
    x, y, z = (points.steps // POINT_STEPS).astype(np.int64).T
    code = (x << 42) + (y << 21) + z
    _each(code[1:] > code[:-1], "the voxel after {} is not after it")


def check_seen(seen: SeenPlaces, places: int) -> None:
    """What is seen from places has the columns that queries are compared by; each of the places has a
    viewpoint, and they are in order."""
    columns = seen.signatures.shape[1]
    if columns != SIGNATURE_COLUMNS:
        raise ValueError(f"signatures of {columns} columns")
    check_near(seen.at_m, "viewpoint")
    if not np.array_equal(np.unique(seen.place), np.arange(places)) or (np.diff(seen.place) < 0).any():
        raise ValueError(f"viewpoints that do not belong to {places} places, in their order")


def check_histograms(histograms: F32, what: str) -> None:
    """Histograms (N, K): no negative share, each row of sum 1, or all 0."""
    if not histograms.size:
        return
    sums = histograms @ np.ones(histograms.shape[1], np.float32)
    _each((np.abs(sums - 1.0) <= _UNIT) | (sums == 0.0), f"{what} histogram {{}} does not have the sum 1")
    _each((histograms >= 0).all(axis=1), f"{what} histogram {{}} has a negative share")


def check_ids(submap_id: NDArray[np.int32]) -> None:
    """Submap ids (N,) are not negative and increase."""
    _each(np.diff(submap_id, prepend=-1) > 0, "the number of submap {} does not increase")


def check_bins(boundary: int, freespace: int, config: Config) -> None:
    """Histograms have as many bins as the configuration makes; others cannot be compared with a query's."""
    radius_m = config.partition.radius_m
    wanted = boundary_bins(radius_m, config.signature), freespace_bins(radius_m, config.signature)
    if (boundary, freespace) != wanted:
        raise ValueError(
            f"histograms of {boundary} and {freespace} bins where its settings make"
            f" {wanted[0]} and {wanted[1]}"
        )
