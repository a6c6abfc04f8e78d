"""Plausibility of the content of a row, which a checksum does not show: it shows only that nothing changed.

Each function raises ValueError that says what is wrong; the caller adds the row. Arrays are checked as a
whole: a million signatures take a fraction of a second.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pc2grid.arrays import F32, F64, I64, U8
from pc2grid.model import POINT_STEPS, OccupancyGrid, Submap

if TYPE_CHECKING:
    from pc2grid.submaps.junction_graph import GraphArrays
    from signature.config import Config

# All chosen by hand: wide enough for every real session.
RESOLUTION_M = (1e-3, 100.0)
"""Smallest and largest edge of a cell."""
MOST_VOXELS = 1 << 21
"""Voxels along an axis; 104 km of 5 cm."""
VOXEL_M = (1e-3, 10.0)
"""Smallest and largest edge of a voxel."""
FARTHEST_M = 1e8
"""Largest coordinate: two and a half times around the earth."""
MAX_RADIUS_M = 1e4
"""Largest radius of a submap."""
MOST = 1e15
"""Largest area in square metres, path in metres, or time in seconds."""
_MOST_INFORMATION = 1e15
"""Largest entry of an information matrix, in 1/m^2 or 1/rad^2: a standard deviation of 3e-8 m."""
_RIGID = 1e-4
"""Largest deviation of R R^T from the identity."""
_UNIT = 1e-3
"""Largest deviation of the sum of a histogram, which is stored as float32, from 1."""


class Sizes(NamedTuple):
    """Numbers of a session's trajectory and grid, which its submaps, loops and graph must fit."""

    scans: int
    height: int
    width: int
    resolution_m: float
    origin_x_m: float
    origin_y_m: float


def number(value: Any, what: str, low: float = -FARTHEST_M, high: float = FARTHEST_M) -> float:
    """The value if it is a number in low..high."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{what} is {_shown(value)} instead of a number in {low:g}..{high:g}")
    return value


def count(value: Any, what: str) -> int:
    """The value if it is a whole number from 0 on."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**63:
        raise ValueError(f"{what} is {_shown(value)} instead of a count")
    return value


def flag(value: Any, what: str) -> bool:
    """The value if it is true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{what} is {_shown(value)} instead of true or false")
    return value


def stamp(value: Any, what: str) -> int:
    """The value if it is a whole number that fits into int64, as a stamp in nanoseconds must."""
    if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
        raise ValueError(f"{what} is {_shown(value)} instead of a stamp")
    return value


def text(value: Any, what: str) -> str:
    """The value if it is text."""
    if not isinstance(value, str):
        raise ValueError(f"{what} is {_shown(value)} instead of text")
    return value


def _shown(value: Any) -> str:
    shown = repr(value) if isinstance(value, int | float | str | None) else f"of type {type(value).__name__}"
    return shown if len(shown) <= 40 else f"{shown[:40]}..."


def check_grid(grid: OccupancyGrid) -> None:
    """A grid has a plausible resolution and origin."""
    number(grid.resolution_m, "resolution_m", *RESOLUTION_M)
    for value in grid.origin_m:
        number(value, "origin_m")


def check_submap(submap: Submap, sizes: Sizes | None) -> None:
    """A submap lies around its centre, and on the grid it was cut from.

    sizes : of its session; None if they are not known.
    """
    count(submap.submap_id, "submap_id")
    number(submap.radius_m, "radius_m", 0.0, MAX_RADIUS_M)
    for value in submap.center_m:
        number(value, "center_m")
    grid = submap.grid
    if not _holds(grid.origin_m, grid.cells.shape, grid.resolution_m, submap.center_m):
        raise ValueError("its centre lies outside its own cells")
    if sizes is None:
        return
    if grid.resolution_m != sizes.resolution_m:
        raise ValueError(f"resolution_m is {grid.resolution_m:g} where its map has {sizes.resolution_m:g}")
    origin_m, shape = (sizes.origin_x_m, sizes.origin_y_m), (sizes.height, sizes.width)
    if not _holds(origin_m, shape, sizes.resolution_m, submap.center_m):
        raise ValueError("its centre lies outside its map")
    column, row = (
        round((mine - whole) / grid.resolution_m) for mine, whole in zip(grid.origin_m, origin_m, strict=True)
    )
    cells = grid.cells
    outside = (
        cells[: max(-row, 0)],
        cells[max(sizes.height - row, 0) :],
        cells[:, : max(-column, 0)],
        cells[:, max(sizes.width - column, 0) :],
    )
    if any((part >= 0).any() for part in outside):
        raise ValueError("it knows cells outside its map")


def _holds(
    origin_m: tuple[float, float],
    shape: tuple[int, ...],
    resolution_m: float,
    point_m: tuple[float, float],
) -> bool:
    """Whether a point lies on a grid, or within a cell of it."""
    return all(
        -1.0 <= (at - begin) / resolution_m <= cells + 1.0
        for at, begin, cells in zip(point_m, origin_m, reversed(shape), strict=True)
    )


def check_stamps(stamps_ns: I64) -> None:
    """Time stamps (N,) do not decrease."""
    back = stamps_ns[1:] < stamps_ns[:-1]
    if back.any():
        raise ValueError(f"stamp {int(back.argmax()) + 1} is earlier than the one before")


def check_poses(T_session_base: F64) -> None:
    """Poses (N, 4, 4) are rigid: an orthonormal rotation with determinant > 0, and a finite translation."""
    turns = T_session_base[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        rigid = (off <= _RIGID) & (np.linalg.det(turns) > 0)
    if not rigid.all():
        raise ValueError(f"pose {int(rigid.argmin())} is not rigid")
    far = (np.abs(T_session_base[:, :3, 3]) > FARTHEST_M).any(axis=1)
    if far.any():
        raise ValueError(f"pose {int(far.argmax())} is more than {FARTHEST_M:g} m away")


def check_loops(pairs: I64, measured: F64, information: F64, accepted: I64, scans: int | None) -> None:
    """Loops between existing poses: pairs (N, 2), measured (N, 3), information (N, 3, 3), accepted (N,).

    scans : how many poses the trajectory has; None if that is not known.
    """
    wrong = (pairs[:, 0] < 0) | (pairs[:, 0] >= pairs[:, 1])
    if scans is not None:
        wrong |= pairs[:, 1] >= scans
    if wrong.any():
        k = int(wrong.argmax())
        of = "" if scans is None else f" of {scans}"
        raise ValueError(f"loop {k} is between poses {pairs[k, 0]} and {pairs[k, 1]}{of}")
    far = (np.abs(measured[:, :2]) > FARTHEST_M).any(axis=1)
    if far.any():
        raise ValueError(f"loop {int(far.argmax())} measures more than {FARTHEST_M:g} m")
    if (accepted > 1).any():
        raise ValueError(f"loop {int((accepted > 1).argmax())} is neither accepted nor rejected")
    scale = np.abs(information).max(axis=(1, 2), initial=0.0)[:, None, None]
    odd = np.abs(information - information.transpose(0, 2, 1)) > 1e-6 * scale
    with np.errstate(over="ignore"):
        odd |= np.linalg.eigvalsh(information)[:, :1, None] < -1e-6 * scale
    odd |= scale > _MOST_INFORMATION
    if odd.any():
        k = int(odd.any(axis=(1, 2)).argmax())
        raise ValueError(f"loop {k} has an information that is no inverse covariance")


def check_graph(graph: GraphArrays, sizes: Sizes | None) -> None:
    """A junction graph lies on the map: nodes, and the points of the ways between them.

    What the arrays must fulfil among themselves is checked by `graph_from_arrays`.

    sizes : of the session; None if they are not known.
    """
    empty, long = graph.pixels < 1, graph.length_m > FARTHEST_M
    if empty.any():
        raise ValueError(f"node {int(empty.argmax())} has less than one pixel")
    if long.any():
        raise ValueError(f"edge {int(long.argmax())} is longer than {FARTHEST_M:g} m")
    if sizes is None:
        return
    cell_m = sizes.resolution_m
    low_m = np.array([sizes.origin_x_m, sizes.origin_y_m]) - cell_m
    high_m = low_m + cell_m * np.array([sizes.width + 2, sizes.height + 2])
    for name, points_m in (("node", graph.center_m), ("point", graph.path_m)):
        outside = ((points_m < low_m) | (points_m > high_m)).any(axis=1)
        if outside.any():
            raise ValueError(f"{name} {int(outside.argmax())} lies outside its map")


def check_voxels(indices: I64, within: U8, voxel_m: float) -> None:
    """Voxels (3, V) increase by x, then y, then z, none twice; points (3, V) lie within them."""
    if not indices.size:
        return
    if indices.min() < 0 or indices.max() >= MOST_VOXELS:
        raise ValueError(f"a voxel outside 0..{MOST_VOXELS}")
    code = (indices[0] << 42) + (indices[1] << 21) + indices[2]
    back = code[1:] <= code[:-1]
    if back.any():
        raise ValueError(f"voxel {int(back.argmax()) + 1} is not after the one before")
    if within.max() >= POINT_STEPS:
        raise ValueError("a point outside its voxel")


def check_histograms(histograms: F32, what: str) -> None:
    """Histograms (N, K): no negative share, each row of sum 1, or all 0. NaN and inf are refused."""
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


def check_described(submap_id: I64, center_m: F64, symmetry: F32) -> None:
    """Signatures have plausible submap ids (N,), centres (N, 2) and symmetry scores (N, 2)."""
    if symmetry.shape[1] != 2:
        raise ValueError(f"{symmetry.shape[1]} symmetry scores instead of 2")
    for wrong, what in (
        (submap_id < 0, "a negative submap_id"),
        (~(np.abs(center_m) <= FARTHEST_M).all(axis=1), f"a centre more than {FARTHEST_M:g} m away"),
        (~((symmetry >= 0) & (symmetry < np.inf)).all(axis=1), "a symmetry score below 0 or not finite"),
    ):
        if wrong.any():
            raise ValueError(f"signature {int(wrong.argmax())} has {what}")


def check_order(submap_id: I64) -> None:
    """Submap ids (N,) increase."""
    back = submap_id[1:] <= submap_id[:-1]
    if back.any():
        k = int(back.argmax())
        raise ValueError(f"submap {submap_id[k + 1]} comes after submap {submap_id[k]}")


def check_bins(boundary: int, freespace: int, config: Config) -> None:
    """Histograms have as many bins as the configuration makes; others cannot be compared with a query's."""
    from signature.boundary import boundary_bins
    from signature.freespace import freespace_bins

    radius_m = config.partition.radius_m
    wanted = boundary_bins(radius_m, config.signature), freespace_bins(radius_m, config.signature)
    if (boundary, freespace) != wanted:
        raise ValueError(
            f"histograms of {boundary} and {freespace} bins where its settings make"
            f" {wanted[0]} and {wanted[1]}"
        )
