"""Plausibility of stored content, which a checksum does not show: it shows only that nothing changed.

Each function raises ValueError that says what is wrong; the caller adds where. Arrays are checked as a
whole: a million signatures take a fraction of a second.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    from pc2grid.submaps.junction_graph import GraphArrays
    from signature.config import Config
    from signature.seen_places import SeenPlaces

# All chosen by hand: wide enough for every real session.
MOST_VOXELS = 1 << 21
"""Voxels along an axis; 104 km of 5 cm."""
MAX_GRAPH_POINTS = 10_000_000
"""Points of the largest junction graph; 260 times that of the map killian, 250 m x 200 m."""
MOST = 1e15
"""Largest area in square metres, path in metres, or time in seconds."""
_NOT_NEGATIVE, _SHARE = (0.0, MOST), (0.0, 1.0)
RANGES = {
    "resolution_m": (1e-3, 100.0),
    "voxel_m": (1e-3, 10.0),
    "sight_m": (1e-3, 1e4),
    **dict.fromkeys(("hits_on_free", "contradicted", "share"), _SHARE),
    **dict.fromkeys(("area_m2", "path_m", "duration_s", "length_m", "sigma_m"), _NOT_NEGATIVE),
    **dict.fromkeys(("distance_m", "turn_rad"), _NOT_NEGATIVE),
}
"""Least and largest value of a number, by the name of its field; of others, `FARTHEST_M` both ways."""
_MOST_INFORMATION = 1e15
"""Largest entry of an information matrix, in 1/m^2 or 1/rad^2: a standard deviation of 3e-8 m."""
_RIGID = 1e-4
"""Largest deviation of R R^T from the identity."""
_UNIT = 1e-3
"""Largest deviation of the sum of a histogram, which is stored as float32, from 1."""


def number(value: Any, name: str) -> float:
    """The value of a field if it is a number in its range."""
    low, high = RANGES.get(name, (-FARTHEST_M, FARTHEST_M))
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} is {shown(value)} instead of a number in {low:g}..{high:g}")
    return value


def count(value: Any, name: str) -> int:
    """The value if it is a whole number from 0 on."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**63:
        raise ValueError(f"{name} is {shown(value)} instead of a count")
    return value


def flag(value: Any, name: str) -> bool:
    """The value if it is true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} is {shown(value)} instead of true or false")
    return value


def stamp(value: Any, name: str) -> int:
    """The value if it is a whole number that fits into int64, as a stamp in nanoseconds must."""
    if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
        raise ValueError(f"{name} is {shown(value)} instead of a stamp")
    return value


def text(value: Any, name: str) -> str:
    """The value if it is text."""
    if not isinstance(value, str):
        raise ValueError(f"{name} is {shown(value)} instead of text")
    return value


def shown(value: Any) -> str:
    """A value for a message, never long."""
    short = repr(value) if isinstance(value, int | float | str | None) else f"of type {type(value).__name__}"
    return short if len(short) <= 40 else f"{short[:40]}..."


def check_grid(grid: OccupancyGrid) -> None:
    """The cells of a grid are unknown, or percents."""
    if grid.cells.size and (grid.cells.min() < -1 or grid.cells.max() > 100):
        raise ValueError("a cell outside -1..100")


def check_near(points_m: F64 | F32, what: str) -> None:
    """Points (N, 2 or 3) are at plausible coordinates."""
    far = (np.abs(points_m) > FARTHEST_M).any(axis=1)
    if far.any():
        raise ValueError(f"{what} {int(far.argmax())} is more than {FARTHEST_M:g} m away")


def check_on_map(points_m: F64 | F32, grid: OccupancyGrid, what: str) -> None:
    """Points (N, 2) lie on a map, or within a cell of it."""
    cell_m = grid.resolution_m
    low_m = np.array(grid.origin_m) - cell_m
    high_m = low_m + cell_m * np.array([grid.cells.shape[1] + 2, grid.cells.shape[0] + 2])
    outside = ~((points_m >= low_m) & (points_m <= high_m)).all(axis=1)
    if outside.any():
        raise ValueError(f"{what} {int(outside.argmax())} lies outside its map")


def check_trajectory(trajectory: Trajectory) -> None:
    """Stamps do not decrease, and poses are rigid: an orthonormal rotation with determinant > 0, the last row
    of a pose, and a translation that is not too far."""
    stamps_ns, poses = trajectory.stamps_ns, trajectory.T_session_base
    back = stamps_ns[1:] < stamps_ns[:-1]
    if back.any():
        raise ValueError(f"stamp {int(back.argmax()) + 1} is earlier than the one before")
    turns = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        rigid = (off <= _RIGID) & (np.linalg.det(turns) > 0) & (poses[:, 3] == np.eye(4)[3]).all(axis=1)
    if not rigid.all():
        raise ValueError(f"pose {int(rigid.argmin())} is not rigid")
    check_near(poses[:, :3, 3], "pose")


def check_loops(loops: tuple[Loop, ...], scans: int) -> None:
    """Loops are between two of so many poses, measure a plausible motion, and have an information matrix."""
    for k, loop in enumerate(loops):
        if not 0 <= loop.older < loop.newer < scans:
            raise ValueError(f"loop {k} is between poses {loop.older} and {loop.newer} of {scans}")
        if max(abs(loop.T_older_newer.x), abs(loop.T_older_newer.y)) > FARTHEST_M:
            raise ValueError(f"loop {k} measures more than {FARTHEST_M:g} m")
    information = np.array([loop.information for loop in loops]).reshape(-1, 3, 3)
    scale = np.abs(information).max(axis=(1, 2), initial=0.0)[:, None, None]
    odd = np.abs(information - information.transpose(0, 2, 1)) > 1e-6 * scale
    with np.errstate(over="ignore"):
        odd |= np.linalg.eigvalsh(information)[:, :1, None] < -1e-6 * scale
    odd |= scale > _MOST_INFORMATION
    if odd.any():
        k = int(odd.any(axis=(1, 2)).argmax())
        raise ValueError(f"loop {k} has an information that is no inverse covariance")


def check_graph(graph: GraphArrays, grid: OccupancyGrid | None) -> None:
    """A junction graph lies on its map: nodes, and the points of the ways between them.

    What the arrays must fulfil among themselves is checked by `graph_from_arrays`. grid : None if it is lost.
    """
    if len(graph.path_m) > MAX_GRAPH_POINTS:
        raise ValueError(f"a graph of {len(graph.path_m)} points, more than {MAX_GRAPH_POINTS}")
    empty, long = graph.pixels < 1, graph.length_m > FARTHEST_M
    if empty.any():
        raise ValueError(f"node {int(empty.argmax())} has less than one pixel")
    if long.any():
        raise ValueError(f"edge {int(long.argmax())} is longer than {FARTHEST_M:g} m")
    if grid is not None:
        check_on_map(graph.center_m, grid, "node")
        check_on_map(graph.path_m, grid, "point")


def check_points(points: PointMap | None) -> None:
    """The voxels of points in space increase by x, then y, then z, none twice. None: there are no points."""
    if points is None:
        return
    check_near(points.origin_m[None], "origin")
    x, y, z = (points.steps // POINT_STEPS).astype(np.int64).T
    if len(points) and (points.steps.min() < 0 or points.steps.max() >= MOST_VOXELS * POINT_STEPS):
        raise ValueError(f"a voxel outside 0..{MOST_VOXELS}")
    code = (x << 42) + (y << 21) + z
    back = code[1:] <= code[:-1]
    if back.any():
        raise ValueError(f"voxel {int(back.argmax()) + 1} is not after the one before")


def check_seen(seen: SeenPlaces, places: int) -> None:
    """What is seen from places has the columns that queries are compared by; each of the places has a
    viewpoint, and they are in order."""
    columns = seen.signatures.shape[1]
    if columns != SIGNATURE_COLUMNS:
        raise ValueError(f"signatures of {columns} columns")
    check_near(seen.at_m, "viewpoint")
    if not np.array_equal(np.unique(seen.place), np.arange(places)) or (np.diff(seen.place) < 0).any():
        raise ValueError(f"viewpoints that do not belong to {places} places, in their order")


def check_covariance(rows: Sequence[Sequence[float]]) -> None:
    """Rows of numbers are a covariance matrix."""
    covariance = np.array(rows)
    scale = float(np.abs(covariance).max())
    off = float(np.abs(covariance - covariance.T).max())
    if off > 1e-6 * scale or np.linalg.eigvalsh(covariance)[0] < -1e-6 * scale:
        raise ValueError("a covariance that is none")


def check_histograms(histograms: F32, what: str) -> None:
    """Histograms (N, K): no negative share, each row of sum 1, or all 0."""
    if not histograms.size:
        return
    sums = histograms @ np.ones(histograms.shape[1], np.float32)
    right = (np.abs(sums - 1.0) <= _UNIT) | (sums == 0.0)
    if not right.all():
        k = int(right.argmin())
        raise ValueError(f"{what} histogram {k} has sum {sums[k]:g} instead of 1")
    if not histograms.min() >= 0:
        k = int((histograms >= 0).all(axis=1).argmin())
        raise ValueError(f"{what} histogram {k} has a negative share")


def check_ids(submap_id: NDArray[np.int32]) -> None:
    """Submap ids (N,) are not negative and increase."""
    if len(submap_id) and submap_id[0] < 0:
        raise ValueError(f"submap_id is {submap_id[0]} instead of a count")
    back = submap_id[1:] <= submap_id[:-1]
    if back.any():
        k = int(back.argmax())
        raise ValueError(f"submap {submap_id[k + 1]} comes after submap {submap_id[k]}")


def check_bins(boundary: int, freespace: int, config: Config) -> None:
    """Histograms have as many bins as the configuration makes; others cannot be compared with a query's."""
    radius_m = config.partition.radius_m
    wanted = boundary_bins(radius_m, config.signature), freespace_bins(radius_m, config.signature)
    if (boundary, freespace) != wanted:
        raise ValueError(
            f"histograms of {boundary} and {freespace} bins where its settings make"
            f" {wanted[0]} and {wanted[1]}"
        )
