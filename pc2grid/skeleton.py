"""From an area to its 1-pixel wide skeleton (paper III-A, III-B 2, III-C 1).

The paper names a thinning algorithm for each use but not which; both classical parallel ones are here,
as look-up tables over the eight neighbours, run over work lists so that the time is linear in the area.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.model import I64, BoolGrid

if TYPE_CHECKING:
    import networkx as nx

Thinning = Literal["guo_hall", "zhang_suen"]

# Neighbours clockwise from north: bit k of a code is neighbour k.
_NEIGHBOURS = [tuple((code >> k) & 1 for k in range(8)) for code in range(256)]


def _guo_hall(p: tuple[int, ...], half: int) -> bool:
    """Guo and Hall 1989: may a pixel with neighbours p go in this half of an iteration?"""
    n, ne, e, se, s, sw, w, nw = p
    groups = (
        ((1 - n) & (ne | e)) + ((1 - e) & (se | s)) + ((1 - s) & (sw | w)) + ((1 - w) & (nw | n))
    )  # of connected neighbours
    pairs = min((nw | n) + (ne | e) + (se | s) + (sw | w), (n | ne) + (e | se) + (s | sw) + (w | nw))
    side = (s | sw | (1 - nw)) & w if half == 0 else (n | ne | (1 - se)) & e
    return groups == 1 and 2 <= pairs <= 3 and not side


def _zhang_suen(p: tuple[int, ...], half: int) -> bool:
    """Zhang and Suen 1984, same question."""
    n, _, e, _, s, _, w, _ = p
    rises = _crossings(p)
    if half == 0:
        return rises == 1 and 2 <= sum(p) <= 6 and not n & e & s and not e & s & w
    return rises == 1 and 2 <= sum(p) <= 6 and not n & e & w and not n & s & w


def _crossings(p: tuple[int, ...]) -> int:
    """How often the ring of neighbours rises from 0 to 1."""
    return sum(1 - p[k] and p[(k + 1) % 8] for k in range(8))


_DELETABLE: dict[str, NDArray[np.bool_]] = {
    name: np.array([[rule(p, half) for p in _NEIGHBOURS] for half in (0, 1)])
    for name, rule in (("guo_hall", _guo_hall), ("zhang_suen", _zhang_suen))
}
_JUNCTION = np.array([_crossings(p) >= 3 or sum(p[::2]) >= 3 for p in _NEIGHBOURS])
_END = np.array([sum(p) == 1 for p in _NEIGHBOURS])


@numba.njit(cache=True)
def _codes(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The eight neighbours of every pixel as bits; image 0/1 with a border of zeros."""
    height, width = image.shape
    codes = np.zeros((height, width), np.uint8)
    inner = width - 2
    for r in range(1, height - 1):
        above, here, below, out = image[r - 1], image[r], image[r + 1], codes[r]
        for c in range(inner):
            out[c + 1] = (
                above[c + 1]
                | (above[c + 2] << 1)
                | (here[c + 2] << 2)
                | (below[c + 2] << 3)
                | (below[c + 1] << 4)
                | (below[c] << 5)
                | (here[c] << 6)
                | (above[c] << 7)
            )
    return codes


@numba.njit(cache=True)
def _thin(image: NDArray[np.uint8], deletable: NDArray[np.bool_]) -> None:
    """Thin a 0/1 image with a border of zeros in place.

    Whether a pixel goes depends on its neighbours alone, so it is looked at again only after one of them
    went: `pending` says in how many halves of an iteration it still has to be, and `waiting` lists the pixels
    with something pending. All that go in one half go together, as the parallel algorithm has it.
    """
    height, width = image.shape
    codes = _codes(image).reshape(-1)
    flat = image.reshape(-1)
    pending = np.zeros(height * width, np.uint8)
    most = 0
    for i in range(len(flat)):
        most += flat[i]
        pending[i] = np.uint8(2) if (flat[i] != 0) & (codes[i] != 255) else np.uint8(0)
    # One more than there are pixels: what is written behind the last does not count.
    waiting, gone = np.empty(most + 1, np.int32), np.empty(most, np.int32)
    # Seen from a neighbour in direction k, the pixel itself lies in direction k + 4.
    steps = np.array([-width, 1 - width, 1, width + 1, width, width - 1, -1, -width - 1])
    keep = np.array([255 - (1 << ((k + 4) % 8)) for k in range(8)], np.uint8)
    count = 0
    for i in range(width, (height - 1) * width):
        waiting[count] = i
        count += pending[i] >> 1
    half = 0
    while count > 0:
        left, losses = 0, 0
        for k in range(count):
            i = waiting[k]
            if deletable[half, codes[i]]:
                pending[i] = 0
                gone[losses] = i
                losses += 1
            else:
                pending[i] -= 1
                waiting[left] = i
                left += pending[i]
        count = left
        for k in range(losses):
            flat[gone[k]] = 0
        for k in range(losses):
            i = gone[k]
            for n in range(8):
                j = i + steps[n]
                codes[j] &= keep[n]
                # By arithmetic: which neighbours wait already is as good as random, a wrong guess costs more.
                waiting[count] = j
                count += int((flat[j] != 0) & (pending[j] == 0))
                pending[j] = 2 * flat[j]
        half = 1 - half


def thin(mask: BoolGrid, thinning: Thinning = "guo_hall") -> BoolGrid:
    """Reduce an area (H, W) to lines one pixel wide, with the same connections.

    guo_hall (default) leaves neither 2x2 blocks nor stairs on slanted lines, so that a line's pixels have
    two neighbours whatever its direction; zhang_suen leaves both, and erases slanted lines two pixels wide.
    """
    padded = np.zeros((mask.shape[0] + 2, mask.shape[1] + 2), np.uint8)
    padded[1:-1, 1:-1] = mask
    _thin(padded, _DELETABLE[thinning])
    return padded[1:-1, 1:-1].view(np.bool_)


def clearance_of(free: BoolGrid, resolution_m: float) -> NDArray[np.float32]:
    """Distance (H, W) in metres from every free cell's centre to the nearest cell that is not free.

    What lies outside the array is not free. Precise to about 2 % (5x5 chamfer distance).
    """
    padded = np.zeros((free.shape[0] + 2, free.shape[1] + 2), np.uint8)
    padded[1:-1, 1:-1] = free
    distance_m = np.asarray(cv2.distanceTransform(padded, cv2.DIST_L2, 5), np.float32)
    distance_m *= np.float32(resolution_m)
    return distance_m[1:-1, 1:-1]


def skeleton_of(
    free: BoolGrid, resolution_m: float, clearance_m: float, thinning: Thinning = "guo_hall"
) -> BoolGrid:
    """The middle lines of free space: distance transform, erosion by `clearance_m`, thinning (III-A).

    free : (H, W) cells known to be free. Returns (H, W).
    """
    if not free.any():
        return np.zeros(free.shape, np.bool_)
    return thin(clearance_of(free, resolution_m) > clearance_m, thinning)


def _pixels_like(skeleton: BoolGrid, table: NDArray[np.bool_]) -> BoolGrid:
    codes = _codes(np.pad(skeleton, 1).view(np.uint8))[1:-1, 1:-1]
    return np.asarray(skeleton & table[codes])


def junctions(skeleton: BoolGrid) -> BoolGrid:
    """Junction test (III-A): skeleton pixels where three or more branches meet."""
    return _pixels_like(skeleton, _JUNCTION)


def ends(skeleton: BoolGrid) -> BoolGrid:
    """Skeleton pixels where a branch ends."""
    return _pixels_like(skeleton, _END)


def pixel_graph(skeleton: BoolGrid, resolution_m: float) -> nx.Graph:
    """The skeleton as a graph: a node (row, column) a pixel, an edge between 8-neighbours.

    Edges carry `length_m`. A diagonal step is left out where two straight steps lead the same way, so that
    a corner does not become a triangle.
    """
    import networkx as nx

    graph = nx.Graph()
    rows, columns = (axis.tolist() for axis in np.nonzero(skeleton))
    pixels = set(zip(rows, columns, strict=True))
    graph.add_nodes_from(zip(rows, columns, strict=True))
    for r, c in pixels:
        for dr, dc in ((0, 1), (1, 0)):
            if (r + dr, c + dc) in pixels:
                graph.add_edge((r, c), (r + dr, c + dc), length_m=resolution_m)
        for dc in (-1, 1):
            corner = (r + 1, c) in pixels or (r, c + dc) in pixels
            if (r + 1, c + dc) in pixels and not corner:
                graph.add_edge((r, c), (r + 1, c + dc), length_m=resolution_m * 2**0.5)
    return graph


def cells_of(mask: BoolGrid) -> I64:
    """Set cells (N, 2) of a mask as (row, column), row by row: `np.argwhere`, many times as fast."""
    flat = np.ascontiguousarray(mask).reshape(-1).view(np.uint8)
    eights = flat[: len(flat) // 8 * 8].view(np.uint64)
    return _set_cells(flat, eights, max(mask.shape[1], 1), int(np.count_nonzero(mask)))


@numba.njit(cache=True)
def _set_cells(flat: NDArray[np.uint8], eights: NDArray[np.uint64], width: int, count: int) -> I64:
    """Where a mask of 0 and 1, row by row, is set; seen eight cells at a time, as most are not."""
    cells = np.empty((count, 2), np.int64)
    n = 0
    for k in range(len(eights) + 1):
        if k < len(eights) and eights[k] == 0:
            continue
        for i in range(8 * k, min(8 * k + 8, len(flat))):
            if flat[i]:
                cells[n, 0], cells[n, 1] = i // width, i % width
                n += 1
    return cells


@numba.njit(cache=True)
def sample_evenly(cells: I64, spacing_cells: float) -> I64:
    """Thin out cells (N, 2) until no two are closer than `spacing_cells`; returns (M, 2), M <= N.

    Greedy in the given order; every cell left out lies closer than the spacing to one that is kept.
    """
    if len(cells) == 0:
        return cells.copy()
    rows, columns = cells[:, 0], cells[:, 1]
    reach = int(np.ceil(spacing_cells))
    r0, c0 = rows.min(), columns.min()
    taken = np.zeros((rows.max() - r0 + 2 * reach + 1, columns.max() - c0 + 2 * reach + 1), np.uint8)
    kept = np.empty_like(cells)
    count = 0
    limit = spacing_cells * spacing_cells - 1e-9
    # Half the width of the disc in each of its rows.
    widths = np.empty(2 * reach + 1, np.int64)
    for dr in range(-reach, reach + 1):
        width = -1
        while width < reach and dr * dr + (width + 1) ** 2 < limit:
            width += 1
        widths[dr + reach] = width
    for k in range(len(cells)):
        r, c = rows[k] - r0 + reach, columns[k] - c0 + reach
        if taken[r, c]:
            continue
        kept[count, 0] = rows[k]
        kept[count, 1] = columns[k]
        count += 1
        for dr in range(-reach, reach + 1):
            width = widths[dr + reach]
            for dc in range(-width, width + 1):
                taken[r + dr, c + dc] = 1
    return kept[:count].copy()
