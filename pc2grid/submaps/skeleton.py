"""From an area to its 1-pixel wide skeleton (paper III-A, III-B 2, III-C 1).

The paper names a thinning algorithm for each use but not which one; both classical parallel algorithms are
here. scikit-image's were compared on the five maps of Table I and not taken: `skeletonize` keeps up to twice
as many junction pixels as the rules that Zhang and Suen print (killian: 269 against 137, so more submaps
than Table I has) and needs 4 to 25 times as long; `thin` (Guo and Hall) needs 80 to 300 times as long.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64, BoolGrid

Thinning = Literal["guo_hall", "zhang_suen"]

# Neighbours clockwise from north: bit k of a code is neighbour k.
_NEIGHBOURS = [tuple((code >> k) & 1 for k in range(8)) for code in range(256)]


def _guo_hall(p: tuple[int, ...], half: int) -> bool:
    """Guo and Hall 1989: whether a pixel with neighbours p is deleted in this half of an iteration."""
    n, ne, e, se, s, sw, w, nw = p
    # Number of groups of connected neighbours.
    groups = ((1 - n) & (ne | e)) + ((1 - e) & (se | s)) + ((1 - s) & (sw | w)) + ((1 - w) & (nw | n))
    pairs = min((nw | n) + (ne | e) + (se | s) + (sw | w), (n | ne) + (e | se) + (s | sw) + (w | nw))
    side = (s | sw | (1 - nw)) & w if half == 0 else (n | ne | (1 - se)) & e
    return groups == 1 and 2 <= pairs <= 3 and not side


def _zhang_suen(p: tuple[int, ...], half: int) -> bool:
    """Zhang and Suen 1984: whether a pixel with neighbours p is deleted in this half of an iteration."""
    n, _, e, _, s, _, w, _ = p
    rises = _crossings(p)
    if half == 0:
        return rises == 1 and 2 <= sum(p) <= 6 and not n & e & s and not e & s & w
    return rises == 1 and 2 <= sum(p) <= 6 and not n & e & w and not n & s & w


def _crossings(p: tuple[int, ...]) -> int:
    """Number of changes from 0 to 1 around the ring of neighbours."""
    return sum(1 - p[k] and p[(k + 1) % 8] for k in range(8))


_DELETABLE: dict[str, NDArray[np.bool_]] = {
    name: np.array([[rule(p, half) for p in _NEIGHBOURS] for half in (0, 1)])
    for name, rule in (("guo_hall", _guo_hall), ("zhang_suen", _zhang_suen))
}
_JUNCTION = np.array([_crossings(p) >= 3 or sum(p[::2]) >= 3 for p in _NEIGHBOURS])
_END = np.array([sum(p) == 1 for p in _NEIGHBOURS])


def _neighbour_steps(width: int) -> I64:
    """From a pixel of an image, row by row, to its neighbours, in the order of the codes; (8,)."""
    return np.array([-width, 1 - width, 1, width + 1, width, width - 1, -1, -width - 1], np.int64)


def _codes(flat: NDArray[np.uint8], width: int, at: I64) -> NDArray[np.uint8]:
    """The eight neighbours of the pixels `at` (N,) as bits; the 0/1 image has a border of zeros."""
    neighbours = flat[at[:, None] + _neighbour_steps(width)]
    return np.packbits(neighbours, axis=1, bitorder="little").reshape(-1)


def thin(mask: BoolGrid, thinning: Thinning = "guo_hall") -> BoolGrid:
    """Reduce an area (H, W) to lines one pixel wide, with the same connections.

    guo_hall (default) leaves neither 2x2 blocks nor stairs on slanted lines, so that a line's pixels have
    two neighbours whatever its direction; zhang_suen leaves both, and erases slanted lines two pixels wide.
    """
    from pc2grid.submaps._kernels import thin_in_place

    image, border = _padded(mask)
    thin_in_place(image.reshape(-1), image.shape[1], border, _DELETABLE[thinning])
    return image[1:-1, 1:-1].view(np.bool_)


def _padded(mask: BoolGrid) -> tuple[NDArray[np.uint8], I64]:
    """The mask as a 0/1 image with a border of zeros, and the set pixels that have a zero neighbour."""
    image = np.zeros((mask.shape[0] + 2, mask.shape[1] + 2), np.uint8)
    image[1:-1, 1:-1] = mask
    inner = cv2.erode(image, np.ones((3, 3), np.uint8))
    return image, np.flatnonzero(image != inner)


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


def junctions_and_ends(skeleton: BoolGrid, pixels: I64) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of the skeleton's pixels (N, 2) are junctions, and which are ends of a branch; (N,) each.

    A junction (III-A) is a pixel where three or more branches meet; an end has one neighbour.
    """
    image = np.pad(skeleton, 1).view(np.uint8)
    codes = _codes(image.reshape(-1), image.shape[1], (pixels + 1) @ np.array([image.shape[1], 1]))
    return _JUNCTION[codes], _END[codes]


def pixel_steps(skeleton: BoolGrid) -> tuple[I64, I64, F64]:
    """The pixels of a skeleton and the steps between 8-neighbours.

    Returns the pixels (P, 2) as (row, column), row by row; the steps (S, 2) as pairs of pixel numbers; and
    the length (S,) of each step in cells, 1 or sqrt(2). A diagonal step is left out where two straight steps
    lead the same way, so that a corner does not become a triangle.
    """
    image = np.pad(skeleton, 1)
    width = image.shape[1]
    flat = image.reshape(-1)
    at = np.flatnonzero(flat)
    firsts, seconds, lengths = [], [], []
    for step, length in ((1, 1.0), (width, 1.0), (width - 1, 2**0.5), (width + 1, 2**0.5)):
        joined = flat[at + step]
        if length > 1.0:
            joined &= ~(flat[at + width] | flat[at + step - width])
        firsts.append(np.flatnonzero(joined))
        seconds.append(np.searchsorted(at, at[joined] + step))
        lengths.append(np.full(len(firsts[-1]), length))
    steps = np.column_stack((np.concatenate(firsts), np.concatenate(seconds)))
    return np.column_stack(np.divmod(at, width)) - 1, steps, np.concatenate(lengths)
